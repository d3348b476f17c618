"""From explanations to a verdict: probabilities, the unknown, and what it is worth."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import stats

from samii_rig.diagnose.channels import NOT_PHYSICS
from samii_rig.diagnose.classes import Class, classes
from samii_rig.diagnose.effect import Effect
from samii_rig.diagnose.measured import Measured
from samii_rig.diagnose.refit import Fitted, Problem
from samii_rig.diagnose.result import Band, Cause, Gap, Value, Verdict
from samii_rig.diagnose.search import NEAR, Explanation, Search
from samii_rig.signal.statistics import octaves
from samii_rig.types import Float

FALSE_ALARM = 0.003  # of the chi-square test of the nominal model alone
NOTHING = 0.2  # probability of nothing missing below which it is called missing
SURE = 0.8  # probability of a class from which it is named
MOST_NAMES = 4  # of a class; more is no answer
OUTSIDE = 6.0  # logarithm of what an unexplained rest must be worth before it is one
IN_DATA = 12.0  # of chi-square, that an effect must explain of the data to be called missing
MOSTLY = 0.5  # of the mismatch; explained by a cause, it is shown although something is left
DRAWS = 400
SAID = ("named", "ambiguous")  # verdicts that come with causes
SHOWN = 0.01  # probability of an alternative from which it is listed
# What a factor between two units is: their names are told, not physics.
UNITS = {57.29578: "degrees for radians", 9.80665: "g for m/s^2", 1000.0: "milli for one",
         6.283185: "hertz for rad/s"}  # fmt: skip
UNIT_WITHIN = 0.03


@dataclass(frozen=True, slots=True)
class Judgement:
    """classes : the most probable first; empty effects mean that nothing is missing.

    nothing, outside : probabilities of nothing missing, and of something (also) missing that
        is not in the table; those of the classes are given that it is.
    inflation : factor on covariances for what the best explanation leaves.
    """

    verdict: Verdict
    classes: tuple[Class, ...]
    nothing: float
    outside: float
    inflation: float

    @property
    def best(self) -> Explanation:
        """The chosen explanation."""
        return self.classes[0].first


def threshold(data: Measured) -> float:
    """Chi-square per degree of freedom that noise alone exceeds with `FALSE_ALARM`."""
    return float(stats.gamma.isf(FALSE_ALARM, 1 / data.spread, scale=data.spread))


def judge(search: Search, decide: Measured | None = None) -> Judgement:
    """Probabilities of all explanations that were looked at, and the verdict.

    decide : lines that took no part in the fit, on which the best explanation must hold too.
    """
    inflation = search.temperature
    ranked = _decided(search, decide) if decide is not None else search.ranked()
    best = ranked[0]
    left = search.ratio(best.fitted)
    weights = np.array([e.weight for e in ranked])
    gain = _worth(left, search.lines.spread)
    if decide is not None:
        gain += _worth(_held(search, decide, best.fitted), decide.spread)
    outside = float(np.max(weights)) + gain - OUTSIDE - (0.0 if best.effects else 2.0)
    p = np.exp(weights - np.max(weights))
    beyond = 1 / (1 + float(np.sum(p)) * math.exp(min(np.max(weights) - outside, 700.0)))
    p /= p.sum()
    grouped = classes(ranked, p.tolist(), search.problem, inflation)
    nothing = sum(c.probability for c in grouped if not c.first.effects)
    closed = _closed(search, best)
    said = _verdict(grouped, nothing, beyond, closed)
    if said in SAID and not _seen(search, grouped, nothing):
        said = "no_mismatch"
    return Judgement(
        verdict=said,
        classes=tuple(_chosen_first(grouped, nothing)),
        nothing=nothing,
        outside=beyond,
        inflation=inflation,
    )


def shown(judged: Judgement, gap: Gap) -> Judgement:
    """The same, but nothing is named that makes data worse which it was not fitted to."""
    if judged.verdict in SAID and gap.value < 0:
        return replace(judged, verdict="unknown")
    return judged


def _worth(left: float, spread: float) -> float:
    """Logarithm of what an explanation of `left`, chi-square per degree of freedom, would gain."""
    return (left - 1 - math.log(left)) / spread if left > 1 else 0.0


def _decided(search: Search, lines: Measured) -> list[Explanation]:
    """The explanations that may still compete, and that nothing is missing, weighed anew by how
    likely each makes lines that were not fitted; the most probable first."""
    ranked = search.ranked()
    rivals = [e for e in ranked if e.weight > ranked[0].weight - NEAR or not e.effects]
    heard = []
    for e in rivals:
        chi2, spread = _predicted(search, lines, e.fitted)
        heard.append(replace(e, weight=e.weight - 0.5 * (chi2 / search.temperature + spread)))
    return sorted(heard, key=lambda e: -e.weight)


def _held(search: Search, lines: Measured, fitted: Fitted) -> float:
    """Chi-square over its mean on lines that were not fitted."""
    return _predicted(search, lines, fitted)[0] / float(np.sum(lines.expected))


def _predicted(search: Search, lines: Measured, fitted: Fitted) -> tuple[float, float]:
    """Chi-square on lines that were not fitted, with the covariance of the noise and of the
    fit's own error there together; and the logarithm of that covariance's determinant over
    the noise's."""
    there = Problem.of(lines, search.grid)
    h, dh = fitted.model.gradient(fitted.x, there.at)
    J, r = there.whiten(dh), there.residual(h)
    own, information = J.T @ r, J.T @ J
    before = fitted.precision()
    both = before + information
    chi2 = float(r @ r - own @ np.linalg.solve(both, own))
    return chi2, float(np.linalg.slogdet(both)[1] - np.linalg.slogdet(before)[1])


