"""One rig in several poses under one set of parameters: the likelihoods of all, summed.

What is missing is missing in every pose. Gravity acts on it, and on the rig's own masses, as the
pose says.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from samii_rig.diagnose.fit.record_search import RecordSearch
from samii_rig.diagnose.fit.records import Whole
from samii_rig.diagnose.fit.refit import Fitted
from samii_rig.diagnose.fit.search import Search
from samii_rig.diagnose.fit.summed import Stacked, Summed, parts_of
from samii_rig.diagnose.fit.usual import POSES
from samii_rig.diagnose.physics.effect import Effect
from samii_rig.diagnose.physics.grid import Grid
from samii_rig.diagnose.physics.model import Model
from samii_rig.diagnose.physics.poses import in_pose
from samii_rig.likelihood.form import Reduced
from samii_rig.likelihood.pieces import Wiring
from samii_rig.likelihood.reduce import LineResiduals
from samii_rig.rig.schema import Rig
from samii_rig.types import Complex, Float, Int


class Posed(Model):
    """A rig in several poses with effects; x is that of the model in any one of them.

    rigs : the rig file in each pose. On the grid of one pose it is the model of the first.
    """

    def __init__(self, rigs: Sequence[Rig], effects: Sequence[Effect] = ()) -> None:
        super().__init__(rigs[0], effects)
        self.rigs = tuple(rigs)
        self.each = tuple(Model(rig, [in_pose(e, rig) for e in effects]) for rig in rigs)

    def having(self, effects: Sequence[Effect]) -> Model:
        """As of `Model`."""
        return Posed(self.rigs, effects)

    def under(self, change: Callable[[Rig], Rig]) -> Model:
        """As of `Model`."""
        return Posed([change(rig) for rig in self.rigs], self.effects)

    def values(self, x: Float) -> dict[tuple[str, str], float]:
        """As of `Model`, in the first pose."""
        return self.each[0].values(x)

    def response(self, x: Float, at: Grid) -> Complex:
        """As of `Model`."""
        if not isinstance(at, Stacked):
            return self.each[0].response(x, at)
        each = zip(self.each, at.parts(), strict=True)
        return np.concatenate([model.response(x, part) for model, part in each])

    def gradient(self, x: Float, at: Grid) -> tuple[Complex, Complex]:
        """As of `Model`."""
        if not isinstance(at, Stacked):
            return self.each[0].gradient(x, at)
        parts = zip(self.each, at.parts(), strict=True)
        h, dh = zip(*(model.gradient(x, part) for model, part in parts), strict=True)
        return np.concatenate(h), np.concatenate(dh)


def _each(fitted: Fitted) -> list[Fitted]:
    """A fit as one of the model in each pose. Its derivatives stay those of all."""
    model = fitted.model
    assert isinstance(model, Posed)
    return [replace(fitted, model=one) for one in model.each]


@dataclass(frozen=True)
class InPoses:
    """The records of each pose, of the same commands and sensors."""

    each: tuple[Whole, ...]

    @property
    def wired(self) -> Wiring:
        """As of `Recorded`; the same of all."""
        return self.each[0].wired

    @property
    def sensor(self) -> Int:
        """As of `Recorded`."""
        return self.each[0].sensor

    @property
    def lines(self) -> int:
        """As of `Recorded`."""
        return sum(whole.lines for whole in self.each)

    @property
    def left_out(self) -> tuple[tuple[str, str], ...]:
        """As of `Recorded`."""
        return tuple(one for whole in self.each for one in whole.left_out)

    @property
    def own_aliases(self) -> bool:
        """As of `Recorded`."""
        return self.each[0].own_aliases

    def with_own_aliases(self) -> InPoses:
        """As of `Recorded`."""
        return replace(self, each=tuple(w.with_own_aliases() for w in self.each))

    def thinned(self, most: int) -> InPoses:
        """As of `Recorded`."""
        return replace(self, each=tuple(w.thinned(most) for w in self.each))

    def showing(self, fitted: Fitted, noise: Reduced) -> InPoses:
        """As of `Recorded`, each pose by itself."""
        each = zip(self.each, _each(fitted), parts_of(noise), strict=True)
        return replace(self, each=tuple(w.showing(own, part) for w, own, part in each))

    def about(self, fitted: Fitted) -> Summed:
        """As of `Recorded`."""
        each = zip(self.each, _each(fitted), strict=True)
        return Summed.of([whole.about(own) for whole, own in each])

    def nodes(self, found: Reduced, fitted: Fitted) -> Grid:
        """As of `Recorded`."""
        each = zip(self.each, parts_of(found), _each(fitted), strict=True)
        return Stacked.of([whole.nodes(part, own) for whole, part, own in each])

    def between(self, found: Reduced, fitted: Fitted) -> Grid:
        """As of `Recorded`."""
        each = zip(self.each, parts_of(found), _each(fitted), strict=True)
        return Stacked.of([whole.between(part, own) for whole, part, own in each])

    def residuals(self, fitted: Fitted, noise: Reduced, *, shown: bool = False) -> LineResiduals:
        """As of `Recorded`, of all poses, by frequency."""
        each = zip(self.each, parts_of(noise), _each(fitted), strict=True)
        found = [whole.residuals(own, part, shown=shown) for whole, part, own in each]
        f = np.concatenate([one.frequency for one in found])
        order = np.argsort(f, kind="stable")
        chi2 = np.concatenate([one.chi2 for one in found])
        return LineResiduals(
            f[order], chi2[order], np.concatenate([one.each for one in found])[order]
        )


class PosesSearch(RecordSearch):
    """As `RecordSearch`, over several poses. by_line : of the first; rigs : of each."""

    usual = POSES

    def __init__(self, records: InPoses, by_line: Search, rigs: Sequence[Rig]) -> None:
        self._rigs = tuple(rigs)
        super().__init__(records, by_line)

    def first(self) -> Fitted:
        """As of `RecordSearch`: where the first pose's own lines lead."""
        return replace(self.by_line.nominal.fitted, model=self.made(()))

    def by_pose(self) -> list[tuple[Whole, Fitted, Float]]:
        """The records of each pose, the nominal model there, and the nodes of their likelihood."""
        assert isinstance(self.whole, InPoses)
        parts = [part.frequency for part in parts_of(self.reduced)]
        return list(zip(self.whole.each, _each(self.nominal.fitted), parts, strict=True))

    def made(self, effects: tuple[Effect, ...]) -> Model:
        """As of `Explanations`."""
        return Posed(self._rigs, effects)
