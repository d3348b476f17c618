"""Mistakes of those who record: each is told as itself, none as physics.

Plan: what a mistake does to a response, against the rig file that has it so; columns mended to the
last bit; a rate that is another, refused; whole diagnoses of sweeps of two masses.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from identify_kit import noiseless, samii

from samii_rig.diagnose.data.pace import paced
from samii_rig.diagnose.data.wiring import outputs_of, scaled, wired
from samii_rig.diagnose.diagnose import diagnose
from samii_rig.diagnose.physics import faults, insert
from samii_rig.diagnose.physics.grid import grid
from samii_rig.diagnose.physics.model import Model
from samii_rig.errors import InputError
from samii_rig.identify.bootstrap import redraw
from samii_rig.rig.load import load_rig
from samii_rig.rig.schema import AbsoluteAngle, Velocity
from samii_rig.types import Channel, Recording

RIG = samii()
LINES = np.geomspace(0.5, 40.0, 120)
SENSORS = np.arange(len(RIG.sensor))
ALL = list(faults.effects(RIG, RIG.rate_hz))
TWO, _ = load_rig("two_masses")
LATE = "is in another row than what it moved: the sensors' stand 2 samples later"


def response(rig, *effects, lines=LINES):
    """(n, n_sensor) of the sampled rig, effects in it."""
    model = Model(rig, effects)
    n = len(rig.sensor)
    at = grid(rig, lines, np.arange(n), np.zeros(n, np.int64))
    return model.response(np.zeros(model.n), at)


def one(physics, site, said, table=ALL):
    (found,) = (e for e in table if e.name == (physics, site) and said in e.variant)
    return found


def test_a_velocity_in_place_of_an_acceleration_is_what_a_sensor_of_velocity_reads():
    tip = next(s for s in RIG.sensor if s.name == "a_2")  # at the end of its link
    chain = {"highpass_hz": tip.highpass_hz, "antialias": tip.antialias}
    made = Velocity(kind="velocity", name="a_2", after="link_3_6", unit="m/s", **chain)
    right = response(insert.replaced(RIG, made))[:, 3]
    found = response(RIG, one("kind_error", "a_2", "a velocity"))[:, 3]
    assert np.max(np.abs(found - right) / np.abs(right)) < 2e-2  # but for aliases


def test_an_angle_against_the_ground_is_one_across_the_joint_and_what_the_base_turns():
    made = AbsoluteAngle(kind="absolute_angle", name="theta_2", after="joint_2", unit="rad")
    right = response(insert.replaced(RIG, made))[:, 0]
    found = response(RIG, one("kind_error", "theta_2", "against the ground"))[:, 0]
    assert np.max(np.abs(found - right) / np.abs(right)) < 5e-3  # aliases are those of the file's


@pytest.mark.parametrize(
    ("physics", "site", "said", "factor"),
    [
        ("sign_error", "a_1", "wrong sign", lambda _f: -1.0),
        ("unit_error", "theta_2", "is 57.3 times", lambda _f: 180 / np.pi),
        ("unit_error", "a_0", "is 0.102 times", lambda _f: 1 / 9.80665),
        ("column_shifted", "a_2", "2 samples later", lambda f: np.exp(-2j * np.pi * f * 2 / 500)),
    ],
)
def test_a_mistake_is_a_factor_that_is_exactly_known(physics, site, said, factor):
    effect = one(physics, site, said)
    k = [s.name for s in RIG.sensor].index(site)
    found = response(RIG, effect)
    assert not effect.unknowns
    assert found[:, k] == pytest.approx(factor(LINES) * response(RIG)[:, k], rel=1e-3)
    others = [i for i in SENSORS if i != k]
    assert np.array_equal(found[:, others], response(RIG)[:, others])


def test_a_logger_shifts_by_rows_of_the_recording_not_of_the_loop():
    (late,) = (e for e in faults.effects(RIG, RIG.rate_hz / 4) if e.variant.startswith(LATE))
    s = 2j * np.pi * LINES
    assert late.factor.value(s, np.zeros(0))[0] == pytest.approx(np.exp(-s * 8 / RIG.rate_hz))


def measured(rig, H, lines=LINES, seed=3, noise=0.01):
    """A response with noise in it, a part of its size, of H (n, n_sensor)."""
    like = noiseless(rig, lines, relative=noise)
    return redraw(like, H[:, :, None], np.random.default_rng(seed), 10)


@pytest.mark.parametrize(
    ("order", "factor"),
    [((0, 2, 1), (1, 1, 1)), ((0, 1, 2), (1, 1e3, -1)), ((0, 1, 2), (1e3, 1, 1))],
)
def test_what_the_wiring_tells_is_mended_in_the_columns_to_the_last_bit(order, factor):
    """Columns v, x_1, a_2 of a recording: swapped, in another unit, of another sign."""
    true = np.random.default_rng(1).standard_normal((20, 3))
    wrong = true[:, order] * factor
    sound = measured(TWO, response(TWO))
    mixed = replace(outputs_of(sound, [i - 1 for i in order[1:]]), outputs=sound.outputs)
    found = wired([scaled(mixed, np.array(factor[1:]) / factor[0])], TWO)
    assert found.mend is not None
    roles = {"v": "command", "x_1": "sensor", "a_2": "sensor"}
    channels = tuple(Channel(name, "1", role) for name, role in roles.items())
    n, quality = np.arange(20), np.zeros((20, 3), np.uint8)
    run = Recording(channels, 500.0, n, n, wrong.copy(), quality)
    assert found.mend(run).values == pytest.approx(true, rel=1e-15)
    assert np.array_equal(run.values, wrong)


@pytest.mark.parametrize("factor", [9.80665, -9.80665])
def test_a_sensor_that_shows_its_noise_alone_is_in_no_other_unit(factor):
    """Where noise is ten times what the sensor answers, its lines are as large as in g."""
    H = response(TWO)
    quiet = measured(TWO, H, noise=10.0)
    shown = factor * H[:, 1]  # of one size and phase, as chance may have it
    noise = replace(quiet, H=np.stack([H[:, 0], shown], axis=1)[:, :, None])
    assert not wired([noise], TWO).remarks
    said = wired([replace(noise, covariance=1e-4 * noise.covariance)], TWO).remarks
    assert said
    assert all(x.startswith("a_2") for x in said)


def test_a_rate_that_is_five_times_another_is_refused_in_one_line():
    lines = LINES[LINES < 15.0]
    slow = replace(measured(RIG, response(RIG, lines=lines), lines), frequency=5 * lines)
    with pytest.raises(InputError, match=r"rate_hz is 500.0; expected 100 Hz: .* at 5 times") as e:
        paced([slow], RIG)
    assert "\n" not in str(e.value)


def test_a_rate_that_leaves_no_line_is_not_another():
    """Were these ten times as high, all of them would stand beyond half the rate."""
    lines = np.geomspace(30.0, 40.0, 40)
    assert lines[0] * 10 > RIG.rate_hz / 2
    paced([measured(RIG, 5 * response(RIG, lines=lines), lines)], RIG)


@pytest.mark.parametrize("rig", ["samii", "two_masses", "beam_on_shaker", "sflr"])
def test_a_rig_a_quarter_stiffer_than_its_file_is_no_wrong_rate(rig):
    """Every frequency is an eighth too high there."""
    made, _ = load_rig(rig)
    data = made.model_dump()
    for e in data["element"]:
        for symbol in ("k", "EI"):
            if e.get(symbol):
                e[symbol]["value"] *= 1.25
    paced([measured(made, response(type(made).model_validate(data)))], made)


@pytest.mark.parametrize(
    ("physics", "site", "said"),
    [
        ("column_shifted", "a_2", "2 samples later"),
        ("kind_error", "a_2", "a velocity"),
        ("unit_error", "v", "is 1000 times"),
        ("sign_error", "a_2", "wrong sign"),
        # Both at once look like a dead time of the drive.
        ("columns_shifted", "v", f"measured, not held, and {LATE}"),
    ],
)
def test_it_is_told_and_no_physics_is_named(physics, site, said):
    effect = one(physics, site, said, list(faults.effects(TWO, TWO.rate_hz)))
    found = diagnose([measured(TWO, response(TWO, effect))], TWO)
    assert found.verdict == "no_mismatch"
    assert not found.causes
    assert any(site in words for words in found.not_physics)


@pytest.mark.slow  # half a minute on a loaded machine
def test_a_shift_stays_a_shift_where_a_dead_time_fits_by_less_than_models_are_exact_to():
    """2 us beside 4 ms are 7 noise units, and 5e-4 of what is wrong."""
    table = list(faults.effects(TWO, TWO.rate_hz))
    (effect,) = (e for e in table if e.variant.startswith(LATE) and e.site == "v")
    off = np.exp(-2j * np.pi * LINES * 2e-6)[:, None]
    found = diagnose([measured(TWO, response(TWO, effect) * off, noise=1e-4)], TWO)
    assert any("2 samples later" in words for words in found.not_physics)
    assert all(c.parameters["tau"].value < 3e-6 for c in found.causes)
