"""Effects whose response depends on the level or on time: laws (`sim.concealed.laws`), and what
the drive does to its command.

Each function puts one into a plant, at a place: parameters that are stated, the others at `dose.x`
times the rig's own scale or drawn (`scales.Dose`).
"""

from __future__ import annotations

from sim.concealed.parts import Description, Law
from sim.concealed.scales import Concealed, Dose, Scales


def friction(plant: Description, site: str, dose: Dose) -> Concealed:
    """Dry friction beside a joint's spring, N m, or in the drive, in command units."""
    if any(site == drive.element for drive in plant.drives):
        T_c = dose("T_c", 0.1 * dose.x)
        plant.laws.append(Law("drive_friction", site, (T_c,)))
        return Concealed("coulomb_friction", site, {"T_c": T_c}, where="command units")
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
