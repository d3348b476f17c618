"""Effects whose response does not depend on the level: parts, numbers and filters that change.

Each function puts one into a plant, at a place: parameters that are stated, the others at `dose.x`
times the rig's own scale or drawn (`scales.Dose`).
"""

from __future__ import annotations

import math

import numpy as np

from sim.concealed.parts import GRAVITY, Description, Part
from sim.concealed.scales import (
    DISPLACEMENT,
    RIGID,
    RIGID_SOURCE,
    UNDAMPED_SOURCE,
    Concealed,
    Dose,
    Scales,
)

# A loss factor over a band as relaxing springs of equal strength, a factor of 3.2 apart.
LADDER_HZ = np.geomspace(0.02, 800.0, 10)


def compliance(plant: Description, site: str, dose: Dose) -> Concealed:
    """A joint that gives where the rig file has a rigid one, or the end of a beam that gives."""
    part = plant.part(site)
    edits = {}
    if part.kind == "torsional_spring":
        k, c = dose("k", part.values["k"] / dose.x), dose("c", part.values["c"] / dose.x)
        part.values.update(k=k, c=c)
        edits = {(site, "k"): (RIGID, RIGID_SOURCE), (site, "c"): (0.0, RIGID_SOURCE)}
    else:
        k = dose("k", 10 * Scales.of(plant).k / dose.x)
        c = dose("c", k * float(dose.rng.uniform(1e-3, 4e-3)))
        plant.insert(Part("torsional_spring", site, {"k": k, "c": c}), after=site)
    return Concealed("torsional_compliance", site, {"k": k, "c": c}, edits)


def crack(plant: Description, site: str, dose: Dose) -> Concealed:
    """A beam that gives at one place between its ends: there its slope jumps by M/(k + c s)."""
    part = plant.part(site)
    seen = [s.position for s in plant.sensors if s.kind == "acceleration" and s.across[0] == site]
    x = dose.along(part.values["L"], seen)
    k = dose("k", part.values["EI"] / part.values["L"] / dose.x)
    c = dose("c", k * float(dose.rng.uniform(1e-3, 4e-3)))
    part.cracks = (*part.cracks, (x, k, c))
    return Concealed("torsional_compliance", site, {"k": k, "c": c}, position=x)


def sideways(plant: Description, site: str, dose: Dose) -> Concealed:
    """A support that gives sideways."""
    scale = Scales.of(plant)
    k = dose("k", 10 * scale.k / scale.length**2 / dose.x)
    c = dose("c", k * float(dose.rng.uniform(1e-3, 4e-3)))
    plant.insert(Part("translational_spring", site, {"k": k, "c": c}), after=site)
    return Concealed("translational_compliance", site, {"k": k, "c": c})


def mass(plant: Description, site: str, dose: Dose) -> Concealed:
    """Mass at the downstream end of a body."""
    m = dose("m", 0.1 * dose.x * Scales.of(plant).m)
    plant.insert(Part("lumped_mass", site, {"m": m}), after=site)
    return Concealed("added_mass", site, {"m": m})


def inertia(plant: Description, site: str, dose: Dose) -> Concealed:
    """Rotary inertia on a body."""
    J = dose("J", 0.2 * dose.x * Scales.of(plant).J)
    plant.insert(Part("lumped_mass", site, {"m": 0.0, "I": J}), after=site)
    return Concealed("added_inertia", site, {"J": J})


def ground_spring(plant: Description, site: str, dose: Dose) -> Concealed:
    """A hose or brace from a body's downstream end to the ground."""
    scale = Scales.of(plant)
    units = {
        "torsional_ground_spring": scale.k,
        "translational_ground_spring": scale.k / scale.length**2,
    }
    kind = dose.choose(units, list(units)[0 if dose.rng.random() < 0.5 else 1])
    k = dose("k", 0.1 * dose.x * units[kind])
    c = dose("c", k * float(dose.rng.uniform(2e-4, 2e-3)))
    plant.insert(Part(kind, site, {"k": k, "c": c}), after=site)
    return Concealed("ground_spring", site, {"k": k, "c": c}, where=kind)


def gravity(plant: Description, site: str, dose: Dose) -> Concealed:
    """The pendulum term of a link that hangs, or stands."""
    v = plant.part(site).values
    side = 1.0 if dose.rng.random() < 0.7 else -1.0
    k = dose("k", side * dose.x * v["m"] * GRAVITY * max(v["r"], 0.05))
    plant.insert(Part("gravity_stiffness", site, {"k": k}), after=site)
    return Concealed("gravity_stiffness", site, {"k": k})


