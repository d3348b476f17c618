"""What a converter's steps add to the noise, known before anything is measured.

A rounding error is white, of step^2/12, where noise dithers it or the motion crosses steps in any
order. Elsewhere it is what the motion makes of it:
- A motion that repeats itself, within a record or from one to the next, repeats the error too, but
  for what noise of sd sigma dithers: of harmonic h of a sawtooth, 6/(pi h)^2 of its power,
  exp(-(2 pi h sigma/step)^2) is the same in all repeats (Widrow and Kollar 2008, Quantization
  Noise, ch. 4). A motion that rests keeps one error as long as it rests.
- Where the motion stays within few steps, what is read is not in proportion to it, but for noise
  that dithers it: of the sawtooth's first harmonic exp(-2 (pi sigma/step)^2) is left.
- A loop closed around the sensor makes the motion follow the error, too. At lines where such a
  motion stays within few steps nothing is read: so much noise of the sensor's own stands in the
  error's place (`cover`) that its lines tell nothing, and those of all others what they tell beside
  the command as it was recorded. Where it rests, it rests anywhere within its step.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np
from scipy import ndimage, optimize, signal

from samii_rig.likelihood.pieces import Piece
from samii_rig.signal.steps import CROSSED_IN, FEW, crossed
from samii_rig.types import Complex, Float, Int

WHITE = 1 / 12  # of a step, squared
HARMONIC = np.arange(1.0, 200.0)  # of a sawtooth: all but 0.3 % of its power
STILL = 1e-3  # steps, rms of a motion that has no factor worth estimating
ALIKE = 0.05  # of a rounding error, that repeats itself: repeats do not show it
UNREAD = 6  # parts in which what is hardly read has a factor of its own
# Of a step, noise sd from which a rounding error is white: the first harmonic of a sawtooth is the
# same to 0.7 % from here on.
DITHERED = 0.5
UNSEEN = 0.05  # of a staircase's error, what dithering leaves of it that nobody sees
# Times by which what rounding adds may differ between pieces of one group, and how many groups are
# distinguished at most: each has bins of its own.
GROUPS_APART, GROUPS = 1.5, 8
# s for which what wanders, below the band, rests in its step: some periods of the band, from which
# its place is determined.
RESTS_IN_STEP = 1.0
WANDERS = 2.0  # times that one place for all leaves more than one a second, of what does not rest
# Times its power, by which a rounding error is covered where it is not read: of what it does as the
# motion does, at most all of it, 1e-4 is left.
COVERS = 1e4
OFFSETS = 16  # places of a motion in its step, at which its rounding is tried: within 25 % a line
ALIKE_OVER = 1.0  # Hz, over which a rounding error's power is spread by what wanders
AT_REST = 0.5  # steps, within which a motion rests
LIKELY = 4  # of these, that are nearest to what is read


def repeating(sd: float) -> float:
    """The part of a rounding error's power that repeats, where noise of sd steps dithers it."""
    each = 6 / (np.pi * HARMONIC) ** 2
    return float(each @ np.exp(-((2 * np.pi * HARMONIC * sd) ** 2)))


def dithering(spread: float) -> float:
    """The sd of noise in steps, from the variance of repeats about their mean, in steps squared:
    spread = (1 - repeating(sd))/12 + sd^2; inf where it is large enough for any."""

    def off(power: float) -> float:
        return (1 - repeating(math.sqrt(power))) * WHITE + power - spread

    if spread >= 1:
        return math.inf
    return math.sqrt(optimize.brentq(off, 0.0, 1.0)) if off(0.0) < 0 else 0.0


def dithered(piece: Piece, step: Float) -> Float:
    """(q,) sd of the noise that dithers each sensor, in its steps, from what repeats of a piece
    differ by; inf where nothing is rounded, or nothing was repeated."""
    out = np.full(step.size, math.inf)
    for i in np.flatnonzero(step > 0) if piece.repeats else ():
        # What repeats differ by from sample to sample: no wandering.
        power = np.mean([np.var(np.diff(s.z[:, i])) / 2 for s in piece.repeats])
        out[i] = dithering(float(power) / step[i] ** 2)
    return out


def alike(piece: Piece, step: Float) -> Float:
    """(q,) part of each sensor's rounding error that is the same in all repeats of a piece."""
    return np.array([repeating(sd) for sd in dithered(piece, step)])


