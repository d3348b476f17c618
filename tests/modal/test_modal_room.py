"""Modes of measured responses: what is there is found, what is not is not, intervals hold."""

import json
import re
from dataclasses import replace
from xml.etree import ElementTree

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from identify_kit import drawn, samii
from modal_kit import HZ, SECOND, SHAPE, ZETA, modal_sum, noise, poles, response

from samii_rig.errors import EstimateError, InputError
from samii_rig.modal.match import Known, known_of, mac, model_modes, pairs
from samii_rig.modal.modes import find_modes
from samii_rig.plain import plain
from samii_rig.report.modes import modes_of
from samii_rig.report.modes_drawing import motions
from samii_rig.rig.load import load_rig
from samii_rig.types import Channel

F = np.linspace(1.0, 40.0, 400)
UNITS = ("m", "m", "m")


@pytest.fixture(scope="module")
def found():
    return find_modes(response(modal_sum(F), F, seed=1))


def test_without_noise_poles_and_shapes_are_those_of_the_closed_form():
    modes = find_modes(response(modal_sum(F), F, 1e-6)).modes
    assert len(modes) == HZ.size
    for mode, pole, shape in zip(modes, poles(), SHAPE, strict=True):
        assert abs(mode.pole / pole - 1) < 1e-6
        np.testing.assert_allclose(mode.shape, shape / shape[mode.reference], atol=1e-4)


@pytest.mark.parametrize("coefficients", ["real", "complex"])
def test_two_modes_three_percent_apart_are_two(coefficients):
    found = find_modes(response(modal_sum(F), F, seed=4), coefficients=coefficients)
    assert found.fit.holds
    assert len(found.modes) == HZ.size
    for mode, hz, zeta in zip(found.modes, HZ, ZETA, strict=True):
        assert abs(mode.frequency_hz.value - hz) < 4 * mode.frequency_hz.sd
        assert abs(mode.damping.value - zeta) < 4 * mode.damping.sd


def test_intervals_of_frequency_damping_and_shape_hold_the_truth():
    inside = []
    for seed in range(10):
        modes = find_modes(response(modal_sum(F), F, 0.05, seed=seed)).modes
        assert len(modes) == HZ.size
        for mode, hz, zeta, shape in zip(modes, HZ, ZETA, SHAPE, strict=True):
            for value, truth in ((mode.frequency_hz, hz), (mode.damping, zeta)):
                low, high = value.interval()
                inside.append(low < truth < high)
            real, _ = mode.shape_interval()
            off = np.abs(mode.shape.real - shape / shape[mode.reference])
            inside += [o < half for o, half in zip(off, real, strict=True) if half > 0]
    assert 0.84 < np.mean(inside) < 0.95


@pytest.mark.parametrize("outputs", [1, 3])
def test_noise_has_no_modes(outputs):
    for seed in range(5):
        assert find_modes(noise(F, seed, outputs)).modes == ()


def test_a_mode_twelve_sigma_above_the_noise_is_found():
    hz, zeta = np.append(HZ, 20.0), np.append(ZETA, 0.015)
    loud = np.vstack([SHAPE, [0.3, -0.2, 0.25]])
    size = find_modes(response(modal_sum(F, hz, zeta, loud), F)).modes[4].sigma
    weak = loud * np.append(np.ones(5), 12 / size)[:, None]
    for seed in range(3):
        modes = find_modes(response(modal_sum(F, hz, zeta, weak), F, seed=seed)).modes
        assert len(modes) == 6
        assert abs(modes[4].frequency_hz.value - 20) < 0.3


def test_one_sensor_is_enough_for_frequencies_and_damping():
    modes = find_modes(response(modal_sum(F), F, seed=2, outputs=1)).modes
    assert [round(m.frequency_hz.value, 1) for m in modes] == [3.1, 8.0, 8.2, 14.5, 27.0]
    assert all(m.shape.tolist() == [1.0] for m in modes)


def test_two_inputs_share_one_shape_and_tell_more_than_one():
    both = find_modes(response(modal_sum(F, inputs=2), F, seed=3))
    alone = find_modes(response(modal_sum(F), F, seed=3))
    for one, two, hz, shape, more in zip(alone.modes, both.modes, HZ, SHAPE, SECOND, strict=True):
        assert abs(two.frequency_hz.value - hz) < 4 * two.frequency_hz.sd
        assert two.frequency_hz.sd < one.frequency_hz.sd
        half = two.shape_interval()[0]
        off = np.abs(two.shape - shape / shape[two.reference])
        assert np.all(off <= 3 * half + 1e-12)
        assert two.participation[1] / two.participation[0] == pytest.approx(more, abs=0.1)


