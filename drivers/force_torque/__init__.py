"""A six-axis force/torque sensor on a CAN bus; see docs/force-torque.md."""

from drivers.force_torque.device import open_rig

__all__ = ["open_rig"]
