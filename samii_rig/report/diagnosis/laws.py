"""x(w) of a named cause: the curve that its law and its parameters give.

A part at a port turns the state `by` into a jump of the state `jump`, z+ = z- + e_jump x z_by. The
shear force is -V, so a jump between w and V is turned round here and a spring has a positive value.
A part of a channel is a factor instead.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from samii_rig.diagnose.physics.insert import DISPLACEMENT
from samii_rig.diagnose.result import Cause, Trace
from samii_rig.types import Complex, Float

Numbers = Mapping[str, float]
Jump = tuple[str, str]
Law = Callable[[Complex, Numbers], Complex]

TURN, SHEAR, FORCE, TORQUE = ("theta", "M"), ("w", "V"), ("V", "w"), ("M", "theta")

# What x(w) is in words, and its unit.
QUANTITY: dict[Jump, tuple[str, str]] = {
    TURN: ("rotation per moment", "rad/(N m)"),
    SHEAR: ("displacement per force", "m/N"),
    FORCE: ("force per displacement", "N/m"),
    TORQUE: ("moment per rotation", "N m/rad"),
}


def _spring(s: Complex, p: Numbers) -> Complex:
    return np.asarray(p.get("k", 0.0) + p.get("c", 0.0) * s)


def _softness(s: Complex, p: Numbers) -> Complex:
    return 1 / _spring(s, p)


def _oil(s: Complex, p: Numbers) -> Complex:
    return 1 / (DISPLACEMENT**2 / p["C_h"] + p.get("c", 0.0) * s)


def _oscillator(s: Complex, p: Numbers) -> Complex:
    inertia, spring = p["J" if "J" in p else "m"] * s**2, _spring(s, p)
    return inertia * spring / (inertia + spring)


JUMPS: dict[str, tuple[tuple[Jump, Law], ...]] = {
    "torsional_compliance": ((TURN, _softness),),
    "translational_compliance": ((SHEAR, _softness),),
    "velocity_feedback": ((TURN, lambda s, p: 1 / (p["g_v"] * s)),),
    "hydraulic_compressibility": ((TURN, _oil),),
    "added_mass": ((FORCE, lambda s, p: p["m"] * s**2),),
    "added_inertia": ((TORQUE, lambda s, p: p["J"] * s**2),),
    "gravity_stiffness": ((TORQUE, _spring),),
    # In rotation or in translation: the unit tells.
    "attached_oscillator": ((TORQUE, _oscillator), (FORCE, _oscillator)),
    "ground_spring": ((TORQUE, _spring), (FORCE, _spring)),
    "viscous_damping": ((TORQUE, _spring), (FORCE, _spring)),
}

FACTORS: dict[str, Law] = {
    "transport_delay": lambda s, p: np.exp(-s * p["tau"]),
    "sensor_delay": lambda s, p: np.exp(-s * p["tau"]),
    "actuator_lag": lambda s, p: p["p"] / (s + p["p"]),
    "sensor_lag": lambda s, p: p["p"] / (s + p["p"]),
    "sensor_gain": lambda s, p: np.full(s.shape, p["gain"], complex),
    "sensor_highpass": lambda s, p: s / (s + 2 * np.pi * p["corner"]),
}


def jump_of(cause: Cause) -> Jump | None:
    """The jump that a cause makes; None where it is none, or acts on the
    input too, as a hydraulic line."""
    if "omega" in cause.parameters:
        return None
    rows = JUMPS.get(cause.physics, ())
    if len(rows) < 2:
        return rows[0][0] if rows else None
    units = {v.unit for v in cause.parameters.values()}
    return FORCE if units & {"N/m", "N s/m"} else TORQUE


def jump_curve(cause: Cause, frequency: Float) -> Complex | None:
    """(n,) x of a cause at `frequency`, Hz, in the unit of `QUANTITY`; None where it has none."""
    jump = jump_of(cause)
    law = next((law for j, law in JUMPS.get(cause.physics, ()) if j == jump), None)
    return None if law is None else _at(law, cause, frequency)


def factor_curve(cause: Cause, frequency: Float) -> Complex | None:
    """(n,) the factor of a cause of a channel; None where the cause is not one."""
    law = FACTORS.get(cause.physics)
    return None if law is None else _at(law, cause, frequency)


def _at(law: Law, cause: Cause, frequency: Float) -> Complex | None:
    s = np.asarray(2j * np.pi * frequency, np.complex128)
    try:
        x = law(s, {symbol: v.value for symbol, v in cause.parameters.items()})
    except KeyError:  # a lab's own physics under a known name
        return None
    return x if np.all(np.isfinite(x)) else None


def seen(trace: Trace) -> Complex:
    """(n,) x of a trace in the unit of `QUANTITY`."""
    return -trace.x if (trace.jump, trace.by) in (SHEAR, FORCE) else trace.x
