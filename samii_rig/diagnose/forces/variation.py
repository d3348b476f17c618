"""A stiffness that is not constant, as an explanation: what it does is taken out of the records.

What varies passes for noise, so the noise that is told with it in the records is too much. So, as
with every force, what it adds to the sensors is computed in time, the records less that are those
of a linear rig, and the likelihood is made anew about them: its noise, its parameters, and what
varies still. All that varies is fitted together (`swings`), with the motion that it changes.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from scipy import stats

from samii_rig.diagnose.fit.between_runs import STIFFNESS, spread_of
from samii_rig.diagnose.fit.exact import NINETY
from samii_rig.diagnose.fit.explanations import Explanation, threshold, unlikely
from samii_rig.diagnose.fit.gap import gap_of
from samii_rig.diagnose.fit.records import Whole, fitted_lines
from samii_rig.diagnose.fit.refit import Fitted
from samii_rig.diagnose.forces.model import ForceModel
from samii_rig.diagnose.forces.paths import TransferPaths
from samii_rig.diagnose.forces.search import ForceSearch
from samii_rig.diagnose.forces.swings import Swings
from samii_rig.diagnose.forces.varying import (
    ALARM,
    SIDES,
    Modulation,
    PieceModulation,
    Springs,
    louder_beside,
    uneven,
)
from samii_rig.diagnose.result import Gap, Value
from samii_rig.likelihood.pieces import Piece
from samii_rig.likelihood.records import CYCLES
from samii_rig.likelihood.unexplained import Unexplained
from samii_rig.types import Float

# Of chi-square of each number that a step promises: half its standard deviation.
SWINGS_STILL = 0.25
SETTLE_ROUNDS = 8  # times that the likelihood is made anew at most: 3 or 4 were usual
# Of the evidence that the first gains in one round, from which on another spring may be the one.
RIVAL_SPRING = 0.5
# Of what it explains, above which a force that does as much makes a law of the amplitude as likely.
LAWFUL = 0.5
REPEATS_DIFFER = 1e-3  # chance of noise to make repeats differ as much, below which they do


@dataclass(frozen=True, slots=True)
class Variation:
    """A stiffness that is not constant.

    sites : (site, probability among springs that may be the one), the likeliest first.
    parameters : of the largest change there, by symbol. evidence : logarithm of the likelihood that
    it adds, in units of the noise without it, which holds what varies. likelihood : its logarithm
    as of `likelihood`, less what was sought. All else is in units of the noise with it.
    gain : of chi-square on the lines fitted. before, after : chi-square per degree of freedom
    without it and with it, on the lines fitted and on those shown. gap : on those shown.
    inside : whether what it leaves of the lines fitted is no more than noise. again : whether
    records of one level differ, or one in itself, so that it is no law of the amplitude, and that
    faster than what wanders; where the stiffness is constant in each, in several recordings; and
    whether no force does as much of it.
    """

    sites: tuple[tuple[str, float], ...]
    parameters: dict[str, Value]
    evidence: float
    likelihood: float
    gain: float
    before: tuple[float, float]
    after: tuple[float, float]
    gap: Gap
    inside: bool
    again: bool

    @property
    def closed(self) -> float:
        """Part of what is left over noise that it explains, on the lines fitted."""
        gap = self.before[0] - 1
        return (self.before[0] - self.after[0]) / gap if gap > 0 else 0.0

    def describe(self) -> str:
        """In words."""
        if "depth" in self.parameters:
            depth, f = self.parameters["depth"].times(100.0), self.parameters["f"]
            how = f"swings at {f.value:.3g} Hz by {depth.value:.2g} % ({depth.within()} %)"
        else:
            spread = self.parameters["spread"].times(100.0)
            how = f"varies between records by {spread.value:.2g} % ({spread.within()} %)"
        return f"the stiffness of {self.sites[0][0]} is not constant: it {how}"


@dataclass(frozen=True)
class BySpring:
    """What a linear explanation `best` leaves of the records, taken back to each spring."""

    search: ForceSearch
    best: Explanation
    springs: Springs
    pieces: dict[str, list[PieceModulation]]

    @classmethod
    def of(cls, search: ForceSearch, best: Explanation) -> BySpring:
        """Of an explanation of these records."""
        springs = Springs.of(search)
        left = _some(search.unexplained(best.fitted))
        return cls(search, best, springs, springs.pieces(search, left))

    def in_own_noise(self) -> BySpring:
        """The same in the noise that the explanation itself leaves. In that of another all that
        tells noise anew gains, a stiffness that does not vary too."""
        search, fitted = _in_own_noise(self.search, self.best.fitted, self.best)
        return BySpring.of(search, replace(self.best, fitted=fitted))

    @cached_property
    def strongest(self) -> list[tuple[str, Modulation]]:
        """As of `Springs`."""
        return self.springs.strongest(self.pieces)

    @property
    def evidence(self) -> float:
        """Logarithm of the evidence of the spring that most speaks for, as any other could have
        been the one."""
        if not self.strongest:
            return -math.inf
        most = max(one.evidence for _, one in self.strongest)
        return most - math.log(len(self.springs.each))


def variation(seen: BySpring, files: int) -> Variation | None:
    """The stiffness that varies; None where noise could do that, or where it leaves the nominal
    parameters at unlikely values. files : recordings, each of which may have a stiffness of its
    own."""
    if not seen.strongest:
        return None
    seen = seen.in_own_noise()
    search, best, springs, found = seen.search, seen.best, seen.springs, seen.strongest
    tried, known = [], dict(found)
    for site, modulation in found:
        k = search.paths.scale((site, STIFFNESS))
        # None varies by more than all of it: something else does.
        if modulation.gain < modulation.known * k**2:
            tried.append(_Taken.of(seen, site))
    if not tried:
        return None
    # As long as what varies stands in the noise, a neighbour gains more than the spring that does:
    # the noise there is what that spring does. One round tells.
    nothing = tried[0].evidence
    for one in tried:
        one.closer(best, known[one.site])
    tried.sort(key=lambda one: -one.evidence)
    # Once the rig moves as it is fitted, it may be that nothing of it varies.
    tried = [one for one in tried if one.modulations]
    if not tried:
        return None
    # A first round that is far off the frequency may gain nothing yet.
    least = nothing + RIVAL_SPRING * max(tried[0].evidence - nothing, 0.0)
    some = [one for one in tried if one.evidence >= least] or tried[:1]
    tried = sorted((one.settled(best) for one in some), key=lambda one: -one.evidence)
    taken = tried[0]
    if taken.evidence <= nothing or unlikely(taken.fitted):
        return None
    before = taken.residuals(search.levels, best.fitted)
    after = taken.residuals(taken.search.levels, taken.fitted)
    each = 2.0 * search.levels.sensor.size
    p = np.exp([one.evidence - taken.evidence for one in tried])
    names = [one.site for one in tried]
    parameters = taken.parameters(search.paths.scale((taken.site, STIFFNESS)), files)
    f = parameters.get("f")
    # As slow as what the lines leave out, it goes with what wanders, and its place with that.
    slow = f is not None and f.value * springs.longest < CYCLES
    gain = float(np.sum(before[0] - after[0])) * each
    lawful = search.most_explained > LAWFUL * gain
    # Within one recording a force that remembers answers the first of several otherwise, too.
    remembered = f is None and files < 2
    return Variation(
        sites=tuple(zip(names, (p / p.sum()).tolist(), strict=True)),
        parameters=parameters,
        evidence=seen.evidence,
        likelihood=taken.evidence,
        gain=gain,
        before=(float(np.mean(before[0])), float(np.mean(before[1]))),
        after=(float(np.mean(after[0])), float(np.mean(after[1]))),
        gap=gap_of(before[1], after[1], np.ones(after[1].size)),
        inside=bool(np.mean(after[0]) < threshold(taken.search.spread)),
        again=taken.again and not (slow or remembered or lawful),
    )


@dataclass(frozen=True, slots=True)
class Uneven:
    """A spring that is not the same to both sides. chi2 : what that explains, with one unknown.
    bent : whether its chain has a bend: its inertia changes with the angle there."""

    site: str
    chi2: float
    bent: bool = False

    def describe(self) -> str:
        """In words."""
        if self.bent:
            return (
                f"motion to one side of {self.site} is not as that to the other, which explains "
                f"{math.sqrt(self.chi2):.3g} sigma: the inertia of a bent chain changes with its "
                "angle, which the model takes for constant; a crack, a stop or a preload there "
                "would look the same (move less to tell: the bend's part falls as the square)"
            )
        return (
            f"the spring of {self.site} is not the same to both sides: that explains "
            f"{math.sqrt(self.chi2):.3g} sigma (no stop beyond a gap does it as well; a preload "
            "that ends, or a spring that is softer to one side, would)"
        )


def uneven_spring(seen: BySpring) -> Uneven | None:
    """The spring that is not the same to both sides: where it explains more than noise, and more
    than one that varies in time, which it would pass for, as it swings with the motion."""
    bent = seen.search.rig.bent
    found = [Uneven(site, uneven(pieces), bent) for site, pieces in seen.pieces.items()]
    most = max(found, key=lambda one: one.chi2, default=None)
    tries = len(SIDES) * len(found)
    if most is None or tries * float(stats.chi2.sf(most.chi2, 1)) > ALARM:
        return None
    return most if not seen.strongest or seen.strongest[0][1].gain < most.chi2 else None


@dataclass
class _Taken:
    """The records less what the variation of one spring adds to them.

    search, fitted : of these, and a model of them. levels : the records with it. modulations : what
    varies, as it was found. repeats : of each, whether repeats of one input differ by it, None
    where there are none. swings : of all of them, what is taken out. left : what `fitted` leaves
    of each piece, on the lines fitted.
    """

    search: ForceSearch
    fitted: Fitted
    springs: Springs
    site: str
    levels: Whole
    swings: Swings
    left: list[Unexplained]
    modulations: list[Modulation] = field(default_factory=list)
    repeats: list[bool | None] = field(default_factory=list)
    pieces: list[PieceModulation] = field(default_factory=list)

    @classmethod
    def of(cls, seen: BySpring, site: str) -> _Taken:
        """Nothing taken out yet of the spring of a site."""
        search, pieces = seen.search, seen.pieces[site]
        none = Swings.none([one.times.size for one in pieces])
        left = [one.left for one in pieces]
        return cls(search, seen.best.fitted, seen.springs, site, search.levels, none, left)

    def settled(self, best: Explanation) -> _Taken:
        """The same, once nothing is left that varies and what was found stands still."""
        for _ in range(SETTLE_ROUNDS):
            if not self.closer(best) and self.swings.left < SWINGS_STILL:
                break
        return self

    @property
    def parts(self) -> list[list[float]]:
        """Of each piece, of its records."""
        return [[c.part for c in piece.commands] for piece in self.levels.records.pieces]

    @property
    def evidence(self) -> float:
        """As of `likelihood`, less what phases and frequencies that were looked for add by
        themselves."""
        sought = sum(one.chi2 / 2 - one.evidence for one in self.modulations)
        return _likelihood(self.left, self.fitted) - sought

    def closer(self, best: Explanation, seen: Modulation | None = None) -> bool:
        """Take out what varies still, and make the likelihood anew. False if noise could do it, or
        what was found does. seen : what is taken out then all the same, as noise could not do what
        a neighbour does."""
        step = 1 / self.springs.longest
        here = self.springs.pieces(self.search, self.left, self.site)
        self.pieces, more = here[self.site], self.springs.strongest(here)
        if not more and seen is not None:
            more = [(self.site, seen)]
        known = [*self.swings.hz, *(0.0 for one in self.modulations if one.hz == 0)]
        # What those that are known still miss looks like others beside them.
        still = not self.swings.hz.size or self.swings.left < SWINGS_STILL
        new = bool(more) and all(abs(more[0][1].hz - hz) > step for hz in known)
        if still and new:
            one = more[0][1].closer(self.pieces, step)
            self.modulations.append(one)
            self.repeats.append(_repeats_differ(self.pieces, one.hz))
            if one.hz > 0:
                self.swings = self.swings.beside(one.hz)
        self.swings = self._level(self.swings.closer(self.pieces, step))
        ports = self.search.paths.ports(dict(self.springs.each)[self.site], of_speed=False)
        assert ports is not None
        each = zip(self.pieces, self.swings.changes, ports.back, self.parts, strict=True)
        hz = self.swings.hz.tolist()
        added = [one.added(x, hz, back, part) for one, x, back, part in each]
        taken = tuple(map(_less, self.levels.records.pieces, added))
        levels = replace(self.levels, records=replace(self.levels.records, pieces=taken))
        self.search = self.search.on(levels, self.fitted)
        again = self.search.refitted(best.effects, replace(best, fitted=self.fitted))
        self.fitted = again or self.fitted
        self.left = _some(self.search.unexplained(self.fitted))
        self._move()
        return new

    def _move(self) -> None:
        """Let the rig move as it is fitted without what varies: the first motion is that of a rig
        that had to make up for it."""
        model, x = self.fitted.model, self.fitted.x
        if isinstance(model, ForceModel):
            return
        paths = TransferPaths(self.search.levels, model, x)
        if paths.ports(dict(self.springs.each)[self.site], of_speed=False) is not None:
            self.search.paths = paths

    def _level(self, found: Swings) -> Swings:
        """The same, but a constant counts where it is not the same in all records: that is the rig
        file's own."""
        changes = [x.copy() for x in found.changes]
        if any(one.hz == 0 for one in self.modulations):
            known = [one.constants()[1][0] for one in self.pieces]
            times = [one.times[0] for one in self.pieces]
            mean = sum(g * t * x[0, 0] for g, t, x in zip(known, times, changes, strict=True))
            mean /= sum(g * t**2 for g, t in zip(known, times, strict=True))
            for x, t in zip(changes, times, strict=True):
                x[0, 0] -= t * mean
        else:
            for x in changes:
                x[:, 0] = 0.0
        return replace(found, changes=tuple(changes))

    @property
    def again(self) -> bool:
        """Whether what varies is no law of the amplitude: repeats of one input differ by it, or,
        where nothing was repeated, records of one level do, or one in itself."""
        levels = [p.levels for p in self.search.levels.records.pieces]
        if all(one is None for one in self.repeats):
            return len(set(levels)) < len(levels) or bool(self.swings.hz.size)
        return any(self.repeats)

    def parameters(self, k: float, files: int) -> dict[str, Value]:
        """Of the deepest modulation, with intervals of 90 %, or of what records differ by where
        that is more. k : the stiffness."""
        modulations = [self._depth(j, k) for j in range(self.swings.hz.size)]
        differing = [self._spread(k, files) for one in self.modulations if one.hz == 0]
        return max((*modulations, *differing), key=lambda found: next(iter(found.values())).value)

    def _depth(self, j: int, k: float) -> dict[str, Value]:
        """Of the j-th frequency, phases that are random in each record."""
        f = float(self.swings.hz[j])
        louder = louder_beside(self.pieces, f, self.springs.f)
        depth, low, high = self.swings.depth(j, self.pieces, self.parts, louder)
        off = NINETY * math.sqrt(louder * self.swings.off[j, j])
        return {
            "depth": Value(depth / k, "1", low / k, high / k),
            "f": Value(f, "Hz", f - off, f + off),
        }

    def _spread(self, k: float, files: int) -> dict[str, Value]:
        """Of normal stiffnesses, as many as there are recordings; chi-square."""
        x = np.concatenate([x[:, 0] for x in self.swings.changes])
        known = np.concatenate([one.constants()[1] for one in self.pieces])
        free = x.size - 1
        square = max(float(known @ x**2) - free, 0.0) / float(np.mean(known))
        # Records of one recording have its stiffness.
        own = min(free, files - 1) if files > 1 else free
        return {"spread": spread_of(square / free / k**2, own)}

    def residuals(self, levels: Whole, fitted: Fitted) -> tuple[Float, Float]:
        """Of the lines fitted (n,) and of those shown (m,), what a fit leaves of records, 1 in the
        mean; what repeats differ by, too."""
        other = copy(self.search)
        other.levels = levels
        left = other.unexplained(fitted)
        own = [np.sum(np.abs(x.white) ** 2, axis=2) / (2 * x.white.shape[2]) for x in left]
        on = [fitted_lines(x.k) for x in left]
        seen = [x[:, m].ravel() for x, m in zip(own, on, strict=True)]
        kept = [x[:, ~m].ravel() for x, m in zip(own, on, strict=True)]
        return np.concatenate(seen), np.concatenate(kept)


