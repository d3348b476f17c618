"""The noise of all sensors together, in the directions that the rig gives it.

Each sensor has noise of its own. Forces on the rig, torques across its joints, the floor and what
is added to its input come out through the rig and its loop, so that a model of the rig knows how
they look in all sensors: u_k(f) of disturbance k. At a line

    C(f) = sum_k p_k(f) u_k(f) u_k(f)^H,  p_k(f) = sum_c lambda_kc/(1 + (f/f_c)^2),  lambda >= 0.

The powers are the most likely ones (see `powers`). Few of them are not zero, so the noise is known
well from one short record, at lightly damped modes and at its lowest lines too.

What the sum does not give is estimated by blocks of lines: each has a covariance of its own about
it, as far from it as all blocks together say that they are (empirical Bayes, inverse Wishart
prior).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.special import gammaln

from samii_rig.errors import EstimateError
from samii_rig.likelihood.powers import most_likely
from samii_rig.types import Complex, Float, Int

# Degrees of freedom for each sensor in a block of lines, at least: from fewer lines its covariance
# is off by more than 1/sqrt(12 q).
FREEDOM = 12.0
# Width of a block over its frequency: of the sensors' own noise, and where what disturbs the rig
# has modes of 1 % of loss. And nepers of its power, by which the sum changes within one.
OWN_WIDTH, MODE_WIDTH, CHANGES = 0.1, 0.01, 0.5
# Corners of the colours, times the one before: a sum of them is within 5 % of any power of the
# frequency from 0 to -2 (log-spaced relaxations; van der Ziel 1950, Physica 16).
CORNERS_APART = 4.0
SMALL = 0.02  # of a bin's frequency, its width: over it no colour changes by more than 4 %
TURN = 0.15  # nepers or rad, by which what a disturbance makes may change within a bin
# Of the largest, what a disturbance makes that is rounding: a force at a place that is held. What
# moves anything, in any unit, makes more than 1e-6.
NOTHING = 1e-12
# Degrees of freedom with which a block may believe the sum: from not at all to wholly.
BELIEF = np.geomspace(0.4, 4e4, 31)
LITTLE = 0.02  # of a line's freedom: one with less says nothing

Disturbances = Callable[[Float], Complex]
"""f (n,) Hz -> (n, q, K), what each of K disturbances of power 1 makes in each of q sensors; the
first q are the sensors' own noises."""


class Known(Protocol):
    """Power of each sensor's own noise that is known beforehand."""

    @property
    def group(self) -> Int:
        """(p,) of each piece: those of one group have the same."""
        ...

    def __call__(self, f: Float, group: Int) -> Float:
        """(n, q) at f (n,) Hz in pieces of groups (n,)."""
        ...

    def cover(self, f: Float, group: Int) -> Float:
        """(n, q) the part of it that stands in the place of what a sensor shows there."""
        ...


