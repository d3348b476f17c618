"""What is in a record beside response and noise, up to amplitudes that nobody knows.

Each is a shape over the lines and sensors of one piece with one real amplitude. The likelihood is
that of the best amplitudes, which for diffuse Gaussian ones is the marginal likelihood.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import lru_cache

import numpy as np
from numpy.polynomial import legendre
from scipy import ndimage, signal

from samii_rig.likelihood.algebra import by_input
from samii_rig.likelihood.contour import Contour
from samii_rig.likelihood.pieces import Loops, Piece
from samii_rig.types import Complex, Float, Int

WANDER = 3  # degree of the polynomial that a sensor wanders by within a piece
# Hz of the mains in any country, how far they stray (EN 50160: 1 % for 99.5 % of a year), and their
# multiples that a rectifier or a motor drive makes of them.
MAINS, STRAY, MULTIPLES = (50.0, 60.0), 0.01, (1, 2, 3)
# Over the median of its neighbours, power of a line that stands out: noise does so at one in 4,000.
STANDS, HUM_BESIDE = 12.0, 20

# Of the rate, up to where records are used: aliases of both sides meet above.
HIGHEST = 0.45
# Shapes of an edge within a sample, which leave 2e-4 of any, and the samples on either side that
# make them as well; lines, instants and oscillations, more than they tell apart.
WITHIN, TAPS, LINES = 7, 24, 64

# Shapes of a meter's noise in one piece: of many pulses each has fewer, one at least, those that
# lines show most.
METERED = 400

# Power, of that of the shape which the lines show most, of one in lost samples that is looked at:
# of what the reference leaves beside a straight line, 100 times the noise where much is amiss.
SHAPE_SHOWN = 1e-5


def wander(n: int, k: Int, q: int) -> Complex:
    """(n_lines, q, WANDER q) of each sensor's own slow drift."""
    t = np.linspace(-1, 1, n)
    shapes = np.asarray(legendre.legvander(t, WANDER)[:, 1:], np.float64)
    return _by_sensor(shapes, k, q)


def _by_sensor(shapes: Float, k: Int, q: int) -> Complex:
    """(n_lines, q, q m) of shapes (n, m) in time, each sensor's of its own amplitude."""
    spectra = np.fft.rfft(shapes, axis=0)[k]
    out = np.zeros((k.size, q, q, shapes.shape[1]), complex)
    for c in range(q):
        out[:, c, c] = spectra
    return out.reshape(k.size, q, -1)


def offsets(piece: Piece, k: Int, steps: Sequence[Float]) -> Complex:
    """(n_lines, q, m) of every input that has an offset, and of every loop's sensor that has one:
    all act from the first sample on.

    steps : (m, q) what the sensors show of a step of each.
    """
    return np.stack([np.fft.rfft(y[piece.history :], axis=0)[k] for y in steps], axis=2)


def edges(piece: Piece, k: Int, impulse: Float, folded: Sequence[Float] = ()) -> Complex:
    """(n_lines, q, m) of the input's edges, which came some part of a sample earlier or later: an
    impulse each; of two that follow one another, all that an edge between them may be.

    impulse : (m, q) answer to an impulse of the input; (m, q inputs) of several. folded : as of
    `folding`.
    """
    every = set(piece.edges)
    between = [(at, of) for at, of in piece.edges if (at + 1, of) in every]
    alone = [(a, of) for a, of in piece.edges if not {(a - 1, of), (a + 1, of)} & every]
    out = [_after(piece, k, impulse, alone)]
    if between:
        first = [(at + 1 - TAPS, of) for at, of in between]
        shapes = (signal.upfirdn(taps, impulse, axis=0) for taps in _within().T)
        out += [_after(piece, k, one, first) for one in shapes]
        second = [(at + 1, of) for at, of in between]
        out += [_after(piece, k, one, second) for one in folded]
    return np.concatenate(out, axis=2)


def folding(impulse: Float, fine: Float, every: int) -> tuple[Float, ...]:
    """Shapes (m, q) or (m, q inputs), from the second of two samples on, of what an edge between
    them excites above half the rate, and what folds back from there: a jump at the second less that
    of a record as `impulse` answers it, and an impulse at each of the rig's samples between.

    impulse : as of `edges`. fine : (m every, q) or (m every, q inputs) answer to an impulse of a
    sample of the rig, of which every so-manieth was recorded.
    """
    jump = np.cumsum(fine, axis=0)[::every]
    jump -= np.cumsum(impulse[: len(jump)], axis=0)
    return (jump, *(fine[every - late :: every] for late in range(1, every)))


