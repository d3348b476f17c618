"""The likelihood of whole records: exact to the last sample, noise as it is, no sigma lost."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy import linalg, signal

from samii_rig.diagnose.fit.records import _shown, fitted_lines
from samii_rig.likelihood import pieces
from samii_rig.likelihood.algebra import Shrinking, as_complex, as_real
from samii_rig.likelihood.before import _past_of
from samii_rig.likelihood.bridged import bridged
from samii_rig.likelihood.contour import EXACT, SMOOTH, Contour
from samii_rig.likelihood.free import Free, Group, residual_of
from samii_rig.likelihood.inputs import MeterNoise
from samii_rig.likelihood.leak import columns
from samii_rig.likelihood.nodes import nodes_of, size_about
from samii_rig.likelihood.noise import Noise
from samii_rig.likelihood.past import Past, likely
from samii_rig.likelihood.pieces import (
    Input,
    Piece,
    Samples,
    Wiring,
    pieces_of,
    wiring,
)
from samii_rig.likelihood.records import Records
from samii_rig.likelihood.reduce import reduced, residuals_by_line
from samii_rig.likelihood.rounding import (
    Added,
    Rounding,
    _wandering,
    dithered,
    dithering,
    repeating,
)
from samii_rig.likelihood.rows import Rows
from samii_rig.likelihood.spikes import mended
from samii_rig.rig.load import load_rig
from samii_rig.types import Channel, Complex, Float, Int, Quality, Recording, Segment

RATE = 200.0
SAMII = load_rig("samii")[0]
NUMERATOR = np.array([[0.0, 0.02, 0.015], [0.0, -0.01, 0.03]])


def poles(frequency: float = 4.0, damping: float = 0.02) -> Float:
    """Denominator in z of one mode."""
    p = np.exp((-damping + 1j * np.sqrt(1 - damping**2)) * 2 * np.pi * frequency / RATE)
    return np.array([1.0, -2 * p.real, abs(p) ** 2])


def response(s: Complex, denominator: Float) -> Complex:
    z = np.exp(s / RATE)
    b = NUMERATOR @ np.stack([np.ones_like(z), 1 / z, 1 / z**2])
    return (b / (denominator @ np.stack([np.ones_like(z), 1 / z, 1 / z**2]))).T


def from_rest(u: Float, denominator: Float) -> Float:
    """The recursion itself."""
    return np.column_stack([signal.lfilter(b, denominator, u) for b in NUMERATOR])


def sweep(n: int, low: float = 1.0, high: float = 12.0) -> Float:
    t = np.arange(n) / RATE
    return signal.chirp(t, low, t[-1], high)


def piece(u: Float, z: Float, name: str = "sweep") -> Piece:
    return Piece(name, u, z, 0, ((1.0, "V"),))


def test_a_record_that_ends_in_full_motion_is_predicted_to_its_last_sample():
    u, a = sweep(1500), poles()
    contour = Contour.over(u.size, RATE, EXACT)
    Y = response(contour.s, a) * contour.damped(u)[:, None]
    exact = from_rest(u, a)
    assert np.max(np.abs(exact[-50:])) > 0.05 * np.max(np.abs(exact))
    np.testing.assert_allclose(contour.record(Y, u.size), exact, atol=1e-9 * np.max(np.abs(exact)))


@pytest.mark.parametrize("history", [0, 300])
def test_what_a_change_between_nodes_does_to_a_spectrum_is_in_closed_form(history: int):
    u = sweep(900)
    contour = Contour.over(u.size, RATE, SMOOTH)
    nodes = np.array([20, 31, 33, 60, 61, 100])
    lines = np.arange(5, 290)  # more than are computed at once
    n = u.size - history
    (both,) = columns(contour, contour.damped(u)[None], nodes, history, n, lines)
    rng = np.random.default_rng(1)
    d = rng.standard_normal(nodes.size) + 1j * rng.standard_normal(nodes.size)
    change = np.zeros(contour.frequency.size, complex)
    every = np.arange(nodes[0], nodes[-1] + 1)
    change[every] = np.interp(every, nodes, d.real) + 1j * np.interp(every, nodes, d.imag)
    y = contour.record((change * contour.damped(u))[:, None], u.size)[history:, 0]
    made = both @ np.concatenate([d.real, d.imag])
    np.testing.assert_allclose(made, np.fft.rfft(y)[lines], atol=1e-10 * np.max(np.abs(y)) * n)


def noisy(seed: int, n: int = 3000, sd: float = 0.02) -> tuple[Float, Float]:
    u = sweep(n)
    rng = np.random.default_rng(seed)
    return u, from_rest(u, poles()) + sd * rng.standard_normal((n, 2))


def own_alone(f: Float) -> Complex:
    """Sensors with noise of their own, and nothing that disturbs the rig."""
    return np.broadcast_to(np.eye(2, dtype=complex), (f.size, 2, 2))


def white_rounding(power: float) -> Added:
    """White rounding of both sensors."""
    return Added.of([Rounding(np.array([0.0, RATE]), np.full((2, 2), power), {}, {})])


def one_piece(f: Float) -> Int:
    return np.zeros(f.size, np.int64)


def likelihood(u: Float, z: Float, denominator: Float):
    records = Records((piece(u, z),), RATE, ((0.8, 15.0),))
    return records, reduced(records, lambda s: response(s, denominator), own_alone)


def test_at_the_truth_chi_square_is_its_degrees_of_freedom_however_the_record_ends():
    left = []
    for seed in range(12):
        _, found = likelihood(*noisy(seed), poles())
        left.append(float(found.target @ found.target) / found.known)
    # 12 times some 150 degrees of freedom: 0.03; the noise itself is known to 5 %.
    assert np.mean(left) == pytest.approx(1.0, abs=0.12)


@pytest.mark.parametrize("off", [0.9995, 1.0005])
def test_of_a_shifted_mode_nearly_all_sigma_is_kept_in_a_cut_record(off: float):
    sd, kept = 0.02, []
    for seed in range(6):
        u, z = noisy(seed, sd=sd)
        _, found = likelihood(u, z, poles(4.0 * off))
        at = found.sigma + 2j * np.pi * found.frequency
        before = float(found.target @ found.target)
        after = float(np.sum(found.residual(response(at, poles())) ** 2))
        there = from_rest(u, poles()) - from_rest(u, poles(4.0 * off))
        kept.append((before - after) / (np.sum(there**2) / sd**2))
    assert 0.81 < np.mean(kept) < 1.15  # of chi-square: 0.9 of sigma, and no more than there is


def test_what_rang_before_a_record_rings_as_the_changed_response_does():
    """Cut just behind the resonance: of chi-square of a mode 1 per mille off, the free motion has
    nearly all."""
    u = sweep(6000, low=3.0, high=5.0)
    rng = np.random.default_rng(0)
    z = from_rest(u, poles()) + 5e-3 * rng.standard_normal((6000, 2))
    _, found = likelihood(u[3100:], z[3100:], poles(4.004))
    at = found.sigma + 2j * np.pi * found.frequency
    before = float(found.target @ found.target)
    after = float(np.sum(found.residual(response(at, poles())) ** 2))
    assert after < 0.01 * before  # 0.18 where it was taken to ring as the reference does


def test_what_does_not_move_at_a_records_start_is_not_taken_for_what_rang_before():
    exact = Contour.over(3000, RATE, EXACT)
    H = response(exact.s, poles(4.0))
    impulse = exact.record(H, exact.samples)
    one = piece(np.zeros(3000), np.zeros((3000, 2)))
    past = Past.of_piece(one, np.arange(12, 225), impulse, exact, np.ones(1))
    a = np.array([1.0, 0.5])
    rang = past.motion(one, a, impulse)
    sd = 0.2 * np.std(rang, axis=0)
    noise = sd * np.random.default_rng(0).standard_normal(rang.shape)
    offset = 3 * np.std(rang, axis=0)
    assert past.begins(rang + noise + offset, a)
    assert not past.begins(rang[::-1] + noise + offset, a)  # a mismatch that grows
    assert not past.begins(rang + noise + offset, -a)


@pytest.mark.parametrize("damping", [0.02, 0.05, 0.2])
def test_a_past_of_one_mode_has_its_two_states_however_long_it_rings(damping: float):
    """Where the mode has died out, rounding of the contour is left: it is no past."""
    exact = Contour.over(3000, RATE, EXACT)
    H = response(exact.s, poles(4.0, damping))
    u = np.zeros(3000)
    one = piece(u, np.zeros((3000, H.shape[1])))
    impulse = exact.record(H, exact.samples)
    found = Past.of_piece(one, np.arange(12, 225), impulse, exact, np.ones(1))
    assert found.shapes.shape[2] == 2


@pytest.mark.parametrize("lines", [(27,), (12, 15)])
def test_the_residual_of_pieces_that_share_a_change_is_what_no_change_and_nuisance_makes(
    lines: tuple[int, ...],
):
    """The projection with the nuisances of every piece in columns of their own, side by side."""
    rng = np.random.default_rng(3)
    q, b, m = 2, 3, 2
    n = sum(lines)

    def drawn(*shape: int) -> Complex:
        return rng.normal(size=shape) + 1j * rng.normal(size=shape)

    piece = np.repeat(np.arange(len(lines)), lines)
    k = np.arange(n)
    N = [drawn(own, q, m) for own in lines]
    X = drawn(n, b)
    rows = Rows((), drawn(n, q), N, [np.zeros(m)] * len(N), k + 1.0, k, piece, k)
    each = [on for on, *_ in rows.each()]
    group = Group.of(range(len(lines)), each, [as_real(X[on]) for on in each])
    left, free = residual_of(Free(rows, [group]), [SimpleNamespace(N=own) for own in N])  # type: ignore[misc]
    freedom = 0.0
    for c in range(q):
        own = linalg.block_diag(*(one[:, c] for one in N))
        A = as_real(np.concatenate([X, own], axis=1))
        Q = np.linalg.qr(A)[0]
        e = as_real(rows.e[:, c])
        np.testing.assert_allclose(as_real(left[:, c]), e - Q @ (Q.T @ e), atol=1e-9)
        freedom += 2 * n - A.shape[1]
    np.testing.assert_allclose(np.sum(free) * 2 * q, freedom, rtol=1e-9)


@pytest.mark.parametrize("likely", [0, 2, 3])
def test_columns_of_likely_amplitudes_are_left_as_in_the_noise_of_both(likely: int) -> None:
    rng = np.random.default_rng(5)
    X, r = rng.normal(size=(12, 3)) * [1e-3, 1.0, 30.0], rng.normal(size=12)
    prior = np.repeat([0.0, 1.0], [3 - likely, likely])
    left = Shrinking.of(X, prior).left(r)
    # Diffuse amplitudes: the limit of ever larger ones.
    sd = np.where(prior > 0, 1.0, 1e4 / np.linalg.norm(X, axis=0))
    both = np.eye(12) + (X * sd**2) @ X.T
    np.testing.assert_allclose(left @ left, r @ np.linalg.solve(both, r), rtol=1e-6)


def test_what_moved_the_rig_before_pieces_of_one_change_is_told_without_their_shapes_side_by_side():
    """By blocks as with the columns of every piece beside each other, zero in the others."""
    rng = np.random.default_rng(4)
    lines, q, before, beside = (7, 9), 2, (3, 2), (2, 4)

    def drawn(*shape: int) -> Complex:
        return rng.normal(size=shape) + 1j * rng.normal(size=shape)

    n = sum(lines)
    e, L = 20 * drawn(n, q), drawn(n, q, q)
    W = L.conj().swapaxes(1, 2) @ L
    change = drawn(n, 5)
    Q = np.linalg.qr(as_real(change))[0]
    at = np.split(np.arange(n), [lines[0]])
    blocks = [
        (own, drawn(own.size, q, a), drawn(own.size, q, b))
        for own, a, b in zip(at, before, beside, strict=True)
    ]
    wide = [np.zeros((n, q, sum(m)), complex) for m in (before, beside)]
    for i, (own, *both) in enumerate(blocks):
        for all_, one, counts in zip(wide, both, (before, beside), strict=True):
            all_[own, :, sum(counts[:i]) : sum(counts[: i + 1])] = one

    def beyond(x: Complex) -> Complex:
        flat = as_real(x.reshape(n, -1))
        return as_complex(flat - Q @ (Q.T @ flat)).reshape(x.shape)

    alike = likely(beyond(wide[0]), beyond(e), beyond(wide[1]), W)
    group = Group.of(range(2), at, [as_real(change[on]) for on in at])
    found = _past_of(group, [(a, b) for _, a, b in blocks], e, W)
    assert found is not None
    assert alike is not None
    np.testing.assert_allclose(found, alike, rtol=1e-9)


def test_a_long_stretch_is_several_pieces_with_the_input_before_each(monkeypatch):
    whole = recording()
    wired = without_loop(wiring([whole], SAMII))
    monkeypatch.setattr(pieces, "LONGEST", len(whole) // 3)
    found = pieces_of([whole], SAMII, wired)
    assert sum(len(p.z) for p in found) == len(whole)
    assert [p.history > 0 for p in found] == [False, True, True, True]
    v = whole.values[:, whole.column("v_2")]
    end = 0
    for p in found:
        end += len(p.z)
        np.testing.assert_array_equal(p.r, v[end - len(p.r) : end])


def test_the_samples_of_a_long_record_are_not_held_twice():
    """An hour of eight channels at 1 kHz is a quarter of a GB, as often as it is copied."""
    whole = recording()
    found = pieces_of([whole], SAMII, without_loop(wiring([whole], SAMII)))
    assert all(np.shares_memory(p.z, whole.values) for p in found if not p.struck)


def test_above_what_is_driven_noise_that_is_in_the_input_too_is_no_response():
    """Behind a loop that runs faster than the record the input has some of a sensor's noise."""
    a, left = poles(), {}
    for driven in (15.0, np.inf):
        each = []
        for seed in range(6):
            u, z = noisy(seed)
            noise = z - from_rest(u, a)
            part = signal.sosfilt(
                signal.butter(4, 15.0, "high", fs=RATE, output="sos"), noise[:, 0]
            )
            one = piece(u + 0.1 * part, z)
            records = Records((one,), RATE, ((0.8, 45.0),), driven=driven)
            found = reduced(records, lambda s: response(s, a), own_alone)
            each.append(float(found.target @ found.target) / found.known)
        left[driven] = np.mean(each)
    assert left[15.0] == pytest.approx(1.0, abs=0.15)
    assert left[np.inf] > 1.5


