"""Records at rates that fold the rig's own modes: the contour's samples against the rig's poles."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from samii_rig.diagnose.physics.channels import effects
from samii_rig.diagnose.physics.grid import Grid, grid
from samii_rig.diagnose.physics.model import Model
from samii_rig.likelihood.contour import EXACT, Contour
from samii_rig.model.realise import realise
from samii_rig.model.sampled import sampled_response
from samii_rig.model.tmm import Chain
from samii_rig.rig.load import load_rig
from samii_rig.rig.schema import Rig
from samii_rig.types import Complex, Float

N = 3000


def held_impulse(rig: Rig, n: int) -> Float:
    """(n, q) what the sensors show of an output of 1 held for a sample, by partial fractions."""
    made = realise(rig)
    T = 1 / rig.rate_hz
    pairs = np.where(made.poles.imag > 0, 2.0, 1.0)
    R = made.residues[:, :, 0] * pairs[:, None]
    grow = np.exp(made.poles * T)
    still = np.abs(made.poles) < 1e-9
    push = np.where(still, T, (grow - 1) / np.where(still, 1.0, made.poles))
    later = grow[None, :] ** np.arange(n - 1)[:, None]
    out = np.zeros((n, R.shape[1]))
    out[1:] = ((later * push) @ R).real
    out[1] += made.direct[:, 0]  # read just before the output changes again
    return out


@pytest.mark.parametrize("rate", [200.0, 250.0])
def test_the_samples_of_a_slow_record_are_the_rigs(rate: float):
    """The beam's second mode is near half of either rate."""
    rig = load_rig("beam_on_shaker")[0].model_copy(update={"rate_hz": rate})
    q = len(rig.sensor)
    contour = Contour.over(N, rate, EXACT)
    model = Model(rig)
    at = grid(rig, contour.frequency[1:], np.arange(q), np.zeros(q, int), sigma=contour.sigma)
    H = np.concatenate([np.zeros((1, q), complex), model.response(np.zeros(model.n), at)])
    impulse = np.zeros(N)
    impulse[0] = 1.0
    shown = contour.predicted(H, impulse)
    exact = held_impulse(rig, N)
    # The line at 0 Hz is missing: a constant, which an accelerometer hardly has.
    for i in range(q):
        off = shown[: N // 2, i] - exact[: N // 2, i]
        assert np.std(off) < 5e-4 * np.std(exact[: N // 2, i])


@pytest.mark.parametrize(
    ("physics", "unknown", "late"), [("transport_delay", 0.12e-3, {"delay": 0.12e-3}),
                                     ("sensor_delay", 0.3e-3, {"delay": 0.3e-3}),
                                     ("sensor_lag", 1 / 0.3e-3, {"lag": 0.3e-3})]
)  # fmt: skip
def test_what_is_late_is_late_in_every_alias(physics: str, unknown: float, late: dict[str, float]):
    """An accelerometer on the mass that the coil drives has a hundredth of what it shows from
    aliases beyond the second, and a delay of a sixteenth of a sample turns those by a radian."""
    rig = load_rig("two_masses")[0]
    near = next(s for s in rig.sensor if s.name == "a_2")
    near = near.model_copy(update={"name": "a_1", "on": "mass_1"})
    rig = rig.model_copy(update={"sensor": (*rig.sensor, near)})
    found = next(
        e for e in effects(rig, 0.7, 40.0)
        if e.physics == physics and e.site in ("coil", "a_1") and len(e.unknowns) == 1
    )  # fmt: skip
    f, q = np.linspace(0.7, 40.0, 80), len(rig.sensor)
    model = Model(rig, (found,))
    at = grid(rig, f, np.arange(q), np.zeros(q, int))
    x = np.append(np.zeros(model.n_nominal), np.log(unknown))
    ours = model.response(x, at)
    on = "sensor" if physics.startswith("sensor") else "actuator"
    some = [
        x.model_copy(update=late) if on == "actuator" or x.name == "a_1" else x
        for x in getattr(rig, on)
    ]
    theirs = sampled_response(rig.model_copy(update={on: tuple(some)}), f)[:, :, 0]
    off = np.max(np.abs(ours - theirs), axis=0) / np.max(np.abs(theirs), axis=0)
    assert np.all(off < 1e-5)
    near_alone = model.response(x, replace(at, far=None))
    assert np.max(np.abs(near_alone - theirs)[:, -1]) > 1e-3 * np.max(np.abs(theirs)[:, -1])


def test_another_gain_of_the_input_is_that_of_every_alias():
    """Three hundredths of what an accelerometer on the driven mass shows at 250 samples/s are
    aliases, most beyond the second: a coil of another gain, behind which a scale of the input makes
    up for it, is the same rig."""
    rig = load_rig("two_masses")[0].model_copy(update={"rate_hz": 250.0})
    near = next(s for s in rig.sensor if s.name == "a_2")
    rig = rig.model_copy(update={"sensor": (near.model_copy(update={"on": "mass_1"}),)})
    found = next(e for e in effects(rig, 0.7, 40.0) if e.physics == "common_gain")
    model = Model(rig, (found,))
    f, one = np.linspace(0.7, 40.0, 40), np.zeros(1, int)
    at = grid(rig, f, one, one, own_aliases=True)
    x = np.zeros(model.n)
    plain = model.response(x, at)
    assert np.max(np.abs(at.rest / plain)) > 3e-3
    x[[model.keys.index(("coil", "K")), -1]] = 0.3, -0.3
    off = model.response(x, at) - plain
    assert np.max(np.abs(off)) < 5e-6 * np.max(np.abs(plain))


def on_a_slow_coil(physics: str) -> tuple[Model, Grid]:
    """A model with an effect on the input, and a grid up to 0.4 of the rate, where a delay of
    samples turns every alias by radians."""
    rig = load_rig("two_masses")[0].model_copy(update={"rate_hz": 100.0})
    found = next(
        e for e in effects(rig, 0.7, 40.0) if e.physics == physics and len(e.unknowns) == 1
    )
    q = len(rig.sensor)
    at = grid(rig, np.linspace(0.7, 40.0, 80), np.arange(q), np.zeros(q, int))
    return Model(rig, (found,)), at


def test_a_delay_of_whole_samples_is_one_of_the_samples():
    model, at = on_a_slow_coil("transport_delay")
    x = np.append(np.zeros(model.n_nominal), np.log(0.02))
    whole = (
        Model(model.rig).response(x[:-1], at) * np.exp(-2j * np.pi * at.frequency * 0.02)[:, None]
    )
    np.testing.assert_allclose(model.response(x, at), whole, atol=1e-9 * np.max(np.abs(whole)))


def test_an_input_that_is_not_held_has_no_alias():
    rig = load_rig("two_masses")[0]
    found = next(e for e in effects(rig, 0.7, 40.0) if e.physics == "input_not_held")
    model, q = Model(rig, (found,)), len(rig.sensor)
    at = grid(rig, np.linspace(0.7, 40.0, 40), np.arange(q), np.zeros(q, int))
    x = np.zeros(model.n)
    plain = Chain(rig).evaluate(at.s)[:, :, 0]
    np.testing.assert_allclose(model.response(x, at), plain, rtol=1e-8)
    assert np.all(np.isfinite(model.gradient(x, at)[1]))


@pytest.mark.parametrize("physics", ["transport_delay", "actuator_lag"])
def test_what_turns_the_aliases_has_its_slope(physics: str):
    model, at = on_a_slow_coil(physics)
    x = np.append(
        np.zeros(model.n_nominal), np.log(0.023 if physics == "transport_delay" else 60.0)
    )
    h, dh = model.gradient(x, at)
    x[-1] += 1e-7
    slope = (model.response(x, at) - h) / 1e-7
    np.testing.assert_allclose(dh[:, :, -1], slope, atol=1e-5 * np.max(np.abs(slope)))


def test_a_model_of_other_parameters_folds_back_what_is_its_own():
    """At 250 samples/s modes of SAMII stand above half the rate: what they fold back is that of
    each model, with its slopes, once a grid is told so."""
    rig = load_rig("samii_joint_3")[0].model_copy(update={"rate_hz": 250.0})
    f = np.linspace(0.5, 40.0, 60)
    sensor, actuator = np.arange(len(rig.sensor)), np.zeros(len(rig.sensor), np.int64)
    model = Model(rig)
    x = model.prior * np.random.default_rng(1).standard_normal(model.n)
    nominal = grid(rig, f, sensor, actuator, Chain(rig), 0.1)
    live = grid(rig, f, sensor, actuator, Chain(rig), 0.1, own_aliases=True)
    own = model.response(x, grid(rig, f, sensor, actuator, model.plain(x), 0.1))

    def off(h: Complex) -> float:
        return float(np.max(np.abs(h - own)) / np.max(np.abs(own)))

    assert off(model.response(x, nominal)) > 1e-3
    assert off(model.response(x, live)) < 1e-4
    h, dh = model.gradient(x, live)
    step = 1e-6
    for j in range(model.n):
        there = x + step * (np.arange(model.n) == j)
        slope = (model.response(there, live) - h) / step
        np.testing.assert_allclose(dh[:, :, j], slope, atol=1e-4 * np.max(np.abs(dh[:, :, j])))
