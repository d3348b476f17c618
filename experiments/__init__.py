"""What is run on a rig: one file an experiment, found by name through entry points."""