def test_an_offset_and_a_slow_wander_of_a_sensor_are_no_mismatch():
    u, z = noisy(3)
    t = np.linspace(-1, 1, len(z))
    records, found = likelihood(u, z + np.column_stack([0.5 + 0.3 * t**2, -2.0 * t**3]), poles())
    (left,) = residuals_by_line(records, lambda s: response(s, poles()), found)
    assert float(np.mean(left.chi2)) == pytest.approx(4.0, rel=0.15)


def test_how_noise_moves_a_mode_at_both_ends_of_a_record_is_no_change_of_the_mode():
    """A mode that rings longer than the record leaves as much at all lines as a change does."""
    a, n, before = poles(4.0, 0.004), 1500, 20_000
    off = poles(4.0 * 1.0001, 0.004)

    def disturbances(f: Float) -> Complex:
        H = response(2j * np.pi * f, a)
        return np.concatenate([own_alone(f), H[:, :, None]], axis=2)

    u, gained = sweep(n), []
    for seed in range(30):
        rng = np.random.default_rng(seed)
        pushed = from_rest(0.02 * rng.standard_normal(before + n), a)[before:]
        z = from_rest(u, a) + pushed + 1e-3 * rng.standard_normal((n, 2))
        records = Records((piece(u, z),), RATE, ((0.8, 15.0),))
        found = reduced(records, lambda s: response(s, a), disturbances)
        at = found.sigma + 2j * np.pi * found.frequency
        slope = found.slopes((response(at, off) - found.reference)[:, :, None])[:, 0]
        gained.append(float(slope @ found.target) ** 2 / float(slope @ slope))
    # 1 in the mean of chi-square with one degree of freedom, of 30: 0.26.
    assert np.mean(gained) == pytest.approx(1.0, abs=0.8)


