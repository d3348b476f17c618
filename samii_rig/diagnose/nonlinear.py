"""Nonlinear physics: held against every amplitude level, beside the linear explanations.

A linear rig has one response at all levels. Where the levels of a campaign are kept apart, a
nonlinear force shows by how its describing function changes between them, so its rows compete
here with the best linear explanations on the very same lines, by the same evidence.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import fields, replace
from typing import Any

import numpy as np

from samii_rig.diagnose.effect import Effect, Unknown
from samii_rig.diagnose.judge import Judgement
from samii_rig.diagnose.measured import Measured, binned
from samii_rig.diagnose.nonlinear_laws import CUBIC, EXCESS, FRICTION, GAP
from samii_rig.diagnose.nonlinear_levels import LevelGrid, level_grid
from samii_rig.diagnose.nonlinear_model import LevelModel, Quasi
from samii_rig.diagnose.refit import Problem, refit
from samii_rig.diagnose.scales import spread
from samii_rig.diagnose.search import LATER, WORTH, Explanation, Search
from samii_rig.errors import SamiiRigError
from samii_rig.model.tmm import Chain
from samii_rig.rig.schema import ANGLE_SOURCES, SOURCES, Rig, TorsionalSpring
from samii_rig.types import Float, FrequencyResponse, Recording

NAMES = (
    "coulomb_friction",
    "valve_deadband",
    "backlash",
    "cubic_stiffness",
    "flow_saturation",
    "output_saturation",
)
BINS = 100  # of each level
# Fields of `Measured` that are not of its lines.
WHOLE = ("levels", "periodic", "sensor", "actuator", "outputs", "inside", "rate_hz")
KEPT = 6  # linear explanations that are held against the levels
BASES = 2  # of these to which a nonlinear force is added
STARTS = 5
PROMISING = 0.3  # of what is needed to be as good as the best, gained in the screen, at least
RANGE = (1e-4, 30.0)  # of a strength over the one that doubles or halves the motion at its place
WIDTHS = (1e-4, 2.0)  # of a gap or limit over the largest amplitude that meets it
ONE_LEVEL = (
    "all runs have one amplitude: friction, deadband, backlash, hardening and saturation cannot "
    "be told from linear physics; runs at half and at twice the amplitude would"
)


def forces(rig: Rig, problem: Problem) -> Iterator[Effect]:
    """Every nonlinear force that the table knows on this rig; ranges are those of the data."""
    order = [e.name for e in rig.element]
    kinds = {e.name: e for e in rig.element}
    for e in rig.element:
        if isinstance(e, TorsionalSpring):
            at = order.index(e.name)
            near: list[tuple[str, ...]] = [
                (order[i], e.name) if i < at else (e.name, order[i])
                for i in (at - 1, at + 1)
                if 0 <= i < len(order) and isinstance(kinds[order[i]], ANGLE_SOURCES)
            ]
            for across in ((e.name,), *near):
                yield from _joint(rig, problem, across, e.name)
    actuator = rig.actuator[int(problem.at.actuator[0])]
    source = next(
        (e for e in rig.element if isinstance(e, SOURCES) and e.input == actuator.name), None
    )
    if source is None:
        return
    alias = actuator.name
    largest = _largest(problem)
    if isinstance(source, ANGLE_SOURCES):
        across = (source.name,)
        yield _force(
            "coulomb_friction", source.name, alias, Quasi("drive", across, FRICTION),
            _log("T_c", actuator.unit, 1e-4 * largest, 2 * largest),
        )  # fmt: skip
        flow = Quasi("flow", across, None)
        scale = _motion(rig, problem, flow, reading=1)
        if scale is not None:
            top = float(np.max(scale[0]))
            yield _force(
                "flow_saturation", source.name, alias, flow,
                _log("T_s", "N m", top, 1e4 * top),
            )  # fmt: skip
    at_source = (source.name,)
    yield _force(
        "valve_deadband", source.name, alias, Quasi("command", at_source, GAP),
        _log("width", actuator.unit, WIDTHS[0] * largest, WIDTHS[1] * largest),
    )  # fmt: skip
    yield _force(
        "output_saturation", source.name, alias, Quasi("command", at_source, EXCESS),
        _log("limit", actuator.unit, 0.02 * largest, largest),
    )  # fmt: skip


def _joint(rig: Rig, problem: Problem, across: tuple[str, ...], spring: str) -> Iterator[Effect]:
    """Forces between both sides of a joint: of its spring alone, or of spring and source."""
    friction = Quasi("joint", across, FRICTION)
    alone = len(across) == 1
    other = next((n for n in across if n != spring), "")
    speed = _motion(rig, problem, friction)
    if speed is None:
        return
    A, y1 = speed
    torque = float(np.median(np.pi / 4 * A / y1))
    low, high = (x * torque for x in RANGE)
    yield _force("coulomb_friction", spring, other, friction, _log("T_c", "N m", low, high))
    if not alone:
        return
    cubic = Quasi("joint", across, CUBIC)
    turned = _motion(rig, problem, cubic)
    assert turned is not None
    A, y1 = turned
    k3 = 4 / 3 / float(np.median(y1)) / float(np.max(A)) ** 2
    yield _force(
        "cubic_stiffness", spring, "", cubic,
        _log("k3", "N m/rad^3", RANGE[0] * k3, RANGE[1] * k3),
    )  # fmt: skip
    top = float(np.max(A))
    yield _force(
        "backlash", spring, "", Quasi("joint", across, GAP, 1.0, (spring, "k")),
        _log("width", "rad", WIDTHS[0] * top, WIDTHS[1] * top),
    )  # fmt: skip


def _log(symbol: str, unit: str, low: float, high: float) -> Unknown:
    return Unknown(symbol, unit, low, high, spread(low, high, STARTS))


def _force(physics: str, site: str, alias: str, quasi: Quasi, unknown: Unknown) -> Effect:
    return Effect(
        physics=physics,
        site=site,
        unknowns=(unknown,),
        quasi=quasi,
        aliases=((physics, alias),) if alias else (),
        variant=f"{quasi.kind} {' '.join(quasi.across)}",
    )


def _largest(problem: Problem) -> float:
    """Largest amplitude of the input at any level."""
    at = problem.at
    assert isinstance(at, LevelGrid)
    sine = np.sqrt(2 * at.driven.max(axis=1))
    return float(np.max(np.where(at.random, 3 * np.sqrt(at.driven.sum(axis=1)), sine)))


def _motion(
    rig: Rig, problem: Problem, quasi: Quasi, reading: int = 0
) -> tuple[Float, Float] | None:
    """Amplitude of what drives a force at every line, and how much a unit force moves it; None
    where nothing moves, or the force cannot act."""
    at = problem.at
    assert isinstance(at, LevelGrid)
    assert at.power is not None
    try:
        G = Chain(quasi.widened(rig)).response(at.frequency)
    except SamiiRigError:
        return None
    n = len(rig.sensor) + reading
    rate = np.ones(at.frequency.size)
    if quasi.law is not None and quasi.law.of_speed:
        rate = 2 * np.pi * at.frequency
    A = np.abs(rate * G[:, n, int(at.actuator[0])]) * np.sqrt(2 * at.power)
    y1 = np.abs(rate * G[:, n, -1])
    on = A > 0
    if not on.any() or not np.all(y1 > 0) or not np.all(np.isfinite(y1)):
        return None
    return A[on], y1[on]


def apart(lines: Measured, search: Search, bins: int = BINS) -> Measured:
    """The lines in bins of one level each, about the best explanation."""
    best = search.ranked()[0].fitted
    parts = []
    for k in np.unique(lines.level):
        own = lines.take(lines.level == k)
        shape = best.model.response(best.x, search.grid.at(own.frequency, own.level))
        parts.append(binned(own, shape, bins))
    order = np.argsort(np.concatenate([p.frequency for p in parts]), kind="stable")

    joined: dict[str, Any] = {
        f.name: np.concatenate([getattr(p, f.name) for p in parts])[order]
        for f in fields(lines)
        if f.name not in WHOLE
    }
    inside = (sum(p.inside[0] for p in parts), sum(p.inside[1] for p in parts))
    return replace(lines, inside=inside, **joined)


def compete(search: Search, responses: Sequence[FrequencyResponse]) -> Effect | None:
    """Let the nonlinear rows compete with what the linear search found.

    Where one wins, `search` goes on with the levels apart and with it; where none does, it is
    left as it was. Nothing is done with fewer than two levels, nor where it is not known how
    strongly each drove each frequency. Returns the winner.
    """
    lines = search.lines
    if np.unique(lines.level).size < 2:
        return None
    grid = level_grid(search.rig, search.grid, lines, responses)
    if grid is None:
        return None
    before = (search.problem, search.grid, search.table, search.found, search.temperature)
    kept = list(search.ranked()[:KEPT])
    kept += [e for e in (search.nominal,) if e not in kept]
    search.problem = Problem.of(apart(lines, search), grid)
    search.grid = grid
    table = list(forces(search.rig, search.problem))
    _use(search, [*before[2], *table])
    search.found = {}
    for e in kept:
        search._keep(e.effects, refit(e.fitted.model, search.problem, e.fitted.x, far=False))
    bases = {e.key: e for e in (search.nominal, *search.ranked()[: BASES - 1])}
    whole = search.table
    search.table = table
    for base in bases.values():
        _grow(search, base)
    search.temper()
    forced = _force_in(search.ranked()[0])
    if forced is not None:
        # Linear effects that the search took to mend the force are no longer needed, others may be.
        search.prune()
        if not search._enough(search.ranked()[0]):
            search.table = whole
            search.grow(search.ranked()[0], LATER)
            search.temper()
            search.prune()
        forced = _force_in(search.ranked()[0])
    search.table = whole
    if forced is None:
        search.problem, search.grid, table_, search.found, search.temperature = before
        _use(search, table_)
    return forced


def _grow(search: Search, base: Explanation) -> None:
    """Refit `base` with each nonlinear force that may come near the best explanation."""
    best = min(e.fitted.cost for e in search.found.values())
    needed = max(WORTH, PROMISING * (base.fitted.cost - best))
    for drop, effect, starts in search.screen(base)[:LATER]:
        if drop < needed:
            break
        effects = (*base.effects, effect)
        ends = [search._refit(effects, base, np.log(s).tolist(), best) for s in starts]
        done = [end for end in ends if end is not None]
        if done:
            search._keep(effects, min(done, key=lambda end: end.cost))


def _force_in(explanation: Explanation) -> Effect | None:
    return next((e for e in explanation.effects if e.quasi is not None), None)


def _use(search: Search, table: Sequence[Effect]) -> None:
    """Give the search another table, with its prior even over the rows of that."""
    search.table = table
    search._rows = Counter(e.physics for e in table)
    search._total = {p: sum(e.weight for e in table if e.physics == p) for p in search._rows}


def level_dependence(explanation: Explanation, search: Search) -> str:
    """How the strength of the force shows: gain of the describing function at the extreme
    levels, in words."""
    fitted = explanation.fitted
    model, at = fitted.model, search.problem.at
    assert isinstance(model, LevelModel)
    assert isinstance(at, LevelGrid)
    assert at.level is not None
    whole = model.response(fitted.x, at)
    linear = model.response(fitted.x, replace(at, power=None))
    change = np.abs(whole - linear).sum(axis=1) / np.maximum(np.abs(linear).sum(axis=1), 1e-300)
    levels = search.lines.levels
    parts = []
    for k in sorted(np.unique(at.level), key=lambda k: levels[k][0]):
        value, unit = levels[k]
        share = 100 * float(np.median(change[at.level == k]))
        if math.isfinite(share):
            parts.append(f"{share:.2g} % at {value:g} {unit}")
    return "its part in the response: " + ", ".join(parts)


def settle(
    judged: Judgement,
    search: Search,
    responses: Sequence[FrequencyResponse],
    runs: Sequence[Recording],
) -> tuple[Judgement, list[str]]:
    """The verdict with the levels, and what is to be said of them.

    A nonlinear force that was not confirmed in time on recorded inputs is not named.
    """
    if np.unique(search.lines.level).size < 2:
        return judged, [] if judged.verdict == "no_mismatch" else [ONE_LEVEL]
    best = judged.best
    if _force_in(best) is None or judged.verdict not in ("named", "ambiguous"):
        return judged, []
    said = [level_dependence(best, search), *distorted(responses)]
    from samii_rig.diagnose.nonlinear_time import confirm, pieces

    recorded = pieces(runs)
    if not recorded:
        said.append("not confirmed in time: no recorded input was given for it")
        return replace(judged, verdict="ambiguous"), said

    effects = frozenset(e.key for e in best.effects if e.quasi is None)
    linear = search.found.get(effects, search.nominal)
    f = search.lines.frequency
    found = confirm(linear.fitted, best.fitted, recorded, (float(f[0]), float(f[-1])))
    said.append(found.told())
    return (judged if found.holds else replace(judged, verdict="ambiguous")), said


def distorted(responses: Sequence[FrequencyResponse]) -> list[str]:
    """What the lines say that a multisine left silent, in words."""
    out = []
    for r in responses:
        for name, level in (("odd", r.odd), ("even", r.even)):
            if level is not None:
                share = 100 * float(np.median(level))
                out.append(f"{name} distortion of {share:.2g} % at {r.level:g} {r.level_unit}")
    return out


def next_levels(judged: Judgement) -> tuple[str, str] | None:
    """(why, experiment) where a nonlinear force is among the leading explanations."""
    forced = [e for c in judged.classes[:2] for e in (_force_in(c.first),) if e is not None]
    if judged.verdict == "no_mismatch" or not forced:
        return None
    if judged.verdict == "named":
        return "", ""
    return (
        f"{forced[0].physics.replace('_', ' ')} at {forced[0].site} changes with amplitude",
        "repeat the runs at half the lowest and at twice the highest amplitude, a random-phase "
        "multisine with odd lines among them",
    )
