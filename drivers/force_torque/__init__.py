"""A six-axis force/torque sensor on a CAN bus; see docs/reference/force-torque.md."""

from drivers.force_torque.device import open_rig
from drivers.sensing import only_measures as check_rig

__all__ = ["check_rig", "open_rig"]
