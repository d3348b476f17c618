"""Whether recordings are of one state of a rig: each by itself against the others.

Runs that repeat an excitation tell noise by what they differ by, and a rig that was changed between
them passes for a noisy one. Here the noise is that of each recording alone. With F_i, t_i the
quadratic form of recording i in a change d of the response, all on the same nodes,

    min_d |F_i d - t_i|^2 + |F_j d - t_j|^2

is chi-square of what no one response, and so no one linear model, explains of i and j. Where both
hold the same excitations a force cannot explain it either: it answers the same the same.

Responses that were kept without their samples are held against each other line by line, those of
one level, as a force answers the same the same.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial

import numpy as np

from samii_rig.diagnose.data.measured import DIFFER, PERIODIC, Measured, measured, repeated
from samii_rig.diagnose.fit.record_search import RecordSearch
from samii_rig.diagnose.fit.records import Whole
from samii_rig.diagnose.fit.refit import Fitted
from samii_rig.errors import EstimateError, InputError
from samii_rig.likelihood.algebra import orthonormal
from samii_rig.likelihood.excited import within
from samii_rig.likelihood.form import Reduced
from samii_rig.likelihood.pieces import Piece
from samii_rig.rig.schema import Rig
from samii_rig.signal.columns import proportional
from samii_rig.signal.estimate import estimate
from samii_rig.types import Finding, Float, FrequencyResponse, Recording

REPEAT = "repeat"  # kind of finding that tells a repeat which is unlike the others
SURELY_DIFFER = 5.0  # standard deviations of chi-square beyond which two recordings differ

Band = tuple[float, float]
Saved = tuple[str, Sequence[FrequencyResponse]]  # a file and the responses that it kept


@dataclass(frozen=True, slots=True)
class Given:
    """Recordings that were given as of one state.

    whole : all of them; fitted : a model of that state, about which they are held against each
    other, on the nodes frequency, Hz. findings : of their samples, as of `Whole.of`. where : which
    of the recordings these are, " before" or " in pose 30 deg".
    """

    runs: Sequence[Recording]
    whole: Whole
    fitted: Fitted
    frequency: Float
    findings: Sequence[Finding] = ()
    where: str = ""

    @classmethod
    def of(
        cls, search: RecordSearch, runs: Sequence[Recording], findings: Sequence[Finding]
    ) -> Given:
        """All recordings of a search that is ended."""
        assert isinstance(search.whole, Whole)
        fitted = search.nominal.fitted
        return cls(runs, search.whole, fitted, search.reduced.frequency, findings)


@dataclass(frozen=True, slots=True)
class SeveralStates:
    """Recordings of more than one state.

    states : the recordings of each, the first one's first. differing : chi-square per degree of
    freedom of the two that differ most. part : of what the nominal model leaves of all recordings,
    in units of each one's own noise, what the two differ by: no model of one state explains it.
    where : as of `Given`. samples : whether they were compared by their samples.
    """

    states: tuple[tuple[str, ...], ...]
    differing: float
    part: float
    where: str = ""
    samples: bool = True

    def describe(self) -> str:
        """In words."""
        first, *others = (", ".join(names) for names in self.states)
        return (
            f"the recordings{self.where} differ from each other (chi-square per degree of freedom "
            f"{self.differing:.3g}): {'; '.join(others)} as if of another state of the rig than "
            f"{first}"
        )

    def experiment(self) -> str:
        """How they are compared."""
        before, after = (" ".join(names) for names in self.states[:2])
        if not self.samples:
            behind = f"the recordings behind {before} and those behind {after}"
            return f"compare {behind}: samii-rig diagnose with --before and --after"
        return f"compare the states: samii-rig diagnose --before {before} --after {after}"


@dataclass(frozen=True)
class _Alone:
    """A recording by itself. whole : its records. given : all recordings, about whose model it is
    held against others."""

    name: str
    whole: Whole
    given: Given

    @cached_property
    def form(self) -> Reduced:
        """Its likelihood, computed where the recording is compared."""
        return self.whole.about(self.given.fitted, self.given.frequency)

    @property
    def pieces(self) -> tuple[Piece, ...]:
        """Its pieces, those of each level apart."""
        return self.whole.by_level().records.pieces

    @property
    def linear(self) -> bool:
        """Whether levels of its own show that it answers in proportion."""
        if not any(p.contrasts for p in self.whole.records.pieces):
            return False
        found, mean = self.form.differing
        return mean > 0 and found < DIFFER * mean

    def comparable(self, other: _Alone) -> bool:
        """Whether no force makes the two differ."""
        ours, theirs = self.pieces, other.pieces
        alike = _all_in(ours, theirs) and _all_in(theirs, ours)
        return alike or (self.linear and other.linear)


def several_states(every: Sequence[Given], left: float | None = None) -> list[SeveralStates]:
    """The states that recordings are of, for each of several that are given as of one and are of
    more; those that differ most come first. left : chi-square over its mean that is to be explained
    of all; None for what the models leave of each recording."""
    each = [_alone(given) if len(given.runs) > 1 else [] for given in every]
    found = [_grouped(len(own), partial(_records_differ, own)) for own in each]
    if not any(len(one.groups) > 1 for one in found):
        return []
    if left is None:
        alone = [one or _alone(given) for given, one in zip(every, each, strict=True)]
        left = sum(_left(given, one) for given, one in zip(every, alone, strict=True))
    several = [
        replace(one.several_states([alone.name for alone in own], left), where=given.where)
        for given, own, one in zip(every, each, found, strict=True)
        if len(one.groups) > 1
    ]
    return sorted(several, key=lambda one: -one.differing)


@dataclass(frozen=True, slots=True)
class _Grouped:
    """Recordings by their states. groups : of each the numbers. worst : chi-square per degree of
    freedom of the two that differ most; excess : the most of it over its mean."""

    groups: list[list[int]]
    worst: float
    excess: float

    def several_states(self, names: Sequence[str], left: float) -> SeveralStates:
        """What they differ by, of so much that is to be explained."""
        states = tuple(tuple(names[i] for i in group) for group in self.groups)
        return SeveralStates(states, self.worst, min(self.excess / left, 1.0) if left > 0 else 1.0)


def _grouped(n: int, difference: Callable[[int, int], tuple[float, float, float]]) -> _Grouped:
    """n recordings. difference : of two, chi-square, its mean and its standard deviation."""
    groups: list[list[int]] = []
    worst = excess = 0.0
    for i in range(n):
        for group in groups:
            chi2, mean, sd = difference(group[0], i)
            if not chi2 > max(DIFFER * mean, mean + SURELY_DIFFER * sd):
                group.append(i)
                break
            worst, excess = max(worst, chi2 / mean), max(excess, chi2 - mean)
        else:
            groups.append([i])
    return _Grouped(groups, worst, excess)


def _alone(given: Given) -> list[_Alone]:
    """Each recording of which enough takes part, its likelihood on the nodes of all."""
    whole = given.whole
    records, sensors = whole.records, whole.wired.sensors
    band = records.bands[0] if whole.asked else None
    out = []
    for i, run in enumerate(whole.runs):
        try:
            findings = _own(run, given.findings)
            own = Whole.of(
                [run], whole.rig, band, sensors, findings, in_order=True, hidden=whole.hidden
            )
            # On two states, those lines alone that both have.
            among = within(own.records, records.band)
        except EstimateError:
            continue
        if own.wired == whole.wired:
            # As long as all, so that what the model answers is computed once.
            long = replace(own, records=replace(among, least=records.longest), kept=whole.kept)
            out.append(_Alone(run.source or f"recording {i + 1}", long, given))
    return out


def _own(run: Recording, findings: Sequence[Finding]) -> Sequence[Finding]:
    """Findings of a recording's samples; what its repeats differ by, if it has any, among its own:
    those of another state are foreign to it."""
    if not any(f.kind == REPEAT for f in findings):
        return findings
    alone = estimate([run], gaps="auto")
    if not alone or any(r.n_averages < 2 for r in alone):
        return findings
    foreign = [f for r in alone for f in r.findings if f.kind == REPEAT and f.severity == "error"]
    return [*foreign, *(f for f in findings if f.kind != REPEAT)]


def _records_differ(each: Sequence[_Alone], i: int, j: int) -> tuple[float, float, float]:
    """As `_difference`, of two of them; 0 where a force may let them differ."""
    a, b = each[i], each[j]
    return _difference(a.form, b.form) if a.comparable(b) else (0.0, 0.0, 0.0)


def _difference(a: Reduced, b: Reduced) -> tuple[float, float, float]:
    """Chi-square of what no one response explains of two, its mean and its standard deviation."""
    m = a.factor.shape[0]
    factor = np.concatenate([x.factor.reshape(m, -1) for x in (a, b)])
    factor = factor[:, a.excited | b.excited]
    target = np.concatenate([a.target, b.target])
    Q = orthonormal(factor)
    chi2 = float(target @ target) - float(np.sum((Q.T @ target) ** 2))
    # Directions that neither tells anything of are in both forms, and in no difference.
    mean = max(a.known + b.known - min(Q.shape[1], m), 1.0)
    free = 1 / max(a.inside[1], 1.0) + 1 / max(b.inside[1], 1.0)  # the noise is known to so much
    return chi2, mean, float(np.sqrt(2 * mean + 2 * mean**2 * free))


def _left(given: Given, each: Sequence[_Alone]) -> float:
    """Chi-square, over its mean, that the nominal model leaves in units of each one's noise."""
    total = 0.0
    for one in each:
        at = given.whole.nodes(one.form, given.fitted)
        r = one.form.residual(given.fitted.model.response(given.fitted.x, at))
        total += float(r @ r) - one.form.known
    return total


