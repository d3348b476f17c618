"""Several devices as one; see docs/composite.md."""

from drivers.composite.rig import open_rig

__all__ = ["open_rig"]
