"""What may be missing: every effect, the table of them, and the rig with effects in it."""
