"""Small recordings as runs leave them, for the tests of index and service."""

from __future__ import annotations

from pathlib import Path

from record_kit import CHANNELS, RATE, STOP, block

from samii_rig.record.writer import Origin, RunWriter
from samii_rig.types import StopRecord


def write_small(path: Path, *, stop: StopRecord = STOP, rig: str = "SAMII", **notes: str) -> Path:
    """A recording of thirty samples with these notes."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with RunWriter(path, CHANNELS, RATE, Origin(f'name = "{rig}"\n', metadata=notes)) as writer:
        writer.write(block(0, 30))
        writer.close(stop)
    return path


def lab(folder: Path) -> None:
    """Three recordings of a small lab."""
    write_small(
        folder / "a.mcap",
        experiment="swept_sine",
        operator="Ada",
        started="2026-03-01T09:00:00+01:00",
    )
    write_small(
        folder / "march" / "b.mcap",
        experiment="multisine",
        operator="Bo",
        started="2026-03-05T12:00:00+00:00",
        stop=StopRecord("tripped", "a_tip over its limit"),
    )
    write_small(
        folder / "c.mcap",
        rig="SFLR",
        experiment="swept_sine",
        operator="Ada",
        started="2026-04-01T12:00:00+00:00",
    )