@lru_cache(maxsize=1)
def _within() -> Float:
    """(2 TAPS, WITHIN) impulses, the samples from 1 - TAPS to TAPS, which make up to `HIGHEST` of
    the rate what an input has of more than its samples where another begins between 0 and 1: the
    largest parts of oscillations of any frequency up to there that begin at any tau, less the
    interpolation of what is sampled of them. A jump is one of none, a turn the slope along it."""
    f = (np.arange(LINES) + 0.5) * (HIGHEST / LINES)
    tau = (np.arange(LINES) + 0.5) / LINES
    s = 2j * np.pi * f[:, None]
    begins = 2j * np.pi * np.arange(LINES) * (HIGHEST / LINES)  # between the lines: no pole is met
    z = (s - np.concatenate([begins, -begins]))[:, :, None]
    begun = np.exp(-z) / (1 - np.exp(-z)) - np.exp(-z * tau) / z
    one, other = np.split(begun.reshape(LINES, -1), 2, axis=1)
    real = np.hstack([one + other, (one - other) / 1j])  # cosines and sines
    impulses = np.exp(-s * np.arange(1 - TAPS, 1 + TAPS))
    every, impulses = (np.concatenate([x.real, x.imag]) for x in (real, impulses))
    parts = np.linalg.svd(every, full_matrices=False)[0][:, :WITHIN]
    return np.asarray(np.linalg.lstsq(impulses, parts, rcond=None)[0])


def lost(piece: Piece, k: Int, impulse: Float) -> Complex:
    """(n_lines, q, m) of all motion in the samples that a piece has lost, and of their input where
    that is unknown: impulses, as many as the lines tell apart.

    impulse : as of `edges`.
    """
    n, q = piece.z.shape
    out = [np.zeros((k.size, q, 0), complex)]
    for first, behind in piece.lost:
        shapes = _shown(behind - first, n, int(k[0]), int(k[-1] - k[0]) + 1)
        inside = np.zeros((n, shapes.shape[1]))
        inside[first:behind] = shapes
        out.append(_by_sensor(inside, k, q))
        if (first, behind) in piece.unknown:
            at = np.linspace(first, behind - 1, shapes.shape[1]).astype(np.int64)
            each = ((int(i), j) for i in at for j in range(piece.inputs))
            out.append(_after(piece, k, impulse, [(piece.history + i, j) for i, j in each]))
    return np.concatenate(out, axis=2)


