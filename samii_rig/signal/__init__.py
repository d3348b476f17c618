"""Excitations, and frequency responses with what is known of their error."""