def damping(plant: Description, site: str, dose: Dose) -> Concealed:
    """A joint's damping where the rig file has none, or a body's damping to the ground."""
    part = plant.part(site)
    if part.kind == "torsional_spring":
        c = part.values["c"] if part.values["c"] > 0 else 0.005 * part.values["k"]
        part.values["c"] = c = dose("c", c * dose.x)
        edits = {(site, "c"): (0.0, UNDAMPED_SOURCE)}
        return Concealed("viscous_damping", site, {"c": c}, edits, "joint")
    scale = Scales.of(plant)
    c = dose("c", dose.x * float(np.sqrt(scale.k / scale.length**2 * scale.m)) * 0.1)
    plant.insert(Part("translational_ground_spring", site, {"k": 0.0, "c": c}), after=site)
    return Concealed("viscous_damping", site, {"c": c}, where="translational_ground")


def loss(plant: Description, site: str, dose: Dose) -> Concealed:
    """A loss factor of the beam, by springs that relax (a constant one is not causal)."""
    eta = dose("eta", 0.02 * dose.x)
    rates = 2 * np.pi * LADDER_HZ
    # sum of e j w/(j w + rate): its imaginary part at the middle of the band is eta.
    middle = 2 * np.pi * 5.0
    e = eta / float(np.sum(middle * rates / (middle**2 + rates**2)))
    # Its real part there would be more stiffness: that is taken out of EI.
    stiffer = e * float(np.sum(middle**2 / (middle**2 + rates**2)))
    part = plant.part(site)
    part.ladder = tuple((e / (1 - stiffer), float(r)) for r in rates)
    part.values["EI"] *= 1 - stiffer
    part.values["tau"] /= 1 - stiffer
    return Concealed("structural_damping", site, {"eta": eta})


def beam(plant: Description, site: str, dose: Dose) -> Concealed:
    """EI or mu that is not as given."""
    symbol = "EI" if dose.rng.random() < 0.5 else "mu"
    symbol = next(iter(dose.stated), symbol)
    ratio = 1 + 0.1 * dose.x if dose.rng.random() < 0.5 else 1 / (1 + 0.1 * dose.x)
    ratio = dose(symbol, ratio)
    plant.part(site).values[symbol] *= ratio
    return Concealed("beam_property", site, {symbol: ratio})


def oscillator(plant: Description, site: str, dose: Dose) -> Concealed:
    """A mass that hangs on a spring at a body's downstream end."""
    m = dose("m", 0.02 * dose.x * Scales.of(plant).m)
    omega = 2 * np.pi * float(np.exp(dose.rng.uniform(np.log(3.0), np.log(30.0))))
    zeta = float(dose.rng.uniform(0.01, 0.05))
    values = {"m": m, "k": dose("k", m * omega**2), "c": dose("c", 2 * zeta * m * omega)}
    plant.insert(Part("oscillator", site, values), after=site)
    return Concealed("attached_oscillator", site, values)


def lag(plant: Description, site: str, dose: Dose) -> Concealed:
    """A lag of the valve before the one that the rig file knows."""
    p = dose("p", 1e3 / dose.x)
    plant.drive(site).lags.append(1 / p)
    return Concealed("actuator_lag", site, {"p": p})


def valve(plant: Description, site: str, dose: Dose) -> Concealed:
    """A second-order valve before the lag."""
    zeta = dose("zeta", float(dose.rng.uniform(0.4, 0.9)))
    # A phase of x ms, as the lag's, where it is small.
    omega = dose("omega", 2 * zeta * 1e3 / dose.x)
    plant.drive(site).valves.append((omega, zeta))
    return Concealed("valve_dynamics", site, {"omega": omega, "zeta": zeta})


def dead_time(plant: Description, site: str, dose: Dose) -> Concealed:
    """Dead time in the input's path."""
    tau = dose("tau", 1e-3 * dose.x)
    plant.drive(site).delay += tau
    return Concealed("transport_delay", site, {"tau": tau})


def give_way(plant: Description, site: str, dose: Dose) -> Concealed:
    """Intrinsic velocity feedback: the source turns back by M/g_v."""
    g_v = dose("g_v", 0.05 * Scales.of(plant).k / dose.x)
    plant.insert(Part("torsional_spring", site, {"k": 0.0, "c": g_v}), after=site)
    return Concealed("velocity_feedback", site, {"g_v": g_v})


