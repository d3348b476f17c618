"""From explanations to a verdict: probabilities, the unknown, and what it is worth."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from samii_rig.diagnose.data.measured import Measured
from samii_rig.diagnose.fit.between_runs import Changing, between_runs
from samii_rig.diagnose.fit.classes import Class, classes
from samii_rig.diagnose.fit.explanations import NEAR_BEST, Explanation, Explanations, threshold
from samii_rig.diagnose.fit.records import TEST_TURN
from samii_rig.diagnose.fit.refit import Fitted, Problem
from samii_rig.diagnose.fit.search import Search
from samii_rig.diagnose.fit.stated import IN_DATA, PLACE, TINY, Evidence, probability
from samii_rig.diagnose.forces.variation import Variation
from samii_rig.diagnose.result import PROBABLE, Gap, Verdict

NOTHING_FROM = 0.2  # probability of nothing missing below which it is called missing
SURE = 0.8  # probability of an answer from which it is named
MOSTLY = 0.5  # of the mismatch; one cause that explains it is told whatever else is missing
MOST_NAMES = 4  # of a class; more is no answer
MUST_SHOW = 900.0  # of chi-square, that an effect explains of the data: 30 noise units
# Of the mismatch, above which what two states have in common is told: where one of them has it
# alone, an effect of both explains half, give or take the noise.
COMMON = 0.6
# Amplitude of what a force does, relative, that no bench follows its law by: a cause beside it that
# does no more is none where the force by itself leaves no more than noise. Beside the dead band of
# a valve, integrated by other means than ours, an oscillator of 0.4 g did 0.6 %.
FOLLOWED = 0.01
PARTLY = 0.9  # of the mismatch: effects that leave more of it, and more than noise, are not named
WITH_CAUSES = ("named", "ambiguous")  # verdicts that come with causes


@dataclass(frozen=True, slots=True)
class Judgement:
    """classes : the most probable first; empty effects mean that nothing is missing. Their
        probabilities are among what was looked at.

    nothing : probability of nothing missing. right : that the chosen explanation is right, up to
        its class, by its evidence. overdispersion : factor on covariances for what it leaves.
    varies : a stiffness that is not constant, where that explains the data better than all classes;
    the place is then its own.
    partly : whether the effects leave much of the mismatch, and more than noise.
    """

    verdict: Verdict
    classes: tuple[Class, ...]
    nothing: float
    right: float
    evidence: Evidence
    overdispersion: float
    varies: Variation | Changing | None = None
    partly: bool = False

    @property
    def best(self) -> Explanation:
        """The chosen explanation."""
        return self.classes[0].first

    @property
    def between(self) -> bool:
        """Whether a stiffness differs from record to record."""
        return self.varies is not None and "spread" in self.varies.parameters

    @property
    def probabilities(self) -> tuple[float, ...]:
        """Probability of each class; what is left to one is of what was not looked at."""
        return self._probabilities(self.right)

    def _probabilities(self, first: float) -> tuple[float, ...]:
        """Of each class, where that of the first is known."""
        if self.varies is not None:
            total = sum(c.probability for c in self.classes)
            return tuple((1 - first) * c.probability / total for c in self.classes)
        if not self.best.effects:
            return tuple(c.probability for c in self.classes)
        others = [c.probability for c in self.classes[1:]]
        scale = min((1 - first) / sum(others), 1.0) if sum(others) > 0 else 0.0
        return (first, *(scale * p for p in others))

    @property
    def placed(self) -> tuple[float, ...]:
        """As `probabilities`, that each class's sites are right, whatever the physics there."""
        return self._probabilities(probability(self.evidence, PLACE))

    @property
    def outside(self) -> float:
        """Probability of something that was not looked at."""
        return max(0.0, 1 - sum(self.probabilities))


