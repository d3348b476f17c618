"""Effects that are no linear element: forces of joints, and what the drive does to its command."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from sim.assumed_modes.effects import Draft, Numbers, drawn_drive, turning_drives
from sim.assumed_modes.ground import held, length, same_as_body, same_as_joint
from sim.assumed_modes.parts import ANGLE_SOURCES, JOINTS, Drive, Force, Setup

Rng = np.random.Generator
GROUND = 1 / 3  # of the draws of friction that are of a body against the ground
SIDES = ("both", "both", "above", "below")  # of a stop: half are on both
GAPS = (0.2, 0.9)  # of what a place moves by at the largest level
HARDEST = 30.0  # times a place's own stiffness: a stop that gives no more than the place beside it
START = 1e-3  # of a joint's swing, or its spring's largest moment: what a force begins with


@dataclass(frozen=True, slots=True)
class Swing:
    """What the nominal rig does at the trial's largest level: peaks of the joints' relative motion
    (rad or m); by actuator, of the moment at its source (N m) and of the command (its unit);
    of the bodies' displacements against the ground (m)."""

    joints: dict[str, float]
    moment: dict[str, float]
    command: dict[str, float]
    bodies: dict[str, float]


def springs(setup: Setup) -> list[str]:
    """Joints with a stiffness."""
    return [p.name for p in setup.parts if p.kind in JOINTS and p.values["k"] > 0]


def joint(rng: Rng, setup: Setup, swing: Swing) -> tuple[str, float, float]:
    """A joint that moves: its name, its stiffness and its peak."""
    name = str(rng.choice(springs(setup)))
    return name, setup.part(name).values["k"], swing.joints[name]


def units(setup: Setup, on: str) -> tuple[str, str]:
    """Units of a joint's force and of its motion."""
    return ("N m", "rad") if setup.part(on).kind == "torsional_spring" else ("N", "m")


def on_joint(law: str, on: str) -> Callable[[Setup, Numbers], Setup]:
    """Puts a law on a joint, with the joint's stiffness beside the law's own numbers."""

    def apply(s: Setup, v: Numbers) -> Setup:
        return replace(s, forces=(*s.forces, Force(law, on, {**v, "k": s.part(on).values["k"]})))

    return apply


def _also(physics: str, setup: Setup, on: str) -> tuple[tuple[str, str], ...]:
    """A joint's source counts as the joint: the neighbours of its spring without extent."""
    names = [p.name for p in setup.parts]
    at = names.index(on)
    beside = [p for p in setup.parts[max(at - 1, 0) : at + 2] if p.kind in ANGLE_SOURCES]
    return tuple((physics, p.name) for p in beside)


def friction(rng: Rng, setup: Setup, swing: Swing) -> Draft:
    """Dry friction of a joint, or of a body against the ground."""
    if swing.bodies and (not springs(setup) or rng.random() < GROUND):
        on = str(rng.choice(list(swing.bodies)))
        peak, own = swing.bodies[on], held(setup, on)

        def apply(s: Setup, v: Numbers) -> Setup:
            return replace(s, forces=(*s.forces, Force("coulomb_friction", on, v, ground=True)))

        return Draft(
            "coulomb_friction", on, length(setup, on), {"T_c": "N"}, lambda x: {"T_c": x}, apply,
            START * own * peak, 0.3 * own * peak, also=same_as_body("coulomb_friction", setup, on),
            where="ground",
        )  # fmt: skip
    on, k, peak = joint(rng, setup, swing)
    return Draft(
        "coulomb_friction", on, None, {"T_c": units(setup, on)[0]}, lambda x: {"T_c": x},
        on_joint("coulomb_friction", on), START * k * peak, 0.3 * k * peak,
        also=(*_also("coulomb_friction", setup, on), *same_as_joint("coulomb_friction", setup, on)),
    )  # fmt: skip


def stop(rng: Rng, setup: Setup, swing: Swing) -> Draft:
    """A stop at a way `gap` from rest, on both sides or one: of a joint, or of a body against the
    ground. Its strength is its stiffness."""
    places = [*((name, False) for name in springs(setup)), *((name, True) for name in swing.bodies)]
    on, ground = places[int(rng.integers(len(places)))]
    sides = SIDES[int(rng.integers(len(SIDES)))]
    own = held(setup, on) if ground else setup.part(on).values["k"]
    peak = swing.bodies[on] if ground else swing.joints[on]
    gap = peak * float(np.exp(rng.uniform(*np.log(GAPS))))
    also = same_as_body if ground else same_as_joint
    force, motion = ("N", "m") if ground else units(setup, on)
    numbers = {"above": float(sides != "below"), "below": float(sides != "above")}

    def apply(s: Setup, v: Numbers) -> Setup:
        return replace(s, forces=(*s.forces, Force("end_stop", on, {**v, **numbers}, ground)))

    return Draft(
        "end_stop", on, length(setup, on) if ground else None,
        {"gap": motion, "k": f"{force}/{motion}"}, lambda x: {"gap": gap, "k": x}, apply,
        START * own, HARDEST * own,
        also=(*(() if ground else _also("end_stop", setup, on)), *also("end_stop", setup, on)),
        where=sides,
    )  # fmt: skip


