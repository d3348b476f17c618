"""Several devices as one; see docs/reference/composite.md."""

from drivers.composite.rig import check_rig, open_rig

__all__ = ["check_rig", "open_rig"]
