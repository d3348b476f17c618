"""Whether the disk has room for the recording of a plan, looked at before anything moves."""

from __future__ import annotations

import math
import shutil
from collections.abc import Sequence
from pathlib import Path

from samii_rig.errors import DiskError
from samii_rig.record.appender import INDEX_BYTES
from samii_rig.record.layout import SampleLayout
from samii_rig.rig.schema import Rig
from samii_rig.run.plan import Plan
from samii_rig.types import Channel

REFERENCES = 2  # columns beside the device's own, of each actuator: u and theta_ref
# bytes for what is no sample: rig and experiment file, events, summary, and the last 0.4 s
BESIDE = 1_000_000


def recording_bytes(plan: Plan, rig: Rig) -> int:
    """Most bytes that the recording of a plan takes on the disk: noise does not pack, and every
    dwell may need its full time."""
    columns = len(rig.units()) + REFERENCES * len(rig.actuator)
    layout = SampleLayout((Channel("", "", "sensor"),) * columns, plan.rate_hz)
    return math.ceil(plan.duration * plan.rate_hz) * (layout.record.itemsize + INDEX_BYTES) + BESIDE


def refuse_full(path: Path, needed: int) -> None:
    """DiskError unless `needed` bytes are free where `path` is to be written."""
    folder = next((p for p in path.absolute().parents if p.is_dir()), None)
    if folder is None:
        return  # making the folder says what is wrong
    disk = shutil.disk_usage(folder)
    # Some file systems know no size: they say 0 of 0.
    if disk.total and disk.free < needed:
        raise DiskError(
            f"{folder} has {disk.free / 1e6:.1f} MB free; expected {math.ceil(needed / 1e6)} MB, "
            "the most that the recording can take"
        )


def room_for(path: Path, plans: Sequence[Plan], rigs: Sequence[Rig]) -> None:
    """DiskError unless the recordings of all runs of an experiment fit beside each other."""
    refuse_full(path, sum(recording_bytes(p, r) for p, r in zip(plans, rigs, strict=True)))
