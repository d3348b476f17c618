"""What gravity makes of an effect: its weight loads the chain, and that depends on the pose."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from samii_rig.diagnose.physics.effect import Effect, Key, Values
from samii_rig.rig.schema import Rig
from samii_rig.types import Float

WEIGHTY = ("added_mass", "attached_oscillator")  # do more than their jump where something is loaded
OF_WEIGHT = "gravity_stiffness"


def weighty(table: Sequence[Effect], rig: Rig, *, poses: bool) -> list[Effect]:
    """The table of a rig with gravity or a bend, where parts at one place no longer differ in x(s)
    alone: those that load the chain have a place of their own. poses : there are several; then the
    stiffness of gravity has one too, as it turns with the chain."""
    own = (*WEIGHTY, *((OF_WEIGHT,) if poses else ()))
    loaded = bool(rig.gravity) or rig.bent
    return [_by_itself(e) if loaded and e.physics in own else e for e in table]


def _by_itself(effect: Effect) -> Effect:
    if effect.jump is None:
        return effect
    place = f"{effect.jump.place}, {effect.physics}"
    return replace(effect, jump=replace(effect.jump, place=place))


def in_pose(effect: Effect, rig: Rig) -> Effect:
    """An effect as it is in the pose of a rig, its unknowns those of a chain that hangs: the
    stiffness of gravity is k cos(pose)."""
    return _times(effect, rig.pull / rig.gravity) if rig.gravity else effect


def turned(effect: Effect, old: Rig, new: Rig) -> Effect:
    """An effect with the unknowns that it has in the pose of one rig, in that of another."""
    return _times(effect, new.pull / old.pull) if old.pull and new.pull != old.pull else effect


def _times(effect: Effect, part: float) -> Effect:
    """The same, a stiffness of gravity so many times what it was."""
    if effect.physics != OF_WEIGHT:
        return effect

    def parameters(x: Float, nominal: Values) -> dict[Key, float]:
        return {key: part * v for key, v in effect.parameters(x, nominal).items()}

    return replace(effect, parameters=parameters)
