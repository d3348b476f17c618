"""The rig file: chain, channels, limits, tolerances, units."""
