"""From explanations to a verdict: probabilities, the unknown, and what it is worth."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import stats

from samii_rig.diagnose.between_runs import Changing, between_runs
from samii_rig.diagnose.channels import NOT_PHYSICS
from samii_rig.diagnose.classes import Class, classes
from samii_rig.diagnose.effect import Effect
from samii_rig.diagnose.measured import Measured
from samii_rig.diagnose.own_law import OwnLaw, own_law
from samii_rig.diagnose.refit import Fitted, Problem
from samii_rig.diagnose.result import Band, Cause, Gap, Value, Verdict
from samii_rig.diagnose.search import NEAR, Explanation, Search
from samii_rig.diagnose.stated import PLACE, TINY, Evidence, probability
from samii_rig.signal.statistics import octaves
from samii_rig.types import Float

FALSE_ALARM = 0.003  # of the chi-square test of the nominal model alone
NOTHING = 0.2  # probability of nothing missing below which it is called missing
SURE = 0.8  # probability of an answer from which it is named
DOUBT = 0.3  # probability of an answer below which none is given
MOSTLY = 0.5  # of the mismatch; one cause that explains it is told whatever else is missing
MOST_NAMES = 4  # of a class; more is no answer
IN_DATA = 45.0  # of chi-square, that an effect must explain of the data to be called missing
UNEXPLAINED = 3e-4  # chance that noise leaves as much as makes an empty answer "unknown"
DRAWS = 400
MUST_SHOW = 900.0  # of chi-square, that an effect explains of the data: 30 noise units
SAID = ("named", "ambiguous")  # verdicts that come with causes
SHOWN = 0.01  # probability of an alternative from which it is listed
# What a factor between two units is: their names are told, not physics.
UNITS = {57.29578: "degrees for radians", 9.80665: "g for m/s^2", 1000.0: "milli for one",
         6.283185: "hertz for rad/s"}  # fmt: skip
UNIT_WITHIN = 0.03


@dataclass(frozen=True, slots=True)
class Judgement:
    """classes : the most probable first; empty effects mean that nothing is missing. Their
        probabilities are among what was looked at.

    nothing : probability of nothing missing. right : that the chosen explanation is right, up to
        its class, by its evidence. inflation : factor on covariances for what it leaves.
    beyond : what is in no table and explains the data better; the place is then its own.
    """

    verdict: Verdict
    classes: tuple[Class, ...]
    nothing: float
    right: float
    evidence: Evidence
    inflation: float
    beyond: Changing | OwnLaw | None = None

    @property
    def best(self) -> Explanation:
        """The chosen explanation."""
        return self.classes[0].first

    @property
    def shares(self) -> tuple[float, ...]:
        """Probability of each class; what is left to one is of what was not looked at."""
        shares = self._shared(self.right)
        if self.beyond is None:
            return shares
        return tuple((1 - max(p for _, p in self.beyond.sites)) * share for share in shares)

    def _shared(self, first: float) -> tuple[float, ...]:
        """Of each class, where that of the first is known."""
        if not self.best.effects:
            return tuple(c.probability for c in self.classes)
        others = [c.probability for c in self.classes[1:]]
        scale = min((1 - first) / sum(others), 1.0) if sum(others) > 0 else 0.0
        return (first, *(scale * p for p in others))

    @property
    def placed(self) -> tuple[float, ...]:
        """As `shares`, that each class's sites are right, whatever the physics there."""
        return self._shared(probability(self.evidence, PLACE))

    @property
    def outside(self) -> float:
        """Probability of something that was not looked at."""
        return max(0.0, 1 - sum(self.shares))


def threshold(data: Measured, chance: float = FALSE_ALARM) -> float:
    """Chi-square per degree of freedom that noise alone exceeds with this chance."""
    return float(stats.gamma.isf(chance, 1 / data.spread, scale=data.spread))


def judge(search: Search, decide: Measured | None = None) -> Judgement:
    """Probabilities of all explanations that were looked at, and the verdict.

    decide : lines that took no part in the fit, on which the best explanation must hold too.
    """
    thin = _thin(search)
    kept = [e for e in search.ranked() if e.key not in thin]
    ranked = _decided(search, decide, kept) if decide is not None else kept
    weights = np.array([e.weight for e in ranked])
    p = np.exp(weights - np.max(weights))
    grouped = classes(ranked, (p / p.sum()).tolist(), search.problem, search.temperature)
    nothing = sum(c.probability for c in grouped if not c.first.effects)
    ordered = tuple(_chosen_first(grouped, nothing))
    evidence = _evidence(search, ordered, ranked, decide)
    said = _verdict(ordered[0], evidence, search, decide)
    beyond = _beyond(search, ordered[0].first, evidence, decide) if said != "no_mismatch" else None
    return Judgement(
        verdict="unknown" if beyond else said,
        classes=ordered,
        nothing=nothing,
        right=probability(evidence),
        evidence=evidence,
        inflation=search.temperature,
        beyond=beyond,
    )


