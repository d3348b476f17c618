"""SAMII as each result of the papers needs it: joints locked, encoder elsewhere, no damping."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from functools import cache

from samii_rig.identify.actuator import with_encoder
from samii_rig.identify.parameters import changed
from samii_rig.rig.load import load_rig
from samii_rig.rig.schema import Beam, Rig, TorsionalSpring, parameters

JOINTS = ("clamp", "joint_1", "joint_2", "joint_3")
SOURCE, SPRING = "joint_2_source", "joint_2"
ENCODER = "theta_2"
METHOD_1 = {"clamp": 2.674e5, "joint_1": 0.136e5, "joint_2": 0.108e5, "joint_3": 0.252e5}
METHOD_2 = {"joint_1": 0.0651e5, "joint_2": 0.0713e5}
"""N m/rad, paper 1, Table II."""
G_V = 500.0  # N m s/rad, Table II, g_v2


@cache
def samii() -> Rig:
    """The shipped rig: method 1's stiffnesses, theta_2 across the source and the spring."""
    return load_rig("samii")[0]


def collocated(rig: Rig) -> Rig:
    """The rig with its encoder at the actuator, as paper 1 concludes (section IV-C)."""
    return with_encoder(rig, ENCODER, [SOURCE])


def locked(rig: Rig, joints: Collection[str]) -> Rig:
    """The rig with joints taken out of the chain, as in paper 1, eq. 16."""
    rig = collocated(rig) if SPRING in joints else rig
    kept = tuple(e for e in rig.element if e.name not in joints)
    return rig.model_copy(update={"element": kept})


def stiffened(rig: Rig, k: Mapping[str, float]) -> Rig:
    """The rig with other stiffnesses of its joints, N m/rad."""
    return changed(rig, {(name, "k"): value for name, value in k.items()})


def lossless(rig: Rig) -> Rig:
    """The rig without any damping."""
    return changed(
        rig,
        {
            (e.name, symbol): 0.0
            for e in rig.element
            for symbol in parameters(e)
            if symbol in ("c", "tau", "eta")
        },
    )


def rayleigh(rig: Rig, alpha: float) -> Rig:
    """The rig with C = alpha K (paper 1, section III-C with beta = 0), alpha in s."""
    values: dict[tuple[str, str], float] = {}
    for e in rig.element:
        match e:
            case Beam():
                values |= {(e.name, "tau"): alpha, (e.name, "eta"): 0.0}
            case TorsionalSpring():
                values[e.name, "c"] = alpha * e.k.value
    return changed(rig, values)
