"""Effects whose response depends on the level or on time: laws (`sim.concealed.laws`), and what
the drive does to its command.

Each function puts one into a plant, at a place: parameters that are stated, the others at `dose.x`
times the rig's own scale or drawn (`scales.Dose`).
"""

from __future__ import annotations

import math

import numpy as np

from sim.concealed.assemble import assemble
from sim.concealed.parts import Description, Law
from sim.concealed.scales import Concealed, Dose, Scales

GROUND = "ground"  # the variant that acts between a body and the ground
BODIES = ("beam", "lumped_mass")  # what shifts and may touch the ground
SIDES = {"both": (1.0, 1.0), "above": (1.0, 0.0), "below": (0.0, 1.0)}
GAPS = (0.2, 0.9)  # of what a place moves by: a stop that is met at the largest level


def is_body(plant: Description, site: str) -> bool:
    """Whether an element is one that a force to the ground acts on, at its downstream end."""
    return plant.part(site).kind in BODIES


def holding(plant: Description, site: str) -> float:
    """What holds a body's downstream end sideways, N/m, the drives held; of one that nothing holds
    the rig's own scale, a joint's stiffness at a link's length."""
    s = assemble(plant)
    free = np.delete(np.arange(s.M.shape[0]), list(s.driven.values()))
    row = s.ends[site][0][free]
    scale = Scales.of(plant)
    try:
        gives = float(row @ np.linalg.solve(s.K[np.ix_(free, free)], row))
    except np.linalg.LinAlgError:
        gives = 0.0
    return 1 / gives if gives > 0 else scale.k / scale.length**2


def friction(plant: Description, site: str, dose: Dose) -> Concealed:
    """Dry friction beside a joint's spring, N m, in the drive, in command units, or of a body
    against the ground, N."""
    if any(site == drive.element for drive in plant.drives):
        T_c = dose("T_c", 0.1 * dose.x)
        plant.laws.append(Law("drive_friction", site, (T_c,)))
        return Concealed("coulomb_friction", site, {"T_c": T_c}, where="command units")
    if is_body(plant, site):
        T_c = dose("T_c", 1e-3 * dose.x * holding(plant, site))
        plant.laws.append(Law("coulomb", site, (T_c,), ground=True))
        return Concealed("coulomb_friction", site, {"T_c": T_c}, where=GROUND)
    T_c = dose("T_c", 1e-3 * dose.x * Scales.of(plant).k)
    plant.laws.append(Law("coulomb", site, (T_c,)))
    return Concealed("coulomb_friction", site, {"T_c": T_c})


def overlap(plant: Description, site: str, dose: Dose) -> Concealed:
    """A dead zone of the valve, full width in command units."""
    plant.drive(site).deadband = width = dose("width", 0.1 * dose.x)
    return Concealed("valve_deadband", site, {"width": width})


def play(plant: Description, site: str, dose: Dose) -> Concealed:
    """Play in a joint, full width in rad."""
    width = dose("width", 1e-3 * dose.x)
    plant.laws.append(Law("backlash", site, (width, plant.part(site).values["k"])))
    return Concealed("backlash", site, {"width": width})


def cubic(plant: Description, site: str, dose: Dose) -> Concealed:
    """A joint that hardens: k3 theta^3."""
    k3 = dose("k3", dose.x * plant.part(site).values["k"] / 1e-3**2 * 0.1)
    plant.laws.append(Law("cubic", site, (k3,)))
    return Concealed("cubic_stiffness", site, {"k3": k3})


def drag(plant: Description, site: str, dose: Dose) -> Concealed:
    """A damper that grows with the speed: c2 |speed| speed."""
    # A joint's spring has as much at 1e-3 rad and 1 rad/s.
    c2 = dose("c2", 1e-3 * dose.x * plant.part(site).values["k"])
    plant.laws.append(Law("drag", site, (c2,)))
    return Concealed("quadratic_damping", site, {"c2": c2})


def stop(plant: Description, site: str, dose: Dose) -> Concealed:
    """A stop at a way `gap` from rest, on both sides or one: of a joint, or of a body against the
    ground."""
    # Half of the stops are on both sides.
    drawn = ("both", "both", "above", "below")[int(dose.rng.integers(4))]
    where = dose.choose(SIDES, drawn)
    share = math.exp(dose.rng.uniform(math.log(GAPS[0]), math.log(GAPS[1])))
    gap = dose("gap", share * dose.reach)
    ground = is_body(plant, site)
    own = holding(plant, site) if ground else plant.part(site).values["k"]
    k = dose("k", dose.x * own)
    plant.laws.append(Law("stop", site, (k, gap, *SIDES[where]), ground))
    return Concealed("end_stop", site, {"gap": gap, "k": k}, where=where)


def one_sided(plant: Description, site: str, dose: Dose) -> Concealed:
    """A joint that is stiffer to one side, as where a crack closes."""
    k = dose("k", 0.01 * dose.x * plant.part(site).values["k"])
    plant.laws.append(Law("one_sided", site, (k,)))
    return Concealed("one_sided_stiffness", site, {"k": k})


def flow(plant: Description, site: str, dose: Dose) -> Concealed:
    """Orifice flow: the speed falls with the root of the pressure that the load leaves."""
    T_s = dose("T_s", 0.01 * Scales.of(plant).k / dose.x)
    plant.laws.append(Law("flow_saturation", site, (T_s,)))
    return Concealed("flow_saturation", site, {"T_s": T_s})


def clipped(plant: Description, site: str, dose: Dose) -> Concealed:
    """A command that is cut off behind where it is recorded."""
    plant.drive(site).limit = limit = dose("limit", 1.0 / dose.x)
    return Concealed("output_saturation", site, {"limit": limit})


def slip(plant: Description, site: str, dose: Dose) -> Concealed:
    """Hysteresis: elements that stick and slide (Maxwell, Iwan) beside a joint's spring.

    They slide from angles that span what the joint does: at any level some stick and some
    slide. If all slid, it would be dry friction.
    """
    own = plant.part(site).values["k"]
    angle = dose("angle", 1e-3 * min(1.0, Scales.of(plant).k / own))
    k = dose("k", 0.08 * dose.x * own) / 4  # of each of four
    values = tuple(v for share in (0.1, 0.4, 1.6, 6.4) for v in (k, k * share * angle))
    plant.laws.append(Law("slip", site, values))
    return Concealed("hysteresis", site, {"k": 4 * k, "angle": angle})


def drift(plant: Description, site: str, dose: Dose) -> Concealed:
    """A joint that softens while the run lasts."""
    share = dose("share", -min(0.1 * dose.x, 0.9))
    tau = dose("tau", float(dose.rng.uniform(20.0, 60.0)))
    plant.laws.append(Law("drift", site, (plant.part(site).values["k"], share, tau)))
    return Concealed("stiffness_variation", site, {"share": share, "tau": tau})
