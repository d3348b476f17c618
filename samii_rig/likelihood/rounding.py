"""What a converter's steps add to the noise, known before anything is measured.

A rounding error is white, of step^2/12, where noise dithers it or the motion crosses steps in any
order. Elsewhere it is what the motion makes of it:
- A motion that repeats itself, within a record or from one to the next, repeats the error too, but
  for what noise of sd sigma dithers: of harmonic h of a sawtooth, 6/(pi h)^2 of its power,
  exp(-(2 pi h sigma/step)^2) is the same in all repeats (Widrow and Kollar 2008, Quantization
  Noise, ch. 4). A motion that rests keeps one error as long as it rests.
- Where the motion stays within few steps, what is read is not in proportion to it, but for noise
  that dithers it: of the sawtooth's first harmonic exp(-2 (pi sigma/step)^2) is left.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import ndimage, optimize

from samii_rig.likelihood.pieces import Piece
from samii_rig.types import Float, Int

WHITE = 1 / 12  # of a step, squared
HARMONIC = np.arange(1.0, 200.0)  # of a sawtooth: all but 0.3 % of its power
# Steps within which a motion is not read in proportion: the describing function of a staircase
# is within 10 % of 1 from here on.
FEW = 3.0
SHORT = 0.5  # s in which a motion that crosses no step is not read: some periods of the band
ALIKE = 0.05  # of a rounding error, that repeats itself: repeats do not show it
# Of the power of what is not read, that is left where a factor of its own was taken out: it varies
# from none to all over the amplitudes within a step.
LEFT = 0.25
AROUND = 5  # lines over which the power of what is not read is the mean
# Of a step, noise sd from which a rounding error is white: the first harmonic of a sawtooth is the
# same to 0.7 % from here on.
DITHERED = 0.5
UNSEEN = 0.05  # of a staircase's error, what dithering leaves of it that nobody sees
# Times by which what rounding adds may differ between pieces of one group, and how many groups are
# told apart at most: each has bins of its own.
APART, GROUPS = 1.5, 8
OFFSETS = 16  # places of a motion in its step, at which its rounding is tried: within 25 % a line


def repeating(spread: float) -> float:
    """The part of a rounding error's power that repeats, from the variance of repeats about their
    mean, in steps squared: spread = (1 - part)/12 + sigma^2."""

    def part(power: float) -> float:
        each = 6 / (np.pi * HARMONIC) ** 2
        return float(each @ np.exp(-((2 * np.pi * HARMONIC) ** 2) * power))

    if spread >= 1:
        return 0.0
    if spread <= (1 - part(0.0)) * WHITE:  # they hardly differ
        return part(0.0)
    found = optimize.brentq(lambda x: (1 - part(x)) * WHITE + x - spread, 0.0, 1.0)
    return part(float(found))


def alike(piece: Piece, step: Float) -> Float:
    """(q,) part of each sensor's rounding error that is the same in all repeats of a piece."""
    out = np.zeros(step.size)
    for i in np.flatnonzero(step > 0) if piece.repeats else ():
        # What repeats differ by from sample to sample: no wandering.
        power = np.mean([np.var(np.diff(s.z[:, i])) / 2 for s in piece.repeats])
        out[i] = repeating(float(power) / step[i] ** 2)
    return out


@dataclass(frozen=True)
class Added:
    """What rounding adds to pieces, in groups that it adds alike to.

    group : (p,) of each piece. each : of every group, for each of its pieces, Hz (m,) and power a
    sample (m, q) of each sensor's rounding; the largest counts.
    """

    group: Int
    each: tuple[tuple[tuple[Float, Float], ...], ...]

    @classmethod
    def of(cls, each: Sequence[tuple[Float, Float]]) -> Added:
        """each : of every piece, as `of_piece` has it."""
        f = max((x[0] for x in each), key=len)
        level = np.stack([_at(f, x) for x in each])
        largest = np.max(level, axis=(0, 1))
        level = np.log(np.maximum(level, 1e-3 * np.where(largest > 0, largest, 1.0)))
        apart = math.log(APART)
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
        return cls(np.array(group, np.int64), members)

    def __call__(self, f: Float, group: Int) -> Float:
        """(n, q) power a sample at f (n,) Hz in pieces of groups (n,)."""
        q = self.each[0][0][1].shape[1]
        out = np.zeros((f.size, q))
        for j, members in enumerate(self.each):
            on = group == j
            for one in members:
                out[on] = np.maximum(out[on], _at(f[on], one))
        return out