def _seen(search: Search, grouped: Sequence[Class], nothing: float) -> bool:
    """Whether the data themselves gain: what a refit of the nominal parameters absorbs, at
    the cost of values that their tolerances make unlikely, is not in the data."""
    chosen = _chosen_first(grouped, nothing)[0].first.fitted
    return search.nominal.fitted.chi2 - chosen.chi2 > IN_DATA * search.temperature


def _chosen_first(grouped: Sequence[Class], nothing: float) -> list[Class]:
    """Nothing missing last, unless that is the answer."""
    alarmed = nothing < NOTHING
    return sorted(grouped, key=lambda c: (bool(c.first.effects) != alarmed, -c.probability))


def _closed(search: Search, best: Explanation) -> float:
    """Part of what the refitted nominal model leaves over the noise that `best` explains."""
    before, after = search.ratio(search.nominal.fitted), search.ratio(best.fitted)
    return (before - after) / (before - 1) if before > 1 else 0.0


def _verdict(grouped: Sequence[Class], nothing: float, outside: float, closed: float) -> Verdict:
    if outside > 0.5:
        return "ambiguous" if closed > MOSTLY else "unknown"
    if nothing >= NOTHING:
        return "no_mismatch"
    best = _chosen_first(grouped, nothing)[0]
    if not best.first.effects:
        return "no_mismatch"
    if best.names() > MOST_NAMES:
        return "unknown"
    if all(e.physics in NOT_PHYSICS for e in best.first.effects):
        return "no_mismatch"
    return "named" if best.probability >= SURE else "ambiguous"


def causes_of(
    chosen: Class, judged: Judgement, *, probability: float | None = None
) -> tuple[Cause, ...]:
    """The physics of a class's first member, each with its own marginal probability."""
    first = chosen.first
    values = _values(first, judged.inflation)
    out = []
    for effect, found in zip(first.effects, values, strict=True):
        if effect.physics in NOT_PHYSICS or unit_of(effect, found):
            continue
        same = {effect.name, *chosen.equivalents(effect)}
        p = probability
        if p is None:
            p = sum(
                c.probability
                for c in judged.classes
                if any(n in same for e in c.first.effects for n in e.names)
            ) * (1 - judged.outside)
        equivalents = tuple(n for n in chosen.equivalents(effect))
        out.append(Cause(effect.physics, effect.site, min(p, 1.0), equivalents, found))
    return tuple(out)


def unit_of(effect: Effect, found: dict[str, Value]) -> str:
    """What unit a sensor's gain would be a confusion of, "" for none."""
    if effect.physics != "sensor_gain":
        return ""
    for factor, name in UNITS.items():
        for value in (factor, 1 / factor):
            if abs(found["gain"].value / value - 1) < UNIT_WITHIN:
                return name
    return ""


