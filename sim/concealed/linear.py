"""Effects whose response does not depend on the level: parts, numbers and filters that change.

Each function puts one into a plant, at a place and at a multiple `x` of the rig's own scale; what
else it needs it draws.
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
    Scales,
)

# A loss factor over a band as relaxing springs of equal strength, a factor of 3.2 apart.
LADDER_HZ = np.geomspace(0.02, 800.0, 10)


def compliance(plant: Description, site: str, x: float, rng: np.random.Generator) -> Concealed:
    """A joint that gives where the rig file has a rigid one, or the end of a beam that gives."""
    part = plant.part(site)
    edits = {}
    if part.kind == "torsional_spring":
        k, c = part.values["k"] / x, part.values["c"] / x
        part.values.update(k=k, c=c)
        edits = {(site, "k"): (RIGID, RIGID_SOURCE), (site, "c"): (0.0, RIGID_SOURCE)}
    else:
        k = 10 * Scales.of(plant).k / x
        c = k * float(rng.uniform(1e-3, 4e-3))
        plant.insert(Part("torsional_spring", site, {"k": k, "c": c}), after=site)
    return Concealed("torsional_compliance", site, {"k": k, "c": c}, edits)


def sideways(plant: Description, site: str, x: float, rng: np.random.Generator) -> Concealed:
    """A support that gives sideways."""
    scale = Scales.of(plant)
    k = 10 * scale.k / scale.length**2 / x
    c = k * float(rng.uniform(1e-3, 4e-3))
    plant.insert(Part("translational_spring", site, {"k": k, "c": c}), after=site)
    return Concealed("translational_compliance", site, {"k": k, "c": c})


def mass(plant: Description, site: str, x: float, rng: np.random.Generator) -> Concealed:
    """Mass at the downstream end of a body."""
    m = 0.1 * x * Scales.of(plant).m
    plant.insert(Part("lumped_mass", site, {"m": m}), after=site)
    return Concealed("added_mass", site, {"m": m})


def inertia(plant: Description, site: str, x: float, rng: np.random.Generator) -> Concealed:
    """Rotary inertia on a body."""
    J = 0.2 * x * Scales.of(plant).J
    plant.insert(Part("lumped_mass", site, {"m": 0.0, "I": J}), after=site)
    return Concealed("added_inertia", site, {"J": J})


def ground_spring(plant: Description, site: str, x: float, rng: np.random.Generator) -> Concealed:
    """A hose or brace from a body's downstream end to the ground."""
    scale = Scales.of(plant)
    kind, unit = (
        ("torsional_ground_spring", scale.k)
        if rng.random() < 0.5
        else ("translational_ground_spring", scale.k / scale.length**2)
    )
    k = 0.1 * x * unit
    c = k * float(rng.uniform(2e-4, 2e-3))
    plant.insert(Part(kind, site, {"k": k, "c": c}), after=site)
    return Concealed("ground_spring", site, {"k": k, "c": c}, where=kind)


def gravity(plant: Description, site: str, x: float, rng: np.random.Generator) -> Concealed:
    """The pendulum term of a link that hangs, or stands."""
    v = plant.part(site).values
    side = 1.0 if rng.random() < 0.7 else -1.0
    k = side * x * v["m"] * GRAVITY * max(v["r"], 0.05)
    plant.insert(Part("gravity_stiffness", site, {"k": k}), after=site)
    return Concealed("gravity_stiffness", site, {"k": k})


def damping(plant: Description, site: str, x: float, rng: np.random.Generator) -> Concealed:
    """A joint's damping where the rig file has none, or a body's damping to the ground."""
    part = plant.part(site)
    if part.kind == "torsional_spring":
        c = part.values["c"] * x if part.values["c"] > 0 else 0.005 * part.values["k"] * x
        part.values["c"] = c
        edits = {(site, "c"): (0.0, UNDAMPED_SOURCE)}
        return Concealed("viscous_damping", site, {"c": c}, edits, "joint")
    scale = Scales.of(plant)
    c = x * float(np.sqrt(scale.k / scale.length**2 * scale.m)) * 0.1
    plant.insert(Part("translational_ground_spring", site, {"k": 0.0, "c": c}), after=site)
    return Concealed("viscous_damping", site, {"c": c}, where="translational_ground")


def loss(plant: Description, site: str, x: float, rng: np.random.Generator) -> Concealed:
    """A loss factor of the beam, by springs that relax (a constant one is not causal)."""
    eta = 0.02 * x
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


def beam(plant: Description, site: str, x: float, rng: np.random.Generator) -> Concealed:
    """EI or mu that is not as given."""
    symbol = "EI" if rng.random() < 0.5 else "mu"
    ratio = 1 + 0.1 * x if rng.random() < 0.5 else 1 / (1 + 0.1 * x)
    plant.part(site).values[symbol] *= ratio
    return Concealed("beam_property", site, {symbol: ratio})


def oscillator(plant: Description, site: str, x: float, rng: np.random.Generator) -> Concealed:
    """A mass that hangs on a spring at a body's downstream end."""
    m = 0.02 * x * Scales.of(plant).m
    omega = 2 * np.pi * float(np.exp(rng.uniform(np.log(3.0), np.log(30.0))))
    zeta = float(rng.uniform(0.01, 0.05))
    values = {"m": m, "k": m * omega**2, "c": 2 * zeta * m * omega}
    plant.insert(Part("oscillator", site, values), after=site)
    return Concealed("attached_oscillator", site, values)


