"""What these data would not have shown: how small an effect must be to stay unseen.

The nominal parameters do what they can against it: an effect counts by what their refit leaves.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from scipy import stats

from samii_rig.diagnose.fit.explanations import Explanation, Explanations
from samii_rig.diagnose.fit.ranking import moved, place_at
from samii_rig.diagnose.fit.refit import Fitted
from samii_rig.diagnose.fit.screen import Screen
from samii_rig.diagnose.physics.along import POSITION
from samii_rig.diagnose.physics.effect import Effect
from samii_rig.diagnose.physics.rows import SOFT
from samii_rig.diagnose.result import Hiding
from samii_rig.errors import SamiiRigError
from samii_rig.types import Float

FOUND = 0.9  # probability with which an effect of the size that is told would have been found
Screens = tuple[Screen, Screen]  # without directions projected out, and with
# Times that a weaker one is tried, and noise units by which one moves the records at most, or one
# over so many at least, where a refit no longer bends.
WEAKER, NOISE_MOVES = 3, 2.0
STRENGTHS = 20  # strengths over the range of an effect, log-spaced, for one that is weak
# Times the weakest that is tried: of a part a thousand times the chain's own. What would be seen
# from there on alone is said to hide, however large: nothing that these sensors show moves there.
GROSS = 1e6


def could_hide(search: Explanations, best: Explanation) -> tuple[Hiding, ...]:
    """Of each physics and site, beside what was found, the smallest that would have been seen."""
    screen = Screen.of(search.problem, _pinned(best.fitted)).of_data()
    screens = screen.unprojected(), screen
    found_by = float(stats.norm.ppf(FOUND))
    found: dict[tuple[str, str], Hiding] = {}
    taken = {e.key for e in best.effects}
    for effect in search.table:
        plain = effect.unknowns and effect.force is None and effect.physical
        crack = effect.pieces and effect.physics in SOFT  # a joint is asked for, not every one
        if plain and not crack and effect.key not in taken and effect.name not in found:
            least = search.critical_value_of((effect,)) * search.overdispersion
            seen = _smallest(search, best, screens, effect, math.sqrt(least) + found_by)
            if seen is not None:
                found[effect.name] = seen
    return tuple(found.values())


def _pinned(fitted: Fitted) -> Fitted:
    """The same, what stands where nature ends it held there: beside a part that is all gone,
    another at its place does not hide as if more than all of it were."""
    model, J = fitted.model, fitted.jacobian.copy()
    for i, effect in enumerate(model.effects):
        for j, unknown in zip(model.own(i), effect.unknowns, strict=True):
            low = unknown.symbol == POSITION and fitted.x[j] <= model.lower[j]
            if unknown.ends and (low or fitted.x[j] >= model.upper[j]):
                J[:, j] = 0.0
    return replace(fitted, jacobian=J)


def _smallest(
    search: Explanations, best: Explanation, screens: Screens, effect: Effect, needed: float
) -> Hiding | None:
    """Where noise units reach what is needed. What a refit leaves grows with a weak strength, or
    with its inverse, in proportion: so far as a refit bends, this is exact for what is weak."""
    first, others = effect.unknowns[0], effect.unknowns[1:]
    strength = np.geomspace(first.low, first.high, STRENGTHS)
    middle = [u.middle for u in others]
    values = np.column_stack([strength, np.tile(middle, (STRENGTHS, 1))])
    with np.errstate(all="ignore"):
        changed = _changed(search, best, screens, effect, values)
    if changed is None:
        return None
    before, left = (np.sqrt(np.maximum(x, 0.0)) for x in changed)
    grows = bool(before[-1] > before[0])
    value, shows = _weak(search, best, screens, effect, values, before, left)
    rate = needed / max(shows, 1e-12)
    value[0] *= rate if grows else 1 / rate
    least, most = (first.low, first.high) if grows else (first.high, first.low)
    most = min(most, GROSS * least) if grows else max(most, least / GROSS)
    toward = 1 if grows else -1
    if toward * (value[0] - least) < 0:
        # What would be seen is less than the range begins with, up to which it is a nominal
        # parameter's own tolerances.
        if np.any(np.sign(np.diff(left)) != toward):
            return None  # a ratio, of either side of 1: no size of it is small
        value[0] = least
    within = toward * (value[0] - most) <= 0
    size = abs(float(effect.report(value)[0])) if within else None
    return Hiding(effect.physics, effect.site, first.symbol, size, first.unit)


def _weak(
    search: Explanations,
    best: Explanation,
    screens: Screens,
    effect: Effect,
    values: Float,
    before: Float,
    left: Float,
) -> tuple[Float, float]:
    """Values (k,) of an effect with which it moves the records by about their noise, so that
    neither rounding nor curvature matters, and the noise units that a refit leaves of it.

    values, before, left : (m, k), (m,) and (m,) over its range. That may begin where a part moves
    the records by far more, of which a refit that bends leaves more than in proportion.
    """
    weak = int(np.nanargmin(np.abs(np.log(np.maximum(before, 1e-12)))))
    value, shows, moves = values[weak].copy(), float(left[weak]), float(before[weak])
    step = moves
    for _ in range(WEAKER if weak in (0, len(values) - 1) else 0):
        if moves < NOISE_MOVES:
            break
        less = value.copy()
        less[0] *= step if weak else 1 / step
        with np.errstate(all="ignore"):
            changed = _changed(search, best, screens, effect, less[None])
        if changed is None or not np.isfinite(changed[1][0]):
            break
        now, left_now = (math.sqrt(max(float(x[0]), 0.0)) for x in changed)
        if now < 1 / NOISE_MOVES:  # it grows faster than in proportion
            step = math.sqrt(step)
            continue
        value, shows, moves, step = less, left_now, now, now
    return value, shows


def _changed(
    search: Explanations, best: Explanation, screens: Screens, effect: Effect, values: Float
) -> tuple[Float, Float] | None:
    """Chi-square (m,) of what an effect with unknowns (m, k) changes: all of it, and what a refit
    leaves; None where the rig does not allow it."""
    unprojected, screen = screens
    linear = all(e.force is None for e in best.effects)
    if linear and effect.jump is not None:
        k = values.shape[1] - effect.jump.fixed
        fixed = tuple(values[0, k:].tolist())
        place = place_at(screen, best.effects, effect, search.model, fixed)
        if place is None:
            return None
        b, phi = place.b, place.phi(effect.jump.x(screen.s, values))
    elif linear and effect.factor is not None:
        b, law = screen.factor(effect)
        phi = law(values)
    else:
        return _with_model(search, best, screens, effect, values)
    return unprojected.form(b).cost(phi), screen.form(b).cost(phi)


def _with_model(
    search: Explanations, best: Explanation, screens: Screens, effect: Effect, values: Float
) -> tuple[Float, Float] | None:
    model = search.model((*best.effects, effect))
    if model is None:
        return None
    known = moved(best.fitted.model, best.fitted.x, model)
    out = np.full((2, len(values)), np.nan)
    for i, value in enumerate(values):
        x = np.append(known, np.log(value))
        try:
            out[:, i] = [float(np.sum(at.residual_with(model, x) ** 2)) for at in screens]
        except SamiiRigError:
            continue
    return None if np.all(np.isnan(out)) else (out[0], out[1])
