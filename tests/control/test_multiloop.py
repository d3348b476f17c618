"""Margins of several loops at once, against other computations."""

from dataclasses import dataclass

import numpy as np
import pytest

from samii_rig.control.multiloop import disk, gain_of, line, multiloop, structured
from samii_rig.control.plants import plant
from samii_rig.model.loops import loops_of
from samii_rig.model.sampled import sampled_response
from samii_rig.rig.load import load_rig

RIG = load_rig("samii_two_joints")[0]
RNG = np.random.default_rng(5)


@dataclass
class Seen:
    """As much of a plant as margins need."""

    frequency: np.ndarray
    response: np.ndarray


def seen(rig, points=120):
    f = np.geomspace(0.02, 0.4999 * rig.rate_hz, points)
    return Seen(f, sampled_response(rig, f))


def gained(rig, factors):
    """The rig with each output's gain K changed."""
    names = dict(zip([a.name for a in rig.actuator], factors, strict=True))
    elements = tuple(
        e.model_copy(update={"K": e.K.model_copy(update={"value": e.K.value * names[e.input]})})
        if getattr(e, "input", None) in names
        else e
        for e in rig.element
    )
    return rig.model_copy(update={"element": elements})


def test_two_outputs_have_the_structured_value_that_many_factors_search_for():
    """The largest spectral radius of M U over factors of modulus 1 (Doyle 1982, theorem 1)."""
    phases = np.exp(2j * np.pi * np.linspace(0, 1, 721))
    for _ in range(20):
        M = RNG.standard_normal((2, 2)) + 1j * RNG.standard_normal((2, 2))
        radii = [np.max(np.abs(np.linalg.eigvals(M * np.array([1.0, p])))) for p in phases]
        assert structured(M) == pytest.approx(max(radii), rel=2e-4)


def test_three_outputs_too():
    phases = np.exp(2j * np.pi * np.linspace(0, 1, 73))
    M = RNG.standard_normal((3, 3)) + 1j * RNG.standard_normal((3, 3))
    factors = np.array([[1.0, p, q] for p in phases for q in phases])
    radius = np.max(np.abs(np.linalg.eigvals(M[None] * factors[:, None, :])))
    assert structured(M) == pytest.approx(radius, rel=5e-3)


def test_a_disk_of_one_is_a_factor_of_three():
    gain, phase = disk(1.0)
    assert gain == pytest.approx(20 * np.log10(3))
    assert phase == pytest.approx(np.degrees(2 * np.arctan(0.5)))
    assert disk(2.5)[0] == np.inf


def test_loops_that_do_not_see_each_other_have_the_margin_of_the_worse_one():
    given = seen(RIG)
    H = given.response.copy()
    names = [s.name for s in RIG.sensor]
    H[:, names.index("theta_2"), 1] = 0.0
    H[:, names.index("theta_3"), 0] = 0.0
    found = multiloop(Seen(given.frequency, H), RIG)
    assert found.alpha == pytest.approx(min(found.loops_alone), rel=1e-5)


def test_both_joints_of_samii_have_a_margin_together_no_larger_than_one_alone():
    given = seen(RIG)
    found = multiloop(given, RIG)
    assert found.stable
    assert found.outputs == ("v_2", "v_3")
    assert 0 < found.alpha <= min(found.loops_alone) + 1e-9
    loops = [loops_of(RIG, a.name) for a in RIG.actuator]
    L = gain_of(RIG, loops, given.frequency, given.response)
    exact = np.min(np.linalg.svd(np.eye(2) + L, compute_uv=False)[:, -1])
    assert found.smallest == pytest.approx(exact)
    assert "v_2 and v_3 together" in line(found)
    # What every output may change by at once keeps both stable, whichever way each goes.
    factor = 10 ** (0.98 * found.gain_db / 20)
    for one in (factor, 1 / factor):
        for other in (factor, 1 / factor):
            rig = gained(RIG, (one, other))
            assert multiloop(seen(rig), rig).stable


def test_gains_that_are_far_too_large_are_not_stable():
    rig = gained(RIG, (300.0, 300.0))
    assert not multiloop(seen(rig), rig).stable


def test_one_loop_has_no_margins_together():
    rig = load_rig("samii")[0]
    assert multiloop(seen(rig, 20), rig) is None


def test_the_plant_of_a_design_serves():
    found = multiloop(plant("nominal", RIG, loops_of(RIG)), RIG)
    assert found.stable
