"""A law of its own: whether one part at one joint, in no table, does what several do together.

Two compliances in a row, one and an oscillator, or one that is all loss can pass for a joint whose
damping goes with a power of frequency. Such a part acts through one number as others do,
x(s) = a (s/w)^b beside the joint's spring, so it is tried at every joint by the same screen
(`moebius`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from scipy import optimize

from samii_rig.diagnose.effect import Effect, Unknown
from samii_rig.diagnose.explanations import Explanation
from samii_rig.diagnose.model import Model
from samii_rig.diagnose.moebius import place_of
from samii_rig.diagnose.ranking import moved
from samii_rig.diagnose.refit import Fitted
from samii_rig.diagnose.scales import spread
from samii_rig.diagnose.screen import Screen
from samii_rig.diagnose.search import Search
from samii_rig.errors import SamiiRigError
from samii_rig.types import Complex, Float

POWER = (0.05, 1.95)  # a spring has 0, a mass 2
PRICE = 6.0  # of chi-square, what a further unknown is worth
CLEAR = 10.0  # by which a law that is in no table must be better than what is
UNKNOWNS = 2  # of that part
TRIED = 2  # joints at which it is refitted, wherever the effects are
BETWEEN = 0.5  # power from which it is refitted besides the screen's: half spring, half damper
ROUNDS, MORE_ROUNDS = 8, 60  # of their refits, and of the best
SETTLED = 1e-4  # of chi-square, relative, gained by a round: less and it ends


@dataclass(frozen=True, slots=True)
class OwnLaw:
    """A part at `site` whose x goes with (i w)^`power`; better by `gain` of chi-square."""

    site: str
    power: float
    gain: float

    @property
    def sites(self) -> tuple[tuple[str, float], ...]:
        """(site, probability) against the explanation that it is held against."""
        return ((self.site, 1 / (1 + math.exp(-min(0.5 * self.gain, 30.0)))),)

    def told(self) -> str:
        """In words."""
        return (
            f"one part at {self.site} whose damping goes with the power {self.power:.2f} of "
            "frequency explains as much: a law of its own, which is in no table"
        )


def own_law(search: Search, best: Explanation) -> OwnLaw | None:
    """The part that does by itself what the effects of `best`, linear ones, do; None if none does
    or if they have fewer unknowns than it."""
    more = sum(len(e.unknowns) for e in best.effects) - UNKNOWNS
    if more < 0:
        return None
    base = _around(search, best)
    look = Screen.of(search.problem, base)
    found = []
    for effect in search.table:
        part = _power(effect, search.problem.data.frequency)
        model = search.model((effect,)) if part else None
        if part is None or model is None or model.keys != base.model.keys:
            continue
        try:
            place = place_of(model, base.x, effect, search.problem.at, look.response)
        except SamiiRigError:
            continue
        if (end := look.through(place, part)) is not None:
            start = np.append(base.x, np.log(end[1][0]))
            between = np.append(start[:-1], math.log(BETWEEN))
            found.append((end[0], part, model, (start, between)))
    if not found:
        return None
    found = sorted(found, key=lambda f: -f[0])
    # What two effects do on either side of a joint is first of all the joint's own.
    there = {site for effect in best.effects for _, site in effect.names}
    found = found[:TRIED] + [f for f in found[TRIED:] if f[1].site in there]
    try:
        ends = [
            (*_refitted(search, part, model, start, ROUNDS), part, model)
            for _, part, model, starts in found
            for start in starts
        ]
        _, y, part, model = min(ends, key=lambda end: end[0])
        cost, y = _refitted(search, part, model, y, MORE_ROUNDS)
    except (SamiiRigError, ValueError):  # on the way the rig's values become ones that no rig has
        return None
    gain = (best.fitted.cost - cost) / search.temperature + PRICE * more
    return OwnLaw(part.site, float(np.exp(y[-1])), gain) if gain > CLEAR else None


def _around(search: Search, best: Explanation) -> Fitted:
    """The nominal model where `best` left it: its own optimum is bent by what is missing."""
    problem, model = search.problem, search.nominal.fitted.model
    x = moved(best.fitted.model, best.fitted.x[: best.fitted.model.n_nominal], model)
    h, dh = model.gradient(x, problem.at)
    J, r = problem.whiten(dh), problem.residual(h)
    return Fitted(model, x, float(r @ r), best.fitted.penalty, J, J.T @ J)


def _refitted(
    search: Search, part: Effect, model: Model, start: Float, rounds: int
) -> tuple[float, Float]:
    """Chi-square with priors, and logarithms, of all nominal parameters and the part's unknowns.

    model : with the effect that is at the part's place.
    """
    problem, nominal = search.problem, search.nominal.fitted.model
    n = nominal.n
    assert part.jump is not None
    law = part.jump.x
    s = problem.at.s

    def left(y: Float) -> Float:
        a = nominal.response(y[:n], problem.at)
        place = place_of(model, y[:n], model.effects[0], problem.at, a)
        h = a + place.b * place.phi(law(s, np.exp(y[None, n:])))[0][:, None]
        return np.concatenate([problem.residual(h), y[:n] / nominal.prior])

    low = np.append(nominal.lower, [math.log(u.low) for u in part.unknowns])
    high = np.append(nominal.upper, [math.log(u.high) for u in part.unknowns])
    end = optimize.least_squares(
        left,
        np.clip(start, low + 1e-9, high - 1e-9),
        bounds=(low, high),
        x_scale=np.append(nominal.prior, np.ones(len(part.unknowns))),
        ftol=SETTLED,
        max_nfev=rounds,
    )
    return 2 * float(end.cost), np.asarray(end.x)


def _power(effect: Effect, frequency: Float) -> Effect | None:
    """The same part with a power of frequency for its law; None where it is no joint's."""
    jump = effect.jump
    if jump is None or jump.fixed:
        return None
    if effect.physics != "viscous_damping" or jump.states is not None:
        return None
    w = 2 * np.pi * float(np.sqrt(frequency[0] * frequency[-1]))

    def x_of(s: Complex, x: Float) -> Complex:
        return np.asarray(w * x[:, :1] * (s / w) ** x[:, 1:2])

    power = Unknown("power", "", *POWER, spread(*POWER, 8))
    return replace(effect, unknowns=(effect.unknowns[0], power), jump=replace(jump, x=x_of))
