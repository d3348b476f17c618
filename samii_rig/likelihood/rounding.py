"""What a converter's steps add to the noise, known before anything is measured.

A rounding error is white, of step^2/12, where noise dithers it or the motion crosses steps in any
order. Elsewhere it is what the motion makes of it:
- A motion that repeats itself, within a record or from one to the next, repeats the error too, but
  for what noise of sd sigma dithers: of harmonic h of a sawtooth, 6/(pi h)^2 of its power,
  exp(-(2 pi h sigma/step)^2) is the same in all repeats (Widrow and Kollar 2008, Quantization
  Noise, ch. 4). A motion that rests keeps one error as long as it rests.
- Where the motion stays within few steps, what is read is not in proportion to it (`staircase`).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import optimize

from samii_rig.likelihood.pieces import Piece
from samii_rig.likelihood.staircase import RESTS_IN_STEP, Stretch, follows
from samii_rig.types import Complex, Float, Int

WHITE = 1 / 12  # of a step, squared
HARMONIC = np.arange(1.0, 200.0)  # of a sawtooth: all but 0.3 % of its power
ALIKE = 0.05  # of a rounding error, that repeats itself: repeats do not show it
# Shapes that are free: numbers that they may be in the lines of all pieces, 200 MB, and the part of
# the lines of one sensor in a piece that they take at most.
ROOM, OF_LINES = 12_000_000, 0.25
# Of a step, noise sd from which a rounding error is white: the first harmonic of a sawtooth is the
# same to 0.7 % from here on.
DITHERED = 0.5
# Times by which what rounding adds may differ between pieces of one group, and how many groups are
# distinguished at most: each has bins of its own.
GROUPS_APART, GROUPS = 1.5, 8
WANDERS = 2.0  # times that one place for all leaves more than one a second, of what does not rest
OFFSETS = 16  # places of a motion in its step, at which its rounding is tried: within 25 % a line
# Of a rounding error's power, what free harmonics miss of it: the sensor has moved within a stretch
# and stands not quite as the reference has it. With none, motions within 3 to 8 steps leave 0.9 to
# 1.1 of the noise but scatter by 0.7; with this 0.8 to 0.94, and half of that.
MISSED = 0.05
TRIED, TRIED_AT = 6, 4  # sd of noise, and places, at which its readings are tried
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
    differ by; inf where nothing is rounded."""
    out = np.full(step.size, math.inf)
    for i in np.flatnonzero(step > 0):
        # What repeats differ by from sample to sample: no wandering.
        power = np.mean([np.var(np.diff(s.z[:, i])) / 2 for s in piece.repeats])
        out[i] = dithering(float(power) / step[i] ** 2)
    return out


def alike(piece: Piece, step: Float) -> Float:
    """(q,) part of each sensor's rounding error that is the same in all repeats of a piece."""
    if not piece.repeats:
        return np.zeros(step.size)
    return np.array([repeating(sd) if sd < math.inf else 0.0 for sd in dithered(piece, step)])


@dataclass(frozen=True)
class Added:
    """What rounding adds to pieces, in groups that it adds alike to.

    group : (p,) of each piece. each : of every group, for each of its pieces, Hz (m,) and power a
    sample (m, q) of each sensor's rounding; the largest counts. times : (q,) as much of each.
    """

    group: Int
    each: tuple[tuple[tuple[Float, Float], ...], ...]
    times: Float

    @classmethod
    def of(cls, pieces: Sequence[Rounding]) -> Added:
        """Of every piece."""
        each = [(x.frequency, x.power) for x in pieces]
        f = max((x[0] for x in each), key=len)
        level = np.stack([_at(f, x) for x in each])
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
        q = self.each[0][0][1].shape[1]
        out = np.zeros((f.size, q))
        for j, members in enumerate(self.each):
            on = group == j
            for one in members:
                out[on] = np.maximum(out[on], _at(f[on], one))
        return out * self.times


def _at(f: Float, of: tuple[Float, Float]) -> Float:
    return np.stack([np.interp(f, of[0], p) for p in of[1].T], axis=1)


