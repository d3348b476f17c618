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
    stiffness of gravity is k cos(pose), the pose that the chain has there."""
    if effect.physics != OF_WEIGHT or not rig.gravity:
        return effect
    return _times(effect, _pull_at(effect, rig) / rig.gravity)


def turned(effect: Effect, old: Rig, new: Rig) -> Effect:
    """An effect with the unknowns that it has in the pose of one rig, in that of another."""
    if effect.physics != OF_WEIGHT:
        return effect
    before, after = _pull_at(effect, old), _pull_at(effect, new)
    return _times(effect, after / before) if before and after != before else effect


def _pull_at(effect: Effect, rig: Rig) -> float:
    """Gravity along the chain, m/s^2, at what an effect puts in: beyond a bend it is another."""
    built, known = effect.build(rig), {e.name for e in rig.element}
    at = [k for k, e in enumerate(built.element) if e.name not in known]
    return built.pulls[at[0]] if at else rig.pull


def _times(effect: Effect, part: float) -> Effect:
    """The same, a stiffness of gravity so many times what it was."""

    def parameters(x: Float, nominal: Values) -> dict[Key, float]:
        return {key: part * v for key, v in effect.parameters(x, nominal).items()}

    return replace(effect, parameters=parameters)
