"""Effects whose response depends on the level or on time: laws (`sim.concealed.laws`), and what
the drive does to its command.

Each function puts one into a plant, at a place and at a multiple `x` of the rig's own scale.
"""

from __future__ import annotations

import numpy as np

from sim.concealed.parts import Description, Law
from sim.concealed.scales import Concealed, Scales


def friction(plant: Description, site: str, x: float, rng: np.random.Generator) -> Concealed:
    """Dry friction beside a joint's spring, N m, or in the drive, in command units."""
    if site == plant.drive.element:
        plant.laws.append(Law("drive_friction", site, (0.1 * x,)))
        return Concealed("coulomb_friction", site, {"T_c": 0.1 * x}, where="command units")
    T_c = 1e-3 * x * Scales.of(plant).k
    plant.laws.append(Law("coulomb", site, (T_c,)))
    return Concealed("coulomb_friction", site, {"T_c": T_c})


def overlap(plant: Description, site: str, x: float, rng: np.random.Generator) -> Concealed:
    """A dead zone of the valve, full width in command units."""
    plant.drive.deadband = 0.1 * x
    return Concealed("valve_deadband", site, {"width": 0.1 * x})


def play(plant: Description, site: str, x: float, rng: np.random.Generator) -> Concealed:
    """Play in a joint, full width in rad."""
    plant.laws.append(Law("backlash", site, (1e-3 * x, plant.part(site).values["k"])))
    return Concealed("backlash", site, {"width": 1e-3 * x})


def cubic(plant: Description, site: str, x: float, rng: np.random.Generator) -> Concealed:
    """A joint that hardens: k3 theta^3."""
    k3 = x * plant.part(site).values["k"] / 1e-3**2 * 0.1
    plant.laws.append(Law("cubic", site, (k3,)))
    return Concealed("cubic_stiffness", site, {"k3": k3})


def flow(plant: Description, site: str, x: float, rng: np.random.Generator) -> Concealed:
    """Orifice flow: the speed falls with the root of the pressure that the load leaves."""
    T_s = 0.01 * Scales.of(plant).k / x
    plant.laws.append(Law("flow_saturation", site, (T_s,)))
    return Concealed("flow_saturation", site, {"T_s": T_s})


def clipped(plant: Description, site: str, x: float, rng: np.random.Generator) -> Concealed:
    """A command that is cut off behind where it is recorded."""
    plant.drive.limit = 1.0 / x
    return Concealed("output_saturation", site, {"limit": 1.0 / x})


def slip(plant: Description, site: str, x: float, rng: np.random.Generator) -> Concealed:
    """Hysteresis: elements that stick and slide (Maxwell, Iwan) beside a joint's spring.

    They slide from angles that span what the joint does: at any level some stick and some
    slide. If all slid, it would be dry friction.
    """
    own = plant.part(site).values["k"]
    angle = 1e-3 * min(1.0, Scales.of(plant).k / own)
    k = 0.02 * x * own
    values = tuple(v for share in (0.1, 0.4, 1.6, 6.4) for v in (k, k * share * angle))
    plant.laws.append(Law("slip", site, values))
    return Concealed("hysteresis", site, {"k": 4 * k, "angle": angle})


def drift(plant: Description, site: str, x: float, rng: np.random.Generator) -> Concealed:
    """A joint that softens while the run lasts."""
    share, tau = -min(0.1 * x, 0.9), float(rng.uniform(20.0, 60.0))
    plant.laws.append(Law("drift", site, (plant.part(site).values["k"], share, tau)))
    return Concealed("time_varying_joint", site, {"share": share, "tau": tau})
