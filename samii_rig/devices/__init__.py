"""What a device promises, how it is opened and checked, and its time held against the host's."""