@dataclass(frozen=True, slots=True)
class Rounding:
    """What the converters' steps do to a piece.

    frequency : (m,) Hz. power : (m, q) a sample, of each sensor's rounding. free : of each sensor
    that less than half a step dithers, shapes of its error that have any amplitude. draws : of each
    of these (OFFSETS, n_lines) what such shapes leave of it, a sample's power, as it is wherever
    the sensor stands in its step.
    """

    frequency: Float
    power: Float
    free: dict[int, list[Stretch]]
    draws: dict[int, Complex]

    @classmethod
    def of_piece(
        cls, piece: Piece, k: Int, step: Float, y: Float, rate_hz: float, room: int = ROOM
    ) -> Rounding:
        """k : (n_lines,) that count. step : (q,) of the converters. y : (n, q) as the sensors
        would move without noise. room : numbers a line that all free shapes of it may be."""
        n, q = piece.z.shape
        frequency = np.asarray(np.fft.rfftfreq(n, 1 / rate_hz), np.float64)
        power = np.zeros((frequency.size, q))
        free, draws = {}, {}
        same = alike(piece, step)
        noise = dithered(piece, step) if piece.repeats else None
        shares = np.array([c.part for c in piece.commands] or [1.0])
        rounded = np.flatnonzero(step > 0).tolist()
        most = min(int(2 * OF_LINES * k.size), room // (q * max(len(rounded), 1)))
        for i in rounded:
            power[:, i] = (1 + len(piece.repeats) * same[i]) * WHITE * step[i] ** 2
            moved = y[:, i] / step[i]
            if noise is None and _drowned(piece.z[:, i] / step[i] - moved, shares):
                continue
            if shares.size == 1 and not piece.repeats and not piece.contrasts:
                width = max(int(RESTS_IN_STEP * rate_hz), 3)
                moved = moved + _wandering(moved, piece.z[:, i] / step[i], width)
            left = piece.z[:, i] / step[i] - moved
            sd = _noise(left, moved, shares) if noise is None else noise[i]
            if sd >= DITHERED:
                continue
            free[i] = follows(y[:, i] / step[i], shares, sd, rate_hz, most)
            errors = _errors(moved, shares, _dither(moved, shares, sd), OFFSETS)
            every = _power(errors)
            for on, shapes in free[i]:
                errors[:, on] -= (errors[:, on] @ shapes.T) @ shapes
            power[:, i] = step[i] ** 2 * (MISSED * every + (1 - MISSED) * _power(errors))
            spectra = np.fft.rfft(step[i] / math.sqrt(n) * errors, axis=1)
            draws[i] = np.asarray(spectra[:, k])
        return cls(frequency, power, free, draws)


def _power(x: Float) -> Float:
    """(m,) power a sample along frequency, of rows (r, n) in the mean."""
    return np.asarray(np.mean(np.abs(np.fft.rfft(x, axis=1)) ** 2, axis=0) / x.shape[1])


def _white(x: Float) -> Float:
    """Power of the white part of rows (..., n)."""
    power = np.abs(np.fft.rfft(x - np.mean(x, axis=-1, keepdims=True))) ** 2 / x.shape[-1]
    return np.asarray(np.median(power[..., power.shape[-1] // 2 :], axis=-1) / math.log(2))


def _drowned(left: Float, shares: Float) -> bool:
    """Whether more is left of a sensor (n,), in steps, than its rounding and noise that dithers it
    can be."""
    return float(_white(left)) >= float(np.sum(np.abs(shares))) ** 2 * (DITHERED**2 + WHITE)


def _noise(left: Float, y: Float, shares: Float) -> float:
    """Sd in steps of the noise that dithers a sensor of motion y (n,), from what a reference leaves
    of it (n,), in steps: that with which the reading of the motion leaves as much; `DITHERED` at
    most. shares : as of `_errors`."""
    shown = float(_white(left))
    before, had = 0.0, 0.0
    for sd in np.linspace(0.0, DITHERED, TRIED):
        noise = _dither(y, shares, sd)
        has = float(np.mean(_white(_errors(y, shares, noise, TRIED_AT) + shares @ noise)))
        if has >= shown:
            return float(np.interp(shown, [had, has], [before, sd]))
        before, had = sd, has
    return DITHERED


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


def _dither(y: Float, shares: Float, sd: float) -> Float:
    """(records, n) of noise, the same each time."""
    return np.random.default_rng(0).standard_normal((shares.size, y.size)) * sd


def _errors(y: Float, shares: Float, dither: Float, places: int) -> Float:
    """(places, n) rounding of a motion y (n,) in steps wherever it stands in its step.

    shares : of the records behind it, whose sum it is, each with its share of y and of its own
    rounding: repeats round alike, other levels otherwise. dither : (records, n) noise of each, in
    steps.
    """
    moved = y * shares[:, None] + dither
    out = np.zeros((places, y.size))
    for one, offset in zip(out, (np.arange(places) + 0.5) / places, strict=True):
        x = moved + offset
        error = shares @ (np.rint(x) - x)
        one[:] = error - np.mean(error)
    return out