def judge(search: Search, decide: Measured | None = None) -> Judgement:
    """Probabilities of all explanations that were looked at, and the verdict.

    decide : lines that took no part in the fit, on which the best explanation must hold too.
    """
    insignificant = _insignificant(search)
    for key, e in search.found.items():
        search.found[key] = replace(e, fitted=e.fitted.with_model_error())
    kept = [e for e in search.ranked() if e.key not in insignificant and search.holds(e)]
    ranked = _decided(search, decide, kept) if decide is not None else kept
    weights = np.array([e.weight for e in ranked])
    p = np.exp(weights - np.max(weights))
    grouped = classes(ranked, (p / p.sum()).tolist(), search.problem, search.overdispersion)
    nothing = sum(c.probability for c in grouped if not c.first.effects)
    ordered = tuple(_chosen_first(grouped, nothing))
    evidence = _evidence(search, ordered, ranked, decide)
    verdict = _verdict(ordered[0], evidence, search, decide)
    varies = (
        _changing(search, ordered[0].first, evidence, decide) if verdict != "no_mismatch" else None
    )
    # Beside more than noise that nothing explains, an effect is believed for the part that is its.
    much = search.partial or evidence.closed < PARTLY
    partly = much and _unexplained(evidence, search, decide)
    if partly:
        verdict = _most(verdict, evidence)
    return Judgement(
        # There are no test lines on which it could show.
        verdict="unknown" if varies else verdict,
        classes=ordered,
        nothing=nothing,
        right=max(p for _, p in varies.sites) if varies else probability(evidence),
        evidence=evidence,
        overdispersion=search.overdispersion,
        varies=varies,
        partly=partly,
    )


def _changing(
    search: Search, best: Explanation, evidence: Evidence, decide: Measured | None
) -> Changing | None:
    """A joint that changes from run to run, where that explains the data better."""
    if any(e.force is not None for e in best.effects):
        return None
    if decide is not None and evidence.held > threshold(decide.spread):
        absorbed = evidence.drop <= evidence.worth
        base = search.nominal if absorbed else best
        return between_runs(search, base.fitted, decide)
    return None


def varying(judged: Judgement, base: Explanation, found: Variation, rival: float) -> Judgement:
    """The same where a stiffness that is not constant explains more than all that was judged.
    base : what else is right, whose mismatch it explains. rival : logarithm of the evidence of what
    was judged, over that."""
    ahead = found.evidence - rival
    others = sum(p for _, p in found.sites[1:])
    if not found.again:  # as likely a law of the amplitude that no row has
        others += 1.0
    evidence = Evidence(
        odds=-math.log(max(others + math.exp(-max(ahead, 0.0)), TINY)),
        left=found.after[0],
        held=1.0,
        effects=1,
        forced=True,
        confirmed=found.gap.low > 0,
        gain=found.evidence,
        drop=found.gain,
        names=1,
        pair=False,
        closed=found.closed,
        worth=judged.evidence.worth,
    )
    verdict = _by_probability(evidence)
    if verdict == "named" and not (evidence.confirmed and found.again):
        verdict = "ambiguous"
    partly = evidence.closed < PARTLY and not found.inside
    if partly:
        verdict = _most(verdict, evidence)
    made = replace(
        judged,
        verdict=verdict,
        classes=(Class((base,), (0.0,), 0.0), *judged.classes),
        right=probability(evidence),
        evidence=evidence,
        varies=found,
        partly=partly,
    )
    return shown(made, found.gap, evidence.drop / (TEST_TURN - 1))


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
    physics = [e.physics for e in first.effects if e.physical]
    base = as_meant(search, first).fitted
    return Evidence(
        odds=math.log(max(chosen.probability, TINY) / max(others, TINY)),
        left=search.ratio(first.fitted),
        held=_held(search, decide, first.fitted) if decide is not None else 1.0,
        effects=len(physics),
        forced=any(e.force is not None for e in first.effects),
        confirmed=False,
        gain=min(first.weight - empty, 1e6),
        drop=(base.chi2 - first.fitted.chi2) / search.overdispersion,
        names=chosen.names(),
        pair=len(physics) == 2 and physics[0] == physics[1],
        closed=search.closed(base, first.fitted),
        worth=search.critical_value_of(first.effects),
    )


