"""The transfer matrix model of a rig."""
