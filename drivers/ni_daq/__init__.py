"""A National Instruments board, through NI-DAQmx; see docs/reference/ni-daq.md."""

from drivers.ni_daq.rig import NiRig, open_rig
from drivers.ni_daq.settings import check_rig

__all__ = ["NiRig", "check_rig", "open_rig"]