def several_states_of_lines(
    files: Sequence[Saved], lines: Measured, left: float, rig: Rig
) -> SeveralStates | None:
    """As `several_states`, of responses that were kept without their samples.

    lines : of all that take part; left : chi-square over its mean that the nominal model leaves of
    them.
    """
    band = float(lines.frequency[0]), float(lines.frequency[-1])
    found = _lines_grouped(files, rig, band)
    if len(found.groups) < 2:
        return None
    return replace(found.several_states([name for name, _ in files], left), samples=False)


def states_of(files: Sequence[Saved], rig: Rig) -> tuple[tuple[str, ...], ...]:
    """The states that recordings are of by their own responses, the names of each; one where they
    agree."""
    every = [f for _, own in files for r in own for f in r.frequency]
    found = _lines_grouped(files, rig, (float(min(every)), float(max(every))))
    return found.several_states([name for name, _ in files], 0.0).states


def _lines_grouped(files: Sequence[Saved], rig: Rig, band: Band) -> _Grouped:
    """Files of responses by the states that they are of."""
    each = [own for _, own in files]
    return _grouped(len(each), lambda i, j: _lines_differ(each[i], each[j], rig, band))


def _lines_differ(
    some: Sequence[FrequencyResponse], others: Sequence[FrequencyResponse], rig: Rig, band: Band
) -> tuple[float, float, float]:
    """Chi-square of what two files' responses of one level differ by, its mean and its standard
    deviation; 0 where they have none in common whose noise is known from repeats."""
    chi2 = mean = variance = 0.0
    for a in some:
        for b in others:
            if _excited(a) != _excited(b) or not (repeated(a) and repeated(b)):
                continue
            try:
                both = measured([a, b], rig, band)
            except (EstimateError, InputError):
                continue
            found, expected = both.disagreeing()
            chi2, mean = chi2 + found, mean + expected
            # That of two sets of lines is shared by their difference.
            variance += both.spread * expected**2
    return chi2, mean, float(np.sqrt(variance))


def _excited(r: FrequencyResponse) -> tuple[float, str, bool, tuple[str, ...]]:
    """What must be the same of two responses that no force lets differ."""
    return r.level, r.level_unit, r.estimator in PERIODIC, tuple(c.name for c in r.inputs)


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
