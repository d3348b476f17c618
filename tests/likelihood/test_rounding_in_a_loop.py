"""A loop's sensor that moves by few steps of its converter: at the lines where it does nothing is
read of it, and the command, which follows its rounding, tells what it tells."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from samii_rig.likelihood import free
from samii_rig.likelihood.noise import Noise
from samii_rig.likelihood.pieces import Command, Piece
from samii_rig.likelihood.rounding import COVERS, WHITE, Added, Rounding, steps_by_line
from samii_rig.types import Complex, Float, Int

RATE = 500.0
N = 20_000


def swept(low: float, high: float) -> Float:
    """(N,) a sweep from one amplitude at 0.5 Hz to another at 40 Hz, in steps: 0.8 at 35 Hz of one
    that ends with 0.5."""
    t = np.arange(N) / RATE
    phase = 2 * np.pi * (0.5 * t + 0.5 * (39.5 / t[-1]) * t**2)
    return np.asarray(np.geomspace(low, high, N) * np.sin(phase))


def piece(y: Float, noise: float = 0.0) -> Piece:
    """That a sensor of step 1 reads."""
    sd = noise * np.random.default_rng(0).standard_normal(y.size)
    z = np.rint(y + sd)[:, None]
    return Piece("sweep", y, z, 0, (), commands=(Command(y, 1.0, (), np.inf),))


def rounded(y: Float, noise: float = 0.0, *, closed: bool = True) -> Rounding:
    k = np.arange(20, 1600)
    return Rounding.of_piece(
        piece(y, noise), k, np.ones(1), y[:, None], RATE, (0,) if closed else ()
    )


def test_a_line_has_the_steps_of_the_motion_while_it_is_swept() -> None:
    f = np.array([1.0, 5.0, 35.0])
    first, middle, last = steps_by_line(swept(20.0, 0.5), RATE, f)
    assert first > 20
    assert last == pytest.approx(1.6, rel=0.1)
    assert last < middle < first


def test_nothing_is_read_where_the_motion_stays_within_three_steps() -> None:
    found = rounded(swept(20.0, 0.5))
    cover = found.covered[:, 0] > 0
    assert not cover[(found.frequency > 1) & (found.frequency < 5)].any()
    assert cover[(found.frequency > 30) & (found.frequency < 39)].all()
    own = found.power[cover, 0]
    np.testing.assert_allclose(found.covered[cover, 0], COVERS * own)


def test_what_is_dithered_or_many_steps_or_in_no_loop_is_read() -> None:
    assert rounded(swept(20.0, 0.5), noise=0.4).cover is None
    assert rounded(swept(200.0, 20.0)).cover is None
    assert rounded(swept(20.0, 0.5), closed=False).cover is None


def test_an_error_that_rests_has_its_power_at_the_lowest_lines() -> None:
    """It is one for as long as the motion rests: 10 s behind a sweep of 20 s."""
    y = swept(20.0, 8.0)
    y[N // 2 : 3 * N // 4] = y[N // 2]
    y[3 * N // 4 :] *= 0.05
    found = rounded(y)
    low = found.frequency < 0.05
    assert np.max(found.power[low, 0]) > 100 * WHITE


def alone(f: Float) -> Complex:
    """Two sensors; the rounding of the first goes round a loop into the second, three times."""
    u = np.tile(np.eye(2, dtype=complex), (f.size, 1, 1))
    u[:, 1, 0] = -3.0 * np.exp(0.02j * f)
    return u


def known_above(hz: float) -> Added:
    """Rounding of the first of two sensors, which is covered above a frequency."""
    at = np.array([0.0, hz, hz + 1e-3, RATE])
    power = np.array([[0.1, 0.0]] * 4)
    return Added.of([Rounding(at, power, {}, {}, COVERS * power * (at > hz)[:, None])])


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_what_is_covered_is_noise_of_its_power_and_leaves_the_others_alone(seed: int) -> None:
    """The error under the cover is ten times what is known: the second sensor's own noise is found
    all the same, and chi-square is what it should be."""
    f = 0.02 * np.arange(50.0, 2000.0)
    known = known_above(20.0)
    rng = np.random.default_rng(seed)
    own = rng.standard_normal((f.size, 2, 2)) @ np.array([1, 1j]) / np.sqrt(2)
    own *= np.sqrt([0.1, 0.04])
    own[f > 20, 0] *= np.sqrt(10.0)
    left = (alone(f) @ own[:, :, None])[:, :, 0]
    piece = np.zeros(f.size, np.int64)
    noise = Noise.of(f, left, np.ones(f.size), piece, alone, known)
    k = np.arange(f.size)
    cover = noise.cover(f, piece, k)
    np.testing.assert_array_equal(cover, noise.cover(f, piece, k))
    assert not cover[f < 20].any()
    white = noise.whitened(f, piece, (left + cover)[:, :, None])[:, :, 0]
    for on in (f < 20, f > 21):
        power = np.mean(np.abs(white[on]) ** 2, axis=0)
        np.testing.assert_allclose(power, 1.0, atol=0.15)
    # In units of what the second sensor has beside the first: its own noise.
    C = noise.covariance(f, piece)
    beside = (C[:, 1, 1] - np.abs(C[:, 0, 1]) ** 2 / C[:, 0, 0]).real
    np.testing.assert_allclose(np.median(beside[f > 21]), 0.04, rtol=0.15)
    some: Int = k[::7]
    np.testing.assert_array_equal(noise.cover(f[some], piece[some], some), cover[some])


@pytest.mark.parametrize("left", [1.0, 1e-12])
def test_levels_are_covered_by_as_much_as_nuisances_leave_of_them(
    left: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of few lines nothing may be left."""
    f, k = 0.02 * np.arange(50.0, 2000.0), np.arange(1950)
    rng = np.random.default_rng(0)
    own = rng.standard_normal((f.size, 2, 2)) @ np.array([1, 1j]) * np.sqrt([0.05, 0.02])
    e = (alone(f) @ own[:, :, None])[:, :, 0]
    of = np.zeros(f.size, np.int64)
    noise = Noise.of(f, e, np.ones(f.size), of, alone, known_above(0.0))
    each = [(f, np.sqrt(left) * e, np.full(f.size, left))]
    monkeypatch.setattr(free, "_beside", lambda *_: each)
    piece = SimpleNamespace(contrasts=(None,), repeats=())
    records = SimpleNamespace(pieces=[piece], lines=lambda _: SimpleNamespace(k=k))
    total, count = free.differing(records, None, [None], noise)  # type: ignore[arg-type,list-item]
    assert total / count == pytest.approx(1.0, abs=0.1)
