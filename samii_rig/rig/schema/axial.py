"""What a chain that moves along itself may be made of, and sources in each other's way."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any, get_args

from samii_rig.rig.schema.elements import (
    AXIAL,
    BEAMS,
    MOTION_SOURCES,
    TURNING,
    Branch,
    Cylinder,
    ForceSource,
    LumpedMass,
    RigidLink,
    Rod,
    Spindle,
    TranslationalGroundSpring,
    TranslationalSpring,
)
from samii_rig.rig.schema.sensors import AbsoluteAngle, Current, Moment, RelativeAngle, places

if TYPE_CHECKING:
    from samii_rig.rig.schema.elements import Element
    from samii_rig.rig.schema.rig import Rig
    from samii_rig.rig.schema.sensors import Sensor

ANGULAR = (AbsoluteAngle, Moment, RelativeAngle)  # sensors that read theta or M
GIVES = (TranslationalSpring, Rod, Cylinder)


def turning(rig: Rig) -> tuple[Element, ...]:
    """The elements of an axial chain that turn: those before its spindle, () without one."""
    at = [i for i, e in enumerate(rig.element) if isinstance(e, Spindle)]
    return rig.element[: at[0]] if at and rig.motion == "axial" else ()


def check_motion(rig: Rig) -> None:
    """ValueError, in one line, for what an axial chain cannot hold or a lateral one cannot, and for
    sources along w that fight."""
    if rig.motion == "lateral":
        for e in rig.element:
            if isinstance(e, (Rod, Spindle)):
                raise ValueError(
                    f"element {e.name}: kind {e.kind!r} moves along the chain; "
                    'expected motion = "axial" of the rig'
                )
        if rig.base == rig.tip == "free" and not any(map(_shifts, rig.element)):
            raise ValueError(
                "base: 'free' of a chain that only turns, so that nothing says where it shifts to; "
                "expected 'pinned', which lets it turn and holds it in place"
            )
        return  # of a beam everything gives way
    _check_ends(rig)
    turns = turning(rig)
    if isinstance(rig.element[0], Spindle):
        raise ValueError(
            f"element {rig.element[0].name}: nothing turns before it; "
            "expected a motor or an inertia there"
        )
    for e in turns:
        if not isinstance(e, TURNING):
            raise ValueError(
                f"element {e.name}: kind {e.kind!r} before the spindle, where the chain turns; "
                f"expected one of {_listed(TURNING)}"
            )
    for e in rig.element[len(turns) + bool(turns) :]:  # the spindle itself apart
        _check_axial(e)
    for s in rig.sensor:
        _check_sensor(s, {e.name for e in turns}, rig)
    _check_fights(rig, len(turns))


def _shifts(e: Element) -> bool:
    """Whether an element has a say in where a lateral chain shifts to: by its mass, or by the
    ground."""
    if isinstance(e, LumpedMass):
        return e.m.value > 0
    return isinstance(e, (*BEAMS, RigidLink, Branch, TranslationalGroundSpring))


def _check_ends(rig: Rig) -> None:
    for where, end in (("base", rig.base), ("tip", rig.tip)):
        if end == "pinned":
            raise ValueError(
                f"{where}: 'pinned' of a chain with motion 'axial'; expected 'clamped' or 'free'"
            )


def _check_axial(e: Element) -> None:
    if not isinstance(e, AXIAL):
        raise ValueError(
            f"element {e.name}: kind {e.kind!r} of a chain with motion 'axial'; "
            f"expected one of {_listed(AXIAL)}"
        )
    if isinstance(e, LumpedMass) and e.I.value != 0:
        raise ValueError(
            f"element {e.name}: I {e.I.value:g} kg m^2 of a chain with motion 'axial', which does "
            "not turn; expected m alone"
        )
    if isinstance(e, Branch):
        if e.tip != "free":
            raise ValueError(
                f"element {e.name}: tip {e.tip!r}; expected 'free', or a ground_spring in its place"
            )
        for part in e.element:
            _check_axial(part)


def _listed(kinds: tuple[type[Any], ...]) -> str:
    """The kinds, each by the last word for it that is no damper, as of a bench of masses."""
    words = [get_args(kind.model_fields["kind"].annotation) for kind in kinds]
    return ", ".join(
        next((w for w in reversed(each) if "damper" not in w), each[0]) for each in words
    )


def _check_sensor(s: Sensor, turns: set[str], rig: Rig) -> None:
    if isinstance(s, Current):  # a motor stands on either side of the spindle
        return
    inside = [name in turns for name in places(s)]
    if isinstance(s, ANGULAR) and not all(inside):
        raise ValueError(
            f"sensor {s.name}: kind {s.kind!r} of a chain with motion 'axial', which does not turn "
            "there; expected displacement, velocity, acceleration or force"
        )
    if not isinstance(s, ANGULAR) and any(inside):
        raise ValueError(
            f"sensor {s.name}: kind {s.kind!r} before the spindle, where the chain turns; "
            "expected relative_angle, absolute_angle or moment"
        )


def _check_fights(rig: Rig, first: int) -> None:
    """Sources along w that nothing parts which gives way: of one input, or against held ends."""
    for group, held in _rigid_groups(rig, first):
        inputs: dict[str, str] = {}
        for e in group:
            if not isinstance(e, (ForceSource, *MOTION_SOURCES)):
                continue
            if e.input in inputs:
                raise ValueError(
                    f"element {e.name}: drives the same point as {inputs[e.input]} with the same "
                    f"input {e.input!r}; expected one of them, or a spring between the two"
                )
            inputs[e.input] = e.name
        moving = [e for e in group if isinstance(e, MOTION_SOURCES)]
        if moving and held == 2:
            raise ValueError(
                f"element {moving[0].name}: moves what is clamped at both ends; "
                "expected a spring or rod beside it"
            )


def _rigid_groups(rig: Rig, first: int) -> Iterator[tuple[list[Element], int]]:
    """The elements between those that give way, and how many of the two ends hold each group."""
    group: list[Element] = []
    held = int(rig.base == "clamped" and first == 0)
    for e in rig.element[first:]:
        if isinstance(e, GIVES):
            yield group, held
            group, held = [], 0
        else:
            group.append(e)
    yield group, held + int(rig.tip == "clamped")
