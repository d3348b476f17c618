"""A National Instruments board, through NI-DAQmx; see docs/ni-daq.md."""

from drivers.ni_daq.rig import NiRig, open_rig

__all__ = ["NiRig", "open_rig"]
