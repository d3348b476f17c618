"""An effect: one piece of physics at one place, as a change of the rig file.

An effect is data: what it inserts into or changes in the rig, and how its unknowns become
parameters of the rig or factors on a channel. Nothing here knows a particular physics; the
table is in `vocabulary`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal

from samii_rig.diagnose.physics.rows import PHYSICS
from samii_rig.model.tmm import State
from samii_rig.rig.schema import Key as Key
from samii_rig.rig.schema import Rig
from samii_rig.types import Complex, Float

if TYPE_CHECKING:
    from samii_rig.diagnose.forces.laws import Force
    from samii_rig.diagnose.physics.fractional import Joint

Values = Mapping[Key, float]
# Of the logarithm of a ratio: no record of a structure shows a part in a million.
LEAST_RATIO = 1e-6


@dataclass(frozen=True, slots=True)
class Unknown:
    """A positive number to be found, log-uniform between `low` and `high` before the data.

    symbol, unit : as reported. starts : values from which a search may begin. ratio : 1 is nothing:
    then the size of its logarithm is log-uniform, as that of every other effect is. ends : whether
    nothing lies beyond `high`, as all of a part is gone there, not just the search ends; of a place
    along a body beyond `low` neither.
    """

    symbol: str
    unit: str
    low: float
    high: float
    starts: tuple[float, ...]
    ratio: bool = False
    ends: bool = False

    @property
    def middle(self) -> float:
        """The start in the middle."""
        return self.starts[len(self.starts) // 2]

    def small(self, x: float) -> float:
        """Logarithm of how much more probable the logarithm x of a ratio is before the data than if
        it were even between the bounds."""
        if not self.ratio:
            return 0.0
        most = max(math.log(self.high), -math.log(self.low))
        return math.log(most / (math.log(most / LEAST_RATIO) * min(max(abs(x), LEAST_RATIO), most)))


@dataclass(frozen=True, slots=True)
class Factor:
    """A factor F(s; unknowns) on an input or a sensor.

    value : (s (n,), unknowns) -> (F (n,), [dF/d unknown (n,), ...]).
    """

    kind: Literal["input", "sensor"]
    channel: str
    value: Callable[[Complex, Float], tuple[Complex, list[Complex]]]


@dataclass(frozen=True, slots=True)
class Jump:
    """A part that acts through one complex number at each frequency.

    It turns a state at its place into a jump of another, z+ = z- + e_j x(s) (e_i' z-), so that
    every output is a Moebius function of x with the same coefficients for all parts there.

    place : the same for parts that differ in x alone.
    x : (s (n,), unknowns (m, k)) -> (m, n), up to a sign or constant that belongs to the place.
    states : the one that jumps and the one that drives it; None for a part inside an element.
    fixed : how many of the unknowns, the last ones, belong to the place.
    """

    place: str
    x: Callable[[Complex, Float], Complex]
    states: tuple[State, State] | None = None
    fixed: int = 0


@dataclass(frozen=True, slots=True)
class Effect:
    """One hypothesis of what was left out.

    physics, site : by the names of the table and of the rig file.
    aliases : other (physics, site) names of the very same change.
    unknowns : its parameters, first the one that says how strong it is.
    build : the rig with the effect, its own parameters at any value.
    parameters : the rig's parameters that it sets, from its unknowns and the nominal values.
    touches : nominal parameters that `parameters` reads.
    factor : what it does to a channel, if that is no parameter of the rig.
    causal : (beam, Hz) whose loss factor it brings, and where the stiffness is as in the file.
    jump : its place and x(s), if it acts through one number; as `build` and `parameters` do.
    fractional : the damper c s^alpha that it is; `parameters` sets its two.
    force : the nonlinear force that it is, if it is one; the first unknown is its strength.
    write : the rig as a file would have it, from the built rig and the unknowns.
    weight : prior weight against the other hypotheses.
    report : physical quantities to be reported, from the unknowns.
    rough : relative model error, the part of what it does by which its law is known to be off; 0
    for one that holds. variant : distinguishes effects with one name and different changes.
    position : m from the site's upstream end, if it stands at one place along it; that of an
        effect with a position among its unknowns is None.
    pieces : names of what it cuts its site into, beside the one that keeps the name. They are the
        same material, whatever other effects make of it: its `parameters` are asked for last.
    """

    physics: str
    site: str
    unknowns: tuple[Unknown, ...] = ()
    build: Callable[[Rig], Rig] = lambda rig: rig
    parameters: Callable[[Float, Values], dict[Key, float]] = lambda _x, _nominal: {}
    touches: tuple[Key, ...] = ()
    factor: Factor | None = None
    jump: Jump | None = None
    causal: tuple[str, float] | None = None
    fractional: Joint | None = None
    force: Force | None = None
    write: Callable[[Rig, Float], Rig] = lambda rig, _x: rig
    weight: float = 1.0
    aliases: tuple[tuple[str, str], ...] = field(default=())
    report: Callable[[Float], Float] = lambda x: x
    rough: float = 0.0
    variant: str = ""
    position: float | None = None
    pieces: tuple[str, ...] = ()

    @property
    def physical(self) -> bool:
        """Whether it is of the rig, and not of how its records were made."""
        row = PHYSICS.get(self.physics)
        return row is None or row.physical

    @property
    def metered(self) -> bool:
        """Whether it is that a meter recorded a column: of what is wrong with the data that alone
        is not exactly known."""
        return self.rough > 0 and not self.physical

    @property
    def name(self) -> tuple[str, str]:
        """(physics, site)."""
        return self.physics, self.site

    def within(self, other: Effect) -> bool:
        """Whether another may do the same by a choice of its unknowns: one that has more of them
        and acts by the same states, at the same place or along a body that this one stands on."""
        if self.jump is None or other.jump is None or self.jump.states != other.jump.states:
            return False
        there = self.jump.place == other.jump.place
        there |= other.site in {site for _, site in self.names}
        return there and len(self.unknowns) < len(other.unknowns)

    @property
    def names(self) -> tuple[tuple[str, str], ...]:
        """All names of the same change, its own first."""
        return (self.name, *self.aliases)

    @property
    def key(self) -> str:
        """Different for different changes."""
        return f"{self.physics}@{self.site}#{self.variant}"