def test_a_sensor_in_another_unit_changes_nothing():
    """Offsets and wandering of each are taken out, however large its numbers are."""
    u, z = noisy(7)
    z = z + np.linspace(-1, 1, len(z))[:, None] ** 2
    unit = np.array([1.0, 1e7])
    both = []
    for scale in (np.ones(2), unit):
        records = Records((piece(u, z * scale),), RATE, ((0.8, 15.0),))
        found = reduced(records, lambda s, scale=scale: response(s, poles()) * scale, own_alone)
        both.append((float(found.target @ found.target), found.inside[0]))
    np.testing.assert_allclose(both[1], both[0], rtol=1e-3)


def test_a_disturbed_mode_makes_noise_at_that_mode_and_nowhere_else():
    """In all sensors together, by the direction in which the rig answers a force."""
    rng = np.random.default_rng(5)
    f = np.linspace(2, 8, 600)

    def disturbances(g: Float) -> Complex:
        H = response(2j * np.pi * g, poles(4.0, 0.01))
        return np.concatenate([own_alone(g), H[:, :, None]], axis=2)

    H = disturbances(f)[:, :, 2]
    H_size = np.sqrt(np.median(np.abs(H) ** 2))
    white = (rng.standard_normal((f.size, 2)) + 1j * rng.standard_normal((f.size, 2))) / np.sqrt(2)
    pushed = (rng.standard_normal(f.size) + 1j * rng.standard_normal(f.size)) / np.sqrt(2)
    left = white + pushed[:, None] * H / H_size
    found = Noise.of(f, left, np.ones(f.size), one_piece(f), disturbances, white_rounding(0.0))
    C = found.covariance(f, one_piece(f))
    truth = np.eye(2) + H[:, :, None] * H[:, None, :].conj() / H_size**2
    ratio = np.linalg.eigvals(np.linalg.solve(truth, C)).real
    assert ratio.min() > 0.75
    assert ratio.max() < 1.3
    whitened = found.whitened(f, one_piece(f), left[:, :, None])
    assert np.mean(np.abs(whitened) ** 2) == pytest.approx(1.0, abs=0.05)