def as_meant(search: Explanations, best: Explanation) -> Explanation:
    """The nominal model of what was meant to be recorded: with what is no physics of `best`, which
    no physics gets the credit for."""
    meant = tuple(e for e in best.effects if not e.physical)
    if not meant:
        return search.nominal
    key = frozenset(e.key for e in meant)
    if key not in search.found:
        own = zip(best.effects, map(best.fitted.model.own, range(len(best.effects))), strict=True)
        more = [best.fitted.x[k] for e, at in own if not e.physical for k in at]
        # What no unknown mends, as a shift by whole samples, has left the nominal model far away.
        near = replace(best.fitted, x=best.fitted.x[: best.fitted.model.n_nominal])
        for start in (search.nominal, replace(best, fitted=near)):
            if (end := search.refitted(meant, start, more)) is not None:
                search.keep(meant, end)
    return search.found.get(key, search.nominal)


def confirmed(judged: Judgement) -> Judgement:
    """The same once a nonlinear force was confirmed in time."""
    evidence = replace(judged.evidence, confirmed=True)
    verdict = "unknown" if evidence.names > MOST_NAMES else _by_probability(evidence)
    if judged.partly:
        verdict = _most(verdict, evidence)
    return replace(judged, verdict=verdict, right=probability(evidence), evidence=evidence)


def _verdict(
    chosen: Class,
    evidence: Evidence,
    search: Search,
    decide: Measured | None,
) -> Verdict:
    # What a refit of the nominal parameters absorbs, at the cost of values that their tolerances
    # make unlikely, is not in the data; what is no physics is told beside the verdict.
    physics = [e for e in chosen.first.effects if e.physical]
    if not physics or evidence.drop <= evidence.worth:
        return "unknown" if _unexplained(evidence, search, decide) else "no_mismatch"
    if evidence.names > MOST_NAMES:
        return "unknown"
    verdict = _by_probability(evidence)
    # A nonlinear force is named once it was confirmed in time: see `confirmed`.
    return "ambiguous" if verdict == "named" and evidence.forced else verdict


def _unexplained(evidence: Evidence, search: Search, decide: Measured | None) -> bool:
    """Whether more than noise is left on lines that were fitted or on those that were not: what
    changes from run to run is seen by the latter alone."""
    held = decide is not None and evidence.held > threshold(decide.spread)
    return held or evidence.left > threshold(search.spread)


def _by_probability(evidence: Evidence) -> Verdict:
    right = probability(evidence)
    if right >= PROBABLE:
        return "named" if right >= SURE else "ambiguous"
    one = evidence.effects == 1 and evidence.closed > MOSTLY
    return "ambiguous" if one else "unknown"


def _most(verdict: Verdict, evidence: Evidence) -> Verdict:
    """What may be said of effects that leave much: one cause of most of it may be told. Sums of
    two mimic what is in no table."""
    if verdict not in WITH_CAUSES:
        return verdict
    return "ambiguous" if evidence.effects == 1 and evidence.closed > MOSTLY else "unknown"


def limited(judged: Judgement, most: Verdict) -> Judgement:
    """The same where something is wrong with the recordings that could pass for physics: no more
    is said than `most`."""
    return replace(judged, verdict=most) if judged.verdict in WITH_CAUSES else judged


def without_causes(judged: Judgement) -> Judgement:
    """The same where all that is said is no physics: a sensor's gain that is a unit."""
    without: dict[Verdict, Verdict] = {"named": "no_mismatch", "ambiguous": "unknown"}
    return replace(judged, verdict=without.get(judged.verdict, judged.verdict))


def of_several_states(judged: Judgement, part: float) -> Judgement:
    """The same where the recordings are of several states of the rig. part : of the mismatch, what
    no model of one state explains; an effect may be told for the rest."""
    if judged.verdict == "no_mismatch":
        return replace(judged, verdict="unknown")
    evidence = replace(judged.evidence, closed=min(judged.evidence.closed, 1 - part))
    if evidence.closed >= PARTLY:
        return judged
    known = evidence.closed > COMMON
    return replace(judged, verdict=_most(judged.verdict, evidence) if known else "unknown")


