"""The force laws: one row each, with all that is known of it."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from samii_rig.diagnose.forces import steps
from samii_rig.diagnose.forces.place import Kind, Place
from samii_rig.diagnose.forces.steps import LAW_NUMBERS, Step
from samii_rig.diagnose.physics.effect import Key
from samii_rig.types import Float

COMPUTED = 0.01  # of a strength: what it was off by where it is hidden in strong forces
# Of dry friction: what comes before sliding, and how it falls with the speed, no one number knows
# nearer (Armstrong-Helouvry et al. 1994, Automatica 30). Two programs' friction differed by that.
RUBBED = 0.05
# Of play: what disturbs the rig makes it tremble inside the gap, and no record says by how much. Of
# 15 widths that were told, seven were off by 5 to 12 %, beyond their intervals; without
# disturbances none was.
TREMBLED = 0.05


@dataclass(frozen=True, eq=False)
class Law:
    """A force law.

    tag : its own. physics : its name in the table. unknowns : their symbols; how they enter the
        law's first numbers (n_unknown, 2), each a sum of unknowns, or `fixed` where none does.
    step : in time, driven by a motion. of_command : (command (n,), numbers) -> force (n,) and its
    slopes
        (n, 2), of a law that the command alone drives.
    weak : (motion (n,), command (n,), numbers) -> force (n,) of a motion that it does not change,
        of a law that has a step.
    of_speed : whether it is driven by the speed of what is read. of_part : symbols of a part's
        parameters that are its numbers behind the first. rough : relative model error.
        words : what it is.
    """

    tag: str
    physics: str
    words: str
    kinds: tuple[Kind, ...]
    symbols: tuple[str, ...]
    enter: tuple[tuple[float, float], ...]
    weak: Callable[[Float, Float, Float], Float] | None = None
    fixed: tuple[float, float] = (0.0, 0.0)
    step: Step | None = None
    of_command: Callable[[Float, Float], tuple[Float, Float]] | None = None
    of_speed: bool = False
    of_part: tuple[str, ...] = ()
    rough: float = COMPUTED

    def __post_init__(self) -> None:
        if {self.step is None, self.weak is None} != {self.of_command is not None}:
            raise ValueError(f"{self.tag}: a law is driven by a motion or by the command")

    def numbers(self, strengths: Float, of_part: Sequence[float] = ()) -> Float:
        """(3,) the law's numbers. of_part : values of the part's parameters that it has."""
        own = np.zeros(LAW_NUMBERS)
        own[:2] = np.array(self.fixed) + np.asarray(strengths) @ np.array(self.enter)
        own[1 : 1 + len(of_part)] = of_part
        return own


def _remembered(step: Step) -> Callable[[Float, Float, Float], Float]:
    """The weak force of a law that has a memory."""
    return lambda y, _v, p: steps.remembered(step, np.ascontiguousarray(y, np.float64), p)


def _clip_slopes(y: Float, half: Float) -> tuple[Float, Float]:
    kept = np.clip(y, -half, half)
    by = np.where(np.abs(y) > half, np.sign(y), 0.0)
    return kept, by


def _overlap(v: Float, p: Float) -> tuple[Float, Float]:
    kept, by = _clip_slopes(v, p[0] / 2)
    return -kept, np.stack([-by / 2, np.zeros_like(by)], axis=1)


def _excess(v: Float, p: Float) -> tuple[Float, Float]:
    kept, by = _clip_slopes(v, p[0])
    return kept - v, np.stack([by, np.zeros_like(by)], axis=1)


def _past(y: Float, p: Float, low: float, high: float) -> Float:
    """The force of stops at p0 times `low` and `high`."""
    return np.asarray(-p[1] * (y - np.clip(y, low * p[0], high * p[0])))


def _starved(M: Float, v: Float, p: Float) -> Float:
    return np.asarray(v * (np.sqrt(np.maximum(1 + np.sign(v) * M / p[0], 0.0)) - 1))


ONE = ((1.0, 0.0),)  # how the only unknown of a law enters its first two numbers
BETWEEN: tuple[Kind, ...] = ("joint", "ground")
FRICTION = Law(
    "friction", "coulomb_friction", "dry friction", (*BETWEEN, "drive"), ("T_c",), ((1.0, 1.0),),
    weak=lambda y, _v, p: np.where(y > 0, -p[0], p[1]) * (y != 0), step=steps.friction,
    of_speed=True, rough=RUBBED,
)  # fmt: skip
UNEVEN = Law(
    "uneven", "coulomb_friction", "dry friction that differs by direction", (*BETWEEN, "drive"),
    ("T_c forward", "T_c backward"), ((1.0, 0.0), (0.0, 1.0)), weak=FRICTION.weak,
    step=steps.friction, of_speed=True, rough=RUBBED,
)  # fmt: skip
# Of bearings and guides: over microns the asperities bend before they slide (Dahl 1968).
PRESLIDING = Law(
    "presliding", "coulomb_friction", "dry friction with presliding", BETWEEN,
    ("T_c", "k"), ((1.0, 0.0), (0.0, 1.0)), weak=_remembered(steps.presliding),
    step=steps.presliding, rough=RUBBED,
)  # fmt: skip
HARDENING = Law(
    "hardening", "cubic_stiffness", "a spring that hardens", BETWEEN, ("k3",), ONE,
    weak=lambda y, _v, p: p[0] * p[1] * y**3, fixed=(0.0, -1.0), step=steps.cubic,
)  # fmt: skip
SOFTENING = Law(
    "softening", "cubic_stiffness", "a spring that softens", BETWEEN, ("k3",), ONE,
    weak=HARDENING.weak, fixed=(0.0, 1.0), step=steps.cubic,
)  # fmt: skip
QUADRATIC = Law(
    "quadratic", "quadratic_damping", "a damper that grows with the speed", BETWEEN, ("c2",), ONE,
    weak=lambda y, _v, p: -p[0] * np.abs(y) * y, step=steps.quadratic, of_speed=True,
)  # fmt: skip
PLAY = Law(
    "play", "backlash", "play", BETWEEN, ("width",), ONE,
    weak=lambda y, _v, p: p[1] * np.clip(y, -p[0] / 2, p[0] / 2), step=steps.play,
    of_part=("k",), rough=TREMBLED,
)  # fmt: skip
# In the gap of a coupling or a gear nothing acts; of a spring between two stops its damper does.
SLACK = Law(
    "slack", "backlash", "play", BETWEEN, ("width",), ONE, weak=PLAY.weak, step=steps.slack,
    of_part=("k", "c"), rough=TREMBLED,
)  # fmt: skip
HYSTERESIS = Law(
    "hysteresis", "hysteresis", "a part that sticks, then slips (Bouc-Wen)", BETWEEN,
    ("T_y", "k"), ((1.0, 0.0), (0.0, 1.0)), weak=_remembered(steps.hysteresis),
    step=steps.hysteresis,
)  # fmt: skip
# What something runs against: a bumper, a neighbour, the end of a slot.
STOPS = Law(
    "stops", "end_stop", "a stop beyond a gap", BETWEEN, ("gap", "k"), ((1.0, 0.0), (0.0, 1.0)),
    weak=lambda y, _v, p: _past(y, p, -1.0, 1.0), step=steps.stops, rough=TREMBLED,
)  # fmt: skip
STOP_ABOVE = replace(
    STOPS, tag="stop above", words="a stop above a gap", step=steps.stop_above,
    weak=lambda y, _v, p: _past(y, p, -math.inf, 1.0),
)  # fmt: skip
STOP_BELOW = replace(
    STOPS, tag="stop below", words="a stop below a gap", step=steps.stop_below,
    weak=lambda y, _v, p: _past(y, p, -1.0, math.inf),
)  # fmt: skip
ORIFICE = Law(
    "orifice", "flow_saturation", "flow with limited supply", ("flow",), ("T_s",), ONE,
    weak=_starved, step=steps.orifice,
)  # fmt: skip
OVERLAP = Law(
    "overlap", "valve_deadband", "a dead band of the valve", ("command",), ("width",), ONE,
    of_command=_overlap,
)  # fmt: skip
CLIPPED = Law(
    "clipped", "output_saturation", "a clipped command", ("command",), ("limit",), ONE,
    of_command=_excess,
)  # fmt: skip
LAWS = (
    FRICTION, UNEVEN, PRESLIDING, HARDENING, SOFTENING, QUADRATIC, PLAY, SLACK, HYSTERESIS, STOPS,
    STOP_ABOVE, STOP_BELOW, ORIFICE, OVERLAP, CLIPPED,
)  # fmt: skip


@dataclass(frozen=True)
class Force:
    """A law at a place. part : whose parameters are among its numbers, "" if none's are."""

    place: Place
    law: Law
    part: str = ""

    def __post_init__(self) -> None:
        if self.place.kind not in self.law.kinds:
            raise ValueError(f"{self.law.tag} does not act on a {self.place.kind}")
        if bool(self.law.of_part) != bool(self.part):
            raise ValueError(f"{self.law.tag} needs a parameter of the rig")

    @property
    def keys(self) -> tuple[Key, ...]:
        """The rig's parameters that are among its numbers."""
        return tuple((self.part, symbol) for symbol in self.law.of_part)