def metered(piece: Piece, k: Int, impulse: Float) -> Complex:
    """(n_lines, q, m) of a meter's noise on inputs that are pulses, while these last: white, so
    that shapes that do not overlap have independent amplitudes, each of standard deviation 1.

    impulse : as of `edges`.
    """
    n, q = piece.z.shape
    out = [np.zeros((k.size, q, 0), complex)]
    for j, r in enumerate(by_input(piece.r)):
        each = [(told.part, told.meter[j]) for told in piece.commands]
        if not each or any(math.isnan(noise.folds) for _, noise in each):
            continue
        sd = math.sqrt(sum((part * noise.shown) ** 2 for part, noise in each))
        lasts = r != np.median(r)
        for first, behind in piece.lost:
            lasts[piece.history + first : piece.history + behind] = False
        pulses = [one for (one,) in ndimage.find_objects(ndimage.label(lasts)[0])]
        moved: dict[int, list[Float]] = {}
        for one in pulses:
            size = one.stop - one.start
            if size not in moved:
                shapes = _shown(size, n, int(k[0]), int(k[-1] - k[0]) + 1)
                most = max(METERED // (len(pulses) * piece.inputs), 1)
                shapes = sd * shapes[:, -most:, None]
                moved[size] = [
                    signal.fftconvolve(impulse, shapes[:, i], axes=0)[: len(impulse)]
                    for i in range(shapes.shape[1])
                ]
            out += [_after(piece, k, y, [(one.start, j)]) for y in moved[size]]
    return np.concatenate(out, axis=2)


def _after(piece: Piece, k: Int, impulse: Float, each: Sequence[tuple[int, int]]) -> Complex:
    """(n_lines, q, m) of impulses at some samples of r, of some inputs. impulse : as of `edges`."""
    q = piece.z.shape[1]
    out = np.zeros((k.size, q, len(each)), complex)
    for j, (at, of) in enumerate(each):
        own = impulse[max(-at, 0) : max(len(piece.r) - at, 0), of :: piece.inputs]
        y = np.zeros((len(piece.r), q))
        y[max(at, 0) :][: len(own)] = own
        out[:, :, j] = np.fft.rfft(y[piece.history :], axis=0)[k]
    return out


@lru_cache(maxsize=32)
def _shown(g: int, n: int, first: int, count: int) -> Float:
    """Shapes (g, m) over g samples of n of which `count` lines from the `first` on show any:
    those of Slepian, one for each half period of the band and some more."""
    turn = 2 * np.pi / n * np.outer(np.arange(g), first + np.arange(count))
    lines = np.concatenate([np.cos(turn), np.sin(turn)], axis=1)
    values, shapes = np.linalg.eigh(lines @ lines.T)
    kept = values > SHAPE_SHOWN * values[-1]
    return np.asarray(shapes[:, kept])


def hum(left: Complex, k: Int, rate_hz: float, n: int) -> Complex:
    """(n_lines, q, 4 q m) of m lines of the mains that stand out in some sensor, each sensor's of
    its own phase and, slowly, of its own swelling.

    left : (n//2 + 1, q) spectrum of what the reference leaves of n samples. k : lines that count.
    """
    q = left.shape[1]
    t = np.linspace(-1, 1, n)
    out = []
    for tone in _tones(left, k, rate_hz / n):
        wave = np.exp(2j * np.pi * tone / n * np.arange(n))
        shapes = np.stack([wave.real, wave.imag, t * wave.real, t * wave.imag], axis=1)
        out.append(_by_sensor(shapes, k, q))
    return np.concatenate(out, axis=2) if out else np.zeros((k.size, q, 0), complex)


def _tones(left: Complex, k: Int, step: float) -> list[float]:
    """Where the mains' lines stand, in lines of a spectrum `step` Hz apart."""
    power = np.abs(left) ** 2
    nyquist = step * (len(power) - 1)
    found = []
    for f in sorted({m * mains for mains in MAINS for m in MULTIPLES}):
        folded = abs(f - 2 * nyquist * round(f / (2 * nyquist)))
        low, high = ((folded + sign * STRAY * f) / step for sign in (-1, 1))
        first, last = max(int(np.floor(low)), 1), min(int(np.ceil(high)), len(power) - 2)
        # Beyond an octave above the band what leaks into it is smooth and small.
        if first >= last or first > 2 * k[-1] or last < k[0]:
            continue
        beside = np.r_[max(first - HUM_BESIDE, 1) : first, last + 1 : last + 1 + HUM_BESIDE]
        floor = np.median(power[beside[beside < len(power)]], axis=0)
        over = power[first : last + 1] / np.where(floor > 0, floor, np.inf)
        at, sensor = np.unravel_index(int(np.argmax(over)), over.shape)
        if over[at, sensor] > STANDS:
            a, b, c = left[first + at - 1 : first + at + 2, sensor]
            # Between the lines: Jacobsen and Kootsookos 2007, IEEE Signal Process. Mag. 24(3).
            found.append(float(first + at + np.clip(((a - c) / (2 * b - a - c)).real, -0.5, 0.5)))
    return found


def unread(
    piece: Piece, k: Int, factors: Mapping[int, Float], H: Complex, contour: Contour, loops: Loops
) -> Complex:
    """(n_lines, q, m) of motion that a converter hardly reads, as it stays within few steps:
    rounding scales it by a factor that nobody knows, and the loop is told so.

    factors : of each sensor (p, n) parts of its motion. H : (M//2 + 1, q) from the input on the
    contour; (M//2 + 1, q m) of m inputs.
    """
    n, q = piece.z.shape
    out = []
    for i, parts in factors.items():
        for spectrum in np.fft.rfft(parts, axis=1)[:, k]:
            seen = np.zeros((k.size, q), complex)
            seen[:, i] = spectrum
            for kp, sensor, of in loops:
                if sensor == i:
                    there = np.round(k * (contour.samples / n)).astype(np.int64)
                    seen -= kp * H[there, of :: piece.inputs] * spectrum[:, None]
            out.append(seen)
    return np.stack(out, axis=2) if out else np.zeros((k.size, q, 0), complex)
