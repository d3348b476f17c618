"""Forces that depend on amplitude as further hypotheses of whole records.

Each force is computed in time under the recorded commands, at strengths over its range, about what
the linear search found; what it explains once all linear parameters are projected out tells which
are refitted. Linear explanations and those with a force then stand on the very same lines with the
same weights, about the best of them, and one rule decides.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass

import numpy as np

from samii_rig.diagnose.effect import Effect
from samii_rig.diagnose.explanations import NEAR, Explanation, Explanations
from samii_rig.diagnose.judge import threshold
from samii_rig.diagnose.model import Model
from samii_rig.diagnose.nonlinear_consistent import self_consistent
from samii_rig.diagnose.nonlinear_forces import RANGE, forces, moves, per_input
from samii_rig.diagnose.nonlinear_laws import EXCESS, GAP
from samii_rig.diagnose.nonlinear_model import CAP, LevelModel, Quasi
from samii_rig.diagnose.nonlinear_records import Chains, ForceProblem, Moved
from samii_rig.diagnose.ranking import moved
from samii_rig.diagnose.records import RecordSearch, Whole
from samii_rig.diagnose.refit import STEPS, Fitted
from samii_rig.diagnose.screen import Screen
from samii_rig.errors import SamiiRigError
from samii_rig.likelihood.reduce import Left
from samii_rig.types import Float

WEAK = 1e-3  # of the strength that doubles or halves a motion: below, what a force does is linear
# Widths of a gap over the largest motion at which it is tried: what it does to the rest has its
# largest part where both are alike, and falls slowly.
WIDTHS = (3e-4, 2e-3, 1e-2, 4e-2, 0.15, 0.5)
CLOSER = 2  # times that the best strength is looked at closer
TIMES = (0.05, 20.0)  # of a strength, one such step
TRIED = 4  # physics of which a force is refitted
# Of what the best linear explanation gains, that a force gains in the screen, unless it gains
# something beside that: strong ones were seen to gain 3 times as much once refitted.
ENOUGH = 0.3
PROMISING = 0.25  # of what the best force gains, at least
AGAIN = 3  # times that the likelihood is made anew about the best explanation
STILL = 0.5  # standard deviations, a move from one to the next that is none
RIVALS = 4  # linear explanations that forces are held against


@dataclass(frozen=True, slots=True)
class RecordReach:
    """`Reach` of whole records. A sweep's motion at its largest is that of one frequency."""

    whole: Whole
    actuator: int

    @property
    def largest(self) -> float:
        """As of `Reach`."""
        return max(float(np.max(np.abs(v))) for _, v in self._commands())

    def motion(self, quasi: Quasi) -> tuple[Float, Float] | None:
        """As of `Reach`, every command taken as one period."""
        rate = self.whole.rig.rate_hz
        tops, each = [], []
        for band, v in self._commands():
            f = np.asarray(np.fft.rfftfreq(v.size, 1 / rate), np.float64)
            on = (f >= max(band[0], 1 / rate)) & (f <= band[1])
            found = per_input(self.whole.rig, quasi, f[on], self.actuator)
            if found is None:
                return None
            W = np.zeros(f.size, complex)
            W[on] = found[0] * np.fft.rfft(v)[on]
            tops.append(float(np.max(np.abs(np.fft.irfft(W, v.size)))))
            each.append(np.abs(found[1]))
        y1 = np.concatenate(each)
        if max(tops) <= 0 or not moves(y1):
            return None
        return np.full(y1.size, max(tops)), y1

    def _commands(self) -> list[tuple[tuple[float, float], Float]]:
        records = self.whole.records
        return [
            (band, c.v)
            for band, piece in zip(records.bands, records.pieces, strict=True)
            for c in piece.commands[:1]
        ]


@dataclass(frozen=True, slots=True)
class Hope:
    """What a force should gain of chi-square, and at which strength."""

    effect: Effect
    gain: float
    start: float


