"""Write a recording that is in memory, whole, as an imported one is."""

from __future__ import annotations

from pathlib import Path

from samii_rig.record.writer import Origin, RunWriter
from samii_rig.types import Recording, SampleBlock


def write_recording(path: Path, recording: Recording) -> None:
    """Write `recording` to `path`; RecordingError if that exists or cannot be written."""
    with RunWriter(
        path,
        recording.channels,
        recording.rate_hz,
        Origin(recording.rig_toml, recording.experiment_toml, recording.metadata),
        clock_offset=recording.clock_offset,
        keep_partial=False,
    ) as writer:
        writer.write(
            SampleBlock(
                recording.channels,
                recording.time,
                recording.sequence,
                recording.values,
                recording.quality,
            )
        )
        for segment in recording.segments:
            writer.segment(segment)
        writer.close(recording.stop)
