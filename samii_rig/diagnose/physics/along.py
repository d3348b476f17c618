"""A part at a place along a body: its position, and the rig with the part there.

On a rigid link it stands on a side chain: a massless arm that is fixed where the link begins. What
acts on the arm acts on the link as if it stood there. A beam or rod is cut in two. In both the
place is a length of the chain, so that derivatives by it are the chain's own.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import chain, pairwise
from typing import Any

from samii_rig.diagnose.physics import insert
from samii_rig.diagnose.physics.effect import Key, Unknown, Values
from samii_rig.errors import InputError
from samii_rig.rig.schema import (
    BEAMS,
    Acceleration,
    Branch,
    Element,
    ForceSource,
    GravityStiffness,
    LumpedMass,
    RelativeAngle,
    Rig,
    RigidLink,
    Rod,
    Strain,
    TorqueSource,
    TorsionalGroundSpring,
    TorsionalSpring,
    TranslationalGroundSpring,
)

POSITION = "position"  # symbol of the unknown
PIECE = "_piece_"  # in the names of what a body is cut into, between its own and a number
SHORTEST = 1e-4  # of a body's length, of a piece: to the data the same as none
SHORT = 0.25  # of a stretch, that its ends take at most where that is hardly longer than SHORTEST
# Elements with no extent and nothing that gives: what is behind moves as what is before.
AT_A_POINT = (
    LumpedMass, Branch, GravityStiffness, TorqueSource, ForceSource, TorsionalGroundSpring,
    TranslationalGroundSpring,
)  # fmt: skip
BODIES = (RigidLink, *BEAMS, Rod)  # elements with a length, along which something may stand


@dataclass(frozen=True, slots=True)
class Along:
    """Where a part may stand: between `start` and `end`, m from a body's upstream end.

    body : its name. whole : m, its length by the rig file. number : among the body's stretches.
    Between the two no accelerometer stands on a beam. The unknown is
    u = exp((position - start)/(end - start)): evenly in the logarithm, as every unknown is before
    the data, is evenly along the body.
    """

    body: str
    start: float
    end: float
    whole: float
    number: int = 0

    def unknown(self, parts: tuple[float, ...]) -> Unknown:
        """The unknown u. parts : of the way from `start` to `end`, at which a search begins."""
        least = min(SHORTEST / self.share, SHORT)
        some = tuple(math.exp(p) for p in parts)
        return Unknown(POSITION, "m", math.exp(least), math.exp(1 - least), some, ends=True)

    def position(self, u: float) -> float:
        """m from the body's upstream end."""
        return self.start + (self.end - self.start) * math.log(u)

    @property
    def share(self) -> float:
        """Of the body's length."""
        return (self.end - self.start) / self.whole

    def place(self) -> str:
        """The same for the same stretch of the same body."""
        return f"on {self.body} from {self.start:g} to {self.end:g}"

    @property
    def pieces(self) -> tuple[str, ...]:
        """Names of what `cut` makes of a body, beside the piece that keeps its name: up to
        `start` if that is not 0, to the part, and on to `end` if that is not the body's own."""
        some = (self.start > 0, True, self.end < self.whole)
        return tuple(f"{self.body}{PIECE}{i + 1}" for i, there in enumerate(some) if there)

    def lengths(self, u: float, L: float) -> dict[Key, float]:
        """Lengths, m, of the pieces on both sides of the part, for a body of length L."""
        # Half of the shortest, so that a place at the bound of its unknown still has a slope.
        least = 0.5 * SHORTEST * self.whole
        at = min(max(self.position(u), self.start + least), self.end - least)
        first, *behind = self.pieces[self.start > 0 :]
        out = {(first, "L"): at - self.start}
        if not behind:
            return {**out, (self.body, "L"): L - at}
        return {**out, (behind[0], "L"): self.end - at, (self.body, "L"): L - self.end}

    def of_pieces(self, u: float, nominal: Values, symbols: Sequence[str]) -> dict[Key, float]:
        """Parameters of all pieces: their lengths, and `symbols` of the body, whose material they
        are. nominal : values of the body's own."""
        out = self.lengths(u, nominal[self.body, "L"])
        for piece in self.pieces:
            out |= {(piece, s): nominal[self.body, s] for s in symbols if s != "L"}
        return out


def stretches(rig: Rig, element: Element) -> Iterator[Along]:
    """The stretches of a body along which a part may stand: all of a link, a beam from one
    sensor to the next."""
    if not isinstance(element, BODIES) or element.L.value <= 0:
        return
    L = element.L.value
    inner = (
        ()
        if isinstance(element, RigidLink)
        else (s.position for s in sensors_on(rig, element.name))
    )
    ends = sorted({0.0, L, *(x for x in inner if SHORTEST * L < x < (1 - SHORTEST) * L)})
    for number, (start, end) in enumerate(pairwise(ends)):
        yield Along(element.name, start, end, L, number)


