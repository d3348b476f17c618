"""The simulated rig with two driven joints against the transfer matrices, through its samples."""

import numpy as np
import pytest
from sim_physics_kit import LINES, PERIOD, last_period, multisine

from samii_rig.devices.protocols import CommandBlock, DeviceLoop
from samii_rig.errors import InputError
from samii_rig.model.sampled import sampled_response
from samii_rig.rig.load import load_rig
from samii_rig.types import Quality
from sim.rig import open_rig

RIG = load_rig("samii_two_joints")[0]
K = len(RIG.actuator)
V, Y = slice(2 * K, 3 * K), slice(3 * K, None)
LOOSE = 1e9  # a limit that nothing reaches


def fine(delay=0.0, sensor_delay=0.0):
    """The rig with outputs without steps, and with delays; v_3 later than v_2."""
    actuators = tuple(
        a.model_copy(update={"resolution": 0.0, "delay": delay * (1 + i)})
        for i, a in enumerate(RIG.actuator)
    )
    sensors = tuple(s.model_copy(update={"delay": sensor_delay}) for s in RIG.sensor)
    return RIG.model_copy(update={"actuator": actuators, "sensor": sensors})


def respond(rig, u, scale=0.0, most=(LOOSE, LOOSE), angle=LOOSE, **settings):
    """All samples on the references u (n, 2); scale : of the rig's own kp."""
    device = open_rig(rig, {"noise": False, **settings})
    loops = [rig.centring_of(a.name) for a in rig.actuator]
    device.actuator.configure(
        tuple(
            DeviceLoop(c.sensor, scale * c.kp, m, LOOSE, angle)
            for c, m in zip(loops, most, strict=True)
        )
    )
    device.actuator.write(tuple(CommandBlock(0, x, np.zeros_like(x)) for x in u.T))
    device.clock.sleep(len(u) / rig.rate_hz)
    return device.sensor.read()


@pytest.mark.parametrize(
    ("kp_over_rig", "delays", "periods"), [(0.0, (0.0013, 0.0031), 20), (1.0, (0.0, 0.0), 8)]
)
def test_its_responses_are_those_of_the_transfer_matrices(kp_over_rig, delays, periods):
    # 20 periods of 20 s, as SAMII's first mode takes 42 s to fall by e: 1e-4 of it is left. The
    # loops damp it. Two experiments, in which the second input has one sign and then the other.
    rig = fine(*delays)
    one, other = multisine(periods, 0.5, seed=1), multisine(periods, 0.5, seed=2)
    parts = []
    for sign in (1.0, -1.0):
        block = respond(rig, np.stack([one, sign * other], axis=1), kp_over_rig)
        assert not block.quality.any()
        parts.append(last_period(block.values))
    v = np.stack([p[:, V] for p in parts], axis=2)
    y = np.stack([p[:, Y] for p in parts], axis=2)
    H = np.swapaxes(np.linalg.solve(np.swapaxes(v, 1, 2), np.swapaxes(y, 1, 2)), 1, 2)
    exact = sampled_response(rig, LINES * rig.rate_hz / PERIOD)
    ratio = H / exact
    assert ratio.shape == (len(LINES), len(rig.sensor), K)
    assert np.max(np.abs(np.abs(ratio) - 1)) < 2e-3
    assert np.max(np.abs(np.angle(ratio, deg=True))) < 0.2


def test_what_two_inputs_do_together_is_the_sum_of_what_each_does():
    rig = fine()
    u = np.stack([multisine(1, 0.5, seed=1), multisine(1, 0.5, seed=2)], axis=1)[:3000]
    alone = [respond(rig, u * np.eye(K)[j], band_hz=200.0).values[:, Y] for j in range(K)]
    both = respond(rig, u, band_hz=200.0).values[:, Y]
    np.testing.assert_allclose(both, alone[0] + alone[1], rtol=0, atol=1e-12)


def test_each_output_keeps_the_limit_of_its_own_loop():
    u = np.stack([multisine(1, 0.5, seed=1), multisine(1, 0.5, seed=2)], axis=1)[:3000]
    block = respond(fine(), u, most=(0.1, LOOSE), band_hz=200.0)
    v, flags = block.values[:, V], block.quality[:, V]
    assert np.abs(v[:, 0]).max() == 0.1
    np.testing.assert_array_equal(v[:, 1], u[:, 1])
    assert (flags[np.abs(u[:, 0]) > 0.1, 0] == Quality.LIMITED).all()
    assert not flags[:, 1].any()


@pytest.mark.parametrize("pushed", [0, 1])
def test_an_angle_beyond_its_limit_drops_both_outputs_in_the_same_sample(pushed):
    u = np.full((1500, K), 0.05)
    u[:, pushed] = 2.0
    block = respond(RIG, u, scale=0.0, angle=0.2, band_hz=200.0)
    v, flags = block.values[:, V], block.quality[:, V]
    ends = [int(np.flatnonzero(v[:, j])[-1]) for j in range(K)]
    assert ends[0] == ends[1] < 1400
    theta = block.values[ends[0] + 1, 3 * K + pushed]
    assert abs(theta) > 0.2
    assert (flags[ends[0] + 1 :] == Quality.LIMITED).all()


@pytest.mark.parametrize("lost", ["theta_2", "theta_3"])
def test_a_lost_encoder_drops_both_outputs(lost):
    block = respond(RIG, np.full((500, K), 0.1), scale=1.0, nan={lost: 0.5}, band_hz=200.0)
    v = block.values[:, V]
    assert (v[:250] != 0.0).all()
    assert not v[250:].any()


def test_friction_of_one_drive_holds_that_one_and_no_other():
    u = np.full((2000, K), 0.2)  # V, less than what holds joint 3
    free, held = (
        respond(fine(), u, band_hz=200.0, coulomb_friction=c).values[:, Y]
        for c in (0.0, {"v_3": 0.25})
    )
    theta_2, theta_3 = ([s.name for s in RIG.sensor].index(f"theta_{j}") for j in (2, 3))
    assert abs(held[-1, theta_3]) < 0.01 * abs(free[-1, theta_3])  # its spring gives way
    assert held[-1, theta_2] == pytest.approx(free[-1, theta_2], rel=0.01)
    every = respond(fine(), u, band_hz=200.0, coulomb_friction=0.25).values[:, Y]
    assert np.all(every == 0.0)


@pytest.mark.parametrize(
    ("friction", "named"),
    [
        (-1.0, r"coulomb_friction\.of_every_drive is -1\.0; expected greater"),
        ({"v_9": 0.1}, "coulomb_friction is 'v_9'; expected one of v_2, v_3"),
        ({"v_3": -1.0}, r"coulomb_friction\.by_actuator\.v_3 is -1\.0; expected greater"),
    ],
)
def test_friction_that_cannot_be_is_told_in_one_line(friction, named):
    with pytest.raises(InputError, match=named) as no:
        open_rig(RIG, {"coulomb_friction": friction})
    assert "\n" not in str(no.value)