def lag(plant: Description, site: str, x: float, rng: np.random.Generator) -> Concealed:
    """A lag of the valve before the one that the rig file knows."""
    plant.drive.lags.append(1e-3 * x)
    return Concealed("actuator_lag", site, {"p": 1e3 / x})


def valve(plant: Description, site: str, x: float, rng: np.random.Generator) -> Concealed:
    """A second-order valve before the lag."""
    zeta = float(rng.uniform(0.4, 0.9))
    omega = 2 * zeta * 1e3 / x  # a phase of x ms, as the lag's, where it is small
    plant.drive.valves.append((omega, zeta))
    return Concealed("valve_dynamics", site, {"omega": omega, "zeta": zeta})


def dead_time(plant: Description, site: str, x: float, rng: np.random.Generator) -> Concealed:
    """Dead time in the input's path."""
    plant.drive.delay += 1e-3 * x
    return Concealed("transport_delay", site, {"tau": 1e-3 * x})


def give_way(plant: Description, site: str, x: float, rng: np.random.Generator) -> Concealed:
    """Intrinsic velocity feedback: the source turns back by M/g_v."""
    g_v = 0.05 * Scales.of(plant).k / x
    plant.insert(Part("torsional_spring", site, {"k": 0.0, "c": g_v}), after=site)
    return Concealed("velocity_feedback", site, {"g_v": g_v})


def oil(plant: Description, site: str, x: float, rng: np.random.Generator) -> Concealed:
    """Compressible oil behind the source, for every second trial with the mass of its line."""
    k = 3 * Scales.of(plant).k / x
    parameters = {"C_h": DISPLACEMENT**2 / k}
    zeta = float(rng.uniform(0.05, 0.3))
    omega, J = 2 * np.pi * float(rng.uniform(15.0, 70.0)), 0.0
    c = k * 1e-3
    if rng.random() < 0.5:
        # The mass of the oil in the line stays as the oil gets stiffer.
        J = 3 * Scales.of(plant).k / omega**2
        omega = math.sqrt(k / J)
        c = 2 * zeta * k / omega
        parameters.update(omega=omega, zeta=zeta)
    plant.insert(Part("oil", site, {"k": k, "c": c, "J": J}), after=site)
    return Concealed("hydraulic_compressibility", site, parameters, where="line" if J else "column")


def sensor_delay(plant: Description, site: str, x: float, rng: np.random.Generator) -> Concealed:
    """The converter's value is older than its stamp."""
    plant.sensor(site).delay += 1e-3 * x
    return Concealed("sensor_delay", site, {"tau": 1e-3 * x})


def sensor_lag(plant: Description, site: str, x: float, rng: np.random.Generator) -> Concealed:
    """A first-order low-pass that the rig file does not know."""
    plant.sensor(site).lags.append(1e-3 * x)
    return Concealed("sensor_lag", site, {"p": 1e3 / x})


def sensor_gain(plant: Description, site: str, x: float, rng: np.random.Generator) -> Concealed:
    """A wrong scale."""
    gain = 1 + 0.05 * x if rng.random() < 0.5 else 1 / (1 + 0.05 * x)
    plant.sensor(site).gain *= gain
    return Concealed("sensor_gain", site, {"gain": gain})


def sensor_highpass(plant: Description, site: str, x: float, rng: np.random.Generator) -> Concealed:
    """A first-order high-pass that the rig file does not know."""
    plant.sensor(site).highpasses.append(0.1 * x)
    return Concealed("sensor_highpass", site, {"corner": 0.1 * x})


def tilt(plant: Description, site: str, x: float, rng: np.random.Generator) -> Concealed:
    """An accelerometer that turns with its link feels gravity: a + g theta."""
    plant.sensor(site).tilt += x
    return Concealed("gravity_cross_sensitivity", site, {})


def encoder(plant: Description, site: str, x: float, rng: np.random.Generator) -> Concealed:
    """The encoder sits before the joint's spring, not behind it."""
    sensor = plant.sensor(site)
    sensor.across = sensor.across[:1]
    return Concealed("noncollocated_encoder", site, {})


def fractional(plant: Description, site: str, x: float, rng: np.random.Generator) -> Concealed:
    """A damper of torque c s^alpha beside a joint, by relaxing springs an octave apart."""
    alpha = float(rng.uniform(0.35, 0.65))
    rates = 2 * np.pi * np.geomspace(0.02, 1500.0, 24)
    # s^alpha = sin(pi alpha)/pi * integral of s/(s + r) r^(alpha - 1) dr.
    weight = np.sin(np.pi * alpha) / np.pi * np.log(rates[1] / rates[0]) * rates**alpha
    c = 0.02 * x * plant.part(site).values["k"] / (2 * np.pi * 5.0) ** alpha
    ladder = tuple((float(c * w), float(r)) for w, r in zip(weight, rates, strict=True))
    # Faster than the ladder they are a plain damper: the rest of the integral of s/r.
    top = float(rates[-1]) * math.sqrt(float(rates[1] / rates[0]))
    rest = c * math.sin(math.pi * alpha) / math.pi * top ** (alpha - 1) / (1 - alpha)
    plant.part(site).values["c"] += rest
    plant.insert(Part("ladder", site, {}, ladder), after=site)
    return Concealed("fractional_damper", site, {"c": c, "alpha": alpha})
