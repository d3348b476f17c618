"""Real devices and buses, one file each, found by name through entry points."""