def _beyond(
    search: Search, best: Explanation, evidence: Evidence, decide: Measured | None
) -> Changing | OwnLaw | None:
    """What is in no table and explains the data better."""
    if any(e.quasi is not None for e in best.effects):
        return None
    if decide is not None and evidence.held > threshold(decide, UNEXPLAINED):
        absorbed = evidence.drop <= IN_DATA
        base = search.nominal if absorbed else best
        if (changing := between_runs(search, base.fitted, decide)) is not None:
            return changing
    return own_law(search, best)


def _evidence(
    search: Search,
    ordered: Sequence[Class],
    ranked: Sequence[Explanation],
    decide: Measured | None,
) -> Evidence:
    chosen = ordered[0]
    first = chosen.first
    # Sums, not 1 - p: odds of a million are told from odds of a billion.
    others = sum(c.probability for c in ordered[1:])
    empty = next((e.weight for e in ranked if not e.effects), -math.inf)
    before, left = search.ratio(search.nominal.fitted), search.ratio(first.fitted)
    return Evidence(
        odds=math.log(max(chosen.probability, TINY) / max(others, TINY)),
        left=left,
        held=_held(search, decide, first.fitted) if decide is not None else 1.0,
        effects=len(first.effects),
        forced=any(e.quasi is not None for e in first.effects),
        confirmed=False,
        gain=min(first.weight - empty, 1e6),
        drop=(search.nominal.fitted.chi2 - first.fitted.chi2) / search.temperature,
        names=chosen.names(),
        pair=len(first.effects) == 2 and len({e.physics for e in first.effects}) == 1,
        closed=(before - left) / (before - 1) if before > 1 else 0.0,
    )


def confirmed(judged: Judgement) -> Judgement:
    """The same once a nonlinear force was confirmed in time."""
    evidence = replace(judged.evidence, confirmed=True)
    said = "unknown" if evidence.names > MOST_NAMES else _said(evidence)
    return replace(judged, verdict=said, right=probability(evidence), evidence=evidence)


def _verdict(
    chosen: Class,
    evidence: Evidence,
    search: Search,
    decide: Measured | None,
) -> Verdict:
    if not chosen.first.effects:
        return "unknown" if _unexplained(evidence, search, decide) else "no_mismatch"
    if evidence.drop <= IN_DATA:
        # What a refit of the nominal parameters absorbs, at the cost of values that their
        # tolerances make unlikely, is not in the data.
        return "unknown" if _unexplained(evidence, search, decide) else "no_mismatch"
    if evidence.names > MOST_NAMES:
        return "unknown"
    if all(e.physics in NOT_PHYSICS for e in chosen.first.effects):
        return "no_mismatch"
    said = _said(evidence)
    # A nonlinear force is named once it was confirmed in time: see `confirmed`.
    return "ambiguous" if said == "named" and evidence.forced else said


def _unexplained(evidence: Evidence, search: Search, decide: Measured | None) -> bool:
    """Whether more than noise is left on lines that were fitted or on those that were not: what
    changes from run to run is seen by the latter alone."""
    held = decide is not None and evidence.held > threshold(decide, UNEXPLAINED)
    return held or evidence.left > threshold(search.lines, UNEXPLAINED)


def _said(evidence: Evidence) -> Verdict:
    right = probability(evidence)
    if right >= DOUBT:
        return "named" if right >= SURE else "ambiguous"
    one = evidence.effects == 1 and evidence.closed > MOSTLY
    return "ambiguous" if one else "unknown"


def doubted(judged: Judgement, most: Verdict) -> Judgement:
    """The same where something is wrong with the recordings that could pass for physics: no more
    is said than `most`."""
    return replace(judged, verdict=most) if judged.verdict in SAID else judged


def shown(judged: Judgement, gap: Gap, due: float) -> Judgement:
    """The same, but nothing is named that makes data worse which it was not fitted to: beyond what
    chance does, or at all if it is so large that it must show, there too. due : of `due_there`."""
    must = judged.evidence.drop > MUST_SHOW and due > IN_DATA
    worse = gap.high < 0 or (gap.value < 0 and must)
    if judged.verdict in SAID and worse:
        return replace(judged, verdict="unknown")
    return judged


