"""The simulated rig, which stands in for the hardware behind the same Protocols."""