def play(rng: Rng, setup: Setup, swing: Swing) -> Draft:
    """Play of a joint: its spring carries nothing within the width."""
    on, _, peak = joint(rng, setup, swing)
    return Draft(
        "backlash", on, None, {"width": units(setup, on)[1]}, lambda x: {"width": x},
        on_joint("backlash", on), START * peak, peak, also=_also("backlash", setup, on),
    )  # fmt: skip


def hardening(rng: Rng, setup: Setup, swing: Swing) -> Draft:
    """A spring that hardens; softening ends at half of the stiffness."""
    on, k, peak = joint(rng, setup, swing)
    sign = 1.0 if rng.random() < 0.7 else -1.0
    whole = k / peak**2
    return Draft(
        "cubic_stiffness", on, None, {"k3": "{}/{}^3".format(*units(setup, on))},
        lambda x: {"k3": sign * x},
        on_joint("cubic_stiffness", on), START * whole, (2.0 if sign > 0 else 0.15) * whole,
        also=_also("cubic_stiffness", setup, on),
    )  # fmt: skip


def drag(rng: Rng, setup: Setup, swing: Swing) -> Draft:
    """A damper that grows with the speed: c2 |x'| x', as of oil through an orifice."""
    on, k, peak = joint(rng, setup, swing)
    force, motion = units(setup, on)
    return Draft(
        "quadratic_damping", on, None, {"c2": f"{force} s^2/{motion}^2"}, lambda x: {"c2": x},
        on_joint("quadratic_damping", on), 1e-6 * k / peak, k / peak,
        also=_also("quadratic_damping", setup, on),
    )  # fmt: skip


def _of_drive(
    physics: str, drive: Drive, units: dict[str, str], values: Callable[[float], Numbers],
    start: float, most: float,
) -> Draft:  # fmt: skip
    source, on = drive.sources[0], drive.name

    def apply(s: Setup, v: Numbers) -> Setup:
        return replace(s, forces=(*s.forces, Force(physics, on, v)))

    return Draft(physics, source, None, units, values, apply, start, most, also=((physics, on),))


def dead_zone(rng: Rng, setup: Setup, swing: Swing) -> Draft:
    """Overlap of the valve's spool."""
    drive = drawn_drive(rng, setup.drives)
    peak = swing.command[drive.name]
    drawn = _of_drive(
        "valve_deadband", drive, {"width": drive.actuator.unit}, lambda x: {"width": x},
        START * peak, peak,
    )  # fmt: skip
    # A loop comes to rest within a step of its converter; a narrower band only shows where it
    # does not.
    return replace(drawn, least=drive.actuator.resolution)


def clipping(rng: Rng, setup: Setup, swing: Swing) -> Draft:
    """The command is clipped behind the converter that is recorded."""
    drive = drawn_drive(rng, setup.drives)
    return _of_drive(
        "output_saturation", drive, {"limit": drive.actuator.unit},
        lambda x: {"limit": swing.command[drive.name] * (1.0 - x)}, START, 0.8,
    )  # fmt: skip


def orifice(rng: Rng, setup: Setup, swing: Swing) -> Draft:
    """Flow through the valve falls as the load takes the pressure: v sqrt(1 + sgn(v) M/M_stall)."""
    drive = drawn_drive(rng, turning_drives(setup))
    return _of_drive(
        "flow_saturation", drive, {"M_stall": "N m"},
        lambda x: {"M_stall": swing.moment[drive.name] / x}, START, 0.8,
    )  # fmt: skip


FORCES: dict[str, Callable[[Rng, Setup, Swing], Draft]] = {
    "coulomb_friction": friction,
    "end_stop": stop,
    "backlash": play,
    "cubic_stiffness": hardening,
    "quadratic_damping": drag,
    "valve_deadband": dead_zone,
    "output_saturation": clipping,
    "flow_saturation": orifice,
}
