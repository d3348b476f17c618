"""Driving a rig: devices' Protocols, clocks, the safety gate, the loop, plans and dry runs."""
