"""A search whose levels are apart, and what each nonlinear force promises in it.

All forces are screened by their describing functions, those that come near are computed in time
under the inputs that were recorded.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from samii_rig.diagnose.effect import Effect
from samii_rig.diagnose.explanations import Explanation
from samii_rig.diagnose.nonlinear_driven import Drives, Known, driven, top_of
from samii_rig.diagnose.nonlinear_laws import CUBIC, EXCESS, GAP
from samii_rig.diagnose.nonlinear_levels import Extra, LevelGrid
from samii_rig.diagnose.nonlinear_model import LevelModel, Quasi
from samii_rig.diagnose.nonlinear_screen import Bins, Levels, Promise
from samii_rig.diagnose.refit import Problem
from samii_rig.diagnose.search import Search
from samii_rig.errors import SamiiRigError
from samii_rig.types import Float

# Forces that describing functions may miss altogether, as their amplitude is not the sweep's.
BLIND = ("output_saturation", "flow_saturation")
CUTS = (0.003, 0.012, 0.05, 0.2, 0.5)  # off the largest command, limits that are tried first
NEARER = (2.0, 1.4, 1.2)  # factors on that, that are tried then
HINT = 5.0  # of chi-square, gained in the screen: less is not looked at any closer
STIFF = 3  # hardening joints that are computed in time in the screen
STIFFER = (1.0, 4.0, 16.0)  # times as stiff as their describing functions say
PLAYS = (1e-5, 1e-4, 1e-3, 1e-2)  # of the widest play that is looked for
KEPT = 6  # forces that are kept
FINE = 150  # bins of each level about a force in time, which varies from line to line


@dataclass
class Apart:
    """A search with its levels apart. grid, problem : with what of forces was computed in time.

    given : the periods of the input of each level that was recorded.
    """

    search: Search
    bins: Bins
    grid: LevelGrid
    problem: Problem
    forces: list[Effect]
    given: Drives
    known: Known = field(default_factory=Known)

    def __post_init__(self) -> None:
        fitted = set(np.unique(self.bins.lines.level).tolist())
        self._fitted = {k: v for k, v in self.given.items() if k in fitted}

    def promises(self, base: Explanation) -> list[Promise]:
        """What each force would gain beside a linear explanation, the largest gain first."""
        look = Levels.of(self.problem, base.fitted)
        found: list[Promise] = []
        for effect in self.forces:
            model = self.search.model((*base.effects, effect))
            if isinstance(model, LevelModel):
                promise = look.promise(effect, model)
                found += [promise] if promise is not None else []
        found.sort(key=lambda p: -p.gain)
        guessed = self._guesses(found)
        kept = found[:KEPT] + [
            p for p in found[KEPT:] if p.effect.physics in BLIND or p.effect.key in guessed
        ]
        closer = []
        for p in kept:
            guesses = guessed.get(p.effect.key, ())
            inexact = bool(guesses) or self._inexact(p)
            closer.append(self._closer(base, look, p, guesses) if inexact else p)
        return sorted((p for p in closer if p.gain > HINT), key=lambda p: -p.gain)

    def _guesses(self, found: Sequence[Promise]) -> dict[str, list[float]]:
        """Strengths that are tried in time, by the force: of hardening joints that promise
        something, which move a resonance by more than its width so that the first start is far too
        soft; and of play where levels differ grossly: a joint within its play has no stiffness."""
        cubes = [p for p in found[:KEPT] if p.gain > HINT and _quasi(p).law is CUBIC]
        out = {p.effect.key: [p.starts[0] * x for x in STIFFER] for p in cubes[:STIFF]}
        if self.bins.lines.torn():
            plays = [p for p in found if _quasi(p).law is GAP and _quasi(p).kind == "joint"]
            out |= {p.effect.key: [p.effect.unknowns[0].high * x for x in PLAYS] for p in plays}
        return out

    @staticmethod
    def _inexact(promise: Promise) -> bool:
        """Whether it is worth while to compute a force in time before it is refitted."""
        quasi = _quasi(promise)
        by_command = quasi.kind == "command"
        likely = promise.gain > HINT or quasi.law is EXCESS
        return likely and (by_command or promise.effect.physics in BLIND)

    def _closer(
        self, base: Explanation, look: Levels, promise: Promise, guesses: Sequence[float]
    ) -> Promise:
        """The same with the force in time, under the inputs that were recorded; at the best of some
        guesses, if there are any."""
        effect = promise.effect
        model = self.search.model((*base.effects, effect))
        assert isinstance(model, LevelModel)
        tried: dict[float, Promise] = {}

        def at(p: float) -> float:
            """Chi-square gained there; a limit below zero is none."""
            if p <= 0:
                return -math.inf
            if p not in tried and self.compute(model, np.append(base.fitted.x, math.log(p)), p):
                one = replace(effect, unknowns=(replace(effect.unknowns[0], starts=(p,)),))
                found = replace(look, problem=self.problem).promise(one, model)
                if found is not None:
                    tried[p] = replace(found, effect=effect)
            return tried[p].gain if p in tried else -math.inf

        if guesses:
            p = max(guesses, key=at)
            max((p / 2, 2 * p), key=at)
        elif model.quasi.law is not EXCESS:
            at(promise.starts[0])
        elif self._fitted:
            top = top_of(model, self._fitted, self.bins.lines)
            cut = max((x * top for x in CUTS), key=lambda x: at(top - x))
            for nearer in NEARER if at(top - cut) > HINT else ():
                cut = max((cut, cut / nearer, cut * nearer), key=lambda x: at(top - x))
        if not tried:
            return promise
        return max(tried.values(), key=lambda p: p.gain)

    def as_promised(self, base: Explanation, promise: Promise) -> None:
        """A force that was computed in time is what it is where it promised this, beside `base`."""
        model = self.search.model((*base.effects, promise.effect))
        if isinstance(model, LevelModel) and model.quasi in self.grid.extra:
            p = promise.starts[0]
            self.compute(model, np.append(base.fitted.x, math.log(p)), p)

    def compute(self, model: LevelModel, x: Float, p: float) -> bool:
        """Put what a force is in time, beyond its describing function, into grid and problem."""
        if not self._fitted or not self._put(model, x, p, self._fitted):
            return False
        quasi = model.quasi
        self.problem = self.bins.better(self.problem, quasi, self.grid.extra[quasi])
        self.search.problem = self.problem
        return True

    def everywhere(self, explanations: Sequence[Explanation]) -> None:
        """Put what their forces are at all levels into the grid: of those that were not fitted it
        was not asked for before."""
        for e in explanations:
            if isinstance(model := e.fitted.model, LevelModel):
                self._put(model, e.fitted.x, model.strength(e.fitted.x)[0], self.given)

    def _put(self, model: LevelModel, x: Float, p: float, given: Drives) -> bool:
        extra = driven(model, x, self.grid, given, p, self.known)
        if extra is None:
            return False
        top = top_of(model, given, self.bins.lines)
        found = {**self.grid.extra, model.quasi: Extra(extra, p, top)}
        self.grid = self.search.grid = replace(self.grid, extra=found)
        return True

    def on_lines(self, model: LevelModel, x: Float) -> Problem:
        """The lines themselves, with the model's force computed in time at x.

        Raises SamiiRigError where the rig has no partial fractions there.
        """
        if self._fitted and not self.compute(model, x, model.strength(x)[0]):
            raise SamiiRigError("no partial fractions")
        return Problem.of(self.search.lines, self.grid)

    def renew(self, best: Explanation) -> None:
        """Bins anew about an explanation with a force: as that is no smooth curve in time, only
        bins about it lose nothing of it."""
        self.bins = Bins.of(self.bins.lines, best.fitted, self.grid, FINE)
        self.problem = Problem.of(self.bins.combined(), self.grid)
        self.search.problem = self.problem


def _quasi(promise: Promise) -> Quasi:
    assert promise.effect.quasi is not None
    return promise.effect.quasi
