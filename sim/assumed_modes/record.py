"""Recordings of a trial in the project's own format, with the faults of the one who logged them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from samii_rig.record.writer import RunWriter
from samii_rig.rig.schema import Rig
from samii_rig.types import Channel, Flags, Float, Quality, SampleBlock, Segment, StopRecord
from sim.assumed_modes.styles import Piece, Style

LEAD = 0.2  # s of rest before the first segment and after the last
# s since the epoch of every trial's first file: no clock of the machine shows in a trial.
STARTED = "2026-01-01T00:00:00+00:00"
VOLTMETER_NOISE = 2e-4  # of the actuator's range, rms
VOLTMETER_STEPS = 2**16  # over that range


@dataclass(frozen=True, slots=True)
class Faults:
    """What the logger did. shift : samples by which the sensors' columns lag those of the input.
    gaps : (first, length) of recorded samples that are lost."""

    shift: int
    gaps: tuple[tuple[int, int], ...]


@dataclass(frozen=True, slots=True)
class Log:
    """What a file holds. values (n, n_channels), without the faults of the logger; notes : more
    metadata."""

    values: Float
    segments: list[Segment]
    faults: Faults
    notes: Mapping[str, str] = field(default_factory=dict)


def draw_faults(rng: np.random.Generator, style: Style, n: int) -> Faults:
    """Faults of recordings of about `n` samples."""
    shift = int(rng.choice([-2, -1, 1, 2, 3])) if "shifted" in style.options else 0
    gaps = [
        (int(rng.integers(n // 20, n - n // 20)), int(np.exp(rng.uniform(0.7, 5.3))))
        for _ in range(int(rng.integers(1, 5)))
    ]
    return Faults(shift, tuple(sorted(gaps)) if "gaps" in style.options else ())


def reference(pieces: tuple[Piece, ...], level: float, style: Style) -> tuple[Float, list[Segment]]:
    """The reference of a file at the loop's rate, and its segments in recorded samples."""
    lead = round(LEAD * style.rate_hz / style.every) * style.every
    parts, segments, at = [np.zeros(lead)], [], lead
    for p in pieces:
        parts.append(level * p.level * p.r)
        start, stop = at + p.skip, at + len(p.r)
        at = stop
        segments.append(
            Segment(
                p.name, p.kind, -(-start // style.every), -(-stop // style.every),
                level * p.level, "", p.repeat,
            )
        )  # fmt: skip
    # Where the record ends with its excitation, nothing follows.
    if pieces[-1].kind in ("burst", "transient"):
        parts.append(np.zeros(lead))
    return np.concatenate(parts), segments


def channels_of(rig: Rig, style: Style) -> tuple[Channel, ...]:
    """The columns of a recording, in the order in which a run has them."""
    a = rig.actuator[0]
    measured = "measured" in style.options
    angle = rig.units()[rig.centring.sensor] if rig.centring else "1"
    references = (
        Channel("u", a.unit, "reference", description="reference of the excitation"),
        Channel("theta_ref", angle, "reference", description="reference of the centring"),
    )
    resolution = (a.high - a.low) / VOLTMETER_STEPS if measured else a.resolution
    how = "input as a voltmeter shows it, not held" if measured else "output as held"
    command = Channel(a.name, a.unit, "command", a.low, a.high, resolution, how)
    sensors = tuple(
        Channel(s.name, s.unit, "sensor", s.low, s.high, s.resolution, s.calibration)
        for s in rig.sensor
    )
    return (*(() if "no_reference" in style.options else references), command, *sensors)


def columns(
    rig: Rig, style: Style, u: Float, v: Float, y: Float, rng: np.random.Generator
) -> Float:
    """(n, n_channels) recorded values from the loop's u (m,), v (m,) and y (m, n_y)."""
    every, a = style.every, rig.actuator[0]
    shown = v[::every]
    if "measured" in style.options:
        # Mean of both sides of the sample's instant: a voltmeter sees no edge.
        before = np.concatenate([[v[0]], v[:-1]])[::every]
        step = (a.high - a.low) / VOLTMETER_STEPS
        noise = VOLTMETER_NOISE * (a.high - a.low) * rng.standard_normal(shown.size)
        shown = np.rint((0.5 * (shown + before) + noise) / step) * step
    out = [u[::every], np.zeros(shown.size)] if "no_reference" not in style.options else []
    return np.column_stack([*out, shown, y[::every]])


def write(
    path: Path,
    rig: Rig,
    rig_toml: str,
    style: Style,
    kp: float,
    log: Log,
) -> None:
    """One file."""
    values, segments, faults = log.values, log.segments, log.faults
    channels = channels_of(rig, style)
    rate = style.rate_hz / style.every
    n_sensor = len(rig.sensor)
    if faults.shift:
        values = values.copy()
        values[:, -n_sensor:] = np.roll(values[:, -n_sensor:], faults.shift, axis=0)
        ends = slice(max(faults.shift, 0), len(values) + min(faults.shift, 0))
    else:
        ends = slice(0, len(values))
    sequence = np.arange(len(values), dtype=np.int64)
    kept = np.zeros(len(values), dtype=bool)
    kept[ends] = True
    for first, length in faults.gaps:
        kept[first : first + length] = False
    quality: Flags = np.zeros(values.shape, dtype=np.uint8)
    low, high = np.array([c.low for c in channels]), np.array([c.high for c in channels])
    quality[(values <= low) | (values >= high)] = int(Quality.CLIPPED)
    lost = int(len(values) - kept.sum())
    block = SampleBlock(
        channels, np.rint(sequence[kept] * 1e9 / rate).astype(np.int64), sequence[kept],
        values[kept], quality[kept],
    )  # fmt: skip
    notes = {"experiment": style.excitation, "operator": "", "started": STARTED, **log.notes}
    if rig.centring:
        notes["centring"] = f"{rig.centring.sensor} {kp}"
    with RunWriter(path, channels, rate, rig_toml=rig_toml, metadata=notes) as writer:
        writer.write(block)
        unit = rig.actuator[0].unit
        for s in segments:
            stop = min(s.stop, int(sequence[kept][-1]) + 1)
            writer.segment(Segment(s.name, s.kind, s.start, stop, s.level, unit, s.repeat))
        writer.close(StopRecord("completed", f"all {len(segments)} segments done", 0, lost))
