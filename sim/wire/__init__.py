"""The simulated rig in a process of its own, behind the bytes that a real one would speak."""
