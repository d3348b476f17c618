"""A vibration damping loop from an acceleration to an actuator, found for all rigs at once.

The filter is a low-pass of n equal real poles,

    F(s) = g (w/(s + w))^n,

so that two numbers are searched for: its gain g at rest and its corner w. A velocity source
turns the joint with v, and the reaction of what it moves pushes the structure with -dv/dt: the
low-pass must turn the structure's acceleration by its poles until that push meets its velocity,
and it must be small at mode 2, which it would drive. With one pole there is not enough of either.

Of all controllers that which leaves the most room is taken: the largest `reserve`, the smallest
of damping, gain and phase margin over what is asked, on the worst rig of those with every
stiffness at either end of its range.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import fmin

from samii_rig.control.plants import Judgement, Known, Plant, Values, judge, plant, with_values
from samii_rig.control.plants import corners as corners_of
from samii_rig.control.plants import inside as draws_inside
from samii_rig.control.plants import uncertain as draws_uncertain
from samii_rig.errors import InputError
from samii_rig.model.loops import Loops, loops_of
from samii_rig.progress import Progress, counted
from samii_rig.rig.schema import Acceleration, Feedback, Rig
from samii_rig.safety.limits import find_actuator, gate_limits
from samii_rig.types import Float

MOST_POLES = 4
# Grid of the first search: the corner over mode 1, and the peak of the feedback's loop gain.
CORNERS = np.geomspace(0.15, 1.5, 12)
PEAKS = np.geomspace(0.5, 40.0, 14)
STEPS = 50  # evaluations of the simplex search
WORST = 8  # corners that it looks at: the worst ones of the start, then those of what it found
ROUNDS = 2  # of that
# Largest output of the loop, of the tightest limit on the actuator: more than half of the
# limit is left to the reference and the centring.
AUTHORITY = 0.4
SIMPLEX = 0.1  # first step of the simplex search, in log of corner and gain


@dataclass(frozen=True, slots=True)
class Goals:
    """What is asked of the closed loop: damping of mode 1, margins in dB and degrees, over
    every stiffness within +-spread (a part of its value)."""

    damping: float = 0.25
    gain_db: float = 6.0
    phase_deg: float = 40.0
    spread: float = 0.2

    def reserve(self, j: Judgement) -> float:
        """Smallest of damping and margins over what is asked: 1 or more when it is met, 0 or
        less when the loop is not stable."""
        if j.outside:
            return min(0.0, j.damping)
        return min(j.damping / self.damping, j.gain_db / self.gain_db, j.phase_deg / self.phase_deg)


@dataclass(frozen=True, slots=True)
class Draws:
    """The rigs that a controller is judged on beside those that it was found for: n within the
    spread of the goals, and n as uncertain as the parameters are.

    seed : of them, and of corners that are too many to take all. known : the covariance of an
    identification, for the parameters that it holds instead of their tolerances.
    """

    n: int = 50
    seed: int = 0
    known: Known | None = None


@dataclass(frozen=True, slots=True)
class Trial:
    """The best controller of one number of poles: reserve and judgement on the worst corner."""

    poles: int
    corner_hz: float
    gain: float
    reserve: float
    worst: Judgement


@dataclass(frozen=True, slots=True)
class Design:
    """A controller and what is known of it.

    rig : with the feedback. trials : the best of each number of poles that was tried.
    nominal, without : the rig as given, with and without the feedback.
    corners, draws : every stiffness at the ends of its range, and inside it at random.
    uncertain : rigs drawn within the tolerances of the rig file.
    """

    rig: Rig
    feedback: Feedback
    loops: Loops
    goals: Goals
    plant: Plant
    trials: tuple[Trial, ...]
    nominal: Judgement
    without: Judgement
    corners: tuple[Judgement, ...]
    draws: tuple[Judgement, ...]
    uncertain: tuple[Judgement, ...]

    @property
    def worst(self) -> Judgement:
        """The rig within +-spread with the smallest reserve."""
        return min((*self.corners, *self.draws), key=self.goals.reserve)

    def least(self, what: str) -> float:
        """Smallest `damping`, `gain_db` or `phase_deg` of all rigs within +-spread."""
        return min(float(getattr(j, what)) for j in (*self.corners, *self.draws))

    @property
    def reached(self) -> bool:
        """Whether the goals hold on every rig within +-spread that was looked at."""
        return self.goals.reserve(self.worst) >= 1.0


def design(
    rig: Rig,
    *,
    sensor: str | None = None,
    actuator: str | None = None,
    poles: int | None = None,
    goals: Goals | None = None,
    draws: Draws | None = None,
    progress: Progress | None = None,
) -> Design:
    """The controller with the largest reserve, and its judgement.

    sensor : the accelerometer (the first by default). poles : of the low-pass; without it as
    few as reach the goals, at most MOST_POLES. draws : of rigs that the design did not see.

    A rig that has a feedback on this actuator already is judged with it as it is.
    InputError for an unknown sensor or actuator, or one that the rig cannot damp.
    """
    goals, draws = goals or Goals(), draws or Draws()
    say = progress or (lambda _stage: None)
    first = rig.actuator[0].name if actuator is None else actuator
    find_actuator(rig, first, rig.name)
    own = [f for f in rig.feedback if f.actuator == first]
    bare = rig.model_copy(
        update={"feedback": tuple(f for f in rig.feedback if f.actuator != first)}
    )
    chosen = own[0].sensor if own else _accelerometer(bare, sensor)
    loops = loops_of(bare, first)
    nominal = plant("nominal", bare, loops)
    values = corners_of(bare, goals.spread, draws.seed)
    at_corners = _plants(nominal, values, loops, say, "rigs at the ends of their stiffness")
    trials: list[Trial] = []
    if not own:
        for n in [poles] if poles else range(1, MOST_POLES + 1):
            say(f"low-pass of {n} pole{'s'[: n > 1]}")
            trials.append(_best(bare, first, chosen, n, nominal, at_corners, goals))
            if trials[-1].reserve >= 1.0:
                break
        best = max(trials, key=lambda t: t.reserve)
        own = [lowpass(bare, chosen, first, best.poles, best.corner_hz, best.gain)]
    whole = rig.model_copy(update={"feedback": (*bare.feedback, *own)})
    closed = loops_of(whole, first)
    inside = draws_inside(bare, goals.spread, draws.n, draws.seed + 1)
    drawn = draws_uncertain(bare, draws.n, draws.seed + 2, draws.known)
    return Design(
        whole,
        own[0],
        closed,
        goals,
        nominal,
        tuple(trials),
        judge(nominal, closed),
        judge(nominal, loops),
        tuple(judge(p, closed) for p in at_corners),
        tuple(judge(p, closed) for p in _plants(nominal, inside, loops, say, "rigs in the range")),
        tuple(judge(p, closed) for p in _plants(nominal, drawn, loops, say, "rigs as uncertain")),
    )


def lowpass(
    rig: Rig, sensor: str, actuator: str, poles: int, corner_hz: float, gain: float
) -> Feedback:
    """F(s) = gain (w/(s + w))^poles as a table of the rig file; gain at rest."""
    w = 2 * math.pi * corner_hz
    limits = gate_limits(rig, actuator, 0.0, sensor)
    units = rig.units()
    return Feedback(
        name="damping",
        sensor=sensor,
        actuator=actuator,
        gain=gain * w**poles,
        unit=f"{units[actuator]}/({units[sensor]})",
        poles=(-w,) * poles,
        max=AUTHORITY * limits.output.max,
    )


def _accelerometer(rig: Rig, name: str | None) -> str:
    known = [s.name for s in rig.sensor if isinstance(s, Acceleration)]
    if not known:
        raise InputError(rig.name, "sensor", None, "an accelerometer to feed back")
    if name is not None and name not in known:
        raise InputError(rig.name, "sensor", name, f"an accelerometer: {', '.join(known)}")
    return name or known[0]


def _plants(
    nominal: Plant, values: dict[str, Values], loops: Loops, say: Progress, what: str
) -> list[Plant]:
    rig, near = nominal.rig, nominal.structure
    every = counted(list(values.items()), say, what)
    return [plant(name, with_values(rig, changed), loops, near) for name, changed in every]


def _best(
    rig: Rig,
    actuator: str,
    sensor: str,
    poles: int,
    nominal: Plant,
    plants: Sequence[Plant],
    goals: Goals,
) -> Trial:
    """Grid on the nominal rig, then a simplex search on the worst of the corners."""
    everything = (nominal, *plants)

    def closed(x: Float) -> Loops:
        loop = lowpass(rig, sensor, actuator, poles, math.exp(x[0]), side * math.exp(x[1]))
        return loops_of(rig.model_copy(update={"feedback": (loop,)}), actuator)

    f1 = abs(nominal.mode_1) / (2 * math.pi)
    best = (-math.inf, np.zeros(2), 1.0)
    for corner in CORNERS * f1:
        unit = loops_of(
            rig.model_copy(
                update={"feedback": (lowpass(rig, sensor, actuator, poles, corner, 1.0),)}
            ),
            actuator,
        )
        peak = _peak(nominal, unit)
        if peak == 0.0:
            raise InputError(rig.name, "sensor", sensor, f"one that {actuator} moves")
        for side in (-1.0, 1.0):
            for size in PEAKS:
                x = np.log([corner, size / peak])
                reserve = goals.reserve(judge(nominal, closed(x)))
                best = max(best, (reserve, x, side), key=lambda b: b[0])
    _, x, side = best
    looked: list[Plant] = []

    def cost(x: Float) -> float:
        loops = closed(x)
        return -min(goals.reserve(judge(p, loops)) for p in looked)

    for _ in range(ROUNDS):
        by_reserve = sorted(everything, key=lambda p: goals.reserve(judge(p, closed(x))))
        looked += [p for p in by_reserve[:WORST] if p not in looked]
        simplex = x + SIMPLEX * np.array([[0, 0], [1, 0], [0, 1]])
        x = fmin(cost, x, initial_simplex=simplex, maxfun=STEPS, xtol=1e-3, ftol=1e-3, disp=False)
    worst = min((judge(p, closed(x)) for p in everything), key=goals.reserve)
    corner, gain = math.exp(x[0]), side * math.exp(x[1])
    return Trial(poles, corner, gain, goals.reserve(worst), worst)


def _peak(given: Plant, loops: Loops) -> float:
    """Largest gain of the feedback's own loop, the centring open."""
    z = np.exp(2j * np.pi * given.frequency / given.rig.rate_hz)
    filters = loops.filters(z, given.rig.rate_hz)
    (i, _), *_ = loops.feedback
    return float(np.max(np.abs(filters[:, 0] * given.response[:, i, loops.actuator])))