def test_the_modes_of_samii_are_those_of_its_chain():
    rig = samii()
    found = find_modes(drawn(rig, 3, n=200), rig)
    known = model_modes(rig, 40.0)
    assert found.fit.holds
    assert [(p.mode, p.other) for p in pairs(found, known)] == [(0, 0), (1, 1), (2, 2)]
    assert all(p.mac > 0.99 for p in pairs(found, known))
    for mode, other in zip(found.modes, known, strict=True):
        assert abs(mode.frequency_hz.value - other.frequency_hz) < 4 * mode.frequency_hz.sd
        assert abs(mode.damping.value - other.damping) < 4 * mode.damping.sd
    assert "whatever loop computes it" in found.of
    assert "the hold of v_2" in found.divided


def test_the_measured_points_lie_on_the_drawn_shapes_and_move_with_them():
    rig = samii()
    all_modes, lost = modes_of([drawn(rig, 3, n=200)], rig)
    assert lost == ()
    drawings = motions(all_modes)
    assert len(drawings) == 3
    for i, (said, svg) in enumerate(drawings):
        assert said == f"Mode {i + 1} at 1 V"
        root = ElementTree.fromstring(svg)
        # A hyphen in an id would be a minus in the animation's begin, and nothing would move.
        assert root.get("id").isalnum()
        assert f"{root.get('id')}.click" in root.find("path/animate").get("begin")
        line, marks = root.findall("path")[1], root.findall("circle")
        assert len(marks) == 3  # accelerometers; an angle is no displacement
        frames = [
            np.array(re.findall(r"([\d.]+) ([\d.]+)", frame), dtype=float)
            for frame in line.find("animate").get("values").split(";")
        ]
        np.testing.assert_allclose(frames[0], frames[-1])
        for mark in marks:
            heights = [float(y) for y in mark.find("animate").get("values").split(";")]
            x = float(mark.get("cx"))
            curve = [np.interp(x, frame[:, 0], frame[:, 1]) for frame in frames]
            np.testing.assert_allclose(heights, curve, atol=0.02 * 150)  # of the drawing's height


def test_masses_on_springs_have_no_length_to_draw() -> None:
    rig, _ = load_rig("two_masses")
    all_modes, lost = modes_of([drawn(rig, 3, n=200)], rig)
    assert lost == ()
    assert len(all_modes[0].found.modes) == 2
    assert motions(all_modes) == []


@pytest.mark.parametrize(
    ("role", "words"),
    [("command", "whatever loop"), ("reference", "closed loop"), ("sensor", "between them")],
)
def test_it_is_said_what_the_poles_are_those_of(role, words):
    data = response(modal_sum(F), F, 0.05, seed=1)
    found = find_modes(replace(data, inputs=(Channel("f", "N", role),)), band=(10.0, 20.0))
    assert words in found.of
    assert found.closed_loop == (role == "reference")


def test_a_hold_and_a_delay_turn_residues_but_move_no_pole():
    late = modal_sum(F) * np.exp(-2j * np.pi * F * 0.004)[:, None, None]
    for mode, hz in zip(find_modes(response(late, F, seed=5)).modes, HZ, strict=True):
        assert abs(mode.frequency_hz.value - hz) < 4 * mode.frequency_hz.sd


def test_a_person_picks_and_gets_these_and_no_others(found):
    picked = find_modes(response(modal_sum(F), F, seed=1), pick=(27.0, 3.2))
    assert [round(m.frequency_hz.value, 1) for m in picked.modes] == [3.1, 27.0]
    # The poles that were not picked are in the model all the same: they bias nothing.
    for mode in picked.modes:
        own = min(found.modes, key=lambda m: abs(m.pole - mode.pole))
        assert mode.frequency_hz.value == pytest.approx(own.frequency_hz.value, rel=1e-5)


def test_a_stepped_sine_that_steps_over_a_resonance_has_not_seen_it():
    f = np.geomspace(1.0, 40.0, 60)
    grid = find_modes(response(modal_sum(f), f, 1e-4, method="stepped (drawn)"))
    assert grid.modes == ()
    assert any(abs(hz - 3.1) < 0.1 for hz in grid.unresolved)


