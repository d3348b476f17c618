"""Velocity feedback: both methods agree on what its gain does, and the amplitude tells it."""

import numpy as np
import pytest
from identify_kit import drawn, samii

from samii_rig.errors import InputError
from samii_rig.fem.model import Fem
from samii_rig.identify.actuator import with_encoder
from samii_rig.identify.conservative import Conservative
from samii_rig.identify.methods import from_responses
from samii_rig.identify.parameters import Free
from samii_rig.identify.velocity_feedback import curves, fit_gain, in_series
from samii_rig.model.tmm import Chain

SOURCE = "joint_2_source"
DAMPER = "joint_2_source_feedback"


def collocated():
    return with_encoder(samii(), "theta_2", (SOURCE,))


def test_a_source_in_series_with_a_damper_is_equation_18():
    f = np.geomspace(0.5, 30, 40)
    ours = Chain(in_series(collocated(), SOURCE, 500.0).model_copy()).response(f)
    # Eq. 18 has no lag; the chain keeps that of its source.
    p = 150.0
    lag = p / (2j * np.pi * f + p)
    fem = Fem(collocated(), feedback={SOURCE: (500.0, 0.5)}).response(f) * lag[:, None, None]
    np.testing.assert_allclose(ours, fem, rtol=1e-4, atol=1e-5 * np.abs(fem).max())


def test_transfer_matrices_and_finite_elements_have_the_same_curves_over_g_v():
    gains = (1e5, 2e3, 500.0, 150.0)
    a, b = (curves(collocated(), SOURCE, gains, by=by) for by in ("tmm", "fem"))
    np.testing.assert_allclose(a.frequency_hz, b.frequency_hz, rtol=1e-6)
    np.testing.assert_allclose(a.damping, b.damping, rtol=1e-5)


def test_g_v_changes_the_damping_and_hardly_the_frequencies_until_it_is_small():
    of = curves(collocated(), SOURCE, np.geomspace(20, 1e5, 30), by="fem")
    at = int(np.argmin(np.abs(of.g_v - 500)))
    moved = np.abs(of.frequency_hz[at] / of.frequency_hz[0] - 1)
    assert moved[0] < 1e-3
    assert moved[1] < 0.025
    assert np.all(of.damping[at] / of.damping[0] > 1.35)
    # It stops being true: mode 2 first, which then no longer swings.
    assert of.leaves(1, 0.01) == pytest.approx(920, rel=0.03)
    assert of.leaves(0, 0.01) == pytest.approx(88, rel=0.03)
    assert np.isnan(of.frequency_hz[-1, 1])
    assert not np.isnan(of.frequency_hz[-1, 0])


@pytest.mark.parametrize("start", [150.0, 1500.0])
def test_the_amplitude_alone_tells_the_gain(start):
    response = drawn(in_series(collocated(), SOURCE, 500.0), outputs=("theta_2",))
    found = fit_gain([response], in_series(collocated(), SOURCE, start), "theta_2")
    assert found.names == (f"{DAMPER}.c",)
    assert found.values[0] == pytest.approx(500.0, rel=0.02)


def test_a_damper_alone_is_held_by_its_source_where_nothing_is_damped():
    f = [Conservative(r, (0.2, 60.0)).frequencies() for r in
         (samii(), in_series(samii(), SOURCE, 500.0))]  # fmt: skip
    np.testing.assert_allclose(f[0], f[1], rtol=1e-6)


def test_method_1_ends_with_the_gain_from_the_amplitude():
    truth = in_series(collocated(), SOURCE, 500.0)
    response = drawn(truth, n=400, relative=0.002)
    free = [Free("joint_1", "k", start=1.7e4), Free("joint_2", "k", start=0.9e4)]
    found = from_responses("1", [response], in_series(collocated(), SOURCE, 900.0), free)
    assert found.gain is not None
    # The gain moves mode 2 by 1.8 %, which the first stage takes for stiffness.
    assert found.match.values == pytest.approx([1.36e4, 1.08e4], rel=0.08)
    assert found.gain.values[0] == pytest.approx(500.0, rel=0.05)


@pytest.mark.parametrize(
    ("act", "words"),
    [
        (lambda: in_series(samii(), "joint_9", 500.0), "joint_9.*one of joint_2_source"),
        (lambda: in_series(samii(), SOURCE, 0.0), "more than 0"),
        (lambda: fit_gain([], samii(), "theta_2"), "a damper of"),
        (lambda: from_responses("3", [], samii(), ["joint_1.k"]), "one of 1, 2"),
        (lambda: from_responses("1", [], samii(), ["joint_1.k"]), "at least one frequency"),
        (lambda: from_responses("2", [drawn(samii(), n=20)], samii(),
                                ["joint_1.k", "joint_2.k", "joint_3.k"]),
         "2 numbers for 3 parameters"),
        (lambda: from_responses("2", [drawn(samii(), n=20, outputs=("theta_2", "a_1"))],
                                samii(), ["joint_1.k"]), "2 accelerometers"),
        (lambda: from_responses("1", [drawn(samii(), n=20)], samii(), ["joint_1.k"],
                                outputs=["theta_2"]), "theta_2.*one of a_0, a_1, a_2"),
    ],
)  # fmt: skip
def test_what_is_asked_wrongly_is_said_in_one_line(act, words):
    with pytest.raises(InputError, match=words) as error:
        act()
    assert "\n" not in str(error.value)