@dataclass(frozen=True, slots=True)
class Noise:
    """Power a sample of q sensors.

    disturbances : u_k. known : of the first q of them, beside `power`. corners : (c,) Hz of the
    colours, inf for white. power : (K, c) lambda. edges : (g - 1,) Hz between blocks.
    about : (g, q, q) covariance of each block over the sum's.
    """

    disturbances: Disturbances
    known: Known
    corners: Float
    power: Float
    edges: Float
    about: Complex

    @classmethod
    def of(
        cls,
        f: Float,
        left: Complex,
        free: Float,
        piece: Int,
        disturbances: Disturbances,
        known: Known,
    ) -> Noise:
        """From lines (n, q) of noise at increasing f (n,), each with its freedom (n,) and the
        number of its piece (n,).

        Raises EstimateError where no line has any.
        """
        some = free > LITTLE
        if not some.any():
            raise EstimateError("the records are too short: what is fitted leaves no noise to see")
        f, left, free, piece = f[some], left[some], free[some], piece[some]
        at, group, which = _once(f, known.group[piece])
        once, back = np.unique(at, return_inverse=True)
        u = disturbances(once)
        size = np.max(np.abs(u), axis=(0, 1))
        u = np.where(size > NOTHING * size.max(), u, 0.0)
        alike = _bins(once, u)[back] * (group.max(initial=0) + 1) + group
        _, middle, bins = np.unique(alike, return_index=True, return_inverse=True)
        S, w = _gathered(left, free, bins[which])
        corners = _corners(once)
        scale = np.sqrt(np.einsum("nq,n->q", np.abs(left) ** 2, 1 / free) / f.size)
        scale = np.where(scale > 0, scale, 1.0)
        S = S / (scale[:, None] * scale)
        u = u[back[middle]] / scale[:, None]
        # What is known may differ from line to line: between those of a motion that repeats itself
        # its rounding has next to nothing.
        weight = np.asarray(np.bincount(which, free, at.size), np.float64)
        own = _mean(known(at, group), weight, bins)
        more = w[:, None] * _mean(known.cover(at, group), weight, bins)
        its = u[:, :, : more.shape[1]]
        S = S + (its * more[:, None, :]) @ its.conj().swapaxes(1, 2)
        power = most_likely(u, S, w, _colours(at[middle], corners), own)
        plain = cls(
            disturbances,
            known,
            corners,
            power,
            np.zeros(0),
            np.eye(left.shape[1], dtype=np.complex128)[None],
        )
        return plain._about(f, left, free, piece)

    def _about(self, f: Float, left: Complex, free: Float, piece: Int) -> Noise:
        """The same, what the sum does not give by blocks."""
        q = left.shape[1]
        group = self.known.group[piece]
        once, first, back = np.unique(f, return_index=True, return_inverse=True)
        u = self.disturbances(once)
        alone = u[back, :, :q]
        own = alone * np.sqrt(self.known(f, group))[:, None, :]
        # Blocks scatter by it as by all other noise.
        cover = np.sqrt(free[:, None] * self.known.cover(f, group)) * _drawn((0,), f.size, q)
        left = left + (alone @ cover[:, :, None])[:, :, 0]
        both = self.whitened(f, piece, np.concatenate([left[:, :, None], own], axis=2))
        white, sure = both[:, :, 0], both[:, :, 1:]
        starts = _blocks(free, self._place(once, u, group[first])[back], FREEDOM * q)
        each = [slice(a, b) for a, b in pairwise([*starts, f.size])]
        A = np.stack([white[on].T @ white[on].conj() for on in each])
        n = np.array([float(np.sum(free[on])) for on in each])
        nu = max(BELIEF, key=lambda nu: _chance(A, n, float(nu)))
        if nu == BELIEF[-1]:
            return self
        about = (nu * np.eye(q) + A) / (nu + n)[:, None, None]
        # No block is quieter than what is known beforehand.
        values, turn = np.linalg.eigh(about)
        least = np.stack([_along(sure[on], V) for on, V in zip(each, turn, strict=True)])
        about = (turn * np.maximum(values, least)[:, None, :]) @ turn.conj().swapaxes(1, 2)
        return replace(self, edges=f[starts[1:]], about=about)

    def _place(self, f: Float, u: Complex, group: Int) -> Float:
        """(n,) how many of the widest blocks lie below f (n,) of groups (n,). u : (n, q, K) what
        disturbances make there.

        Where what disturbs the rig is seen above a sensor's own noise, a mode that stands elsewhere
        than in the sum makes another noise at every line: blocks are as narrow as it there, and
        as over which the sum changes.
        """
        q = u.shape[1]
        power = np.abs(u) ** 2 * (_colours(f, self.corners) @ self.power.T)[:, None, :]
        own = power[:, :, :q].sum(axis=2) + self.known(f, group)
        rig = power[:, :, q:].sum(axis=2)
        every = np.maximum(own + rig, np.finfo(np.float64).tiny)
        share = np.max(rig / every, axis=1)
        turn = np.max(np.abs(np.diff(np.log(every), axis=0)), axis=1, initial=0.0) / CHANGES
        each = (1 - share) / OWN_WIDTH + share / MODE_WIDTH
        step = np.diff(np.log(f)) * np.maximum(each[:-1], each[1:])
        return np.append(0.0, np.cumsum(step + turn))

    def of_sensors_alone(self, own_power: Float) -> Noise:
        """White noise of each sensor, of `own_power` (q,), and what is known beforehand; nothing
        that disturbs the rig."""
        power = np.zeros_like(self.power)
        power[: own_power.size, np.isinf(self.corners)] = own_power[:, None]
        alike = np.eye(own_power.size, dtype=np.complex128)[None]
        return replace(self, power=power, edges=self.edges[:0], about=alike)

    def cover(self, f: Float, piece: Int, k: Int, repeat: int = 0) -> Complex:
        """(n, q) what stands at lines k (n,) of pieces (n,), f (n,) Hz, in the place of what
        sensors show there: noise of its power, the same whenever it is asked for. repeat : 0 of
        the piece itself, else of those beside it which."""
        power = self.known.cover(f, self.known.group[piece])
        if not power.any():
            return np.zeros_like(power, dtype=np.complex128)
        q = power.shape[1]
        drawn = np.zeros((f.size, q), np.complex128)
        for i in np.unique(piece):
            on = piece == i
            drawn[on] = _drawn((int(i), repeat), int(k[on].max()) + 1, q)[k[on]]
        u = self.disturbances(f)[:, :, :q]
        return np.asarray((u @ (np.sqrt(power) * drawn)[:, :, None])[:, :, 0])

    def covered(self, f: Float, piece: Int) -> NDArray[np.bool_]:
        """(n,) whether any sensor is covered at f (n,) Hz in pieces (n,)."""
        return np.asarray(self.known.cover(f, self.known.group[piece]).any(axis=1))

    def covariance(self, f: Float, piece: Int) -> Complex:
        """(n, q, q) at f (n,) in pieces (n,)."""
        L = self.root(f, piece)
        return np.asarray(L @ L.conj().swapaxes(1, 2))

    def whitened(self, f: Float, piece: Int, e: Complex) -> Complex:
        """(n, q, m) in units of the noise, of lines e (n, q, m) at f (n,) of pieces (n,)."""
        return np.asarray(np.linalg.solve(self.root(f, piece), e))

    def scaled(self, f: Float, piece: Int, white: Complex) -> Float:
        """(n, q) power of each sensor over its own noise's, of `whitened` lines (n, q)."""
        L = self.root(f, piece)
        plain = (L @ white[:, :, None])[:, :, 0]
        return np.asarray(np.abs(plain) ** 2 / np.sum(np.abs(L) ** 2, axis=2))

    def root(self, f: Float, piece: Int) -> Complex:
        """(n, q, q) L with L L^H = C at f (n,) in pieces (n,)."""
        at, group, which = _once(f, self.known.group[piece])
        once, back = np.unique(at, return_inverse=True)
        u, p = self.disturbances(once)[back], _colours(at, self.corners) @ self.power.T
        p[:, : u.shape[1]] += self.known(at, group)
        plain = (u * p[:, None, :]) @ u.conj().swapaxes(1, 2)
        block = np.searchsorted(self.edges, at, side="right")
        roots = np.linalg.cholesky(self.about)[block]
        return np.asarray((_cholesky(plain) @ roots)[which])


