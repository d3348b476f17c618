"""Recordings of a trial in the project's own format, with the faults of the one who logged them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from samii_rig.devices.channels import command_channel, reference_channels
from samii_rig.record.writer import Origin, RunWriter
from samii_rig.rig.schema import ActuatorSpec, Rig
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


def reference(
    pieces: tuple[Piece, ...], level: float, style: Style, drives: Sequence[str]
) -> tuple[Float, list[Segment]]:
    """The references (n, n_in) of a file at the loop's rate, and its segments in recorded samples.

    drives : names of the inputs.
    """
    lead = round(LEAD * style.rate_hz / style.every) * style.every
    parts, segments, at = [np.zeros((lead, len(drives)))], [], lead
    for p in pieces:
        parts.append(level * p.level * p.r)
        start, stop = at + p.skip, at + len(p.r)
        at = stop
        segments.append(
            Segment(
                p.name, p.kind, -(-start // style.every), -(-stop // style.every),
                level * p.level, "", p.repeat, tuple(drives[i] for i in p.driven),
            )
        )  # fmt: skip
    # Where the record ends with its excitation, nothing follows.
    if pieces[-1].kind in ("burst", "transient"):
        parts.append(np.zeros((lead, len(drives))))
    return np.concatenate(parts), segments


def channels_of(rig: Rig, style: Style) -> tuple[Channel, ...]:
    """The columns of a recording, in the order in which a run has them."""
    measured = "measured" in style.options
    how = "input as a voltmeter shows it, not held" if measured else "output as held"
    commands = [
        command_channel(a, _voltmeter_step(a) if measured else a.resolution, how)
        for a in rig.actuator
    ]
    sensors = tuple(
        Channel(s.name, s.unit, "sensor", s.low, s.high, s.resolution, s.calibration)
        for s in rig.sensor
    )
    references = () if "no_reference" in style.options else reference_channels(rig)
    return (*references, *commands, *sensors)


def _voltmeter_step(a: ActuatorSpec) -> float:
    return (a.high - a.low) / VOLTMETER_STEPS


def columns(
    rig: Rig, style: Style, u: Float, v: Float, y: Float, rng: np.random.Generator
) -> Float:
    """(n, n_channels) recorded values from the loops' u (m, n_in), v (m, n_in), y (m, n_y)."""
    every = style.every
    shown = v[::every]
    if "measured" in style.options:
        # Mean of both sides of the sample's instant: a voltmeter sees no edge.
        before = np.concatenate([v[:1], v[:-1]])[::every]
        step = np.array([_voltmeter_step(a) for a in rig.actuator])
        noise = VOLTMETER_NOISE * VOLTMETER_STEPS * step * rng.standard_normal(shown.shape)
        shown = np.rint((0.5 * (shown + before) + noise) / step) * step
    out: list[Float] = []
    if "no_reference" not in style.options:
        for column in u[::every].T:
            out += [column, np.zeros_like(column)]
    return np.column_stack([*out, shown, y[::every]])


def write(
    path: Path,
    rig: Rig,
    rig_toml: str,
    style: Style,
    loops: Sequence[tuple[str, float]],
    log: Log,
) -> None:
    """One file. loops : sensor and kp of each."""
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
    if loops:
        notes["centring"] = "; ".join(f"{sensor} {kp}" for sensor, kp in loops)
    with RunWriter(path, channels, rate, Origin(rig_toml, metadata=notes)) as writer:
        writer.write(block)
        unit = rig.actuator[0].unit
        for s in segments:
            stop = min(s.stop, int(sequence[kept][-1]) + 1)
            writer.segment(replace(s, stop=stop, unit=unit))
        writer.close(StopRecord("completed", f"all {len(segments)} segments done", 0, lost))
