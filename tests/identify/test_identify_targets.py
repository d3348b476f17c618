"""Methods 1 and 2, the actuator fit, the place of the encoder."""

import numpy as np
import pytest
from identify_kit import STIFFNESSES, drawn, samii

from samii_rig.errors import InputError
from samii_rig.identify.actuator import choice, compare_variants, fit_actuator, with_encoder
from samii_rig.identify.conservative import Conservative
from samii_rig.identify.parameters import Free
from samii_rig.identify.targets import Target, braced, match, method_1, method_2, valley
from samii_rig.model.realise import realise

BAND = (0.2, 60.0)
EXACT = np.array([2.674e5, 0.136e5, 0.108e5, 0.252e5])


def test_natural_frequencies_of_table_3():
    f = Conservative(samii(), BAND).frequencies()
    np.testing.assert_allclose(f[:2], [1.703, 7.394], rtol=2e-3)


def test_with_damping_frequencies_are_those_of_the_poles():
    chain = Conservative(samii(), BAND)
    poles = np.abs(realise(samii()).poles) / 2 / np.pi
    for f in chain.damped(chain.frequencies()[:3]):
        assert np.min(np.abs(poles / f - 1)) < 1e-6


def test_zeros_are_where_the_response_without_damping_vanishes():
    chain = Conservative(samii(), BAND)
    for output in ("theta_2", "a_0", "a_2"):
        for z in chain.zeros(output):
            i = [s.name for s in samii().sensor].index(output)
            H = np.abs(chain._chain.response([z, 1.02 * z])[:, i, 0])
            assert H[0] < 1e-5 * H[1]


def test_a_shape_ratio_is_that_of_the_residues():
    chain = Conservative(samii(), BAND)
    for f in chain.frequencies():
        states = chain._chain.field_at([2j * np.pi * f * (1 + 1e-7)])[0, 0]
        ports = chain._chain.places()
        w = {name: states[i, 0] for i, (name, _) in enumerate(ports)}
        ratio = chain.shape_ratio(float(f), "a_1", "a_2")
        assert ratio == pytest.approx((w["link_1"] / w["link_3_6"]).real, rel=1e-4)


def test_method_1_has_its_targets_but_not_its_four_stiffnesses():
    chain = Conservative(samii(), BAND)
    f, z = chain.frequencies()[:2], float(chain.zeros("a_0")[0])
    free = [Free(n[:-2], "k", start=1.5 * k) for n, k in zip(STIFFNESSES, EXACT, strict=True)]
    found = method_1(samii(), f, z, "a_0", free)
    assert found.error < 1e-10
    np.testing.assert_allclose(found.model, [*f, z], rtol=1e-5)
    assert found.values[:2] == pytest.approx(EXACT[:2], rel=0.01)  # these two it knows
    assert found.values[3] > 1.5 * EXACT[3]  # this one it does not


def test_the_valley_of_method_1_runs_along_joints_2_and_3():
    chain = Conservative(samii(), BAND)
    f, z = chain.frequencies()[:2], float(chain.zeros("a_0")[0])
    targets = [*(Target("frequency", x, i) for i, x in enumerate(f)), Target("zero", z, 0, "a_0")]
    found = match(samii(), STIFFNESSES, targets)
    line = valley(found, targets, reach=1.3)
    assert line.dimensions == 1
    assert line.error.max() < 1e-8
    reach = line.values.max(axis=0) / line.values.min(axis=0)
    assert reach[0] < 1.01
    assert reach[3] > 1.5


def test_three_stiffnesses_leave_no_valley():
    chain = Conservative(samii(), BAND)
    f, z = chain.frequencies()[:2], float(chain.zeros("a_0")[0])
    targets = [*(Target("frequency", x, i) for i, x in enumerate(f)), Target("zero", z, 0, "a_0")]
    found = match(samii(), STIFFNESSES[:3], targets)
    assert valley(found, targets).dimensions == 0


def test_method_2_on_the_braced_chain_finds_joints_1_and_2():
    held = braced(samii(), "joint_1")
    assert [s.name for s in held.sensor] == ["theta_2", "a_1", "a_2"]
    chain = Conservative(held, BAND)
    f1 = float(chain.frequencies()[0])
    ratio = chain.shape_ratio(f1, "a_1", "a_2")
    free = [Free("joint_1", "k", start=1.9e4), Free("joint_2", "k", start=8e3)]
    found = method_2(held, f1, ratio, ("a_1", "a_2"), free, weight=100.0)
    np.testing.assert_allclose(found.values, EXACT[1:3], rtol=1e-3)


def test_the_actuator_fit_finds_c_k_and_p():
    free = [Free("joint_2", "c", start=50.0), Free("joint_2", "k", start=1.4e4),
            Free("joint_2_source", "p", start=200.0)]  # fmt: skip
    found = fit_actuator([drawn(samii(), outputs=("theta_2",))], samii(), "theta_2", free)
    np.testing.assert_allclose(found.values, [73.6, 1.08e4, 150.0], rtol=0.02)
    assert found.gain_db < 0.5
    assert fit_actuator([drawn(samii())], samii(), "theta_2").names[0] == "joint_2.c"


def test_the_place_of_the_encoder_is_chosen_by_the_data():
    at_actuator = with_encoder(samii(), "theta_2", ("joint_2_source",))
    rigs = {"across both": samii(), "at the actuator": at_actuator}
    done = compare_variants([drawn(samii())], rigs, (*STIFFNESSES, "joint_2.c"), starts=2)
    assert done[0].name == "across both"
    assert done[0].found.fit.holds
    assert done[1].ratio > 20
    assert choice(done).startswith("across both fits")


@pytest.mark.parametrize(
    ("act", "words"),
    [
        (lambda: match(samii(), STIFFNESSES, []), "at least one frequency or zero"),
        (lambda: method_1(samii(), [1.7], 19.0, "a_9", STIFFNESSES), "a_9.*one of theta_2"),
        (lambda: braced(samii(), "joint_9"), "joint_9.*one of clamp"),
        (lambda: braced(samii(), "joint_3"), "an element before a source"),
        (lambda: fit_actuator([], samii(), "a_0"), "a relative angle across a source"),
        (lambda: with_encoder(samii(), "a_0", ("joint_2",)), "a_0.*a relative angle"),
        (lambda: with_encoder(samii(), "theta_2", ("clamp", "joint_2")), "neighbours"),
    ],
)
def test_what_is_asked_wrongly_is_said_in_one_line(act, words):
    with pytest.raises(InputError, match=words) as error:
        act()
    assert "\n" not in str(error.value)
