"""Bodies that shift against the ground: which there are, what holds them, their names."""

from __future__ import annotations

import numpy as np

from samii_rig.types import Float
from sim.assumed_modes.effects import GIVES, at_end
from sim.assumed_modes.parts import Setup
from sim.assumed_modes.ritz import Mechanism

SAME = 1e-9  # relative: rows nearer than this are the same motion
Names = tuple[tuple[str, str], ...]


def length(setup: Setup, on: str) -> float:
    """m from the upstream end of a body to the place at which the ground acts on it."""
    return setup.part(on).values.get("L", 0.0)


def bodies(setup: Setup) -> list[str]:
    """Lumped masses and beams whose place shifts by itself: not with a source alone."""
    mech, shifting = Mechanism(setup), setup.shifting()
    return [
        p.name
        for p in setup.parts
        if (p.kind == "beam" or (p.kind == "lumped_mass" and p.values["m"] > 0))
        and p.name in shifting
        and np.any(mech.against_ground(p.name)[mech.free])
    ]


def held(setup: Setup, on: str) -> float:
    """What holds a body, N/m, sources held. Where nothing does, the stiffness on which all masses
    would swing at 1 Hz, which is slow for a rig."""
    mech = Mechanism(setup)
    K = mech.K.copy()
    for branch in mech.maxwell:  # springs beside what relaxes
        K[branch.at, branch.at] += branch.k
    row = mech.against_ground(on)[mech.free]
    try:
        gives = float(row @ np.linalg.solve(K[np.ix_(mech.free, mech.free)], row))
    except np.linalg.LinAlgError:
        gives = 0.0
    if gives > 0:
        return 1 / gives
    mass = sum(p.values.get("m", 0.0) for p in setup.parts)
    return float(mass * (2 * np.pi) ** 2)


def same_as_body(physics: str, setup: Setup, on: str) -> Names:
    """Other names of a force between the ground and a body: the neighbours that shift with it, and
    a spring whose other side is the ground."""
    beside = [n for n in at_end(setup, on, length(setup, on)) if setup.part(n).kind not in GIVES]
    row = Mechanism(setup).against_ground(on)
    names = (*beside, *(n for n, own in _grounded(setup) if _alike(own, row)))
    return tuple((physics, n) for n in dict.fromkeys(names) if n != on)


def same_as_joint(physics: str, setup: Setup, on: str) -> Names:
    """Bodies that a spring alone holds to the ground: its stretch is what they move by."""
    own = next((row for name, row in _grounded(setup) if name == on), None)
    if own is None:
        return ()
    mech = Mechanism(setup)
    return tuple((physics, n) for n in bodies(setup) if _alike(mech.against_ground(n), own))


def _grounded(setup: Setup) -> list[tuple[str, Float]]:
    """Springs against displacement with the row of their stretch."""
    mech = Mechanism(setup)
    eye = np.eye(mech.size)
    return [
        (p.name, eye[mech.joints[p.name]]) for p in setup.parts if p.kind == "translational_spring"
    ]


def _alike(one: Float, other: Float) -> bool:
    return bool(np.abs(one - other).max() <= SAME * np.abs(other).max())
