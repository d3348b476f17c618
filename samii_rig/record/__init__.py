"""Recordings: one MCAP file a run, written, read, recovered, verified, imported, exported."""
