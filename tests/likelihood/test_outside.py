"""What moves a command from outside of a loop, by its law, its reference, or the record itself."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from two_masses_kit import RATE, RIG, recorded

from samii_rig.likelihood.bridged import Bridged
from samii_rig.likelihood.outside import followed, outside
from samii_rig.model.feedback import state_space
from samii_rig.rig.schema import Feedback, Rig
from samii_rig.types import Channel, Float, Recording

KP, KD = 3000.0, 100.0  # V/m and V s/m
READ = ("x_1", "a_2")
STEP = 3e-4  # V, of the converter
PD = Feedback(
    name="pd", sensor="x_1", actuator="v", gain=1.0, unit="V/(m)",
    zeros=(-2 * RATE / 3,), poles=(-2 * RATE,), max=10.0,
)  # fmt: skip


def whole(run: Recording) -> Bridged:
    return Bridged.of(run, np.ones(len(run), np.bool_), ["v"])


def stairs() -> Float:
    """(n,) V, a new value each 0.8 s."""
    return np.repeat(np.random.default_rng(3).uniform(-1.5, 1.5, 10), int(0.8 * RATE))


def with_reference(run: Recording, r: Float) -> Recording:
    return replace(
        run,
        channels=(*run.channels, Channel("u", "V", "reference")),
        values=np.column_stack([run.values, r]),
        quality=np.column_stack([run.quality, np.zeros(len(run), np.uint8)]),
    )


@pytest.fixture(scope="module")
def closed() -> Recording:
    return recorded(stairs(), 5, pd=(KP, KD))


def test_a_law_that_nobody_stated_is_found_in_the_record(closed: Recording) -> None:
    found = outside(whole(closed), RIG, "v", READ)
    assert found is not None
    # But for slow parts, which differences hardly show.
    off = np.diff(found - stairs(), 2)
    assert np.median(np.abs(off)) < 2 * STEP
    assert np.median(np.abs(np.diff(closed.values_of("v"), 2))) > 100 * STEP


def test_so_under_a_sweep() -> None:
    t = np.arange(4000) / RATE
    sweep = np.sin(2 * np.pi * (0.5 + 2 * t) * t)
    found = outside(whole(recorded(sweep, 5, pd=(KP, KD))), RIG, "v", READ)
    assert found is not None
    assert np.median(np.abs(np.diff(found - sweep, 2))) < 2 * STEP


def test_an_open_loop_has_none() -> None:
    assert outside(whole(recorded(stairs(), 5)), RIG, "v", READ) is None
    t = np.arange(4000) / RATE
    sweep = np.sin(2 * np.pi * (0.5 + 2 * t) * t)
    noise = 1e-3 * np.random.default_rng(1).standard_normal(t.size)
    for v in (sweep, sweep + noise):
        assert outside(whole(recorded(v, 6)), RIG, "v", READ) is None


def test_what_was_not_recorded_or_for_a_moment_only_has_none(closed: Recording) -> None:
    assert outside(whole(closed), RIG, "v_2", READ) is None
    few = replace(
        closed, time=closed.time[:40], sequence=closed.sequence[:40], values=closed.values[:40],
        quality=closed.quality[:40], segments=(),
    )  # fmt: skip
    assert outside(whole(few), RIG, "v", READ) is None


def test_a_stated_law_that_ran_leaves_what_moved_it() -> None:
    rig = RIG.model_copy(update={"feedback": (PD,)})
    run = recorded(stairs(), 5)
    assert outside(whole(run), rig, "v", READ) is None, "it did not run"
    assert outside(whole(_in_loop(rig, run)), rig, "v", ("a_2",)) is None, "no noise goes round"
    ran = _in_loop(rig, run)
    found = outside(whole(ran), rig, "v", READ)
    assert found is not None
    np.testing.assert_allclose(found, stairs(), atol=1e-9)


def _in_loop(rig: Rig, run: Recording) -> Recording:
    """A record whose command has what the loop of a rig file makes of what x_1 reads."""
    A, B, C, D = state_space(rig.feedback[0], RATE)
    noisy = run.values_of("x_1") + 1e-5 * np.random.default_rng(2).standard_normal(len(run))
    w, made = np.zeros(len(A)), np.zeros(len(run))
    for i, y in enumerate(noisy):
        made[i] = (C @ w + D[:, 0] * y)[0]
        w = A @ w + B[:, 0] * y
    values = run.values.copy()
    values[:, run.column("v")] += made
    values[:, run.column("x_1")] = noisy
    return replace(run, values=values)


def test_the_reference_is_what_moves_it_where_it_explains_the_command(closed: Recording) -> None:
    found = outside(whole(with_reference(closed, stairs())), RIG, "v", READ)
    np.testing.assert_array_equal(found, stairs())


def test_a_reference_that_explains_little_is_not_all_that_moves_it(closed: Recording) -> None:
    other = np.random.default_rng(9).standard_normal(len(closed))
    found = outside(whole(with_reference(closed, other)), RIG, "v", READ)
    assert found is not None
    assert not np.array_equal(found, other)  # the law in the record instead


def test_above_the_band_of_what_moves_it_a_command_answers_noise(closed: Recording) -> None:
    v, found = closed.values_of("v"), outside(whole(closed), RIG, "v", READ)
    assert found is not None
    assert 20 < followed(v, found, RATE) < 60
    assert followed(stairs(), 2 * stairs(), RATE) == np.inf
