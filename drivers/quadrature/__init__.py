"""A quadrature counter on a serial port; see docs/quadrature.md."""

from drivers.quadrature.device import open_rig

__all__ = ["open_rig"]