def _drawn(seed: tuple[int, ...], n: int, q: int) -> Complex:
    """(n, q) normal of power 1; of more lines the first are the same."""
    each = np.random.default_rng(seed).standard_normal((n, q, 2)) / np.sqrt(2)
    return np.asarray(each @ np.array([1, 1j]))


def _once(f: Float, group: Int) -> tuple[Float, Int, Int]:
    """Frequencies (m,), increasing, and groups (m,) that differ, and which of them each of (n,)
    is."""
    both, which = np.unique(f + 1j * group, return_inverse=True)
    return both.real.copy(), both.imag.astype(np.int64), which


def _along(sure: Complex, directions: Complex) -> Float:
    """(q,) mean power of what is known, whitened (n, q, q), along directions (q, q)."""
    power = np.abs(directions.conj().T @ sure) ** 2
    return np.asarray(np.mean(np.sum(power, axis=2), axis=0))


def _cholesky(C: Complex) -> Complex:
    """Of (n, q, q), each sensor in units of its own size, so that no unit counts."""
    size = np.sqrt(np.diagonal(C, axis1=1, axis2=2).real)
    alike = C / (size[:, :, None] * size[:, None, :])
    q = C.shape[1]
    return np.asarray(size[:, :, None] * np.linalg.cholesky(alike + 1e-9 * np.eye(q)))


