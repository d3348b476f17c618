"""SAMII driven by joint 3 and with its base braced: what the rig files say and what runs give."""

from __future__ import annotations

import numpy as np
import pytest
from experiment_kit import coverage, shipped, simulate

from samii_rig.identify.modal import estimate_modes
from samii_rig.model.realise import realise
from samii_rig.model.sampled import sampled_response
from samii_rig.model.tmm import Chain
from samii_rig.rig.load import load_rig

SHORT = {"amplitudes": [0.5], "repeats": 3, "duration": 12.0, "ring_down": 3.0}


def element(rig, name):
    return next(e for e in rig.element if e.name == name)


def values(e):
    return {k: v.value for k, v in e if hasattr(v, "value")}


@pytest.mark.parametrize("name", ["samii_joint_3", "samii_braced"])
def test_a_variant_has_the_robot_of_samii(name):
    rig, samii = load_rig(name)[0], load_rig("samii")[0]
    shared = {e.name for e in samii.element} & {e.name for e in rig.element}
    assert len(shared) >= len(samii.element) - 1
    for e in shared:
        assert values(element(rig, e)) == values(element(samii, e))


def test_a_brace_takes_the_beam_out_of_the_dynamics():
    """Braced, the joints answer as if link 0 stood on the floor (paper 1, section IV-D)."""
    rig = load_rig("samii_braced")[0]
    after = [e.name for e in rig.element].index("link_0")
    floor = rig.model_copy(update={"element": rig.element[after + 1 :]})
    sensors = tuple(s for s in rig.sensor if s.name in ("theta_2", "a_1", "a_2"))
    f = np.geomspace(0.5, 15.0, 60)
    braced = Chain(rig.model_copy(update={"sensor": sensors})).response(f)
    stands = Chain(floor.model_copy(update={"sensor": sensors})).response(f)
    np.testing.assert_allclose(braced, stands, rtol=0.05)


def test_the_braced_robot_gives_what_method_2_starts_from(tmp_path):
    """f_1 and phi_1(1)/phi_1(2) of eq. (19), each with an interval that holds the truth."""
    rig, text, sweep = shipped("samii_braced", "swept_sine", **SHORT)
    response = simulate(rig, text, sweep, tmp_path / "run.mcap").responses[0]
    assert 0.84 < coverage(response, rig, (1.0, 40.0)) < 0.96
    modes = estimate_modes(response, rig, band=(1.5, 30.0))
    f1 = modes.modes[0].frequency_hz
    poles = realise(rig).poles
    truth = np.abs(poles[poles.imag > 0]).min() / (2 * np.pi)
    assert f1.value == pytest.approx(truth, abs=max(4 * f1.sd, 1e-4 * truth))
    ratio = modes.shape_ratio(0, "a_1", "a_2")
    assert 0 < ratio.value < 1
    assert ratio.sd < 0.01 * ratio.value


def test_joint_3_drives_the_whole_robot(tmp_path):
    rig, text, sweep = shipped("samii_joint_3", "swept_sine", **SHORT)
    response = simulate(rig, text, sweep, tmp_path / "run.mcap").responses[0]
    assert [c.name for c in response.outputs] == ["theta_3", "a_0", "a_1", "a_2"]
    assert 0.84 < coverage(response, rig, (2.5, 40.0)) < 0.96
    # An integrator at low frequency, as joint 2's.
    theta = np.abs(sampled_response(rig, np.array([0.5]))[0, 0, 0])
    assert theta == pytest.approx(element(rig, "joint_3_source").K.value / np.pi, rel=0.02)
