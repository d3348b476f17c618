"""What a chain that moves along itself may be made of, and sources in each other's way."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, get_args

from samii_rig.rig.elements import (
    AXIAL,
    MOTION_SOURCES,
    Branch,
    ForceSource,
    LumpedMass,
    Rod,
    TranslationalSpring,
)
from samii_rig.rig.sensors import AbsoluteAngle, Moment, RelativeAngle

if TYPE_CHECKING:
    from samii_rig.rig.schema import Element, Rig

TURNING = (AbsoluteAngle, Moment, RelativeAngle)  # what reads theta or M
GIVES = (TranslationalSpring, Rod)


def check_motion(rig: Rig) -> None:
    """ValueError, in one line, for what an axial chain cannot hold or a lateral one cannot, and for
    sources along w that fight."""
    if rig.motion == "axial":
        _check_ends(rig)
        for e in rig.element:
            _check_axial(e)
        for s in rig.sensor:
            if isinstance(s, TURNING):
                raise ValueError(
                    f"sensor {s.name}: kind {s.kind!r} of a chain with motion 'axial', which does "
                    "not turn; expected displacement, velocity, acceleration or force"
                )
    else:
        for e in rig.element:
            if isinstance(e, Rod):
                raise ValueError(
                    f"element {e.name}: kind 'rod' is stretched along the chain; "
                    'expected motion = "axial" of the rig'
                )
    _check_fights(rig)


def _check_ends(rig: Rig) -> None:
    for where, end in (("base", rig.base), ("tip", rig.tip)):
        if end == "pinned":
            raise ValueError(
                f"{where}: 'pinned' of a chain with motion 'axial'; expected 'clamped' or 'free'"
            )


def _check_axial(e: Element) -> None:
    if not isinstance(e, AXIAL):
        expected = ", ".join(_short(kind) for kind in AXIAL)
        raise ValueError(
            f"element {e.name}: kind {e.kind!r} of a chain with motion 'axial'; "
            f"expected one of {expected}"
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


def _short(kind: type) -> str:
    """The last word for a kind that is no damper: the one that a bench of masses is told in."""
    words = get_args(kind.model_fields["kind"].annotation)  # type: ignore[attr-defined]
    return str(next((w for w in reversed(words) if "damper" not in w), words[0]))


def _check_fights(rig: Rig) -> None:
    """Sources along w that nothing parts which gives way: of one input, or against held ends."""
    if rig.motion != "axial":
        return  # of a beam everything gives way
    for group, held in _rigid_groups(rig):
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


def _rigid_groups(rig: Rig) -> Iterator[tuple[list[Element], int]]:
    """The elements between those that give way, and how many of the two ends hold each group."""
    group: list[Element] = []
    held = int(rig.base == "clamped")
    for e in rig.element:
        if isinstance(e, GIVES):
            yield group, held
            group, held = [], 0
        else:
            group.append(e)
    yield group, held + int(rig.tip == "clamped")
