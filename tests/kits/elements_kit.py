"""Rigs of any elements in a line each, and their natural frequencies from the model."""

from typing import Any

import numpy as np
from scipy.optimize import brentq

from samii_rig.model.tmm import Chain
from samii_rig.rig.schema import (
    AngularVelocitySource,
    AngularVelocitySource2,
    Beam,
    ForceSource,
    GravityStiffness,
    HydraulicLine,
    LumpedLine,
    LumpedMass,
    OilColumn,
    Rig,
    RigidLink,
    TimoshenkoBeam,
    TorqueSource,
    TorsionalGroundSpring,
    TorsionalSpring,
    TranslationalGroundSpring,
    TranslationalSpring,
)
from samii_rig.rig.schema.elements import quantities

KINDS: dict[str, Any] = {
    c.model_fields["kind"].annotation.__args__[0]: c
    for c in (
        Beam, TimoshenkoBeam, RigidLink, LumpedMass, TorsionalSpring, TranslationalSpring,
        TorsionalGroundSpring, TranslationalGroundSpring, GravityStiffness, OilColumn,
        HydraulicLine, LumpedLine, AngularVelocitySource, AngularVelocitySource2, TorqueSource,
        ForceSource,
    )
}  # fmt: skip
GAIN = {"torque_source": "N m/V", "force_source": "N/V"}


def part(kind: str, name: str = "", **values: Any) -> dict[str, Any]:
    """An element as the rig file gives it, its units filled in."""
    units = {symbol: q.unit for symbol, q in quantities(KINDS[kind]).items()}
    out: dict[str, Any] = {"kind": kind, "name": name or kind}
    if kind in GAIN or kind.startswith("angular"):
        out["input"] = "v"
        units["K"] = GAIN.get(kind, "rad/(s V)")
    for symbol, value in values.items():
        given_ = {"value": value, "unit": units.get(symbol, ""), "source": "test"}
        out[symbol] = given_ if symbol in units else value
    return out


def branch(*inner: dict[str, Any], tip: str = "free", name: str = "side") -> dict[str, Any]:
    return {"kind": "branch", "name": name, "tip": tip, "element": list(inner)}


SOURCE = part("angular_velocity_source", "source", K=0.5, p=150.0)
ANGLE = {"name": "y", "kind": "relative_angle", "across": ["source"], "unit": "rad"}


def rig(*parts: dict[str, Any], base: str, tip: str, sensor: Any = None) -> Rig:
    return Rig.model_validate(
        {
            "name": "test", "base": base, "tip": tip, "rate_hz": 500.0, "element": list(parts),
            "sensor": sensor or [ANGLE],
            "actuator": [{"name": "v", "unit": "V", "low": -1.0, "high": 1.0}],
        }
    )  # fmt: skip


def natural_frequencies(r: Rig, low: float, high: float, n: int = 3000) -> list[float]:
    """rad/s at which the cleared characteristic function of an undamped chain changes its sign."""
    chain = Chain(r)
    w = np.geomspace(low, high, n)
    D, _ = chain.characteristic(1j * w, clear=True)
    assert np.abs(D.imag).max() < 1e-6
    at = np.flatnonzero(np.diff(np.sign(D.real)))

    def value(x: float) -> float:
        D, scale = chain.characteristic([1j * x], clear=True)
        return float(D[0].real * np.exp(min(scale[0], 0.0)))

    return [float(brentq(value, w[i], w[i + 1], xtol=1e-13)) for i in at]


BEAM = {"EI": 3.0, "mu": 0.2, "L": 0.7}
