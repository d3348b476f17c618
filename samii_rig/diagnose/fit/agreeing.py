"""Whether recordings are of one state of a rig: each by itself against the others.

Runs that repeat an excitation tell noise by what they differ by, and a rig that was changed between
them passes for a noisy one. Here the noise is that of each recording alone. With F_i, t_i the
quadratic form of recording i in a change d of the response, all on the same nodes,

    min_d |F_i d - t_i|^2 + |F_j d - t_j|^2

is chi-square of what no one response, and so no one linear model, explains of i and j. Where both
hold the same excitations a force cannot explain it either: it answers the same the same.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from samii_rig.diagnose.data.measured import DIFFER
from samii_rig.diagnose.fit.records import RecordSearch, Whole
from samii_rig.errors import EstimateError
from samii_rig.likelihood.pieces import Piece
from samii_rig.likelihood.reduce import Reduced, orthonormal
from samii_rig.signal.columns import aligned, proportional
from samii_rig.signal.estimate import estimate
from samii_rig.types import Finding, Recording

REPEAT = "repeat"  # kind of finding that tells a repeat which is unlike the others
SURE = 5.0  # standard deviations of chi-square beyond which two recordings differ


@dataclass(frozen=True, slots=True)
class Apart:
    """Recordings of more than one state.

    states : the recordings of each, the first one's first. differing : chi-square per degree of
    freedom of the two that differ most. part : of what the nominal model leaves of all recordings,
    in units of each one's own noise, what the two differ by: no model of one state explains it.
    """

    states: tuple[tuple[str, ...], ...]
    differing: float
    part: float

    def told(self) -> str:
        """In words."""
        first, *others = (", ".join(names) for names in self.states)
        return (
            f"the recordings differ from each other (chi-square per degree of freedom "
            f"{self.differing:.3g}): {'; '.join(others)} as if of another state of the rig than "
            f"{first}"
        )

    def experiment(self) -> str:
        """How they are compared."""
        before, after = (" ".join(names) for names in self.states[:2])
        return f"compare the states: samii-rig diagnose --before {before} --after {after}"


@dataclass(frozen=True, slots=True)
class _Alone:
    """A recording by itself. whole : its pieces, those of each level apart. form : its likelihood
    about what all recordings led to."""

    name: str
    pieces: tuple[Piece, ...]
    form: Reduced

    @property
    def linear(self) -> bool:
        """Whether levels of its own show that it answers in proportion."""
        found, mean = self.form.differing
        return mean > 0 and found < DIFFER * mean

    def comparable(self, other: _Alone) -> bool:
        """Whether no force makes the two differ."""
        if self.linear and other.linear:
            return True
        ours, theirs = self.pieces, other.pieces
        return _all_in(ours, theirs) and _all_in(theirs, ours)


def states_apart(
    search: RecordSearch, runs: Sequence[Recording], findings: Sequence[Finding] = ()
) -> Apart | None:
    """The states that recordings are of, where they are of more than one.

    search : ended, on all of them together. findings : of their samples, as of `Whole.of`.
    """
    each = _alone(search, runs, findings)
    groups: list[list[_Alone]] = []
    worst = excess = 0.0
    for one in each:
        for group in groups:
            chi2, mean, sd = _difference(group[0].form, one.form)
            differ = group[0].comparable(one) and chi2 > max(DIFFER * mean, mean + SURE * sd)
            if not differ:
                group.append(one)
                break
            worst, excess = max(worst, chi2 / mean), max(excess, chi2 - mean)
        else:
            groups.append([one])
    if len(groups) < 2:
        return None
    left = _left(search, each)
    states = tuple(tuple(one.name for one in group) for group in groups)
    return Apart(states, worst, min(excess / left, 1.0) if left > 0 else 1.0)


def _alone(
    search: RecordSearch, runs: Sequence[Recording], findings: Sequence[Finding]
) -> list[_Alone]:
    """Each recording of which enough takes part, its likelihood on the nodes of all."""
    whole = search.whole
    if len(runs) < 2 or not isinstance(whole, Whole):
        return []
    records, sensors = whole.records, whole.wired.sensors
    band = records.bands[0] if whole.asked else None
    out = []
    for i, (run, _) in enumerate(aligned(runs)):
        try:
            own = Whole.of([run], whole.rig, band, sensors, _own(run, findings))
        except EstimateError:
            continue
        if own.wired == whole.wired:
            long = replace(own, records=replace(own.records, least=records.longest))
            form = long.about(search.nominal.fitted, search.reduced.frequency)
            pieces = own.by_level().records.pieces
            out.append(_Alone(run.source or f"recording {i + 1}", pieces, form))
    return out


def _own(run: Recording, findings: Sequence[Finding]) -> Sequence[Finding]:
    """Findings of a recording's samples; what its repeats differ by, if it has any, among its own:
    those of another state are foreign to it."""
    if not any(f.kind == REPEAT for f in findings):
        return findings
    alone = estimate([run], gaps="exclude")
    if not alone or any(r.n_averages < 2 for r in alone):
        return findings
    foreign = [f for r in alone for f in r.findings if f.kind == REPEAT and f.severity == "error"]
    return [*foreign, *(f for f in findings if f.kind != REPEAT)]


def _difference(a: Reduced, b: Reduced) -> tuple[float, float, float]:
    """Chi-square of what no one response explains of two, its mean and its standard deviation."""
    m = a.factor.shape[0]
    factor = np.concatenate([x.factor.reshape(x.factor.shape[0], -1) for x in (a, b)])
    target = np.concatenate([a.target, b.target])
    Q = orthonormal(factor)
    chi2 = float(target @ target) - float(np.sum((Q.T @ target) ** 2))
    # Directions that neither tells anything of are in both forms, and in no difference.
    mean = max(a.known + b.known - min(Q.shape[1], m), 1.0)
    free = 1 / max(a.inside[1], 1.0) + 1 / max(b.inside[1], 1.0)  # the noise is known to so much
    return chi2, mean, float(np.sqrt(2 * mean + 2 * mean**2 * free))


def _left(search: RecordSearch, each: Sequence[_Alone]) -> float:
    """Chi-square, over its mean, that the nominal model leaves in units of each one's noise."""
    fitted, total = search.nominal.fitted, 0.0
    for one in each:
        at = search.whole.nodes(one.form, fitted)
        r = one.form.residual(fitted.model.response(fitted.x, at))
        total += float(r @ r) - one.form.known
    return total


def _all_in(some: Sequence[Piece], others: Sequence[Piece]) -> bool:
    """Whether each of some excitations is among the others, at the same level."""
    return all(
        any(
            p.levels == o.levels
            and p.r.shape == o.r.shape
            and proportional(p.r.ravel(), o.r.ravel())
            for o in others
        )
        for p in some
    )
