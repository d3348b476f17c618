"""Which experiment would distinguish the leading explanations."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterator, Sequence

import numpy as np

from samii_rig.diagnose.fit.explanations import Explanation
from samii_rig.diagnose.fit.refit import Problem
from samii_rig.diagnose.fit.search import Search
from samii_rig.diagnose.physics import insert
from samii_rig.diagnose.physics.grid import Grid
from samii_rig.diagnose.verdict.judge import Judgement
from samii_rig.errors import SamiiRigError
from samii_rig.model.sampled import hold_response, sensor_response
from samii_rig.rig.schema import (
    Acceleration,
    Beam,
    LumpedMass,
    Rig,
    RigidLink,
    TorsionalGroundSpring,
    TranslationalGroundSpring,
)
from samii_rig.rig.schema.pose import Angle
from samii_rig.signal.steps import FEW, steps_driven
from samii_rig.types import Complex, Float, Recording

Change = Callable[[Rig], Rig]

TELLING = 5.0  # noise units from which an experiment is worth its time
PLAN_POINTS = 80  # frequencies at which experiments are held against each other
BAND_WIDER = 2.0  # how far a band is widened at either end
STIFF = 1e9  # N m/rad and N/m: a brace that does not give
KNOWN_MASS = 0.1  # of the chain's own mass, a mass that is added
RIVAL_FROM = 0.05  # probability from which another class is to be distinguished


def next_experiment(
    search: Search, judged: Judgement, levels: int = 1
) -> tuple[str, str, float | None]:
    """(why, experiment) in words, both empty where nothing is to be distinguished; and by how many
    noise units the experiment would tell, if that is known. levels : that were recorded."""
    rivals = _rivals(judged)
    if not rivals and judged.verdict != "no_mismatch" and (alone := _alone(search)):
        return *alone, None
    if judged.verdict == "unknown" and not rivals:
        if levels > 1:
            return (
                "no explanation passes: what is missing is in no row, or changes by itself",
                "repeat one excitation three times, each from rest",
                None,
            )
        return (
            "no explanation passes: what is missing may depend on amplitude",
            "repeat the sweep at half and at twice the amplitude",
            None,
        )
    if not rivals:
        return "", "", None
    first, other = rivals
    if not first.effects and not other.effects:
        return "", "", None
    what = f"{_in_words(first)} and {_in_words(other)} are not distinguished"
    best = ("", 0.0)
    for words, rig_of, f in _experiments(search):
        d = _separation(first, other, rig_of, f, search)
        if d > best[1]:
            best = (words, d)
    if best[1] < TELLING:
        none = "no experiment that was tried distinguishes them: to every sensor they are the same"
        return what, none, best[1]
    return f"{what}; predicted {best[1]:.0f} noise units apart", *best


def harder(runs: Sequence[Recording], rig: Rig, hidden: Collection[str]) -> tuple[str, str]:
    """(why, experiment) in words for sensors that are not read as they move by few of their steps;
    both empty where there are none."""
    for a in rig.actuator:
        loop = rig.centring_of(a.name)
        if loop is None or loop.sensor not in hidden:
            continue
        moved = [
            steps_driven(
                r.channels[r.column(loop.sensor)],
                r.values_of(loop.sensor),
                r.values_of(a.name),
                r.rate_hz,
            )
            for r in runs
            if {loop.sensor, a.name} <= {c.name for c in r.channels}
        ]
        every = np.concatenate([*moved, np.zeros(0)])
        if not (moves := every[every > 0]).size:
            continue
        steps = float(np.median(moves))
        times = max(math.ceil((FEW + 1) / steps), 2)  # beyond FEW, by whole steps
        return (
            f"{loop.sensor} is not read where it moves by few of its steps: what shows in it alone "
            "could hide",
            f"drive {a.name} {times} times as hard, or read {loop.sensor} with finer steps: it "
            f"moves by {steps:.0f} of them most of the time that it moves; more than {FEW:g} count",
        )
    return "", ""


def _alone(search: Search) -> tuple[str, str] | None:
    """Where one sensor is all there is: what it cannot know, and what would tell."""
    outputs = set(search.problem.data.outputs)
    links = [e.name for e in search.rig.element if isinstance(e, RigidLink) and e.L.value > 0]
    if len(outputs) > 1 or not links:
        return None
    (only,) = outputs
    return (
        f"{only} alone does not show which part moves: what gives in the base or in a joint before "
        "the actuator is told from what gives behind it by the shape of one curve",
        f"brace the rig behind {links[0]}, which takes the base out of {only}, and compare",
    )


def _rivals(judged: Judgement) -> tuple[Explanation, Explanation] | None:
    top = judged.classes[0]
    if judged.verdict == "no_mismatch":
        return None
    names = {e.name for e in top.first.effects}

    def rivals(other: Explanation) -> bool:
        # The same with one part more is no other explanation.
        return not names <= {e.name for e in other.effects}

    for member in top.members[1:]:
        if rivals(member):
            return top.first, member
    for other in judged.classes[1:]:
        if other.probability > RIVAL_FROM and (rivals(other.first) or not names):
            return top.first, other.first
    return None


def _in_words(explanation: Explanation) -> str:
    if not explanation.effects:
        return "nothing missing"
    return " and ".join(f"{e.physics.replace('_', ' ')} at {e.site}" for e in explanation.effects)


def _experiments(search: Search) -> Iterator[tuple[str, Change, Float]]:
    rig, f = search.rig, search.problem.data.frequency
    low, high = float(f[0]), float(f[-1])
    inside = np.geomspace(low, high, PLAN_POINTS)
    top = min(BAND_WIDER * high, 0.45 * rig.rate_hz)
    if top > 1.2 * high:
        yield (f"widen the band to {top:.3g} Hz", lambda r: r, np.geomspace(high, top, PLAN_POINTS))
    yield (
        f"start the sweep at {low / BAND_WIDER:.3g} Hz",
        lambda r: r,
        np.geomspace(low / BAND_WIDER, low, PLAN_POINTS // 2),
    )
    if rig.gravity:
        degrees = 90.0 if rig.pull > 0.5 * rig.gravity else 0.0
        yield (
            f"record it at {degrees:.0f} deg to the way down too, and give both, each with --pose",
            _leaning(degrees),
            inside,
        )
    mass = sum(e.m.value for e in rig.element if isinstance(e, RigidLink | LumpedMass))
    tip = rig.element[-1].name
    for e in rig.element:
        if isinstance(e, RigidLink) and e.L.value > 0:
            yield (f"brace the rig behind {e.name}", _braced(e.name), inside)
    yield (
        f"add a known mass of {KNOWN_MASS * mass:.2g} kg at {tip}",
        _loaded(tip, KNOWN_MASS * mass),
        inside,
    )
    worn = {s.on for s in rig.sensor if isinstance(s, Acceleration)}
    for e in rig.element:
        if isinstance(e, RigidLink | Beam) and e.name not in worn and e.L.value > 0:
            yield (f"put another accelerometer on {e.name}", _watched(e.name, e.L.value), inside)


def _leaning(degrees: float) -> Change:
    pose = Angle(value=math.radians(degrees), unit="rad", written="deg")
    return lambda rig: rig.model_copy(update={"pose": pose})


def _braced(name: str) -> Change:
    def change(rig: Rig) -> Rig:
        turn = TorsionalGroundSpring(
            kind="torsional_ground_spring",
            name=f"{insert.PREFIX}brace_turn",
            k=insert.parameter(STIFF, "N m/rad"),
        )
        move = TranslationalGroundSpring(
            kind="translational_ground_spring",
            name=f"{insert.PREFIX}brace_move",
            k=insert.parameter(STIFF, "N/m"),
        )
        return insert.inserted(insert.inserted(rig, name, turn), name, move)

    return change


def _loaded(name: str, mass: float) -> Change:
    def change(rig: Rig) -> Rig:
        made = LumpedMass(
            kind="lumped_mass", name=f"{insert.PREFIX}known", m=insert.parameter(mass, "kg")
        )
        return insert.inserted(rig, name, made)

    return change


def _watched(name: str, L: float) -> Change:
    def change(rig: Rig) -> Rig:
        like = next((s for s in rig.sensor if isinstance(s, Acceleration)), None)
        fields = like.model_dump() if like else {"kind": "acceleration", "unit": "m/s^2"}
        fields |= {"name": "a_added", "on": name, "position": 0.5 * L}
        return rig.model_copy(update={"sensor": (*rig.sensor, Acceleration(**fields))})

    return change


def _separation(a: Explanation, b: Explanation, change: Change, f: Float, search: Search) -> float:
    """Noise units between a's prediction and b's best, on the old data and the new together."""
    problem = search.problem
    try:
        old = problem.residual(b.fitted.model.response(b.fitted.x, problem.at)) - problem.residual(
            a.fitted.model.response(a.fitted.x, problem.at)
        )
        ya, _ = _elsewhere(a, change, f)
        yb, Jb = _elsewhere(b, change, f)
    except (SamiiRigError, ValueError):
        return 0.0
    scale = _noise(problem, ya)
    diff = ((yb - ya) / scale).ravel()
    slope = (Jb / scale[:, :, None]).reshape(-1, Jb.shape[2])
    prior = b.fitted.model.prior
    rows = np.diag(np.where(np.isfinite(prior), 1 / prior, 1e-2))
    J = np.concatenate([b.fitted.jacobian, slope.real, slope.imag, rows])
    r = np.concatenate([old, diff.real, diff.imag, np.zeros(len(prior))])
    left = r - J @ np.linalg.lstsq(J, r, rcond=None)[0]
    new = float(left @ left)
    return math.sqrt(max(new, 0.0))


def _elsewhere(e: Explanation, change: Change, f: Float) -> tuple[Complex, Complex]:
    """Response and its derivatives of an explanation under an experiment, hold and filters on."""
    model = e.fitted.model
    there = model.under(change)
    rig = there.rig
    hold = np.stack([hold_response(f, rig.rate_hz, x.delay) for x in rig.actuator], axis=1)
    n_s, n_a = len(rig.sensor), len(rig.actuator)
    sensor, actuator = (x.ravel() for x in np.meshgrid(range(n_s), range(n_a), indexing="ij"))
    factor = sensor_response(rig.sensor, f)[:, sensor] * hold[:, actuator]
    none = np.zeros_like(factor)
    at = Grid(f, factor, none, none[None][:0], rig.rate_hz, sensor, actuator)
    return there.gradient(e.fitted.x, at)


def _noise(problem: Problem, y: Complex) -> Float:
    """Standard deviation of one real part of each entry (n, q'), from the measured ones: that of
    the response over its root mean square, like that of the entries measured."""
    variance = np.diagonal(np.linalg.pinv(problem.data.W), axis1=1, axis2=2).real
    told = variance > 0  # an entry that nothing was told of has none, but for rounding
    each = np.sqrt(np.where(told, variance, 0.0)) / np.maximum(np.abs(problem.data.H), 1e-300)
    every = float(np.median(each[told]))
    relative = np.array(
        [np.median(r[on]) if on.any() else every for r, on in zip(each.T, told.T, strict=True)]
    )
    level = np.sqrt(np.mean(np.abs(y) ** 2, axis=0))
    share = np.full(y.shape[1], float(np.median(relative)))
    share[: relative.size] = relative[: y.shape[1]]
    bins = problem.data.n / PLAN_POINTS
    return np.asarray(share * (np.abs(y) + 0.1 * level) * math.sqrt(max(1.0, 1 / bins)))
