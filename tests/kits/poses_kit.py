"""Recordings of an arm of two links in several poses, of the simulated rig and what it hides."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from elements_kit import part
from gravity_kit import hanging

from samii_rig.devices.protocols import CommandBlock, DeviceLoop
from samii_rig.diagnose.physics.insert import element_of, inserted
from samii_rig.diagnose.posed import InPose
from samii_rig.diagnose.result import Cause, Diagnosis
from samii_rig.identify.poses import at_pose
from samii_rig.rig.pose import read_whole_pose
from samii_rig.rig.schema import GravityStiffness, LumpedMass, Rig, TorsionalGroundSpring
from samii_rig.rig.schema.elements import quantities
from samii_rig.signal.estimate import estimate
from samii_rig.signal.excitation import swept_sine
from samii_rig.types import Channel, Recording, Segment
from sim.rig import open_rig

RATE = 200.0
BAND = (0.6, 25.0)  # Hz
SWEEP = 8.0  # s
LEVEL = 1.0  # V, 1 N m
Change = Callable[[Rig], Rig]


def _known(element: dict, **tolerance: float) -> dict:  # type: ignore[type-arg]
    for symbol, relative in tolerance.items():
        element[symbol]["tolerance"] = relative
    return element


def two_links() -> Rig:
    """An arm on a spring, an elbow, a forearm; its weight is a sixth of the first stiffness."""
    upper = part("rigid_link", "upper", L=0.5, r=0.25, m=1.5, I=0.03)
    fore = part("rigid_link", "fore", L=0.4, r=0.2, m=0.8, I=0.012)
    return hanging(
        _known(part("torsional_ground_spring", "shoulder", k=60.0, c=0.3), k=0.05),
        _known(upper, m=0.03, I=0.03),
        _known(part("torsional_spring", "elbow", k=40.0, c=0.08), k=0.05),
        _known(fore, m=0.03, I=0.03),
        pose=0.0,
        rate_hz=RATE,
        sensor=[
            {"name": "q_1", "kind": "absolute_angle", "after": "push", "unit": "rad"},
            {"name": "q_2", "kind": "absolute_angle", "after": "fore", "unit": "rad"},
        ],
    )


def recorded(hidden: Rig, seed: int, noise: float = 2e-4) -> Recording:
    """One sweep from rest, with noise (rad rms)."""
    device = open_rig(hidden, {"seed": seed})
    u = LEVEL * swept_sine(RATE, *BAND, SWEEP, ramp=1.0)[0]
    u = np.concatenate([u, np.zeros(int(2 * RATE))])
    far = 1e9  # limits that nothing reaches
    device.actuator.configure(DeviceLoop("q_1", 0.0, far, far, far))
    device.actuator.write(CommandBlock(0, u, np.zeros_like(u)))
    device.clock.sleep(len(u) / RATE)
    block = device.sensor.read()
    values = block.values.copy()
    names = _channels(hidden)
    n = len(values)
    columns = [i for i, c in enumerate(names) if c.role == "sensor"]
    values[:, columns] += np.random.default_rng(seed).normal(0, noise, (n, len(columns)))
    segment = Segment("sweep", "single", 0, n, LEVEL, "V", 0)
    return Recording(
        names, RATE, block.time, block.sequence, values, block.quality, (segment,),
        source=f"run_{seed}.mcap",
    )  # fmt: skip


def _channels(rig: Rig) -> tuple[Channel, ...]:
    units = rig.units()
    return (
        Channel("u", "V", "reference"),
        Channel("theta_ref", "rad", "reference"),
        *(Channel(a.name, a.unit, "command") for a in rig.actuator),
        *(Channel(s.name, units[s.name]) for s in rig.sensor),
    )


def in_pose(rig: Rig, pose: str, seed: int, *changes: Change, repeats: int = 2) -> InPose:
    """Recordings of the rig in a pose, with changes that its file does not have."""
    at = read_whole_pose(pose, rig)
    hidden = at_pose(rig, at)
    for change in changes:
        hidden = change(hidden)
    runs = [recorded(hidden, 10 * seed + i) for i in range(repeats)]
    return InPose(at, estimate(runs), runs)


def _hidden(kind: type[Any], **values: float) -> Change:
    """An element behind the elbow's arm or forearm, with these values."""
    units = {symbol: q.unit for symbol, q in quantities(kind).items()}
    made = element_of(kind, "hidden", units)
    change = {s: getattr(made, s).model_copy(update={"value": values.get(s, 0.0)}) for s in units}
    return lambda rig: inserted(rig, "fore", made.model_copy(update=change))


def loaded(mass: float) -> Change:
    """A mass (kg) at the tip."""
    return _hidden(LumpedMass, m=mass)


def named_mass(found: Diagnosis, mass: float) -> Cause:
    """The one cause, which must be a mass (kg) at the tip that explains all but the noise."""
    assert found.verdict == "named"
    (cause,) = found.causes
    assert (cause.physics, cause.site) == ("added_mass", "fore")
    assert cause.parameters["m"].value == pytest.approx(mass, rel=0.05)
    assert found.with_causes[0] < found.threshold < found.chi2_per_dof
    return cause


def held(k: float) -> Change:
    """A spring to the ground (N m/rad), which turns with the forearm."""
    return _hidden(TorsionalGroundSpring, k=k)


def weighed(k: float) -> Change:
    """A weight whose moment about the elbow is k (N m) a rad where the chain hangs."""
    return lambda rig: _hidden(GravityStiffness, k=k * rig.pulls[-1] / rig.gravity)(rig)
