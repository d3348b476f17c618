"""What the tests of recordings share: small runs with gaps, results and events."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from samii_rig.record.writer import Origin, RunWriter
from samii_rig.types import (
    Channel,
    Finding,
    FrequencyResponse,
    Quality,
    SampleBlock,
    Segment,
    StopRecord,
)

CHANNELS = (
    Channel("u", "V", "reference"),
    Channel("v", "V", "command", -10.0, 10.0, 20 / 65536, "what went out"),
    Channel("theta", "rad"),
)
RATE = 500.0
# ns by which the wall clock of these runs is ahead of their device's: 2026-11-23 14:00 UTC.
WALL = 1_795_442_400 * 10**9
RIG = 'name = "test"\n'
EXPERIMENT = 'name = "swept sine"\n'
NOTES = {"seed": "7", "operator": "Ångström"}
SEGMENT = Segment("sweep 1", "burst", 0, 100, 0.5, "V")
STOP = StopRecord("completed", "all segments done", late_ticks=2, missing_samples=10)


def block(start: int, rows: int, channels: tuple[Channel, ...] = CHANNELS) -> SampleBlock:
    """Samples start, start + 1, ... of a signal that says by its value where it belongs."""
    sequence = np.arange(start, start + rows)
    rng = np.random.default_rng(start)
    values = rng.standard_normal((rows, len(channels)))
    quality = np.zeros((rows, len(channels)), np.uint8)
    if rows:
        values[0, -1] = np.nan
        quality[0, -1] = Quality.MISSING
        quality[-1, 0] = Quality.CLIPPED | Quality.LIMITED
    return SampleBlock(channels, 10**9 + sequence * 2_000_000, sequence, values, quality)


def blocks(count: int = 4, rows: int = 30) -> list[SampleBlock]:
    """`count` blocks; ten samples are lost before the last one."""
    starts = [i * rows for i in range(count)]
    starts[-1] += 10
    return [block(start, rows) for start in starts]


def response(level: float = 0.5, n: int = 7) -> FrequencyResponse:
    """A result with 2 outputs and 1 input, its covariance not diagonal."""
    rng = np.random.default_rng(3)

    def noise(*shape: int) -> np.ndarray:
        return rng.standard_normal(shape) + 1j * rng.standard_normal(shape)

    half = noise(n, 2, 2)
    return FrequencyResponse(
        frequency=np.linspace(1, 20, n),
        H=noise(n, 2, 1),
        covariance=half @ half.conj().transpose(0, 2, 1),
        dof=np.full(n, 11.0),
        coherence=rng.uniform(size=(n, 2)),
        inputs=CHANNELS[1:2],
        outputs=(CHANNELS[2], Channel("a", "m/s^2")),
        level=level,
        level_unit="V",
        input_rms=rng.uniform(size=(n, 1)),
        rate_hz=RATE,
        n_averages=3,
        method="periodic",
        why="three repeats of one reference",
        odd=rng.uniform(size=(n, 2)),
        findings=(Finding("gap", "warning", "ten samples lost", segment="sweep 1"),),
        sources=("run.mcap",),
    )


def write_run(path: Path, parts: list[SampleBlock], *, compression: str = "lz4") -> None:
    """A whole run: each block a chunk of its own, an event, a segment, two results."""
    writer = RunWriter(
        path,
        parts[0].channels if parts else CHANNELS,
        RATE,
        Origin(RIG, EXPERIMENT, NOTES),
        clock_offset=WALL,
        compression=compression,  # type: ignore[arg-type]  # parametrised with its values
    )
    with writer:
        writer.event(10**9, "armed", {"by": "test"})
        for part in parts:
            writer.write(part)
            writer.flush()
        writer.segment(SEGMENT)
        writer.frequency_response(response(0.5))
        writer.frequency_response(response(1.0))
        writer.close(STOP)


def joined(parts: list[SampleBlock]) -> tuple[np.ndarray, ...]:
    """time, sequence, values, quality of all blocks."""
    return (
        np.concatenate([p.time for p in parts]),
        np.concatenate([p.sequence for p in parts]),
        np.concatenate([p.values for p in parts]),
        np.concatenate([p.quality for p in parts]),
    )
