"""The units in which effects are sized on a rig, how much of one is put in, what is noted of it."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

import numpy as np

from samii_rig.errors import InputError
from sim.concealed.parts import Description

RIGID = 1e9  # N m/rad: what a rig file says of a joint that is believed to be rigid
RIGID_SOURCE = "taken as rigid"
UNDAMPED_SOURCE = "taken as undamped"
REACH = 1e-3  # rad or m, what a place moves by where no run was asked
WITHIN = (0.15, 0.85)  # of a body's length: what lies there is not at its ends
NEAR = 0.02  # of the length, within which a place counts as a sensor's
DISPLACEMENT = 0.01475e-3  # m^3/rad, of the papers' vane motor: turns a stiffness into C_h


@dataclass(frozen=True, slots=True)
class Scales:
    """Of a plant: a joint's stiffness N m/rad, all mass kg, all rotary inertia kg m^2, a
    link's length m. Effects are multiples of them; the multiple is what is scaled."""

    k: float
    m: float
    J: float
    length: float

    @classmethod
    def of(cls, plant: Description) -> Scales:
        """Geometric mean of the springs that give and hold, sums of the links."""
        stiffness = [p.values["k"] for p in plant.parts if p.kind == "torsional_spring"]
        springs = [k for k in stiffness if 0 < k < RIGID]
        links = [p.values for p in plant.parts if p.kind == "rigid_link"]
        beams = [p.values for p in plant.parts if p.kind == "beam"]
        m = sum(v["m"] for v in links) + sum(v["mu"] * v["L"] for v in beams)
        J = sum(v["I"] + v["m"] * v["r"] ** 2 for v in links)
        length = float(np.mean([v["L"] for v in links])) if links else 1.0
        k = float(np.exp(np.mean(np.log(springs)))) if springs else J * 400.0
        return cls(k, m, J, length)


@dataclass(frozen=True, slots=True)
class Dose:
    """How much of an effect: parameters that are stated (SI), the others at `x` times the rig's own
    scale or drawn. where : the variant, of an effect that has some; drawn if empty. reach : rad or
    m, what the place moves by at most without the effect, for what acts beyond a gap. position : m
    along its body, of an effect within one; drawn if None."""

    x: float
    rng: np.random.Generator
    stated: Mapping[str, float] = field(default_factory=dict)
    where: str = ""
    reach: float = REACH
    position: float | None = None

    def __call__(self, symbol: str, otherwise: float) -> float:
        """The parameter as stated, or else as the scale or the draw has it."""
        return self.stated.get(symbol, otherwise)

    def choose(self, known: Iterable[str], otherwise: str) -> str:
        """The variant as stated, or else as drawn. InputError for one that is not known."""
        if self.where and self.where not in known:
            raise InputError("effect", "where", self.where, f"one of {', '.join(known)}")
        return self.where or otherwise

    def along(self, length: float, taken: Iterable[float]) -> float:
        """The position as stated, or else drawn within a body of this length, clear of its ends and
        of the positions `taken`. InputError for one that is not clear of the ends."""
        if self.position is not None:
            least = NEAR * length
            if not least < self.position < length - least:
                expected = f"more than {least:g} and less than {length - least:g} m"
                raise InputError("effect", "position", self.position, expected)
            return self.position
        while True:
            x = float(self.rng.uniform(*WITHIN)) * length
            if all(abs(x - at) > NEAR * length for at in taken):
                return x


@dataclass(slots=True)
class Concealed:
    """One effect as it was put in.

    site : of the rig file. position : m from the site's upstream end, of what is within it.
    parameters : SI, by the vocabulary's symbols. edits : what the nominal rig file must not know,
    {(element, symbol): (value, source)}. across : {sensor: elements} that the nominal rig file
    gives instead.
    """

    physics: str
    site: str
    parameters: dict[str, float]
    edits: dict[tuple[str, str], tuple[float, str]] = field(default_factory=dict)
    where: str = ""
    position: float | None = None