@dataclass(frozen=True)
class Added:
    """What rounding adds to pieces, in groups that it adds alike to.

    group : (p,) of each piece. each : of every group, for each of its pieces, Hz (m,), power a
    sample (m, q) of each sensor's rounding, and of what covers it; the largest counts. times : (q,)
    as much of each rounding.
    """

    group: Int
    each: tuple[tuple[tuple[Float, Float, Float], ...], ...]
    times: Float

    @classmethod
    def of(cls, pieces: Sequence[Rounding]) -> Added:
        """Of every piece."""
        each = [(x.frequency, x.power, x.covered) for x in pieces]
        f = max((x[0] for x in each), key=len)
        level = np.stack([_at(f, x, power + cover) for x, power, cover in each])
        largest = np.max(level, axis=(0, 1))
        level = np.log(np.maximum(level, 1e-3 * np.where(largest > 0, largest, 1.0)))
        apart = math.log(GROUPS_APART)
        while True:
            first: list[int] = []
            group = []
            for i, one in enumerate(level):
                near = [j for j, k in enumerate(first) if np.max(np.abs(one - level[k])) < apart]
                if not near:
                    first.append(i)
                group.append(near[0] if near else len(first) - 1)
            if len(first) <= GROUPS:
                break
            apart *= 2
        members = tuple(
            tuple(x for x, g in zip(each, group, strict=True) if g == j) for j in range(len(first))
        )
        return cls(np.array(group, np.int64), members, np.ones(level.shape[2]))

    def __call__(self, f: Float, group: Int) -> Float:
        """(n, q) power a sample at f (n,) Hz in pieces of groups (n,)."""
        return self._largest(f, group, 1) * self.times + self.cover(f, group)

    def cover(self, f: Float, group: Int) -> Float:
        """(n, q) the part of it that stands in the place of what is not read."""
        return self._largest(f, group, 2)

    def _largest(self, f: Float, group: Int, which: int) -> Float:
        out = np.zeros((f.size, self.times.size))
        if not any(one[which].any() for members in self.each for one in members):
            return out
        for j, members in enumerate(self.each):
            on = group == j
            for one in members:
                out[on] = np.maximum(out[on], _at(f[on], one[0], one[which]))
        return out


def _at(f: Float, known: Float, power: Float) -> Float:
    return np.stack([np.interp(f, known, p) for p in power.T], axis=1)


@dataclass(frozen=True, slots=True)
class Rounding:
    """What the converters' steps do to a piece.

    frequency : (m,) Hz. power : (m, q) a sample, of each sensor's rounding. factors : of each
    sensor (p, n) parts of its motion that are read by a factor of their own. draws : of each sensor
    that nothing dithers (OFFSETS, n_lines) rounding beyond these, a sample's power, as it is
    wherever the sensor stands in its step. cover : (m, q) power of what stands in its place where
    it is not read, None for nowhere.
    """

    frequency: Float
    power: Float
    factors: dict[int, Float]
    draws: dict[int, Complex]
    cover: Float | None = None

    @property
    def covered(self) -> Float:
        """(m, q) as of `cover`."""
        return np.zeros_like(self.power) if self.cover is None else self.cover

    @classmethod
    def of_piece(
        cls,
        piece: Piece,
        k: Int,
        step: Float,
        y: Float,
        rate_hz: float,
        closed: Collection[int] = (),
    ) -> Rounding:
        """k : (n_lines,) that count. step : (q,) of the converters. y : (n, q) as the sensors
        would move without noise. closed : sensors that loops follow, whose commands were recorded
        as they were sent."""
        n, q = piece.z.shape
        frequency = np.asarray(np.fft.rfftfreq(n, 1 / rate_hz), np.float64)
        power = np.zeros((frequency.size, q))
        factors, draws, cover = {}, {}, np.zeros_like(power)
        repeats = dithered(piece, step)
        for i in np.flatnonzero(step > 0).tolist():
            same = len(piece.repeats) * repeating(repeats[i])
            power[:, i] = (1 + same) * WHITE * step[i] ** 2
            if piece.repeats:  # what a reference leaves of them has the rounding alike
                sd = float(repeats[i] * step[i])
            else:
                sd = _noise(piece.z[:, i] - y[:, i], float(step[i]))
            if sd >= DITHERED * step[i]:
                continue
            parts = _parts(piece, y[:, i], float(step[i]), sd, rate_hz)
            shares = np.array([c.part for c in piece.commands] or [1.0])
            moved = y[:, i] / step[i]
            if shares.size == 1 and not piece.repeats and not piece.contrasts:
                width = max(int(RESTS_IN_STEP * rate_hz), 3)
                moved = moved + _wandering(moved, piece.z[:, i] / step[i], width)
            errors = _errors(moved, shares, parts, sd / step[i])
            spectra = np.fft.rfft(step[i] / math.sqrt(n) * errors, axis=1)
            power[:, i] = np.mean(np.abs(spectra) ** 2, axis=0)
            factors[i], draws[i] = parts, np.asarray(spectra[:, k])
            if i in closed and _is_staircase(sd / step[i]):
                moved = y[:, i] / (step[i] * _records(piece))
                few = steps_by_line(moved, rate_hz, frequency) <= FEW
                if few[k].any():
                    rests = WHITE * step[i] ** 2 * _of_rests(moved, rate_hz)
                    power[:, i] = np.maximum(_unlike(power[:, i], n / rate_hz), rests)
                    cover[few, i] = COVERS * power[few, i]
        return cls(frequency, power, factors, draws, cover if cover.any() else None)


def _is_staircase(sd: float) -> bool:
    """Whether a motion of few steps is read as a staircase, beside noise of sd steps."""
    return math.exp(-2 * (math.pi * sd) ** 2) >= UNSEEN


