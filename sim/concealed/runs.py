"""The runs of a trial: what is driven, at which levels, how often.

Three kinds at three levels each: swept-sine bursts that run into each other, one realisation of a
random-phase odd multisine, and steps of the set point.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from samii_rig.signal.excitation import cosine_ramp, schedule_factor, swept_sine
from samii_rig.signal.multisine import odd_lines, realisations
from samii_rig.types import Float, Segment

# SAMII's own schedule: less drive around mode 2, where the tip moves most.
SCHEDULE = ((4.0, 1.0), (6.0, 0.35), (9.0, 0.35), (12.0, 1.0))
STEP = 0.04  # of set point at the highest level, in the centring sensor's unit
STEP_HOLD = 5.0  # s between steps


@dataclass(frozen=True, slots=True)
class Design:
    """How a trial is measured.

    levels : peak of the excitation, in the actuator's unit. bursts : of `burst` s, the sweep
    with `lead_in` s of rest before and `ring_down` s behind it. period, settle, periods : of the
    multisine. steps : how many. noise : multiple of the
    errors that the rig file gives to its sensors, but of their steps.
    sensors : names of those recorded, all if empty.
    """

    levels: tuple[float, ...] = (0.25, 0.5, 1.0)
    low_hz: float = 0.5
    high_hz: float = 40.0
    bursts: int = 4
    burst: float = 36.0
    lead_in: float = 1.0
    ring_down: float = 6.0
    period: float = 8.0
    settle: int = 3
    periods: int = 4
    steps: int = 4
    noise: float = 4.0
    sensors: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Run:
    """One recording's references, (n,) each, and its segments."""

    name: str
    u: Float
    theta_ref: Float
    segments: tuple[Segment, ...]


def burst(design: Design, rate_hz: float) -> Float:
    """One swept-sine burst of level 1."""
    wave, _ = swept_sine(
        rate_hz,
        design.low_hz,
        design.high_hz,
        design.burst - design.lead_in - design.ring_down,
        ramp=0.5,
        lead_in=design.lead_in,
        ring_down=design.ring_down,
        schedule=SCHEDULE,
    )
    return wave


def runs(design: Design, rate_hz: float, units: tuple[str, str], seed: int) -> tuple[Run, ...]:
    """All runs. units : of the actuator and of the centring sensor."""
    wave = burst(design, rate_hz)
    sine = _multisine(design, rate_hz, seed)
    out = []
    for i, level in enumerate(design.levels):
        u = np.tile(level * wave, design.bursts)
        out.append(_run(f"swept_sine_{i + 1}", u, "burst", level, units[0], wave.size))
    for i, level in enumerate(design.levels):
        ramp = round(0.5 * rate_hz)
        n = round(design.period * rate_hz)
        before = ramp + (design.settle - 1) * n
        length = before + (1 + design.periods) * n + ramp
        turn = np.arange(-before, length - before) % n
        u = level * sine[turn] * cosine_ramp(length, rate_hz, 0.5)
        name = f"multisine_{i + 1}"
        stop = before + (1 + design.periods) * n
        segment = Segment(f"multisine_{level:g}_1", "periodic", before, stop, level, units[0])
        out.append(Run(name, u, np.zeros_like(u), (segment,)))
    for i, level in enumerate(design.levels):
        hold = round(STEP_HOLD * rate_hz)
        size = STEP * level / max(design.levels)
        # Down and up again around the centre, and at rest before the first.
        ref = np.repeat([0.0, *(size * (k % 2 == 0) for k in range(design.steps))], hold)
        name = f"steps_{i + 1}"
        segment = Segment(f"steps_{size:g}_1", "single", 0, ref.size, size, units[1])
        out.append(Run(name, np.zeros_like(ref), ref, (segment,)))
    return tuple(out)


def _run(name: str, u: Float, kind: Literal["burst"], level: float, unit: str, length: int) -> Run:
    segments = tuple(
        Segment(f"swept_sine_{level:g}_{k + 1}", kind, k * length, (k + 1) * length, level, unit, k)
        for k in range(u.size // length)
    )
    return Run(name, u, np.zeros_like(u), segments)


def _multisine(design: Design, rate_hz: float, seed: int) -> Float:
    grid, phases = np.random.SeedSequence(seed).spawn(2)
    lines = odd_lines(
        design.low_hz, design.high_hz, design.period, 4, np.random.default_rng(grid)
    ).excited
    shape = schedule_factor(lines / design.period, SCHEDULE, "logarithmic")
    wave = realisations(round(design.period * rate_hz), lines, shape, 2.5, 1, phases)
    return np.asarray(wave[0])