def test_a_force_at_a_place_that_is_held_makes_no_noise():
    """What it makes is rounding, that no power turns into noise of a few lines."""
    rng = np.random.default_rng(6)
    f = np.linspace(2, 8, 600)

    def disturbances(g: Float) -> Complex:
        H = response(2j * np.pi * g, poles(4.0, 0.01))
        return np.concatenate([own_alone(g), 1e-18 * H[:, :, None]], axis=2)

    left = rng.standard_normal((f.size, 2)) + 1j * rng.standard_normal((f.size, 2))
    left[np.abs(f - 4) < 0.05] *= 30  # as if that force had acted
    found = Noise.of(f, left, np.ones(f.size), one_piece(f), disturbances, white_rounding(0.0))
    assert np.all(found.power[2] == 0)


@pytest.mark.parametrize("corner", [0.0, 0.3, 2.0])
def test_a_sensor_that_wanders_is_as_loud_as_that_at_the_lowest_lines(corner: float):
    """In a short record, one sensor of two."""
    rng = np.random.default_rng(4)
    chi2 = []
    for _ in range(20):
        f = np.arange(2, 400) * 0.033
        truth = np.stack([1 + (corner / f) ** 2, np.ones(f.size)], axis=1)
        white = rng.standard_normal((f.size, 2)) + 1j * rng.standard_normal((f.size, 2))
        left = np.sqrt(truth / 2) * white
        found = Noise.of(f, left, np.ones(f.size), one_piece(f), own_alone, white_rounding(0.0))
        chi2.append(np.abs(found.whitened(f, one_piece(f), left[:, :, None])[:, :, 0]) ** 2)
    mean = np.mean(chi2, axis=0)
    for low, high in ((0, 5), (5, 15), (15, 50), (50, 398)):
        each = np.mean(mean[low:high], axis=0)
        np.testing.assert_allclose(each, 1.0, atol=0.35 if low == 0 else 0.2)


def test_noise_that_no_disturbance_makes_is_told_by_its_block():
    """Beside the sum, which knows of no hump; where the sum is right, blocks change nothing."""
    rng = np.random.default_rng(2)
    f = np.linspace(1, 30, 3000)
    left = (rng.standard_normal((f.size, 2)) + 1j * rng.standard_normal((f.size, 2))) / np.sqrt(2)
    plain = Noise.of(f, left, np.ones(f.size), one_piece(f), own_alone, white_rounding(0.0))
    assert len(plain.edges) == 0 or np.ptp(plain.about[:, 0, 0].real) < 0.5
    hump = (f > 10) & (f < 12)
    left[hump, 0] *= 5
    found = Noise.of(f, left, np.ones(f.size), one_piece(f), own_alone, white_rounding(0.0))
    C = found.covariance(f, one_piece(f))[:, 0, 0].real
    assert np.median(C[(f > 10.5) & (f < 11.5)]) == pytest.approx(25, rel=0.35)
    assert np.median(C[f > 15]) == pytest.approx(1, rel=0.25)


def test_noise_is_never_less_than_what_is_known_of_it():
    rng = np.random.default_rng(3)
    f = np.linspace(1, 30, 900)
    left = 0.1 * (rng.standard_normal((f.size, 2)) + 1j * rng.standard_normal((f.size, 2)))
    found = Noise.of(f, left, np.ones(f.size), one_piece(f), own_alone, white_rounding(1.0))
    assert np.linalg.eigvalsh(found.covariance(f, one_piece(f))).min() > 0.99


@pytest.mark.parametrize("sigma", [0.02, 0.1, 0.2, 0.4])
def test_a_rounding_error_repeats_itself_as_far_as_noise_does_not_dither_it(sigma: float):
    rng = np.random.default_rng(6)
    y = 40 * np.sin(np.linspace(0, 60, 20_000))
    a, b = (np.rint(y + sigma * rng.standard_normal(y.size)) for _ in range(2))
    common = float(np.mean((a - y) * (b - y))) * 12
    assert repeating(dithering(float(np.var(a - b)) / 2)) == pytest.approx(common, abs=0.06)


def rounded(y: Float, sigma: float) -> tuple[Float, Float]:
    """Power of the rounding of a motion in steps, as it is known beforehand and as it was."""
    rng, each = np.random.default_rng(8), []
    for place in rng.random(40):
        x = y + place + sigma * rng.standard_normal(y.size)
        each.append(np.abs(np.fft.rfft(np.rint(x) - x)) ** 2 / y.size)
    z = np.rint(y + sigma * rng.standard_normal(y.size))
    return read(y, z).power[:, 0], np.mean(each, axis=0)


