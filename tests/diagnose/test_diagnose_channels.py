"""What channels do that is no physics: an input that was measured, not held."""

from __future__ import annotations

import numpy as np
import pytest
from identify_kit import noiseless, samii
from table_kit import Effects, table_of

from samii_rig.diagnose.diagnose import diagnose
from samii_rig.diagnose.physics.grid import grid
from samii_rig.diagnose.physics.insert import exchanged
from samii_rig.diagnose.physics.model import Model
from samii_rig.errors import InputError
from samii_rig.identify.bootstrap import redraw
from samii_rig.model.sampled import sensors_at
from samii_rig.model.tmm import Chain
from samii_rig.rig.load import load_rig

RIG = samii()
BAND = (0.5, 40.0)
LINES = np.geomspace(*BAND, 160)
SENSORS = np.arange(len(RIG.sensor))
# The command itself, and all that comes late or grows with frequency as it does.
LATE = ("input_not_held", "transport_delay", "actuator_lag", "sensor_delay", "sensor_lag",
        "velocity_feedback", "torsional_compliance")  # fmt: skip
ALL = Effects(lambda: table_of(RIG, *BAND))


def not_held():
    return next(e for e in ALL if e.name == ("input_not_held", "v_2"))


def test_an_input_that_is_not_held_has_the_response_of_the_chain_itself():
    model = Model(RIG, (not_held(),))
    at = grid(RIG, LINES, SENSORS, np.zeros(SENSORS.size, np.int64))
    found = model.response(np.zeros(model.n), at)
    chain = Chain(RIG).response(LINES)[:, :, 0]
    plain = chain * sensors_at(RIG.sensor, 2j * np.pi * LINES)
    size = np.abs(plain).max(axis=0)
    # What is left are the aliases far above, which the grid holds as they are of a held input.
    assert np.max(np.abs(found - plain) / size) < 1e-3


def test_it_is_told_and_no_physics_is_named():
    model = Model(RIG, (not_held(),))
    at = grid(RIG, LINES, SENSORS, np.zeros(SENSORS.size, np.int64))
    exact = model.response(np.zeros(model.n), at)[:, :, None]
    measured = redraw(noiseless(RIG, LINES), exact, np.random.default_rng(3), 10)
    found = diagnose([measured], RIG, effects=[e for e in ALL if e.physics in LATE])
    assert found.verdict == "no_mismatch"
    assert any("v_2 was not held between samples" in words for words in found.not_physics)
    assert not found.causes


def test_oil_behind_a_source_is_seen_by_an_encoder_at_the_source_whichever_comes_first() -> None:
    """An encoder at the vane shows what the oil gives: it had shown the flow alone, and a true pair
    of both left 55 sigma."""
    every = table_of(load_rig("samii_joint_3")[0], 0.5, 40.0)
    at_vane = next(e for e in every if e.name == ("noncollocated_encoder", "theta_3"))
    oil = next(
        e
        for e in every
        if e.name == ("hydraulic_compressibility", "joint_3_source") and e.variant == "line"
    )
    assert at_vane.variant == "joint_3_source"
    rig = load_rig("samii_joint_3")[0]
    one, other = (a.build(b.build(rig)) for a, b in ((oil, at_vane), (at_vane, oil)))
    assert one.sensor == other.sensor
    assert other.element == one.element
    (angle,) = (s for s in other.sensor if s.name == "theta_3")
    assert len(angle.across) == 2  # the source and its oil; not the joint's spring
    swapped = exchanged(rig, "theta_3", "a_2")
    with pytest.raises(InputError, match=r"theta_3.*no angle"):
        at_vane.build(swapped)


def test_a_soft_spring_that_a_force_sensor_in_line_shows_is_in_the_table() -> None:
    """25 N/m beside a cylinder of some 1e6 N/m: it shows where nothing else holds the mass."""
    every = table_of(load_rig("cylinder")[0], 0.9, 30.0)
    (k,) = (e.unknowns[0] for e in every if e.physics == "ground_spring")
    assert k.starts[0] < 25.0 < k.high
