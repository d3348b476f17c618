"""The runs of a trial: what is driven, at which levels, how often.

Three kinds at three levels each: swept-sine bursts that run into each other, one realisation of a
random-phase odd multisine, and steps of the set point. Of several inputs sweeps and steps drive one
after the other; multisines drive all, with signs that are orthogonal over the runs of a level.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import hadamard

from samii_rig.devices.channels import centring_name
from samii_rig.rig.schema import Rig
from samii_rig.signal.excitation import Profile, cosine_ramp, schedule_factor, swept_sine
from samii_rig.signal.multisine import odd_lines, realisations
from samii_rig.types import Float, Segment

# SAMII's own schedule: less drive around mode 2, where the tip moves most.
SCHEDULE = ((4.0, 1.0), (6.0, 0.35), (9.0, 0.35), (12.0, 1.0))
STEP_SIZE = 0.04  # of set point at the highest level, in the centring sensor's unit
STEP_HOLD = 5.0  # s between steps
# Of the output's range at the highest level: 1 V of SAMII's 10. A level in the actuator's own unit
# drives a motor of 255 counts with one, less than its encoder reads.
SHARE = 0.1


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

    @classmethod
    def usual(cls, rig: Rig) -> Design:
        """That of a trial: of several inputs two levels and three bursts, so that two inputs are
        recorded for 760 s where one is for 678."""
        several = len(rig.actuator) > 1
        most = SHARE * min(min(a.high, -a.low) for a in rig.actuator)
        levels = tuple(most * x for x in ((0.5, 1.0) if several else (0.25, 0.5, 1.0)))
        return cls(levels=levels, bursts=3) if several else cls(levels=levels)


@dataclass(frozen=True, slots=True)
class Run:
    """One recording's references, (n, d) each, and its segments. level : of `Design`."""

    name: str
    u: Float
    theta_ref: Float
    segments: tuple[Segment, ...]
    level: float


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
        profile=Profile(schedule=SCHEDULE),
    )
    return wave


def runs(design: Design, rig: Rig, seed: int) -> tuple[Run, ...]:
    """All runs, those of the swept sine first."""
    rate_hz, names = rig.rate_hz, [a.name for a in rig.actuator]
    wave = burst(design, rate_hz)
    sine = _multisine(design, rate_hz, seed, len(names))
    each = [_Driven(rig, (k,)) for k in range(len(names))]
    out = []
    for i, level in enumerate(design.levels):
        for one in each:
            u = one.only(np.tile(level * wave, design.bursts))
            out.append(_swept(one.named(f"swept_sine_{i + 1}"), u, level, one, wave.size))
    signs = hadamard(1 << (len(names) - 1).bit_length())[:, : len(names)]
    for i, level in enumerate(design.levels):
        ramp = round(0.5 * rate_hz)
        n = round(design.period * rate_hz)
        before = ramp + (design.settle - 1) * n
        length = before + (1 + design.periods) * n + ramp
        turn = np.arange(-before, length - before) % n
        u = level * sine[turn] * cosine_ramp(length, rate_hz, 0.5)[:, None]
        stop = before + (1 + design.periods) * n
        together = _Driven(rig, tuple(range(len(names))))
        for block, sign in enumerate(signs):
            name = f"multisine_{i + 1}" + (f"_{block + 1}" if len(signs) > 1 else "")
            segment = Segment(
                f"multisine_{level:g}_1", "periodic", before, stop, level, together.unit,
                excited=together.excited,
            )  # fmt: skip
            out.append(Run(name, u * sign, np.zeros_like(u), (segment,), level))
    for i, level in enumerate(design.levels):
        hold = round(STEP_HOLD * rate_hz)
        size = STEP_SIZE * level / max(design.levels)
        # Down and up again around the centre, and at rest before the first.
        ref = np.repeat([0.0, *(size * (k % 2 == 0) for k in range(design.steps))], hold)
        for one in each:
            segment = Segment(
                f"steps_{size:g}_1", "single", 0, ref.size, size, one.angle, excited=one.excited
            )
            theta = one.only(ref)
            name = one.named(f"steps_{i + 1}")
            out.append(Run(name, np.zeros_like(theta), theta, (segment,), level))
    return tuple(out)


@dataclass(frozen=True, slots=True)
class _Driven:
    """The actuators that a run drives, by number."""

    rig: Rig
    which: tuple[int, ...]

    @property
    def excited(self) -> tuple[str, ...]:
        """Their names, of a rig with several."""
        actuators = self.rig.actuator
        return tuple(actuators[k].name for k in self.which) if len(actuators) > 1 else ()

    @property
    def unit(self) -> str:
        """Of the first one's command."""
        return self.rig.actuator[self.which[0]].unit

    @property
    def angle(self) -> str:
        """Unit of the sensor that its set point means."""
        name = centring_name(self.rig, self.rig.actuator[self.which[0]].name)
        return self.rig.units()[name]

    def named(self, name: str) -> str:
        """A run's name, with the actuator's where there are several."""
        return "_".join([name, *self.excited])

    def only(self, x: Float) -> Float:
        """(n, d) with x (n,) as reference of these alone."""
        out = np.zeros((x.size, len(self.rig.actuator)))
        out[:, self.which] = x[:, None]
        return out


def _swept(name: str, u: Float, level: float, one: _Driven, length: int) -> Run:
    segments = tuple(
        Segment(
            f"swept_sine_{level:g}_{k + 1}", "burst", k * length, (k + 1) * length, level, one.unit,
            k, one.excited,
        )
        for k in range(len(u) // length)
    )  # fmt: skip
    return Run(name, u, np.zeros_like(u), segments, level)


def _multisine(design: Design, rate_hz: float, seed: int, inputs: int) -> Float:
    """(n, d) of level 1."""
    grid, phases = np.random.SeedSequence(seed).spawn(2)
    lines = odd_lines(
        design.low_hz, design.high_hz, design.period, 4, np.random.default_rng(grid)
    ).excited
    shape = schedule_factor(lines / design.period, SCHEDULE, "logarithmic")
    wave = realisations(round(design.period * rate_hz), lines, shape, 2.5, inputs, phases)
    return np.asarray(wave).T
