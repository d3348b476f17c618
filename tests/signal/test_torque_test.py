"""The torque test of paper 2, section 5: theta/M, M/v and theta/v, vertical and horizontal."""

from __future__ import annotations

import numpy as np
import pytest
from experiment_kit import coverage, shipped, simulate

from experiments.torque_test import end_slopes, pendulum
from samii_rig.errors import InputError
from samii_rig.model.sampled import sampled_response
from samii_rig.rig.load import load_rig
from samii_rig.signal.estimate import estimate
from samii_rig.signal.ratio import ratio
from samii_rig.signal.statistics import imag_interval, real_interval

J = 0.015 + 2.0 * 0.15**2  # about the joint, kg m^2
MGR = 2.0 * 9.81 * 0.15
SHORT = {
    "amplitudes": [1.0],
    "repeats": 3,
    "duration": 20.0,
    "ring_down": 4.0,
    "start_hz": 0.2,
    "schedule": [[0.5, 0.4], [3.0, 1.0]],
}


@pytest.fixture(scope="module", params=["vertical", "horizontal"])
def orientation(request):
    return request.param


@pytest.fixture(scope="module")
def run(orientation, tmp_path_factory):
    folder = tmp_path_factory.mktemp(orientation)
    rig, text, test = shipped(f"samii_torque_{orientation}", "torque_test", **SHORT)
    outcome = simulate(rig, text, test, folder / "run.mcap")
    return rig, test, outcome


def test_intervals_hold_the_truth(run):
    rig, _, outcome = run
    assert 0.84 < coverage(outcome.responses[0], rig, (0.2, 20.0)) < 0.96


def test_theta_over_M_is_the_ratio_of_its_responses_and_covers(run):
    """Fig. 8. With M as the input, estimated through the reference, it is the same."""
    rig, _, outcome = run
    q = ratio(outcome.responses[0], "M_2", ["theta_2"])
    direct = estimate([outcome.recording], input="M_2", outputs=["theta_2"])[0]
    inside = (q.frequency > 0.2) & (q.frequency < 20)
    np.testing.assert_allclose(q.H[inside], direct.H[inside], rtol=1e-9)
    H = sampled_response(rig, q.frequency)
    truth = (H[:, :1] / H[:, 1:])[inside]
    for interval, part in ((real_interval(q), truth.real), (imag_interval(q), truth.imag)):
        held = (interval.low[inside] < part) & (part < interval.high[inside])
        assert 0.82 < held.mean() < 0.97


def test_the_link_is_a_pendulum_when_it_hangs_and_an_inertia_when_it_stands_out(run, orientation):
    """Eq. (4) and (5)."""
    rig, _, outcome = run
    p = pendulum(ratio(outcome.responses[0], "theta_2", ["M_2"]), rig, 0.2)
    k = MGR if orientation == "vertical" else 0.0
    assert abs(p.J - J) < 2.5 * p.half[0]
    assert abs(p.k - k) < 2.5 * p.half[1]
    assert p.half[0] < 1e-3 * J
    assert p.half[1] < 2e-3 * MGR


def test_M_over_v_goes_from_1_over_s_to_s_when_gravity_restores(run, orientation):
    """Fig. 9: M follows theta at low frequency and theta'' at high frequency."""
    low, high = end_slopes(run[2].responses[0], "M_2", (0.2, 10.0))
    assert low == pytest.approx(-1.0 if orientation == "vertical" else 1.0, abs=0.15)
    assert high == pytest.approx(1.0, abs=0.1)


def test_gravity_is_an_offset_of_M_when_the_link_stands_out(run, orientation):
    outcome = run[2]
    M = outcome.recording.values[:, outcome.recording.column("M_2")]
    start = M[: round(0.8 * outcome.recording.rate_hz)].mean()
    assert start == pytest.approx(MGR if orientation == "horizontal" else 0.0, abs=0.005)


def test_the_conclusion_says_so_and_leaves_theta_over_M_in_a_file(run, tmp_path, orientation):
    rig, test, outcome = run
    found = test.conclude([rig], [outcome], tmp_path / "run")
    assert [p.name for p in found.written] == ["run_theta_2_over_M_2_1.csv"]
    assert "M_2" in found.written[0].read_text().splitlines()[0]
    text = "\n".join(found.lines)
    assert "J = 0.0" in text
    assert "90 %" in text


def test_theta_over_v_is_the_same_in_both_orientations():
    """Fig. 10: an integrator with a lag (eq. 1), whatever gravity does."""
    f = np.geomspace(0.1, 10, 40)
    vertical, horizontal = (
        sampled_response(load_rig(f"samii_torque_{x}")[0], f)[:, 0, 0]
        for x in ("vertical", "horizontal")
    )
    np.testing.assert_allclose(vertical, horizontal, rtol=1e-3)
    s = 2j * np.pi * f
    hold = np.exp(-s / (2 * 500.0))
    np.testing.assert_allclose(vertical, 0.5 * 150 / (s * (s + 150)) * hold, rtol=0.025)


@pytest.mark.parametrize(
    ("changes", "words"),
    [({"moment": "M"}, "theta_2, M_2"), ({"moment": "theta_2"}, "kind moment")],
)
def test_a_rig_without_the_sensors_is_refused(changes, words):
    rig, _, test = shipped("samii_torque_vertical", "torque_test", **changes)
    with pytest.raises(InputError, match=words):
        test.plan(rig)