def _unlike(power: Float, seconds: float) -> Float:
    """(m,) power of a rounding error at the lines of a record of so many seconds, where what
    wanders moves the sensor in its step, so that no repeat rounds as the one before it does."""
    near = ndimage.uniform_filter1d(power, max(round(ALIKE_OVER * seconds), 1))
    return np.maximum(power, near)


def _records(piece: Piece) -> float:
    """Times by which a piece moves as one of its records does."""
    return math.sqrt(1 + len(piece.repeats) + len(piece.contrasts))


def steps_by_line(y: Float, rate_hz: float, frequency: Float) -> Float:
    """(m,) steps within which a motion y (n,) in steps stays while it has what it has at
    `frequency` (m,), Hz."""
    width = min(2 * max(int(CROSSED_IN * rate_hz), 3), y.size)
    f, t, power = signal.spectrogram(y, rate_hz, "hann", width, width // 2)
    stays = crossed(y, rate_hz)[np.minimum(np.rint(t * rate_hz).astype(np.int64), y.size - 1)]
    total = np.sum(power, axis=1)
    each = np.divide(power @ stays, total, out=np.zeros(total.size), where=total > 0)
    return np.asarray(np.interp(frequency, f, each))


def _of_rests(y: Float, rate_hz: float) -> Float:
    """(m,) power a sample, at the lines of a record, of an error of power 1 that is the same for as
    long as a motion y (n,) in steps rests, and another at each rest."""
    labels, count = ndimage.label(crossed(y, rate_hz) < AT_REST)
    out = np.zeros(y.size // 2 + 1)
    for on in ndimage.find_objects(labels, count):
        out += np.abs(np.fft.rfft((labels[on] > 0) * 1.0, y.size)) ** 2 / y.size
    return out


def _noise(left: Float, step: float) -> float:
    """Sd of the noise that dithers a converter, from what a reference leaves of it (n,)."""
    power = np.abs(np.fft.rfft(left - np.mean(left))) ** 2 / left.size
    white = float(np.median(power[power.size // 2 :])) / math.log(2)
    return math.sqrt(max(white - WHITE * step**2, 0.0))


def _wandering(y: Float, z: Float, width: int) -> Float:
    """(n,) by how much a motion y (n,) stands elsewhere in its step than over all: of each `width`
    samples the place at which its rounding is nearest to what is read z (n,). 0 where one place
    leaves hardly more. All in steps."""
    parts = np.array_split(np.arange(y.size), max(y.size // width, 1))
    offsets = np.arange(OFFSETS) / OFFSETS
    off = np.rint(y + offsets[:, None]) - z
    left = np.stack([np.var(off[:, on], axis=1) for on in parts])
    one = int(np.argmin(np.mean(left, axis=0)))
    least = np.min(left, axis=1)
    if np.mean(left[:, one]) <= WANDERS * np.mean(least):
        return np.zeros(y.size)
    at = np.where(left[:, one] <= least, one, np.argmin(left, axis=1))  # at rest all are alike
    return np.repeat(offsets[at] - offsets[one], [on.size for on in parts])


def _errors(y: Float, shares: Float, parts: Float, sd: float) -> Float:
    """(OFFSETS, n) rounding of a motion y (n,) in steps wherever it stands in its step, less what
    factors of its parts (p, n) explain.

    shares : of the records behind it, whose sum it is, each with its share of y and of its own
    rounding: repeats round alike, other levels otherwise. sd : of the noise that dithers each, in
    steps.
    """
    dither = np.random.default_rng(0).standard_normal((shares.size, y.size)) * sd
    moved = y * shares[:, None] + dither
    out = np.zeros((OFFSETS, y.size))
    size = np.sum(parts**2, axis=1)
    for one, offset in zip(out, (np.arange(OFFSETS) + 0.5) / OFFSETS, strict=True):
        x = moved + offset
        error = shares @ (np.rint(x) - x)
        error -= np.mean(error)
        one[:] = error - (parts @ error / size) @ parts
    return out


def _parts(piece: Piece, y: Float, step: float, sd: float, rate_hz: float) -> Float:
    """(p, n) what of the motion y (n,) of a sensor stays within few steps and is not read in
    proportion, less its mean: each stretch its own, as a part may rest at another place after it
    was moved. In parts of equal power: the factor depends on the amplitude. sd : of the noise."""
    still = crossed(y, rate_hz) < FEW * step * _records(piece)
    labels, count = ndimage.label(still)
    if count == 0 or not _is_staircase(sd / step):
        return np.zeros((0, y.size))
    mean = np.append(0.0, ndimage.mean(y, labels, np.arange(1, count + 1)))
    part = np.where(still, y - mean[labels], 0.0)
    grown = np.cumsum(part**2)
    if grown[-1] <= y.size * (STILL * step) ** 2:
        return np.zeros((0, y.size))
    turn = np.minimum((UNREAD * grown / grown[-1]).astype(np.int64), UNREAD - 1)
    # A part before all motion, which jumps from none to the next, has nothing to be scaled.
    return np.stack([np.where(turn == j, part, 0.0) for j in np.unique(turn[part != 0])])
