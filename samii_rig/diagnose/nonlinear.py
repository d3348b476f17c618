"""Nonlinear physics: held against every amplitude level, beside the linear explanations.

A linear rig has one response at all levels. Where the levels of a campaign are kept apart, a
nonlinear force shows by how its describing function changes between them, so its rows compete
here with the best linear explanations on the very same lines, by the same evidence.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace

import numpy as np

from samii_rig.diagnose.effect import Effect
from samii_rig.diagnose.explanations import NEAR, Explanation
from samii_rig.diagnose.judge import Judgement
from samii_rig.diagnose.nonlinear_apart import Apart
from samii_rig.diagnose.nonlinear_confirm import seen
from samii_rig.diagnose.nonlinear_consistent import self_consistent
from samii_rig.diagnose.nonlinear_driven import drives, timed
from samii_rig.diagnose.nonlinear_forces import LineReach, forces, softens
from samii_rig.diagnose.nonlinear_levels import LevelGrid, level_grid
from samii_rig.diagnose.nonlinear_model import LevelModel, Quasi
from samii_rig.diagnose.nonlinear_screen import Bins, Promise
from samii_rig.diagnose.refit import Fitted, Problem
from samii_rig.diagnose.search import MIXED, WORTH, Search
from samii_rig.errors import SamiiRigError
from samii_rig.types import FrequencyResponse, Recording

NAMES = (
    "coulomb_friction",
    "valve_deadband",
    "backlash",
    "cubic_stiffness",
    "flow_saturation",
    "output_saturation",
)
KEPT = 4  # linear explanations that are held against the levels
PROMISING = 0.25  # of what the first gains in the screen, at least
TRIED = 4  # physics of which a force is refitted beside each base
ALARM, BETWEEN = 14.0, 8.0  # of chi-square, and of that between levels, that a force must gain
SHARE, MORE = 0.1, 3.4  # of what it should gain between levels, that it does
AGAIN, MOVED = 4, 0.5  # times that a force is computed anew at most; a move that is small
SWAPPED = 2  # times that another linear effect may take the place of one beside a force
BETTER = 3.0  # of the logarithm of evidence, that it must be for the force to be computed anew
REACH = 0.5  # of what the best explanation gains, that a rival may lose and still be computed
RIVALS, REFITTED = 4, 8  # forces that are computed each time, and explanations refitted
GROWN = 8  # linear effects that are refitted beside a force
ONE_LEVEL = (
    "all runs have one amplitude: friction, deadband, backlash, hardening and saturation cannot "
    "be told from linear physics; runs at half and at twice the amplitude would"
)


def compete(
    search: Search, responses: Sequence[FrequencyResponse], runs: Sequence[Recording] = ()
) -> Effect | None:
    """Let the nonlinear rows compete with what the linear search found.

    Where one wins, `search` goes on with the levels apart and with it; where none does, it is
    left as it was. Nothing is done with fewer than two levels, nor where it is not known how
    strongly each drove each frequency. runs : recordings of the inputs, under which promising
    forces are computed in time; without them their describing functions must do. Returns the
    winner.
    """
    whole = search.lines
    if np.unique(whole.level).size < 2:
        return None
    grid = level_grid(search.rig, search.grid, whole, responses)
    if grid is None:
        return None
    before = (search.problem, search.grid, search.table, search.found, search.temperature)
    ranked = search.ranked()
    kept = [e for e in ranked[:KEPT] if e.weight > ranked[0].weight - NEAR]
    kept += [e for e in (search.nominal,) if e not in kept]
    given = drives(search.rig, whole, responses, runs)
    lines = search.lines = timed(whole, given)
    bins = Bins.of(lines, ranked[0].fitted, search.grid)
    problem = Problem.of(bins.combined(), grid)
    every = forces(search.rig, LineReach.of(search.rig, problem))
    levels = Apart(search, bins, grid, problem, [e for e in every if not softens(e)], given)
    search.problem, search.grid = problem, grid
    search.use([*before[2], *levels.forces])
    bases = list({e.key: e for e in (ranked[0], search.nominal)}.values())
    promised = [(base, levels.promises(base)) for base in bases]
    forced: Effect | None = None
    if any(_heard(p) for _, found in promised for p in found):
        search.found = {}
        for e in kept:
            if (end := search.refitted(e.effects, e, far=False)) is not None:
                search.keep(e.effects, end)
        _force(levels, promised)
        search.temper()
        forced = _settled(levels, before[2])
        if forced is not None:
            ranked = search.ranked()
            levels.everywhere(_each_force(ranked, ranked[0].weight - NEAR))
    search.table = before[2]
    if forced is None:
        search.lines = whole
        search.problem, search.grid, table, search.found, search.temperature = before
        search.use(table)
    return forced


def _heard(promise: Promise) -> bool:
    """Whether levels differ as the force would make them, and not much more."""
    low, high = max(BETWEEN, SHARE * promise.due), BETWEEN + MORE * promise.due
    return promise.gain > ALARM and low < promise.contrast < high


def _force(levels: Apart, promised: Sequence[tuple[Explanation, list[Promise]]]) -> None:
    """Refit each base with the force that promises most beside it, and with others that may come
    as near."""
    search = levels.search
    for base, promise in [(base, p) for base, found in promised for p in _worth(found)]:
        effects = (*base.effects, promise.effect)
        levels.as_promised(base, promise)
        ends = [search.refitted(effects, base, [math.log(p)]) for p in promise.starts]
        done = [end for end in ends if end is not None]
        if done:
            search.keep(effects, min(done, key=lambda end: end.cost))


def _worth(found: Sequence[Promise]) -> list[Promise]:
    """Those that may be the best: of each physics the first, and the first's at other places,
    for torques and angles of neighbouring joints go nearly together."""
    heard = [p for p in found if _heard(p)]
    heard = [p for p in heard if p.gain > PROMISING * heard[0].gain]
    first = {p.effect.physics: p for p in reversed(heard)}
    # `found` has the largest gain first, and so have these.
    elsewhere = [p for p in heard[1:] if p.effect.physics == heard[0].effect.physics]
    return sorted(first.values(), key=lambda p: -p.gain)[:TRIED] + elsewhere


def _settled(levels: Apart, table: Sequence[Effect]) -> Effect | None:
    """The force of the best explanation, if it has one, once linear effects that only mimicked it
    are gone and those beside it are found."""
    search = levels.search
    if _force_in(search.ranked()[0]) is None:
        return None
    _again(levels)
    best = search.ranked()[0]
    forced = next((e for e in search.ranked() if _force_in(e) and len(e.effects) == 1), best)
    before = best.key
    for base in {e.key: e for e in (best, forced)}.values():
        if _force_in(base) is not None:
            _beside(search, base, table)
    search.temper()
    search.prune()
    if search.ranked()[0].key != before:
        _again(levels)
    if _force_in(search.ranked()[0]) is not None:
        _on_lines(levels, table)
    return _force_in(search.ranked()[0])


def _again(levels: Apart) -> None:
    """Compute the leading forces where they were found and refit all that may still compete,
    until the best explanation stands still."""
    search = levels.search
    for turn in range(AGAIN):
        best = search.ranked()[0]
        if not isinstance(best.fitted.model, LevelModel):
            return
        far = math.inf if turn == 0 else NEAR
        rivals = _computed(levels, math.inf if turn == 0 else REACH)
        levels.renew(best)
        ranked = search.ranked()
        bare = (e for e in ranked if len(e.effects) == 1 and _force_in(e) is not None)
        # The force alone stays: other linear effects are tried beside it.
        kept = [e for e in ranked if e.weight > best.weight - far][:REFITTED]
        _only(search, [*kept, *rivals, search.nominal, *list(bare)[:1]])
        search.temper()
        search.prune()
        after = search.ranked()[0]
        if after.key == best.key and after.fitted.away(best.fitted) < MOVED:
            return


def _each_force(ranked: Sequence[Explanation], least: float) -> list[Explanation]:
    """The first explanation with each force, of those with at least this weight."""
    first: dict[Quasi, Explanation] = {}
    for e in ranked:
        if isinstance(e.fitted.model, LevelModel) and e.weight >= least:
            first.setdefault(e.fitted.model.quasi, e)
    return list(first.values())


def _computed(levels: Apart, reach: float) -> list[Explanation]:
    """The best explanation with each of the leading forces, computed where it was found; of those
    that lose less than `reach` of what the best gains."""
    ranked = levels.search.ranked()
    least = ranked[0].weight - reach * max(ranked[0].weight - levels.search.nominal.weight, NEAR)
    rivals = _each_force(ranked, least)[:RIVALS]
    for e in rivals:
        assert isinstance(e.fitted.model, LevelModel)
        levels.compute(e.fitted.model, e.fitted.x, e.fitted.model.strength(e.fitted.x)[0])
    return rivals


def _only(search: Search, some: Sequence[Explanation]) -> None:
    """Refit some explanations, and forget all others."""
    search.found = {}
    for e in {e.key: e for e in some}.values():
        end = search.refitted(e.effects, e)
        if end is not None:
            search.keep(e.effects, end)


def _on_lines(levels: Apart, table: Sequence[Effect]) -> None:
    """Refit the leading explanations on the lines themselves: bins about one force lose what
    another adds, as that is no smooth curve."""
    search = levels.search
    ranked = search.ranked()
    bare = next((e for e in ranked if len(e.effects) == 1 and _force_in(e) is not None), ranked[0])
    try:
        end = self_consistent(bare.fitted, levels.on_lines)
    except SamiiRigError:  # no partial fractions where the refit ended
        return
    _use_force_of(levels, end)
    alone = replace(bare, fitted=end)
    if search.leftover(end) > 1:
        # What else is missing was looked for beside a force that was not right yet.
        levels.renew(alone)
        _only(search, [*ranked[:REFITTED], alone, search.nominal])
        _beside(search, search.found.get(bare.key, alone), table)
        search.temper()
        ranked = search.ranked()
    rivals = _computed(levels, REACH)
    near = [e for e in ranked if e.weight > ranked[0].weight - NEAR]
    _use_force_of(levels, end)
    _only(search, [e for e in (*near[:RIVALS], *rivals, search.nominal) if e.key != bare.key])
    search.keep(bare.effects, end)
    search.temper()
    for _ in range(SWAPPED):
        best = search.ranked()[0]
        if _force_in(best) is None or best.key == bare.key:
            break
        with suppress(SamiiRigError):
            again = self_consistent(best.fitted, levels.on_lines)
            # Not the better of both: the force was that of another explanation.
            del search.found[best.key]
            search.keep(best.effects, again)
            _use_force_of(levels, again)
            _in_its_place(search, search.found[best.key], table)
            # What stands beside it may only have led out of a valley in which the force was stuck.
            less = _without_linear(search, replace(best, fitted=again))
            if less is not None:
                search.keep(less.effects, self_consistent(less.fitted, levels.on_lines))
        search.temper()
        if search.ranked()[0].weight < search.found[best.key].weight + BETTER:
            break
    _use_force_of(levels, search.ranked()[0].fitted)
    search.temper()


def _in_its_place(search: Search, best: Explanation, table: Sequence[Effect]) -> None:
    """Refit every other linear effect that promises as much beside the force of `best`, as it is
    there: what was tried beside another force says nothing of what else would fit."""
    linear = [i for i, e in enumerate(best.effects) if e.quasi is None]
    base = search.bare(best, linear[0]) if len(best.effects) == 2 and len(linear) == 1 else None
    if base is None:
        return
    force = base.key
    for key in [k for k in search.found if force < k and k != best.key and len(k) == 2]:
        del search.found[key]
    _beside(search, base, table, best.fitted.cost + 4 * NEAR * search.temperature)


def _without_linear(search: Search, whole: Explanation) -> Explanation | None:
    """A force and linear effects without the latter, not refitted."""
    less: Explanation | None = whole
    while less is not None and len(less.effects) > 1:
        less = search.bare(less, next(i for i, e in enumerate(less.effects) if e.quasi is None))
    return less


def _use_force_of(levels: Apart, fitted: Fitted) -> None:
    """The problem on the lines, with the force where this fit has it; as it was where the rig has
    no partial fractions there."""
    if isinstance(fitted.model, LevelModel):
        with suppress(SamiiRigError):
            levels.search.problem = levels.on_lines(fitted.model, fitted.x)


def _beside(
    search: Search, base: Explanation, table: Sequence[Effect], enough: float = math.inf
) -> None:
    """Refit an explanation with a force and each of the most promising linear effects.

    They are screened on what is left of the measurements without what the force adds. enough :
    chi-square above which a refit that leads no lower is given up.
    """
    model, x, whole, every = base.fitted.model, base.fitted.x, search.problem, search.table
    assert isinstance(model, LevelModel)
    linear = tuple(e for e in base.effects if e.quasi is None)
    plain = search.model(linear)
    if plain is None or len(base.effects) >= MIXED + 1:
        return
    known = np.delete(x, model.unknown)
    added = model.response(x, whole.at) - plain.response(known, whole.at)
    search.problem = replace(whole, data=replace(whole.data, H=whole.data.H - added))
    search.table = table
    rest = search.refitted_from(linear, known, steps=2, far=False)
    screened = search.screen(Explanation(linear, rest, 0.0)) if rest is not None else []
    search.problem, search.table = whole, every
    for drop, effect, starts in screened[:GROWN]:
        effects = (*base.effects, effect)
        mixed = len(effects) > MIXED and len({e.physics for e in effects}) > MIXED
        if drop < WORTH or mixed or frozenset(e.key for e in effects) in search.found:
            continue
        ends = [search.refitted(effects, base, np.log(start).tolist(), enough) for start in starts]
        done = [end for end in ends if end is not None]
        if done:
            search.keep(effects, min(done, key=lambda end: end.cost))


def _force_in(explanation: Explanation) -> Effect | None:
    return next((e for e in explanation.effects if e.quasi is not None), None)


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
) -> tuple[bool, list[str]]:
    """Whether a nonlinear force of the answer was confirmed in time on recorded inputs, and what
    is to be said of the levels."""
    if np.unique(search.lines.level).size < 2:
        return False, [] if judged.verdict == "no_mismatch" else [ONE_LEVEL]
    best = judged.best
    if _force_in(best) is None or judged.verdict == "no_mismatch":
        return False, []
    said = [level_dependence(best, search), *distorted(responses)]
    # Held against the same without the force, not against a model that lacks the rest too.
    force = next(i for i, e in enumerate(best.effects) if e.quasi is not None)
    linear = search.without(best, force) or search.nominal
    at = search.grid
    assert isinstance(at, LevelGrid)
    found = seen(linear.fitted, best.fitted, at, search.lines, responses, runs)
    if found is not None:
        return found.holds, [*said, found.told()]
    from samii_rig.diagnose.nonlinear_time import confirm, pieces

    recorded = pieces(runs)
    if not recorded:
        return False, [*said, "not confirmed in time: no recorded input was given for it"]
    f = search.lines.frequency
    ends = confirm(linear.fitted, best.fitted, recorded, (float(f[0]), float(f[-1])))
    return ends.holds, [*said, ends.told()]


def distorted(responses: Sequence[FrequencyResponse]) -> list[str]:
    """What the lines say that a multisine left silent, in words."""
    out = []
    for r in responses:
        for name, level in (("odd", r.odd), ("even", r.even)):
            if level is not None:
                share = 100 * float(np.median(level))
                out.append(f"{name} distortion of {share:.2g} % at {r.level:g} {r.level_unit}")
    return out


def next_levels(judged: Judgement) -> tuple[str, str, None] | None:
    """(why, experiment), of unknown gain, where a force is among the leading explanations."""
    forced = [e for c in judged.classes[:2] for e in (_force_in(c.first),) if e is not None]
    if judged.verdict == "no_mismatch" or not forced:
        return None
    if judged.verdict == "named":
        return "", "", None
    return (
        f"{forced[0].physics.replace('_', ' ')} at {forced[0].site} changes with amplitude",
        "repeat the runs at half the lowest and at twice the highest amplitude, a random-phase "
        "multisine with odd lines among them",
        None,
    )
