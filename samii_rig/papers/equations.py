"""Where each equation of the papers lives in the code."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Equation:
    """paper 1 or 2, number as printed. where : `module:name`, names with dots inside a class."""

    paper: int
    number: str
    what: str
    where: tuple[str, ...]


_ELEMENTS = "samii_rig.model.elements"
_FEEDBACK = "samii_rig.identify.velocity_feedback"

EQUATIONS: tuple[Equation, ...] = (
    Equation(1, "1-9", "beam: states, solution and transfer matrix", (f"{_ELEMENTS}:beam_matrix",)),
    Equation(
        1, "10", "flexible joint: torsional spring", (f"{_ELEMENTS}:torsional_spring_matrix",)
    ),
    Equation(
        1,
        "11",
        "chain as a product; rigid link R",
        ("samii_rig.model.tmm:Chain", f"{_ELEMENTS}:rigid_link_matrix"),
    ),
    Equation(
        1,
        "12",
        "finite elements, constraints with Lagrange multipliers",
        ("samii_rig.fem.assemble:assemble", "samii_rig.fem.model:Fem.evaluate"),
    ),
    Equation(1, "13", "rigid and flexible modes", ("samii_rig.fem.reduce:reduce",)),
    Equation(
        1,
        "14",
        "reduced equations of motion",
        ("samii_rig.fem.reduce:Reduced", "samii_rig.fem.reduce:Reduced.to_statespace"),
    ),
    Equation(
        1,
        "15",
        "perfect velocity source, theta' = g_a v",
        (f"{_ELEMENTS}:angular_velocity_source_matrix",),
    ),
    Equation(1, "16", "SAMII with perfect joints", ("samii_rig.papers.rigs:locked",)),
    Equation(
        1,
        "17",
        "clamped base, free tip: roots of the determinant",
        ("samii_rig.model.tmm:Chain.characteristic", "samii_rig.model.modes:natural_frequencies"),
    ),
    Equation(
        1,
        "18",
        "velocity feedback, T = g_v (g_a v - theta')",
        ("samii_rig.fem.model:Fem", f"{_FEEDBACK}:in_series"),
    ),
    Equation(
        1,
        "e (section IV-C)",
        "method 1: cost of f_1, f_2, z_1; then g_v",
        ("samii_rig.identify.targets:method_1", f"{_FEEDBACK}:fit_gain"),
    ),
    Equation(
        1,
        "19",
        "method 2: cost of f_1 and the mode shape ratio",
        ("samii_rig.identify.targets:method_2",),
    ),
    Equation(
        2,
        "1",
        "velocity source of first order",
        (
            f"{_ELEMENTS}:angular_velocity_source_matrix",
            "samii_rig.papers.spring_damper:first_order",
        ),
    ),
    Equation(
        2,
        "2",
        "velocity source of second order (s^2 for the s that is printed)",
        (
            "samii_rig.rig.schema.elements:AngularVelocitySource2",
            "samii_rig.papers.spring_damper:second_order",
        ),
    ),
    Equation(2, "3", "velocity feedback", ("samii_rig.fem.model:Fem", f"{_FEEDBACK}:in_series")),
    Equation(
        2,
        "4, 5",
        "link under gravity, hanging and level",
        ("samii_rig.rig.schema.elements:GravityStiffness", "samii_rig.papers.torque:closed_form"),
    ),
    Equation(
        2,
        "6, 7",
        "source in series with spring and damper",
        (f"{_ELEMENTS}:torsional_spring_matrix", f"{_ELEMENTS}:angular_velocity_source_matrix"),
    ),
    Equation(2, "8", "state vector [w, theta, M, V, 1]", ("samii_rig.model.tmm:Chain.field",)),
    Equation(2, "9, 10", "states before and after the actuator", (f"{_ELEMENTS}:matrix",)),
    Equation(
        2,
        "11",
        "theta across source and spring: where the encoder sits",
        ("samii_rig.rig.schema:RelativeAngle", "samii_rig.identify.actuator:with_encoder"),
    ),
    Equation(2, "12", "SAMII, clamp to links 3 to 6", ("samii_rig.papers.rigs:samii",)),
    Equation(
        2,
        "fit (section 6.2)",
        "c, k and p on the Bode diagram",
        ("samii_rig.identify.actuator:fit_actuator",),
    ),
)