def sensors_on(rig: Rig, body: str) -> tuple[Acceleration | Strain, ...]:
    """The accelerometers and strain gauges on a body."""
    return tuple(s for s in rig.sensor if isinstance(s, Acceleration | Strain) and s.on == body)


def carried(rig: Rig, link: str, name: str, parts: tuple[Any, ...]) -> Rig:
    """The rig with parts on a rigid link, at (`arm_of(name)`, "L") from its upstream end."""
    zero = {"r": ("m", 0.0), "m": ("kg", 0.0), "I": ("kg m^2", 0.0), "L": ("m", 0.0)}
    values = {symbol: insert.parameter(x, unit) for symbol, (unit, x) in zero.items()}
    arm = RigidLink(kind="rigid_link", name=arm_of(name), **values)
    at = [e.name for e in rig.element].index(link)
    side = Branch(kind="branch", name=name, element=(arm, *parts))
    return rig.model_copy(update={"element": (*rig.element[:at], side, *rig.element[at:])})


def arm_of(name: str) -> str:
    """The element whose length is the place of what `carried` put in by this name."""
    return f"{name}_place"


def cut(rig: Rig, along: Along, part: Element, u: float = math.exp(0.5)) -> Rig:
    """The rig with a beam or rod cut and `part` in the cut, at u of `along`: in its middle.

    The last piece keeps the name, so that what measures behind the body still does.

    Raises InputError where the body is cut already, or has a sensor between the stretch's ends.
    """
    order = [e.name for e in rig.element]
    at = order.index(along.body)
    body: Any = rig.element[at]
    if any(body_of(name) == along.body != name for name in order):
        raise InputError("cut", "", along.body, "a body with no other part along it")
    lengths = along.lengths(u, body.L.value)
    if along.start > 0:
        lengths[along.pieces[0], "L"] = along.start

    def of(name: str) -> Any:
        L = body.L.model_copy(update={"value": lengths[name, "L"], "tolerance": 0.0})
        return body.model_copy(update={"name": name, "L": L})

    before = 1 + (along.start > 0)
    last = of(along.body)
    tip = LumpedMass(
        kind="lumped_mass", name=f"{along.body}{PIECE}end", m=insert.parameter(0.0, "kg")
    )
    most = (1 - SHORTEST) * along.whole
    at_tip = any(
        s.position >= most for s in sensors_on(rig, along.body) if isinstance(s, Acceleration)
    )
    there = [*map(of, along.pieces[:before]), part, *map(of, along.pieces[before:]), last]
    turning = [e.name for e in there if isinstance(e, (*BEAMS, TorsionalSpring))]
    there += [tip] if at_tip else []

    def kept(sensor: Any) -> Any:
        if isinstance(sensor, RelativeAngle):
            each = ([n] if n != along.body else turning for n in sensor.across)
            return sensor.model_copy(update={"across": tuple(chain.from_iterable(each))})
        if not isinstance(sensor, Acceleration | Strain) or sensor.on != along.body:
            return sensor
        if sensor.position >= most and isinstance(sensor, Acceleration):
            return sensor.model_copy(update={"on": tip.name, "position": 0.0})
        if sensor.position <= along.start:
            return sensor.model_copy(update={"on": along.pieces[0]})
        if sensor.position < along.end:  # on which side of the part it is depends on u
            expected = f"one up to {along.start:g} or from {along.end:g} m on"
            raise InputError("cut", f"sensor[{sensor.name}].position", sensor.position, expected)
        return sensor.model_copy(update={"position": sensor.position - along.end})

    elements = (*rig.element[:at], *there, *rig.element[at + 1 :])
    sensors = tuple(kept(s) for s in rig.sensor)
    return rig.model_copy(update={"element": elements, "sensor": sensors})


def joined(rig: Rig, along: Along, part: str) -> Rig:
    """The rig as before `cut`, without `part`: its pieces and the sensors on them as one body's."""
    tip = f"{along.body}{PIECE}end"
    gone = {*along.pieces, part, tip}
    names = (*along.pieces, along.body)
    L = sum(e.L.value for e in rig.element if isinstance(e, BODIES) and e.name in names)

    def whole(e: Any) -> Any:
        if e.name != along.body:
            return e
        return e.model_copy(update={"L": e.L.model_copy(update={"value": L})})

    def on_it(sensor: Any) -> Any:
        if isinstance(sensor, RelativeAngle):
            across = tuple(n for n in sensor.across if n not in gone)
            return sensor.model_copy(update={"across": across})
        if getattr(sensor, "on", None) not in (*gone, along.body):
            return sensor
        at = {tip: L, along.body: along.end + sensor.position}.get(sensor.on, sensor.position)
        return sensor.model_copy(update={"on": along.body, "position": at})

    elements = tuple(whole(e) for e in rig.element if e.name not in gone)
    return rig.model_copy(update={"element": elements, "sensor": tuple(map(on_it, rig.sensor))})


def body_of(piece: str) -> str:
    """The body that a piece is of; its own name for what is no piece."""
    return piece.partition(PIECE)[0]