def read(y: Float, z: Float) -> Rounding:
    """Of a motion y and what a converter of step 1 shows of it."""
    lines = np.arange(1, y.size // 2)
    return Rounding.of_piece(
        piece(np.zeros(y.size), z[:, None]), lines, np.ones(1), y[:, None], RATE
    )


def test_the_rounding_of_a_motion_that_repeats_itself_within_a_record_is_in_its_harmonics():
    y = 20 * np.sin(2 * np.pi * 20 * np.arange(4000) / 4000)  # 20 periods
    known, was = rounded(y, 0.0)
    harmonic = np.arange(20, 2000, 40)  # odd ones
    np.testing.assert_allclose(known[harmonic], was[harmonic], rtol=1.0, atol=0.02)
    assert np.mean(known[harmonic]) > 10 / 12
    assert np.max(known[np.arange(1, 2000, 20)]) < 0.01
    dithered, _ = rounded(y, 0.6)
    np.testing.assert_allclose(dithered, 1 / 12)


def test_a_part_at_rest_keeps_one_rounding_error_as_long_as_it_rests():
    y = np.repeat([0.0, 7.3, -4.1, 12.9, 3.2], 800)
    known, was = rounded(y, 0.02)
    low = slice(1, 5)
    assert np.mean(was[low]) > 100 / 12
    np.testing.assert_allclose(np.mean(known[low]), np.mean(was[low]), rtol=0.4)


def test_repeats_that_hardly_differ_have_the_same_rounding_error():
    assert repeating(dithering(0.0)) == pytest.approx(1.0, abs=5e-3)


def recording(n: int = 2000, level: float = 0.5, repeat: int = 0) -> Recording:
    names = ["v_2", *(s.name for s in SAMII.sensor)]
    rng = np.random.default_rng(repeat)
    values = 1e-3 * rng.standard_normal((n, len(names)))
    values[:, 0] = level * sweep(n)
    return Recording(
        tuple(Channel(x, "V") for x in names),
        SAMII.rate_hz,
        np.arange(n),
        np.arange(n),
        values,
        np.zeros(values.shape, np.int64),
        (Segment("sweep", "single", 0, n, level, "V", repeat),),
    )


def sweeping(u: Float, y: Float, *segments: Segment) -> Recording:
    """Of an input u (n,) and two sensors y (n, 2); one sweep if no segments are given."""
    whole = Segment("sweep", "single", 0, u.size, 1.0, "V", 0)
    return Recording(
        (Channel("v_2", "V", "command"), Channel("theta_2", "rad"), Channel("a_0", "m/s^2")),
        RATE,
        np.arange(u.size),
        np.arange(u.size),
        np.column_stack([u, y]),
        np.zeros((u.size, 3), np.int64),
        segments or (whole,),
    )


def without_loop(wired: Wiring) -> Wiring:
    return replace(wired, inputs=tuple(Input(x.command) for x in wired.inputs))


def test_records_of_proportional_inputs_are_one_with_the_noise_of_one():
    runs = [recording(level=x, repeat=i) for i, x in enumerate((0.5, 0.5, 1.0))]
    wired = without_loop(wiring(runs, SAMII))
    (one,) = pieces_of(runs, SAMII, wired)
    assert (len(one.repeats), len(one.contrasts)) == (1, 1)
    power = sum(float(np.sum(r.values[:, 0] ** 2)) for r in runs)
    assert float(one.r @ one.r) == pytest.approx(power, rel=1e-6)
    for other in (*one.repeats, *one.contrasts):
        assert float(other.r @ other.r) < 1e-6 * power
        assert np.std(other.z) == pytest.approx(1e-3, rel=0.05)


def test_bursts_in_a_row_are_predicted_however_long_the_rig_rings():
    """A mode that rings for a minute, under a burst every 5 s: a piece knows the burst before its
    own, and not those before that."""
    n, bursts, sd = 1000, 8, 0.02
    u = np.tile(np.concatenate([sweep(800), np.zeros(200)]), bursts)
    mode = poles(4.0, 0.002)
    y = from_rest(u, mode) + sd * np.random.default_rng(6).standard_normal((u.size, 2))
    each = (Segment(f"burst_{i}", "burst", i * n, (i + 1) * n, 1.0, "V", i) for i in range(bursts))
    run = sweeping(u, y, *each)
    wired = without_loop(wiring([run], SAMII))
    found = pieces_of([run], SAMII, wired)
    assert [(p.moving, len(p.repeats)) for p in found] == [(False, 0), (False, 0), (True, 5)]
    records = Records(tuple(found), RATE, ((0.8, 15.0),) * 3)
    form = reduced(records, lambda s: response(s, mode), own_alone)
    assert float(form.target @ form.target) / form.known == pytest.approx(1.0, abs=0.25)
    (left,) = residuals_by_line(records, lambda s: response(s, mode), form)
    assert float(np.mean(left.chi2)) == pytest.approx(4.0, rel=0.15)
    f = np.arange(2.0, 13.0)
    power = np.trace(form.noise.covariance(f, one_piece(f)), axis1=1, axis2=2).real
    assert np.mean(power) == pytest.approx(2 * sd**2, rel=0.15)


def without_samples(run: Recording, *lost: slice) -> Recording:
    at = np.delete(np.arange(len(run)), np.concatenate([np.arange(len(run))[x] for x in lost]))
    return replace(
        run,
        time=run.time[at],
        sequence=run.sequence[at],
        values=run.values[at],
        quality=run.quality[at],
    )


def test_a_piece_goes_on_across_a_gap_and_across_missing_samples():
    run = recording()
    run.quality[700:720, 2] = Quality.MISSING
    run = without_samples(run, slice(1300, 1350))
    (one,) = pieces_of([run], SAMII, wiring([run], SAMII))
    assert (len(one.z), one.moving) == (2000, False)
    assert one.lost == ((700, 720), (1300, 1350))


def test_a_segment_that_ends_or_begins_within_a_gap_has_none_of_its_samples():
    u = sweep(2000)
    each = (Segment(f"part_{i}", "single", i * 1000, (i + 1) * 1000, 1.0, "V", i) for i in (0, 1))
    run = without_samples(sweeping(u, from_rest(u, poles()), *each), slice(990, 1010))
    found = pieces_of([run], SAMII, without_loop(wiring([run], SAMII)))
    assert [(len(p.z), p.lost) for p in found] == [(990, ()), (990, ())]


def test_a_gap_of_more_than_a_second_begins_a_piece():
    run = without_samples(recording(4000), slice(300, 310), slice(900, 2000))
    found = pieces_of([run], SAMII, wiring([run], SAMII))
    assert [(len(p.z), p.history, p.lost) for p in found] == [
        (900, 0, ((300, 310),)),
        (2000, 0, ()),
    ]


def test_a_gap_in_which_the_input_is_a_guess_begins_a_piece():
    run = without_samples(recording(), slice(800, 900))  # half a second of a sweep at its resonance
    found = pieces_of([run], SAMII, wiring([run], SAMII))
    assert [(len(p.z), p.history, p.lost) for p in found] == [(800, 0, ()), (1100, 0, ())]


def test_a_recording_without_a_sound_sample_has_no_piece():
    one, none = recording(), recording(repeat=1)
    none.quality[:, 2] = Quality.MISSING
    found = pieces_of([one, none], SAMII, wiring([one, none], SAMII))
    assert [(len(p.z), len(p.repeats)) for p in found] == [(2000, 0)]


def test_what_was_long_before_a_periodic_excitation_is_not_its_settling():
    u = np.concatenate([np.zeros(3000), np.tile(sweep(400), 3)])
    own = Segment("multisine", "periodic", 3400, 4200, 1.0, "V", 0)
    run = sweeping(u, np.zeros((u.size, 2)), own)
    (one,) = pieces_of([run], SAMII, without_loop(wiring([run], SAMII)))
    assert (len(one.z), one.history) == (1600, 1600)


def test_where_many_samples_are_missing_each_gap_begins_a_piece():
    run = recording(6000)
    run.quality[300::300, 2] = Quality.CLIPPED
    found = pieces_of([run], SAMII, wiring([run], SAMII))
    assert [(len(p.z), p.history, p.lost) for p in found] == [
        (300, 0, ()),
        *[(299, 0, ())] * 19,
    ]


def test_a_long_stretch_with_a_gap_is_cut_beside_it(monkeypatch):
    monkeypatch.setattr(pieces, "LONGEST", 1000)
    run = without_samples(recording(2000), slice(990, 1010))
    found = pieces_of([run], SAMII, wiring([run], SAMII))
    assert [(len(p.z), p.history, p.lost) for p in found] == [
        (1010, 0, ((990, 1010),)),
        (990, 0, ()),
    ]


@pytest.mark.parametrize("lost", [3, 10, 30])
def test_a_record_with_a_gap_loses_no_more_than_its_samples(lost: int):
    """Wherever a sweep is, just behind the resonance too, where all that the mode does later
    depends on how it moved before."""
    u, sd, kept, chi2 = sweep(3000), 0.02, [], []
    there = from_rest(u, poles()) - from_rest(u, poles(4.002))
    for seed, first in enumerate((600, 1000, 1400, 1800)):
        z = from_rest(u, poles()) + sd * np.random.default_rng(seed).standard_normal((u.size, 2))
        run = without_samples(sweeping(u, z), slice(first, first + lost))
        (one,) = pieces_of([run], SAMII, without_loop(wiring([run], SAMII)))
        assert (len(one.z), one.lost) == (3000, ((first, first + lost),))
        records = Records((one,), RATE, ((0.8, 15.0),))
        form = reduced(records, lambda s: response(s, poles(4.002)), own_alone)
        at = form.sigma + 2j * np.pi * form.frequency
        before = float(form.target @ form.target)
        after = float(np.sum(form.residual(response(at, poles())) ** 2))
        known = np.delete(there, slice(first, first + lost), axis=0)
        kept.append((before - after) / (np.sum(known**2) / sd**2))
        chi2.append(after / form.known)
    assert 0.81 < np.mean(kept) < 1.15
    assert np.mean(chi2) == pytest.approx(1.0, abs=0.2)


@pytest.mark.parametrize("lost", [1, 10, 30])
def test_lost_samples_of_a_sweep_follow_from_those_beside_them(lost: int):
    u = sweep(3000)
    for first in (200, 1000, 2500):
        x = u.copy()
        x[first : first + lost] = 0.0
        values, off = bridged(x, first, first + lost)
        np.testing.assert_allclose(values, u[first : first + lost], atol=1e-4)
        assert np.all(off < 1e-3)


def test_of_lost_samples_of_noise_it_is_said_how_far_off_they_may_be():
    rng = np.random.default_rng(3)
    u = signal.sosfilt(signal.butter(4, 0.2, output="sos"), rng.standard_normal(20_000))
    error, off = [], []
    for first in range(1000, 19_000, 300):
        x = u.copy()
        x[first : first + 8] = 0.0
        values, sd = bridged(x, first, first + 8)
        error.append(values - u[first : first + 8])
        off.append(sd)
    assert np.std(error) == pytest.approx(np.sqrt(np.mean(np.square(off))), rel=0.2)
    assert np.std(error) > 0.1 * np.std(u)


def test_a_periodic_excitation_is_a_record_from_where_it_begins_to_settle():
    u = np.tile(sweep(400), 6)
    settled = Segment("multisine", "periodic", 800, 2000, 1.0, "V", 0)  # two periods before it
    other = Segment("multisine", "periodic", 2100, 2400, 1.0, "V", 1)
    run = sweeping(u, np.zeros((u.size, 2)), settled, other)
    found = pieces_of([run], SAMII, without_loop(wiring([run], SAMII)))
    assert [(len(p.z), p.history, p.moving) for p in found] == [
        (2000, 0, False),
        (400, 400, True),
    ]


def test_a_record_with_two_commands_has_two_inputs_and_each_has_its_loop():
    rig = load_rig("samii_two_joints")[0]
    one = recording()
    run = replace(
        one,
        channels=(Channel("v_3", "V", "command"), *one.channels),
        values=np.column_stack([one.values[:, 0], one.values]),
        quality=np.zeros((len(one), len(one.channels) + 1), np.int64),
    )
    assert [x.command for x in wiring([run], rig).inputs] == ["v_2", "v_3"]
    assert wiring([one], rig).only.command == "v_2"


def test_the_mains_are_no_mismatch_between_lines_too():
    u, z = noisy(4)
    t = np.arange(len(z)) / RATE
    hum = np.column_stack(
        [0.3 * np.sin(2 * np.pi * 50.013 * t), 0.1 * np.cos(2 * np.pi * 50.013 * t)]
    )
    records = [Records((piece(u, x),), RATE, ((0.8, 70.0),)) for x in (z, z + hum)]
    plain, humming = (
        residuals_by_line(
            r, lambda s: response(s, poles()),
            reduced(records[0], lambda s: response(s, poles()), own_alone),
        )[0]
        for r in records
    )  # fmt: skip
    near = np.abs(plain.frequency - 50) < 2
    assert np.mean(humming.chi2[near]) / 4 == pytest.approx(1.0, abs=0.25)
    np.testing.assert_allclose(humming.chi2[~near], plain.chi2[~near], rtol=0.5, atol=1.0)


def test_a_part_that_rests_elsewhere_after_a_motion_has_not_moved_within_a_step():
    y = np.concatenate([np.zeros(500), np.linspace(0, 100, 400), np.full(500, 100.0)])
    still = np.sum(read(y, y).factors[0], axis=0)
    assert np.max(np.abs(still)) < 3  # steps, as far as a motion that counts as still


def test_a_motion_that_is_within_few_steps_for_some_samples_has_no_part_without_motion():
    i = np.arange(2000)
    y = (1.49 + 2.13e-5 * (i - 1000.0) ** 2) * np.sin(2 * np.pi * i / 7)
    found = read(y, y)
    assert np.all(np.sum(found.factors[0] ** 2, axis=1) > 0)
    assert np.all(np.isfinite(found.power))


def test_a_sensor_that_falls_with_the_frequency_covers_no_mode_of_another_one() -> None:
    """As SAMII's encoder at its first mode, of which its accelerometers see less than of others."""
    contour = Contour(24_000, 500.0, SMOOTH / 24_000)
    s, mode = contour.s, 2 * np.pi * 1.65
    a = s**2 * (0.2 + mode**2 / (s**2 + 2 * 0.03 * mode * s + mode**2))
    angle = 1 / (s + 1.0)
    near = 1.65 + 0.1 * np.array([-1.0, 1.0])  # Hz, twice the mode's half width

    def nodes(H: Complex, *, spare: bool) -> int:
        f = contour.frequency[nodes_of(contour, H, (0.3, 20.0), spare=spare)]
        return int(np.count_nonzero((f > near[0]) & (f < near[1])))

    for spare in (False, True):
        alone, both = a[:, None], np.stack([angle, a], axis=1)
        found = nodes(both / size_about(both), spare=spare)
        assert found >= 0.7 * nodes(alone / size_about(alone), spare=spare)
        assert found > nodes(both / np.median(np.abs(both[15:960]), axis=0), spare=spare)


@pytest.mark.parametrize("sd", [0.0, 0.1, 0.3])
def test_repeats_tell_what_dithers_a_sensor_that_crosses_few_steps(sd: float) -> None:
    """What a reference leaves of them does not: their error is alike, and of several times the
    power of one that is white."""
    y = 0.6 * np.sin(2 * np.pi * np.arange(8000) / 61)
    rng = np.random.default_rng(3)
    each = [np.rint(y + sd * rng.standard_normal(y.size)) for _ in range(3)]
    whole = np.sum(each, axis=0) / np.sqrt(3)
    others = [(each[0] - each[1]) / np.sqrt(2), (each[0] + each[1] - 2 * each[2]) / np.sqrt(6)]
    samples = tuple(Samples(np.zeros(y.size), z[:, None]) for z in others)
    of = replace(piece(np.zeros(y.size), whole[:, None]), repeats=samples)
    assert dithered(of, np.ones(1))[0] == pytest.approx(sd, abs=0.12)
    found = Rounding.of_piece(of, np.arange(1, 4000), np.ones(1), np.sqrt(3) * y[:, None], RATE)
    assert 0 in found.draws  # it is tried, and not taken for white


def test_a_sensor_that_rests_for_a_while_stands_at_one_place_in_its_step() -> None:
    """Each second by itself it would stand anywhere while it rests; one that wanders does."""
    i = np.arange(40 * int(RATE))
    y = np.where(i % (2 * int(RATE)) < RATE, 0.0, 4 * np.sin(2 * np.pi * i / 61))
    for place in (0.0, 0.3, 0.45):
        moved = _wandering(y, np.rint(y + place), int(RATE))
        assert np.all(moved == 0.0)
    slow = 0.8 * np.sin(2 * np.pi * i / i.size)
    always = 4 * np.sin(2 * np.pi * i / 61)
    moved = _wandering(always, np.rint(always + slow), int(RATE))
    assert np.abs(np.mean(np.exp(2j * np.pi * (moved - slow)))) > 0.9  # places are of a circle


@pytest.mark.parametrize("size", [1.5, 2.5, 4.0])
def test_the_rounding_of_a_motion_that_follows_the_input_is_no_change_of_the_response(size: float):
    """Steps of the input: each is followed by the same motion, of three to eight steps of a
    converter, and by the same error. Taken for independent from line to line, 1.7 to 2.1."""
    left, denominator = [], poles(damping=0.08)
    for seed in range(6):
        rng = np.random.default_rng(seed)
        u = np.repeat(rng.choice([-1.0, 1.0], 20), 400)
        z = from_rest(u, denominator)
        z[:, 0] = np.rint(z[:, 0] / size + rng.random()) * size
        z[:, 1] += 1e-2 * rng.standard_normal(u.size)
        records = Records((piece(u, z),), RATE, ((0.8, 15.0),), (size, 0.0))
        found = reduced(records, lambda s: response(s, denominator), own_alone)
        left.append(float(found.target @ found.target) / found.known)
    assert 0.7 < np.mean(left) < 1.1


def coarse(u: Float, denominator: Float, place: float, rng: np.random.Generator) -> Piece:
    """What a converter of steps of 2 shows of a motion that rests at a place in its step."""
    z = from_rest(u, denominator)
    z[:, 0] = np.rint(z[:, 0] / 2 + place) * 2 - 2 * place
    z[:, 1] += 1e-2 * rng.standard_normal(u.size)
    return replace(piece(u, z), commands=(pieces.Command(u, 1.0, (MeterNoise(),)),))


def test_what_rests_at_one_place_in_its_step_is_rounded_alike_in_all_records():
    """One motion in several records and at two levels, some of them joined. Each by itself, the
    levels taken for one larger motion, 1.5."""
    left, denominator = [], poles(damping=0.08)
    for seed in range(8):
        rng = np.random.default_rng(seed)
        u, place = np.repeat(rng.choice([-1.0, 1.0], 20), 400), rng.random()
        parts = (u, 0.63 * u, u[:-9], 0.63 * u[:-50])
        found = tuple(pieces.joined([coarse(x, denominator, place, rng) for x in parts]))
        assert [len(p.commands) for p in found] == [2, 1, 1]
        records = Records(found, RATE, ((0.8, 15.0),) * 3, (2.0, 0.0))
        form = reduced(records, lambda s: response(s, denominator), own_alone)
        left.append(float(form.target @ form.target) / form.known)
    assert 0.6 < np.mean(left) < 1.15, left


def test_the_rounding_of_what_wanders_in_its_step_follows_what_is_read():
    """A joint that nothing holds wanders by one step in a record. Taken for at rest, 1.6."""
    left, denominator = [], poles(damping=0.08)
    for seed in range(6):
        rng = np.random.default_rng(seed)
        u = sweep(12_000)
        z = from_rest(u, denominator)
        size = 0.6 * np.std(z[:, 0])
        wander = 0.6 * np.sin(2 * np.pi * (np.arange(u.size) / u.size + rng.random()))
        z[:, 0] = (np.rint(z[:, 0] / size + wander) - wander) * size
        z[:, 1] += 1e-2 * rng.standard_normal(u.size)
        records = Records((piece(u, z),), RATE, ((0.8, 15.0),), (size, 0.0))
        found = reduced(records, lambda s: response(s, denominator), own_alone)
        left.append(float(found.target @ found.target) / found.known)
    assert 0.6 < np.mean(left) < 1.15, left


def test_a_spike_that_a_fast_motion_hides_shows_beside_the_prediction():
    """At a third of the rate a cubic through the neighbours misses every sample by as much."""
    denominator, rng = poles(frequency=30.0, damping=0.02), np.random.default_rng(3)
    u = sweep(4000, 20.0, 34.0)
    z = from_rest(u, denominator)
    sd = 0.01 * np.std(z, axis=0)
    z += sd * rng.standard_normal(z.shape)
    struck = z.copy()
    struck[2500, 1] += 40 * sd[1]
    assert not mended(struck, np.zeros(2))[1]
    records = Records((piece(u, struck),), RATE, ((20.0, 34.0),))
    H = response(records.exact().s, denominator)
    (found,) = records.without_spikes(H).pieces
    assert np.abs(found.z[2500, 1] - z[2500, 1]) < 6 * sd[1]
    np.testing.assert_array_equal(np.delete(found.z, 2500, axis=0), np.delete(z, 2500, axis=0))


@pytest.mark.parametrize("every", [1, 2, 3, 7, 10, 16, 64])
def test_one_line_in_ten_is_kept_apart_of_any_comb(every: int):
    k = np.arange(every, 400 * every, every)
    assert np.mean(_shown(k)) == pytest.approx(0.1, abs=0.03)
    assert np.array_equal(fitted_lines(k), ~_shown(k))


@pytest.mark.parametrize("last", [3000, 20 + 256 * 10 + 1])  # and a block of one line
def test_what_is_far_from_a_block_of_lines_is_known_from_a_few_points(last: int) -> None:
    """A change in each node as its own response: the record of each, transformed."""
    n, history, lines = 9000, 400, np.arange(20, last)
    contour = Contour.over(n + history, RATE, SMOOTH)
    r = np.random.default_rng(5).normal(size=n + history)
    nodes = np.unique(np.geomspace(30, 6300 * contour.samples / (2 * n), 40).astype(np.int64))
    nodes = nodes[nodes <= contour.samples // 2]
    got = columns(contour, contour.damped(r)[None], nodes, history, n, lines)[0]
    for j in (0, 7, nodes.size - 2):
        H = np.zeros((contour.samples // 2 + 1, 1), complex)
        at = np.arange(nodes[0], nodes[-1] + 1)
        H[at, 0] = np.interp(at, nodes, np.eye(nodes.size)[j])
        y = contour.predicted(H, r)[history:]
        want = np.fft.rfft(y, axis=0)[lines, 0]
        assert np.max(np.abs(got[:, j] - want)) < 1e-8 * np.max(np.abs(want))