def _values(explanation: Explanation, inflation: float) -> list[dict[str, Value]]:
    """Parameters of every effect with 90 % intervals, from draws of the logarithms."""
    fitted = explanation.fitted
    model, x = fitted.model, fitted.x
    cov = fitted.covariance()[model.n_nominal :, model.n_nominal :] * inflation
    rng = np.random.default_rng(0)
    centre = x[model.n_nominal :]
    draws = rng.multivariate_normal(centre, cov, DRAWS, method="eigh") if centre.size else None
    out, at = [], 0
    for effect, theta in zip(model.effects, model.parts(x), strict=True):
        n = len(effect.unknowns)
        reported = effect.report(theta)
        found: dict[str, Value] = {}
        if draws is not None and n:
            low = np.log([u.low for u in effect.unknowns])
            high = np.log([u.high for u in effect.unknowns])
            drawn = np.exp(np.clip(draws[:, at : at + n], low, high))
            every = np.array([effect.report(row) for row in drawn])
            ends = np.quantile(every, [0.05, 0.95], axis=0)
            found = {
                u.symbol: Value(float(reported[i]), u.unit, float(ends[0, i]), float(ends[1, i]))
                for i, u in enumerate(effect.unknowns)
            }
        at += n
        out.append(found)
    return out


def told(judged: Judgement) -> list[str]:
    """Findings of the chosen explanation that are not physics, in words."""
    out = []
    best = judged.best
    for effect, found in zip(best.effects, _values(best, judged.inflation), strict=True):
        unit = unit_of(effect, found)
        match effect.physics:
            case "channel_swap":
                out.append(f"{effect.site} and {effect.aliases[0][1]} are swapped")
            case "sign_error":
                out.append(f"{effect.site} has the wrong sign")
            case "common_gain":
                g = found["gain"]
                out.append(
                    f"all channels share a gain of {g.value:.4g} ({g.low:.4g} to {g.high:.4g}): "
                    "a scale of the input, not a shape that physics would have"
                )
            case _ if unit:
                g = found["gain"]
                out.append(f"{effect.site} is {g.value:.4g} times what it should be: {unit}")
    many = judged.classes[0].names()
    if many > MOST_NAMES:
        alike = [" and ".join(" at ".join(e.name) for e in m.effects)
                 for m in judged.classes[0].members[:MOST_NAMES]]  # fmt: skip
        out.append(f"{many} names fit these data alike, among them {'; '.join(alike)}")
    return out


def sites(judged: Judgement) -> list[tuple[str, float]]:
    """Probability of each site over all explanations, the most probable first."""
    total: dict[str, float] = defaultdict(float)
    for c in judged.classes:
        for site in {e.site for e in c.first.effects if e.physics not in NOT_PHYSICS}:
            total[site] += c.probability
    ranked = sorted(total.items(), key=lambda item: -item[1])
    return [(s, min(p, 1.0)) for s, p in ranked if p >= SHOWN]


def bands(search: Search, fitted: Fitted) -> tuple[Band, ...]:
    """Chi-square per degree of freedom of each channel in each octave."""
    data = search.problem.data
    e = np.abs(fitted.model.response(fitted.x, search.problem.at) - data.H) ** 2
    variance = np.diagonal(np.linalg.pinv(data.W), axis1=1, axis2=2).real
    q = data.H.shape[1]
    mean = (data.expected / q)[:, None]
    unit = np.divide(e, variance, out=np.zeros_like(e), where=variance > 0) / mean
    out = []
    for low, high in octaves(data.frequency):
        inside = (data.frequency >= low) & (data.frequency < high)
        if inside.any():
            top = min(high, float(data.frequency[-1]))
            out += [
                Band(name, low, top, float(np.mean(unit[inside, k])))
                for k, name in enumerate(data.outputs)
            ]
    return tuple(out)


def per_dof(search: Search, lines: Measured, fitted: Fitted) -> tuple[float, Float]:
    """Chi-square per degree of freedom on other lines, and of each line its share."""
    h = fitted.model.response(fitted.x, search.grid.at(lines.frequency, lines.level))
    chi = lines.chi_square(h)
    return float(np.sum(chi) / np.sum(lines.expected)), chi


def gap(search: Search, show: Measured, before: Fitted, after: Fitted) -> Gap:
    """How far the way from the refitted nominal model to the noise was gone, on `show`."""
    a, chi_before = per_dof(search, show, before)
    b, chi_after = per_dof(search, show, after)
    rng = np.random.default_rng(1)
    rows = rng.integers(0, show.n, (DRAWS, show.n))
    floor = show.expected
    num = (chi_before - chi_after)[rows].sum(axis=1)
    den = (chi_before - floor)[rows].sum(axis=1)
    # Where nothing is left to be closed, only the sign of the change says anything.
    value = (a - b) / (a - 1) if a > 1 else min(a - b, 0.0)
    drawn = num / np.where(np.abs(den) > 0, den, np.inf)
    low, high = np.quantile(drawn, [0.05, 0.95])
    return Gap(float(value), float(low), float(high))
