"""A quadrature counter on a serial port; see docs/reference/quadrature.md."""

from drivers.quadrature.device import open_rig
from drivers.sensing import only_measures as check_rig

__all__ = ["check_rig", "open_rig"]