def likelihood(search: ForceSearch, fitted: Fitted) -> float:
    """Logarithm of the likelihood of the lines fitted, the noise that of the search."""
    return _likelihood(_some(search.unexplained(fitted)), fitted)


def _likelihood(left: Sequence[Unexplained], fitted: Fitted) -> float:
    """As `likelihood`, of what is left of each piece."""
    found = sum(
        len(x.white) * float(np.sum(2 * np.linalg.slogdet(x.root)[1]))
        - float(np.sum(np.abs(x.white) ** 2)) / 2
        for x in left
    )
    return found - fitted.penalty / 2


def of_its_own(search: ForceSearch, explanation: Explanation) -> float:
    """As `likelihood`, of a linear explanation with the noise that it leaves; -inf where it is no
    rig on these records."""
    fitted = search.refitted(explanation.effects, explanation, far=False)
    if fitted is None:
        return -math.inf
    return likelihood(*_in_own_noise(search, fitted, explanation))


def _in_own_noise(
    search: ForceSearch, fitted: Fitted, explanation: Explanation
) -> tuple[ForceSearch, Fitted]:
    """A search with the noise that a fit of an explanation leaves, and the fit there."""
    own = search.on(search.levels, fitted)
    return own, own.refitted(explanation.effects, explanation, far=False) or fitted


def _repeats_differ(pieces: Sequence[PieceModulation], hz: float) -> bool | None:
    """Whether repeats of one input differ by a modulation, whose phase is another in each, more
    than noise does; None where nothing was repeated."""
    chi2, free = (sum(x) for x in zip(*(one.differing(hz) for one in pieces), strict=True))
    return bool(stats.chi2.sf(chi2, free) < REPEATS_DIFFER) if free else None


def _some(left: Sequence[Unexplained]) -> list[Unexplained]:
    """On the lines that are fitted."""
    each = [(x, fitted_lines(x.k)) for x in left]
    return [replace(x, k=x.k[on], root=x.root[on], white=x.white[:, on]) for x, on in each]


def _less(piece: Piece, added: Float) -> Piece:
    """A piece and its repeats less what is added to each (1 + repeats, n, q)."""
    rest = zip(piece.repeats, added[1:], strict=True)
    repeats = tuple(replace(x, z=x.z - y) for x, y in rest)
    return replace(piece, z=piece.z - added[0], repeats=repeats)