def test_where_chi_square_refuses_the_intervals_are_wider():
    data = response(modal_sum(F), F, seed=1)
    small = replace(data, covariance=data.covariance / 4)
    found, honest = find_modes(small), find_modes(data)
    assert not found.fit.holds
    assert found.inflation == pytest.approx(2.0, rel=0.1)
    ratio = found.modes[0].frequency_hz.sd / honest.modes[0].frequency_hz.sd
    assert ratio == pytest.approx(1.0, rel=0.05)


def test_plain_data_are_json_and_hold_all_numbers(found):
    data = json.loads(json.dumps(plain(found.plain()), allow_nan=False))
    assert {"of", "divided", "modes", "chi_square_per_dof", "false_alarm"} <= set(data)
    mode = data["modes"][0]
    low, high = mode["frequency_hz_90"]
    assert low < mode["frequency_hz"] < high
    assert mode["shape"][mode["reference"]]["real"] == 1.0
    assert set(mode["shape"]) == {"y_0", "y_1", "y_2"}


complex_shapes = st.lists(
    st.complex_numbers(min_magnitude=0.1, max_magnitude=10.0), min_size=3, max_size=3
)


@settings(max_examples=50)
@given(complex_shapes, st.complex_numbers(min_magnitude=0.1, max_magnitude=10.0))
def test_mac_knows_no_size_no_phase_and_no_unit(shape, factor):
    a = np.array(shape)
    b = np.array([1.0, 2.0, -1.0]) + 0j
    units = ("rad", "m", "m")
    assert mac(a, factor * a, units) == pytest.approx(1.0)
    other = np.array([180 / np.pi, 1.0, 1.0])  # the angle in degrees
    turned = mac(other * a, other * b, ("deg", "m", "m"))
    assert turned == pytest.approx(mac(a, b, units), rel=1e-9)
    assert 0 <= mac(a, b, units) <= 1 + 1e-12


def test_pairs_are_one_to_one_and_by_shape_where_frequencies_lie_close(found):
    # 1 % higher, and the two close modes have changed places.
    hz, shapes = 1.01 * HZ[[0, 2, 1, 3, 4]], SHAPE
    hz[1], hz[2] = 8.05, 8.2
    names = found.outputs
    known = [
        Known(float(f), 0.01, dict(zip(names, psi + 0j, strict=True)))
        for f, psi in zip(hz, shapes[[0, 2, 1, 3, 4]], strict=True)
    ]
    assert [p.other for p in pairs(found, known)] == [0, 2, 1, 3, 4]
    assert [p.other for p in pairs(found, known_of(found))] == [0, 1, 2, 3, 4]
    assert np.isnan(mac(np.ones(1) + 0j, np.ones(1) + 0j, ("m",)))


@pytest.mark.parametrize(
    ("act", "words"),
    [
        (lambda r: find_modes(r, outputs=("a_9",)), "one of y_0, y_1, y_2"),
        (lambda r: find_modes(r, band=(90.0, 95.0)), "1 to 40 Hz, which was measured"),
        (lambda r: find_modes(r, pick=(11.0,)), "a frequency next to a pole in Hz: 3.1"),
        (lambda r: find_modes(r, pick=(3.1, 3.11)), "one frequency for each pole"),
    ],
)
def test_what_is_asked_wrongly_is_said_in_one_line(act, words):
    with pytest.raises(InputError, match=words):
        act(response(modal_sum(F), F, seed=1))


@pytest.mark.parametrize("n", [8, 10, 14, 20, 30])
def test_few_lines_bear_few_modes(n):
    f = np.linspace(5.0, 11.0, n)
    found = find_modes(response(modal_sum(f), f, 1e-3, seed=n))
    assert len(found.modes) <= n // 4
    assert all(5.0 <= m.frequency_hz.value <= 11.0 for m in found.modes)


def test_too_little_data_are_said_in_one_line():
    data = response(modal_sum(F), F, seed=1)
    with pytest.raises(EstimateError, match="too few for modes"):
        find_modes(data, band=(1.0, 1.2))
    with pytest.raises(EstimateError, match="degrees of freedom"):
        find_modes(replace(data, dof=np.full(F.size, 3.0)))
