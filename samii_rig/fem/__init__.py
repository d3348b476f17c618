"""Finite elements of a rig: a second model, independent of the transfer matrices."""