def oil(plant: Description, site: str, dose: Dose) -> Concealed:
    """Compressible oil behind the source, for every second trial with the mass of its line; where
    parameters are stated, if they have its frequency."""
    scale = Scales.of(plant).k
    C_h = dose("C_h", DISPLACEMENT**2 * dose.x / (3 * scale))
    k = DISPLACEMENT**2 / C_h
    parameters = {"C_h": C_h}
    zeta = dose("zeta", float(dose.rng.uniform(0.05, 0.3)))
    omega, J = 2 * np.pi * float(dose.rng.uniform(15.0, 70.0)), 0.0
    c = k * 1e-3
    line = dose.rng.random() < 0.5
    if "omega" in dose.stated if dose.stated else line:
        # The mass of the oil in the line stays as the oil gets stiffer.
        omega = dose("omega", omega * math.sqrt(k / (3 * scale)))
        J = k / omega**2
        c = 2 * zeta * k / omega
        parameters.update(omega=omega, zeta=zeta)
    plant.insert(Part("oil", site, {"k": k, "c": c, "J": J}), after=site)
    return Concealed("hydraulic_compressibility", site, parameters, where="line" if J else "column")


def sensor_delay(plant: Description, site: str, dose: Dose) -> Concealed:
    """The converter's value is older than its stamp."""
    tau = dose("tau", 1e-3 * dose.x)
    plant.sensor(site).delay += tau
    return Concealed("sensor_delay", site, {"tau": tau})


def sensor_lag(plant: Description, site: str, dose: Dose) -> Concealed:
    """A first-order low-pass that the rig file does not know."""
    p = dose("p", 1e3 / dose.x)
    plant.sensor(site).lags.append(1 / p)
    return Concealed("sensor_lag", site, {"p": p})


def sensor_gain(plant: Description, site: str, dose: Dose) -> Concealed:
    """A wrong scale."""
    gain = 1 + 0.05 * dose.x if dose.rng.random() < 0.5 else 1 / (1 + 0.05 * dose.x)
    gain = dose("gain", gain)
    plant.sensor(site).gain *= gain
    return Concealed("sensor_gain", site, {"gain": gain})


def sensor_highpass(plant: Description, site: str, dose: Dose) -> Concealed:
    """A first-order high-pass that the rig file does not know."""
    corner = dose("corner", 0.1 * dose.x)
    plant.sensor(site).highpasses.append(corner)
    return Concealed("sensor_highpass", site, {"corner": corner})


def tilt(plant: Description, site: str, dose: Dose) -> Concealed:
    """An accelerometer that turns with its link feels gravity: a + g theta."""
    plant.sensor(site).tilt += dose.x
    return Concealed("gravity_cross_sensitivity", site, {})


def encoder(plant: Description, site: str, dose: Dose) -> Concealed:
    """The encoder sits before the joint's spring, not behind it."""
    sensor = plant.sensor(site)
    sensor.across = sensor.across[:1]
    return Concealed("noncollocated_encoder", site, {})


def fractional(plant: Description, site: str, dose: Dose) -> Concealed:
    """A damper of torque c s^alpha beside a joint, by relaxing springs an octave apart."""
    alpha = dose("alpha", float(dose.rng.uniform(0.35, 0.65)))
    rates = 2 * np.pi * np.geomspace(0.02, 1500.0, 24)
    # s^alpha = sin(pi alpha)/pi * integral of s/(s + r) r^(alpha - 1) dr.
    weight = np.sin(np.pi * alpha) / np.pi * np.log(rates[1] / rates[0]) * rates**alpha
    k = plant.part(site).values["k"]
    c = dose("c", 0.02 * dose.x * k / (2 * np.pi * 5.0) ** alpha)
    ladder = tuple((float(c * w), float(r)) for w, r in zip(weight, rates, strict=True))
    # Faster than the ladder they are a plain damper: the rest of the integral of s/r.
    top = float(rates[-1]) * math.sqrt(float(rates[1] / rates[0]))
    rest = c * math.sin(math.pi * alpha) / math.pi * top ** (alpha - 1) / (1 - alpha)
    plant.part(site).values["c"] += rest
    plant.insert(Part("ladder", site, {}, ladder), after=site)
    return Concealed("fractional_damper", site, {"c": c, "alpha": alpha})