class ForceSearch(RecordSearch):
    """As `RecordSearch`, on the complete likelihood, with every level by itself."""

    def __init__(self, linear: RecordSearch) -> None:
        assert isinstance(linear.whole, Whole)  # of one state
        self.levels = whole = linear.whole.by_level()
        self._chains = Chains()
        self.linear = linear
        actuator = int(linear.grid.actuator[0])
        self.reach = RecordReach(whole, actuator)
        self.forces = tuple(forces(whole.rig, self.reach))
        super().__init__(whole, linear.by_line)
        self.use((*linear.table, *self.forces))

    def __post_init__(self) -> None:
        self.use(self.table)
        ranked = self.linear.ranked()
        self._about(ranked[0].fitted)
        kept = [e for e in ranked[:RIVALS] if e.weight > ranked[0].weight - NEAR]
        self._only((self.linear.nominal, *kept))

    def _only(self, some: Sequence[Explanation]) -> None:
        """Refit some explanations, and forget all others."""
        self.found = {}
        for e in {e.key: e for e in some}.values():
            end = self.refitted(e.effects, e, far=False)
            if end is not None:
                self.keep(e.effects, end)

    def _about(self, fitted: Fitted) -> None:
        self._chains.renew()
        self.problem = ForceProblem.near(self.levels, fitted, self.by_line.problem, self._chains)
        between = self.levels.between(self.reduced, fitted)
        self._between = between, fitted.model.response(fitted.x, between)

    def refitted_from(
        self,
        effects: tuple[Effect, ...],
        start: Float,
        give_up: float = math.inf,
        steps: int = STEPS,
        *,
        far: bool = True,
    ) -> Fitted | None:
        """As of `Explanations`; a force is computed in time at every step."""
        model = self.model(effects)
        if not isinstance(model, LevelModel):
            return super().refitted_from(effects, start, give_up, steps, far=far)
        x = np.clip(start, model.lower, model.upper)
        at = Fitted(model, x, 0.0, 0.0, np.zeros((0, model.n)), np.eye(model.n))
        try:
            return self_consistent(at, lambda _model, _x: self.problem, [model.unknown])
        except (SamiiRigError, np.linalg.LinAlgError):
            return None

    def settled(self) -> bool:
        """Refit what promises most, and all that may compete again about the best of it, until
        that stands still. Whether it has a force."""
        for hope in _worth_while(self.hopes(), self.worth):
            effects = (hope.effect,)
            end = self.refitted(effects, self.nominal, [math.log(hope.start)])
            if end is not None:
                self.keep(effects, end)
        self.temper()
        for _ in range(AGAIN):
            best = self.ranked()[0]
            if not isinstance(best.fitted.model, LevelModel):
                return False
            self._about(best.fitted)
            near = [e for e in self.ranked() if e.weight > best.weight - NEAR]
            self._only((*near, self.nominal))
            self.temper()
            after = self.ranked()[0]
            if after.key == best.key and after.fitted.away(best.fitted) < STILL:
                return True
        return isinstance(self.ranked()[0].fitted.model, LevelModel)

    def is_enough(self) -> bool:
        """Whether the best explanation leaves no more than noise."""
        return self.ratio(self.ranked()[0].fitted) < threshold(self.spread)

    def hopes(self) -> list[Hope]:
        """Every force beside the nominal parameters, the most promising first: what it gains beside
        what the best linear explanation, or nothing, leaves."""
        nominal = self.nominal
        bases = {e.key: e for e in (nominal, self.ranked()[0])}.values()
        looks = [Screen.of(self.problem, e.fitted) for e in bases]
        out = []
        for effect in self.forces:
            model = self.model((effect,))
            if isinstance(model, LevelModel):
                hope = self._hope(effect, model, nominal, looks)
                out += [hope] if hope is not None else []
        return sorted(out, key=lambda h: -h.gain)

    def _hope(
        self, effect: Effect, model: LevelModel, nominal: Explanation, looks: Sequence[Screen]
    ) -> Hope | None:
        known = moved(nominal.fitted.model, nominal.fitted.x, model)
        (unknown,) = effect.unknowns
        left = [look.left_by() for look in looks]
        tried: list[tuple[float, float, float]] = []
        may = 0.0
        most = np.full(len(looks), -math.inf)
        starts = self._starts(effect)
        for turn in range(1 + CLOSER):
            for p in starts:
                try:
                    g = self._change(model, np.append(known, math.log(p)))
                except SamiiRigError:
                    return None
                gains = [_gained(g, look, r) for look, r in zip(looks, left, strict=True)]
                gain, times, best = max(gains)
                tried.append((gain, times, p))
                may = max(may, best)
                most = np.maximum(most, [gain for gain, _, _ in gains])
            gain, times, p = max(tried)
            # One that is far from what counts is not looked at closer: its shape hardly changes.
            if turn == CLOSER or may < ENOUGH * self.worth or not math.isfinite(times):
                break
            if times <= 0:
                break
            starts = [self._scaled(model, p, times)]
            starts = [min(max(x, unknown.low), unknown.high) for x in starts]
        gain, _, p = max(tried)
        # Beside the nominal parameters alone it must do as much as a linear effect did.
        ahead = looks[0].base.cost - min(look.base.cost for look in looks)
        if most[0] < ENOUGH * ahead and most[-1] < self.worth / 2:
            return None
        return Hope(effect, gain, p) if gain > 0 else None

    def _starts(self, effect: Effect) -> list[float]:
        (unknown,) = effect.unknowns
        assert effect.quasi is not None
        law = effect.quasi.law
        if law is EXCESS:
            return list(unknown.starts)
        if law is GAP:
            return [unknown.high / 2 * x for x in WIDTHS]
        if law is None:
            return [unknown.high * WEAK]
        return [unknown.low / RANGE[0] * WEAK]

    def _scaled(self, model: LevelModel, p: float, times: float) -> float:
        times = float(min(max(times, TIMES[0]), TIMES[1]))
        if model.quasi.law is EXCESS:
            top = self.reach.largest
            return float(top - max(top - p, 0.0) * times ** (1 / CAP))
        return float(p * times ** (1 / model.quasi.power))

    def _change(self, model: LevelModel, x: Float) -> Float:
        """What the force adds to the prediction, in noise units."""
        problem = self._force_problem
        return problem.complete.split(problem.lines_of(model, x))

    def left(self, fitted: Fitted, *, shown: bool = False) -> Left:
        """As of `RecordSearch`."""
        if not isinstance(fitted.model, LevelModel):
            return super().left(fitted, shown=shown)
        rest = Moved(self.levels, self._chains).without(fitted)
        return rest.left(fitted, self.reduced, shown=shown)

    def beside(self, best: Explanation) -> tuple[Explanations, Explanation]:
        """As of `Explanations`: the records without the force of `best`, about which the likelihood
        stands."""
        linear = tuple(e for e in best.effects if e.quasi is None)
        model = Model(self.rig, linear)
        plain = copy(self)
        plain.problem = self._force_problem.without_force()
        old = best.fitted
        x = np.delete(old.x, old.model.unknown) if isinstance(old.model, LevelModel) else old.x
        h, dh = model.gradient(x, plain.problem.at)
        J, r = plain.problem.whiten(dh), plain.problem.residual(h)
        fitted = Fitted(model, x, float(r @ r), old.penalty, J, J.T @ J)
        return plain, Explanation(linear, fitted, 0.0)

    @property
    def _force_problem(self) -> ForceProblem:
        assert isinstance(self.problem, ForceProblem)
        return self.problem


