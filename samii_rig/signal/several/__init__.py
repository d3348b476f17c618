"""Frequency responses of several inputs: from experiments one after the other, or together."""
