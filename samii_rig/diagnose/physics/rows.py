"""One row a physics: its name in the contract, its words, and what else is to be known of it."""

from __future__ import annotations

from dataclasses import dataclass

EVERY_SENSOR = "every sensor"  # the site of what all have alike


@dataclass(frozen=True, slots=True)
class Physics:
    """A row of the table.

    name : in the contract. words : for a person. hidden : what a person asks for first, where any
    of it could hide, (a part, a part under a size); () for what nobody asks. soft : the larger its
    number, the less of it. physical : not wiring, units or signs, which are reported separately.
    resonant : it acts in a narrow band that may be anywhere.
    """

    name: str
    words: str
    hidden: tuple[str, ...] = ()
    soft: bool = False
    physical: bool = True
    resonant: bool = False


_ROWS = (
    Physics(
        "torsional_compliance",
        "a joint or clamp that gives, or a crack",
        hidden=("a joint that gives", "a joint spring stiffer than"),
        soft=True,
    ),
    Physics("translational_compliance", "a support that gives sideways, or a crack in a rod"),
    Physics("added_mass", "a mass", hidden=("a mass", "a mass under")),
    Physics("added_inertia", "a rotary inertia"),
    Physics("ground_spring", "a spring to ground"),
    Physics("gravity_stiffness", "the stiffness of gravity"),
    Physics("viscous_damping", "a damper", hidden=("a damper", "a damper under")),
    Physics("structural_damping", "the beam's own damping"),
    Physics("beam_property", "a beam other than given"),
    Physics("joint_stiffness", "a joint softer or stiffer than it was"),
    Physics("attached_oscillator", "something that hangs on and resonates", resonant=True),
    Physics("actuator_lag", "a lag of the drive"),
    Physics("valve_dynamics", "a valve of second order"),
    Physics("transport_delay", "a dead time of the drive", hidden=("a delay", "a delay under")),
    Physics("velocity_feedback", "a drive that gives way to torque"),
    Physics("hydraulic_compressibility", "oil that is compressed"),
    Physics("sensor_delay", "a delay of the sensor"),
    Physics("sensor_lag", "a lag of the sensor"),
    Physics("sensor_gain", "a gain of the sensor"),
    Physics("sensor_highpass", "a high-pass of the sensor, or one of every sensor"),
    Physics("sensor_position", "a sensor at another place"),
    Physics("gravity_cross_sensitivity", "an accelerometer that tilts"),
    Physics("noncollocated_encoder", "an encoder across other parts"),
    Physics("coulomb_friction", "dry friction"),
    Physics("quadratic_damping", "a damper that grows with the speed"),
    Physics("valve_deadband", "a dead band of the valve"),
    Physics("backlash", "play"),
    Physics("end_stop", "a stop beyond a gap"),
    Physics("cubic_stiffness", "a joint that stiffens or softens"),
    Physics("stiffness_variation", "a stiffness that is not constant"),
    Physics("hysteresis", "a part that sticks, then slips"),
    Physics("flow_saturation", "a flow that saturates"),
    Physics("output_saturation", "a clipped command"),
    Physics("fractional_damping", "a damper between a spring and a dashpot"),
    Physics("channel_swap", "channels that are swapped", physical=False),
    Physics("sign_error", "a wrong sign", physical=False),
    Physics("common_gain", "a scale of the input", physical=False),
    Physics("time_offset", "a channel that is stamped too early", physical=False),
    Physics("unit_rest", "a unit that is another", physical=False),
    Physics("unit_error", "a unit that is another, exactly", physical=False),
    Physics("kind_error", "a sensor of another kind", physical=False),
    Physics("column_shifted", "a column that stands samples from the others", physical=False),
    Physics("columns_shifted", "columns that stand samples apart", physical=False),
    Physics("input_not_held", "an input that was not held", physical=False),
    Physics("input_held", "an input that was held, not measured", physical=False),
)
PHYSICS = {row.name: row for row in _ROWS}
RESONANT = frozenset(row.name for row in _ROWS if row.resonant)
SOFT = frozenset(row.name for row in _ROWS if row.soft)  # the larger, the less of it