def shown(judged: Judgement, gap: Gap, due: float) -> Judgement:
    """The same, but nothing is named that makes data worse which it was not fitted to: beyond what
    chance does, or at all if it is so large that it must show, there too.

    due : of `answer.due_there`; a command that is clipped at the highest level alone shows at no
        other.
    """
    must = judged.evidence.drop > MUST_SHOW and due > IN_DATA
    worse = gap.high < 0 or (gap.value < 0 and must)
    if judged.verdict in WITH_CAUSES and worse:
        return replace(judged, verdict="unknown")
    return judged


def _insignificant(search: Search) -> set[frozenset[str]]:
    """Explanations of which one linear effect, beside the others, is not in the data: it spares
    the nominal parameters values that their tolerances make unlikely, and no more."""
    out: set[frozenset[str]] = set()
    while True:
        ranked = [e for e in search.ranked() if e.key not in out]
        near = [e for e in ranked if e.weight > ranked[0].weight - NEAR_BEST]
        if not (insignificant := {e.key for e in near if _is_insignificant(search, e)}):
            return out
        out |= insignificant


def _is_insignificant(search: Search, e: Explanation) -> bool:
    if len(e.effects) < 2:
        return False
    single = [s for s in search.found.values() if len(s.effects) == 1 and not s.key <= e.key]
    if any(s.fitted.chi2 - e.fitted.chi2 < _off(search, s) for s in single if s.effects[0].rough):
        # Several effects that fit better than one, by no more than its own law may be off.
        return True
    fewer: list[Explanation | None] = []
    for i, effect in enumerate(e.effects):
        if not effect.physical:
            # What is wrong with the data is no answer. Of two causes beside it, evidence decides.
            continue
        if all(x.force is None for x in e.effects):
            fewer.append(search.without(e, i))
        else:
            # A force is not refitted here: what is left without one of both was fitted to itself,
            # or not at all.
            fewer.append(search.found.get(e.key - {effect.key}))
    return any(
        less is not None and less.fitted.chi2 - e.fitted.chi2 < _critical_value(search, less, e)
        for less in fewer
    )


def _critical_value(search: Search, less: Explanation, more: Explanation) -> float:
    """Chi-square that an effect which `more` has beside those of `less` must explain: more than
    chance does, and more than their own laws are off by."""
    critical = search.critical_value_of(more.effects)
    least = max(critical * search.overdispersion, _off(search, less))
    forced = any(x.force is not None for x in less.effects)
    if forced and search.ratio(less.fitted) <= threshold(search.spread):
        did = as_meant(search, less).fitted.chi2 - less.fitted.chi2
        least = max(least, FOLLOWED**2 * did)
    return least


def _off(search: Search, e: Explanation) -> float:
    """Chi-square that an explanation leaves because the laws of its effects do not quite hold."""
    faults = max((x.rough for x in e.effects if not x.physical), default=0.0)
    law = max((x.rough for x in e.effects if x.physical), default=0.0)
    nominal = search.nominal.fitted.chi2
    # What is wrong with the data no law of the rig explains.
    meant = as_meant(search, e).fitted.chi2 if law else nominal
    left = e.fitted.chi2
    return max(faults**2 * (nominal - left), law**2 * (meant - left))


def _decided(search: Search, lines: Measured, ranked: list[Explanation]) -> list[Explanation]:
    """Those of `ranked` that may still compete, and that nothing is missing, weighed anew by how
    likely each makes lines that were not fitted; the most probable first."""
    rivals = [e for e in ranked if e.weight > ranked[0].weight - NEAR_BEST or not e.effects]
    predicted = {e.key: _predicted(search, lines, e.fitted) for e in rivals}
    nominal_chi2, _ = predicted[search.nominal.key]
    reweighted = []
    for e in rivals:
        chi2, spread = predicted[e.key]
        lost = 0.5 * (chi2 / search.overdispersion + spread) + search.model_error_penalty(
            e.effects, nominal_chi2
        )
        reweighted.append(replace(e, weight=e.weight - lost))
    return sorted(reweighted, key=lambda e: -e.weight)


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
    alarmed = nothing < NOTHING_FROM
    return sorted(grouped, key=lambda c: (bool(c.first.effects) != alarmed, -c.probability))