def _thin(search: Search) -> set[frozenset[str]]:
    """Explanations of linear effects of which one, beside the others, is not in the data: it spares
    the nominal parameters values that their tolerances make unlikely, and no more."""
    ranked = search.ranked()
    near = [e for e in ranked if e.weight > ranked[0].weight - NEAR]
    out = set()
    while near:
        e = near.pop()
        if len(e.effects) < 2 or e.key in out or any(x.quasi is not None for x in e.effects):
            continue
        for i in range(len(e.effects)):
            less = search.without(e, i)
            gained = less.fitted.chi2 - e.fitted.chi2 if less is not None else math.inf
            if less is not None and gained < IN_DATA * search.temperature:
                out.add(e.key)
                near.append(less)
    return out


def _decided(search: Search, lines: Measured, ranked: list[Explanation]) -> list[Explanation]:
    """Those of `ranked` that may still compete, and that nothing is missing, weighed anew by how
    likely each makes lines that were not fitted; the most probable first."""
    rivals = [e for e in ranked if e.weight > ranked[0].weight - NEAR or not e.effects]
    predicted = {e.key: _predicted(search, lines, e.fitted) for e in rivals}
    gross, _ = predicted[search.nominal.key]
    heard = []
    for e in rivals:
        chi2, spread = predicted[e.key]
        lost = 0.5 * (chi2 / search.temperature + spread) + search.inexact(e.effects, gross)
        heard.append(replace(e, weight=e.weight - lost))
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


def _chosen_first(grouped: Sequence[Class], nothing: float) -> list[Class]:
    """Nothing missing last, unless that is the answer."""
    alarmed = nothing < NOTHING
    return sorted(grouped, key=lambda c: (bool(c.first.effects) != alarmed, -c.probability))


def causes_of(chosen: Class, judged: Judgement, share: float | None = None) -> tuple[Cause, ...]:
    """The physics of a class's first member. Each has its own marginal probability, or that of
    the whole class where it is given."""
    first = chosen.first
    values = _values(first, judged.inflation)
    out = []
    for effect, found in zip(first.effects, values, strict=True):
        if effect.physics in NOT_PHYSICS or unit_of(effect, found):
            continue
        same = {effect.name, *chosen.equivalents(effect)}
        p = share
        if p is None:
            p = sum(
                q
                for c, q in zip(judged.classes, judged.shares, strict=True)
                if any(n in same for e in c.first.effects for n in e.names)
            )
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
            case "time_offset":
                t = found["tau"]
                out.append(
                    f"{effect.site} is {1e3 * t.value:.4g} ms ({1e3 * t.low:.4g} to "
                    f"{1e3 * t.high:.4g}) ahead of the other channels: stamped or read too early"
                )
            case "common_gain":
                g = found["gain"]
                out.append(
                    f"all channels share a gain of {g.value:.4g} ({g.low:.4g} to {g.high:.4g}): "
                    "a scale of the input, not a shape that physics would have"
                )
            case _ if unit:
                g = found["gain"]
                out.append(f"{effect.site} is {g.value:.4g} times what it should be: {unit}")
    if judged.beyond is not None:
        out.append(judged.beyond.told())
    many = judged.classes[0].names()
    if many > MOST_NAMES:
        alike = [" and ".join(" at ".join(e.name) for e in m.effects)
                 for m in judged.classes[0].members[:MOST_NAMES]]  # fmt: skip
        out.append(f"{many} names fit these data alike, among them {'; '.join(alike)}")
    return out


def sites(judged: Judgement) -> list[tuple[str, float]]:
    """Probability of each site over all explanations and what they are not told apart from, the
    most probable first. Sites of what was chosen are there however improbable."""
    if judged.beyond is not None:
        return [(s, p) for s, p in judged.beyond.sites if p >= SHOWN]
    total: dict[str, float] = defaultdict(float)
    for c, share in zip(judged.classes, judged.placed, strict=True):
        for member, part in c.parts():
            for site in {e.site for e in member.effects if e.physics not in NOT_PHYSICS}:
                total[site] += share * part
    chosen = {e.site for e in judged.best.effects}
    ranked = sorted(total.items(), key=lambda item: -item[1])
    return [(s, min(p, 1.0)) for s, p in ranked if p >= SHOWN or s in chosen]


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
    drawn = num / np.where(np.abs(den) > 0, np.abs(den), np.inf)
    low, high = np.quantile(drawn, [0.05, 0.95])
    return Gap(float(value), float(low), float(high))


def due_there(search: Search, show: Measured, before: Fitted, after: Fitted) -> float:
    """Chi-square that `after`, if true, should explain of other lines: they may lie where the two
    are alike."""
    at = search.grid.at(show.frequency, show.level)
    predicted = replace(show, H=after.model.response(after.x, at))
    return float(np.sum(predicted.chi_square(before.model.response(before.x, at))))
