"""Where a force is fed into a rig, and what the rig's sensors show of it."""

from __future__ import annotations

import numpy as np

from samii_rig.diagnose.forces.place import EXTRA, Place
from samii_rig.model.tmm import Chain
from samii_rig.rig.load import load_rig
from samii_rig.rig.schema import AbsoluteAngle


def test_a_load_cell_behind_a_joint_reads_the_friction_beside_the_spring_too() -> None:
    """What it reads is what moves the link, J theta'' + m g r theta, and nothing else does."""
    rig = load_rig("samii_torque_vertical")[0]
    angle = AbsoluteAngle(kind="absolute_angle", name="theta", after="gravity", unit="rad")
    wide = Place("joint", ("joint_2",)).augmented(rig)
    wide = wide.model_copy(update={"sensor": (*wide.sensor, angle)})
    s = 2j * np.pi * np.geomspace(0.3, 60, 40)
    names, inputs = [x.name for x in wide.sensor], [a.name for a in wide.actuator]
    G = Chain(wide).evaluate(s)[:, :, inputs.index(EXTRA)]
    parts = {e.name: e for e in rig.element}
    link = parts["link"]
    J = link.m.value * link.r.value**2 + link.I.value
    moved = (parts["gravity"].k.value + J * s**2) * G[:, names.index("theta")]
    np.testing.assert_allclose(np.abs(G[:, names.index("M_2")]), np.abs(moved), rtol=1e-9)