def _gained(g: Float, look: Screen, left: Float) -> tuple[float, float, float]:
    """Fall of chi-square with a change g of what is predicted, how many times as large it would be
    at its best, and the fall there."""
    Q = look.directions[: g.size]
    through = Q.T @ g
    power = float(g @ g - through @ through)
    along = -float(g @ left[: g.size])
    if not power > 0 or not math.isfinite(power):
        return -math.inf, math.nan, 0.0
    return 2 * along - power, along / power, max(along, 0.0) * along / power


def compete_on_records(linear: RecordSearch) -> ForceSearch | None:
    """Let forces compete with what the linear search of whole records found; None where none wins.

    Raises SamiiRigError where no force can be computed on this rig.
    """
    search = ForceSearch(linear)
    return search if search.settled() else None


def _worth_while(hopes: Sequence[Hope], worth: float) -> list[Hope]:
    """Those that may be the best: of each physics the first, and the first's at other places."""
    some = [h for h in hopes if h.gain > max(worth / 2, PROMISING * hopes[0].gain)]
    if not some:
        return []
    first = {h.effect.physics: h for h in reversed(some)}
    # Torques and angles of neighbouring joints go nearly together.
    elsewhere = [h for h in some[1:] if h.effect.physics == some[0].effect.physics]
    ranked = sorted(first.values(), key=lambda h: -h.gain)[:TRIED]
    return list({h.effect.key: h for h in (*ranked, *elsewhere[:TRIED])}.values())