def _at(f: Float, of: tuple[Float, Float]) -> Float:
    return np.stack([np.interp(f, of[0], p) for p in of[1].T], axis=1)


def of_piece(piece: Piece, step: Float, y: Float, rate_hz: float) -> tuple[Float, Float]:
    """Hz (m,) and power a sample (m, q) of each sensor's rounding.

    step : (q,) of the converters. y : (n, q) as the sensors would move without noise.
    """
    n, q = piece.z.shape
    frequency = np.asarray(np.fft.rfftfreq(n, 1 / rate_hz), np.float64)
    power = np.zeros((frequency.size, q))
    if not np.any(step > 0):
        return frequency, power
    same = alike(piece, step)
    for i in np.flatnonzero(step > 0):
        times = 1 + len(piece.repeats) * same[i]
        sd = _noise(piece.z[:, i] - y[:, i], float(step[i]))
        still, part = _within(piece, y[:, i], float(step[i]), sd, rate_hz)
        if sd < DITHERED * step[i]:
            power[:, i] = times * _made(y[:, i], still, float(step[i]), sd)
        else:
            power[:, i] = times * WHITE * step[i] ** 2
        if part.any():
            unread = np.abs(np.fft.rfft(part)) ** 2 / n
            power[:, i] += LEFT * ndimage.uniform_filter1d(unread, AROUND)
    return frequency, power


def _noise(left: Float, step: float) -> float:
    """Sd of the noise that dithers a converter, from what a reference leaves of it (n,)."""
    power = np.abs(np.fft.rfft(left - np.mean(left))) ** 2 / left.size
    white = float(np.median(power[power.size // 2 :])) / math.log(2)
    return math.sqrt(max(white - WHITE * step**2, 0.0))


def _made(y: Float, still: Int, step: float, sd: float) -> Float:
    """(n//2 + 1,) power a sample of the rounding of a motion y (n,) wherever it stands in its step.

    still : (n,) numbers of the stretches that stay within few steps, of which the mean error alone
    counts, and 0. sd : of the noise that dithers it.
    """
    rng = np.random.default_rng(0)
    power = np.zeros(y.size // 2 + 1)
    count = int(still.max())
    for offset in (np.arange(OFFSETS) + 0.5) / OFFSETS:
        x = y / step + offset + rng.standard_normal(y.size) * (sd / step)
        error = np.rint(x) - x
        if count:
            mean = np.append(0.0, ndimage.mean(error, still, np.arange(1, count + 1)))
            error = np.where(still > 0, mean[still], error)
        power += np.abs(np.fft.rfft(error - np.mean(error))) ** 2
    return power * (step**2 / (OFFSETS * y.size))


def within(piece: Piece, i: int, y: Float, step: float, rate_hz: float) -> Float:
    """(n,) what of the motion y (n,) of sensor i stays within few steps and is not read in
    proportion, less its mean: each stretch its own, as a part may rest at another place after it
    was moved."""
    return _within(piece, y, step, _noise(piece.z[:, i] - y, step), rate_hz)[1]


def _within(piece: Piece, y: Float, step: float, sd: float, rate_hz: float) -> tuple[Int, Float]:
    """(n,) numbers of the stretches, 0 elsewhere, and what `within` gives. sd : of the noise."""
    times = math.sqrt(1 + len(piece.repeats) + len(piece.contrasts))
    width = max(int(SHORT * rate_hz), 3)
    high, low = ndimage.maximum_filter1d(y, width), ndimage.minimum_filter1d(y, width)
    still = high - low < FEW * step * times
    labels, count = ndimage.label(still)
    stretch = np.asarray(labels, np.int64)
    seen = math.exp(-2 * (math.pi * sd / step) ** 2)
    if count == 0 or seen < UNSEEN:
        return stretch, np.zeros(y.size)
    mean = np.append(0.0, ndimage.mean(y, stretch, np.arange(1, count + 1)))
    return stretch, np.asarray(np.where(still, seen * (y - mean[stretch]), 0.0))
