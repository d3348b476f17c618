"""What can be concealed: every row of the vocabulary, and what lies outside it.

A row is data: where it can sit, and a function that puts it into a plant. To add one, write that
function in `linear` or `nonlinear` and a line in `ROWS`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

from sim.concealed import linear, nonlinear
from sim.concealed.parts import Description
from sim.concealed.scales import Concealed, Dose

Put = Callable[[Description, str, Dose], Concealed]


@dataclass(frozen=True, slots=True)
class Row:
    """A row of the table.

    at : which parts or sensors can have it. linear : whether its response does not depend on
    the level. most : the largest multiple. fixed : whether it is there or not, without a size.
    gap : whether it acts beyond a gap, which is drawn from how far its place moves. along : whether
    it has a position along its site.
    """

    physics: str
    at: str
    put: Put
    linear: bool = True
    most: float = 3.0
    fixed: bool = False
    outside: bool = False
    gap: bool = False
    along: bool = False


def clamp_of(plant: Description) -> str:
    """The spring at the base, "" if there is none. Its damper is what lets the whole structure come
    to rest: without it no burst would settle within a run, whatever else is concealed."""
    first = plant.parts[0]
    return first.name if first.kind == "torsional_spring" else ""


def places(plant: Description, row: Row) -> list[str]:
    """Names of the elements or sensors at which a row can sit."""

    def kinds(*wanted: str) -> list[str]:
        return [p.name for p in plant.parts if p.kind in wanted]

    angles = [s.name for s in plant.sensors if s.kind != "acceleration"]
    accelerations = [s.name for s in plant.sensors if s.kind == "acceleration"]
    loose = [name for name in kinds("torsional_spring") if name != clamp_of(plant)]
    joints, sources = kinds("torsional_spring"), kinds("angular_velocity_source")
    bodies = kinds(*nonlinear.BODIES)
    spanned = {n for s in plant.sensors if s.kind == "relative_angle" for n in s.across}
    return {
        "joint": joints,
        "loose": loose,
        "junction": loose + kinds("beam"),
        "support": joints + kinds("beam"),
        "body": kinds("rigid_link", "beam"),
        "link": kinds("rigid_link"),
        "beam": kinds("beam"),
        "source": sources,
        "friction": _every_third(joints + sources, bodies),
        "stop": _every_third(joints, bodies),
        "sensor": angles + accelerations,
        "accelerometer": accelerations,
        "encoder": [s.name for s in plant.sensors if len(s.across) > 1 and s.across[0] in spanned],
    }[row.at]


def _every_third(names: list[str], bodies: list[str]) -> list[str]:
    """Names with one of the bodies behind each second: every third place is the ground."""
    out = []
    for i, name in enumerate(names):
        out.append(name)
        if bodies and i % 2:
            out.append(bodies[i // 2 % len(bodies)])
    return out or bodies


ROWS = (
    Row("torsional_compliance", "junction", linear.compliance),
    Row("translational_compliance", "support", linear.sideways),
    Row("added_mass", "body", linear.mass),
    Row("added_inertia", "body", linear.inertia),
    Row("ground_spring", "body", linear.ground_spring, most=30.0),
    Row("gravity_stiffness", "link", linear.gravity, most=30.0),
    Row("viscous_damping", "loose", linear.damping),
    Row("viscous_damping", "body", linear.damping, most=10.0),
    Row("structural_damping", "beam", linear.loss, most=10.0),
    Row("beam_property", "beam", linear.beam, most=5.0),
    Row("attached_oscillator", "body", linear.oscillator, most=5.0),
    Row("actuator_lag", "source", linear.lag, most=10.0),
    Row("valve_dynamics", "source", linear.valve, most=10.0),
    Row("transport_delay", "source", linear.dead_time, most=20.0),
    Row("velocity_feedback", "source", linear.give_way),
    Row("hydraulic_compressibility", "source", linear.oil, most=5.0),
    Row("sensor_delay", "sensor", linear.sensor_delay, most=20.0),
    Row("sensor_lag", "sensor", linear.sensor_lag, most=10.0),
    Row("sensor_gain", "sensor", linear.sensor_gain, most=20.0),
    Row("sensor_highpass", "accelerometer", linear.sensor_highpass, most=20.0),
    Row("gravity_cross_sensitivity", "accelerometer", linear.tilt, fixed=True),
    Row("noncollocated_encoder", "encoder", linear.encoder, fixed=True),
    Row("coulomb_friction", "friction", nonlinear.friction, linear=False, most=10.0),
    Row("valve_deadband", "source", nonlinear.overlap, linear=False, most=5.0),
    Row("backlash", "joint", nonlinear.play, linear=False, most=20.0),
    Row("cubic_stiffness", "joint", nonlinear.cubic, linear=False, most=100.0),
    Row("quadratic_damping", "joint", nonlinear.drag, linear=False, most=20.0),
    Row("flow_saturation", "source", nonlinear.flow, linear=False, most=10.0),
    Row("output_saturation", "source", nonlinear.clipped, linear=False, most=20.0),
    Row("end_stop", "stop", nonlinear.stop, linear=False, most=30.0, gap=True),
    Row("torsional_compliance", "beam", linear.crack, along=True),
)
OUTSIDE = (
    Row("hysteresis", "joint", nonlinear.slip, linear=False, most=10.0, outside=True),
    Row("fractional_damper", "joint", linear.fractional, most=20.0, outside=True),
    Row("one_sided_stiffness", "joint", nonlinear.one_sided, linear=False, most=20.0, outside=True),
)
VARYING = (Row("stiffness_variation", "joint", nonlinear.drift, linear=False, most=6.0),)
TABLES = {"outside": OUTSIDE, "varying": VARYING}  # rows of a kind, where it has its own


def physics() -> Iterator[str]:
    """The vocabulary's names, each once."""
    yield from dict.fromkeys(row.physics for row in ROWS)