def _corners(f: Float) -> Float:
    """Hz, from below the lowest line to above the highest, then white."""
    count = int(np.ceil(np.log(f[-1] / f[0]) / np.log(CORNERS_APART))) + 1
    return np.append(f[0] / CORNERS_APART * CORNERS_APART ** np.arange(count), np.inf)


def _colours(f: Float, corners: Float) -> Float:
    """(n, c) of power, 1 at its largest over the band."""
    lowest = corners[0] * CORNERS_APART
    return np.asarray((1 + (lowest / corners) ** 2) / (1 + (f[:, None] / corners) ** 2))


def _bins(f: Float, u: Complex) -> Int:
    """(n,) the bin of each frequency: neighbours at which disturbances look alike."""
    size = np.linalg.norm(u, axis=(0,), keepdims=True)
    one = u / np.where(size > 0, size, 1.0)
    turning = np.linalg.norm(np.diff(one, axis=0), axis=1) / np.maximum(
        np.linalg.norm(one[1:], axis=1), 1e-300
    )
    step = np.diff(np.log(f)) / SMALL + np.max(turning, axis=1, initial=0.0) / TURN
    place = np.floor(np.append(0.0, np.cumsum(step)))
    return np.unique(place, return_inverse=True)[1].astype(np.int64)


def _gathered(left: Complex, free: Float, bins: Int) -> tuple[Complex, Float]:
    """(b, q, q) sums of e e^H over the lines of each bin, and their freedom (b,)."""
    n, q = int(bins.max()) + 1, left.shape[1]
    S = np.zeros((n, q, q), np.complex128)
    np.add.at(S, bins, left[:, :, None] * left[:, None, :].conj())
    return S, np.asarray(np.bincount(bins, free, n), np.float64)


def _mean(x: Float, weight: Float, bins: Int) -> Float:
    """(b, q) of x (n, q) over each bin."""
    n = int(bins.max()) + 1
    sums = [np.bincount(bins, weight * one, n) for one in x.T]
    return np.asarray(np.stack(sums, axis=1) / np.bincount(bins, weight, n)[:, None])


def _blocks(free: Float, place: Float, least: float) -> list[int]:
    """Where blocks begin that have so much freedom at least. place : (n,) as `Noise._place`."""
    starts, have = [0], 0.0
    for i in range(free.size):
        have += float(free[i])
        if have >= least and place[i] > place[starts[-1]] + 1:
            starts.append(i + 1)
            have = 0.0
    # What is left at the end is too little for a block of its own.
    return starts[:-1] if len(starts) > 1 else [0]


def _chance(A: Complex, n: Float, nu: float) -> float:
    """Logarithm of the chance of scatters A (g, q, q) of n (g,) lines, if each block's covariance
    is drawn about 1 with nu degrees of freedom (up to a constant)."""
    q = A.shape[1]
    order = np.arange(q)
    gammas = np.sum(gammaln(nu + q + n[:, None] - order) - gammaln(nu + q - order), axis=1)
    det = np.linalg.slogdet(nu * np.eye(q) + A)[1]
    return float(np.sum(gammas + (nu + q) * q * np.log(nu) - (nu + q + n) * det))
