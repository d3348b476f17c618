"""The noise of all sensors together.

In blocks of lines each sensor's own noise and what they share is one covariance C0. What disturbs
the rig itself, forces, a floor, the loop's own noise, comes out by the rig's poles, with another
covariance C1. So in a block

    C(f) = C0 + a(f)^2 C1,

a the size of what such a disturbance moves, with the poles of the rig; C0 and C1 by expectation
maximisation (Dempster, Laird and Rubin 1977, J. R. Stat. Soc. B 39).

Sensors wander, with a power that falls by f^2. Where a block is wide beside its frequency, as the
lowest ones of a short record are, each sensor's power in it is 1 + g/f^2 times C0 and C1, and the
block is cut into narrow ones with that.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from samii_rig.types import Complex, Float

# Degrees of freedom for each sensor from which a block of lines tells the covariance: its inverse
# is then off by 1/sqrt(12 q), and 0.6 % of an effect's sigma is lost to it.
FREEDOM = 12.0
NARROWEST = 0.1  # of its frequency, a block's width at least: sensors' own noise is smooth
TURNS = 40  # of the maximisation: C1 is then within a few per cent of its end
SEEN = 0.02  # of C0's power, less than which a disturbance adds nothing that counts

WIDE = 1.5  # highest over lowest frequency of a block from which 1/f^2 shows beside a constant
RED_TURNS = 100  # of the fit of 1/f^2: g is then within a few per cent of its end

LITTLE = 0.1  # of a line's freedom: one with less says nothing by itself

Shape = Callable[[Float], Float]
"""f (n,) Hz -> (n,), a^2, about 1."""


@dataclass(frozen=True, slots=True)
class Noise:
    """Power a sample in blocks of lines.

    edges : (g - 1,) Hz between blocks. own, pushed : (g, q, q) C0 and C1, such that the inverse of
    C is that of the noise in the mean.
    """

    edges: Float
    own: Complex
    pushed: Complex
    shape: Shape

    @classmethod
    def of(cls, f: Float, left: Complex, free: Float, shape: Shape) -> Noise:
        """From lines (n, q) of noise at increasing f (n,), each with its freedom (n,)."""
        q = left.shape[1]
        starts, have = [0], 0.0
        for i in range(f.size):
            have += float(free[i])
            if have >= FREEDOM * q and f[i] > f[starts[-1]] * (1 + NARROWEST):
                starts.append(i + 1)
                have = 0.0
        # What is left at the end is too little for a block of its own.
        ends = [*starts[:-1], f.size] if len(starts) > 1 else [0, f.size]
        power = shape(f)
        lows, each = [], []
        for a, b in pairwise(ends):
            first, red = lows_of(f[a:b]), _red(f[a:b], left[a:b], free[a:b], power[a:b])
            louder = np.sqrt(1 + red / f[a:b, None] ** 2)
            C0, C1 = _fitted(left[a:b] / louder, free[a:b], power[a:b])
            middle = np.sqrt(first * np.append(first[1:], f[b - 1]))
            for low, scale in zip(first, np.sqrt(1 + red / middle[:, None] ** 2), strict=True):
                lows.append(low)
                each.append((scale[:, None] * C0 * scale, scale[:, None] * C1 * scale))
        own, pushed = (np.stack(C) for C in zip(*each, strict=True))
        return cls(np.array(lows[1:]), own, pushed, shape)

    def ranges(self, f: Float) -> list[tuple[int, int]]:
        """Where the lines f (n,), increasing, of each block stand."""
        at = np.searchsorted(f, self.edges).tolist()
        return list(pairwise([0, *at, f.size]))

    def covariance(self, f: Float) -> Complex:
        """(n, q, q) at f (n,)."""
        block = np.searchsorted(self.edges, f, side="right")
        return np.asarray(self.own[block] + self.shape(f)[:, None, None] * self.pushed[block])

    def parts(self, power: Float, block: int) -> list[tuple[Complex, Float]]:
        """The inverse of C at lines of a block as sums of W (q, q) times weights (n,).

        power : (n,), their `shape`.
        """
        root = np.linalg.inv(np.linalg.cholesky(self.own[block]))
        # Directions in which C0 is 1 and C1 diagonal.
        values, turn = np.linalg.eigh(root @ self.pushed[block] @ root.conj().T)
        G = turn.conj().T @ root
        loud = [i for i, value in enumerate(values) if value * np.max(power, initial=0.0) > SEEN]
        rest = np.delete(G, loud, axis=0)
        out: list[tuple[Complex, Float]] = []
        if rest.size:
            out.append((np.asarray(rest.conj().T @ rest, np.complex128), np.ones(power.size)))
        for i in loud:
            out.append((np.outer(G[i].conj(), G[i]), 1 / (1 + power * values[i])))
        return out

    def whitened(self, f: Float, e: Complex) -> Complex:
        """(n, q, m) in units of the noise, of lines e (n, q, m) at f (n,)."""
        return np.asarray(np.linalg.solve(np.linalg.cholesky(self.covariance(f)), e))

    def scaled(self, f: Float, white: Complex) -> Float:
        """(n, q) power of each sensor over its own noise's, of `whitened` lines (n, q)."""
        C = self.covariance(f)
        plain = (np.linalg.cholesky(C) @ white[:, :, None])[:, :, 0]
        return np.asarray(np.abs(plain) ** 2 / np.diagonal(C, axis1=1, axis2=2).real)


def lows_of(f: Float) -> Float:
    """Hz at which the narrow blocks begin into which the lines f (n,) of one block are cut."""
    wide = f[-1] / f[0]
    parts = int(np.ceil(np.log(wide) / np.log(1 + NARROWEST))) if wide > WIDE else 1
    marks = f[0] * wide ** (np.arange(parts) / parts)
    # Each begins with a line of its own.
    return np.asarray(f[np.unique(np.searchsorted(f, marks * (1 - 1e-9)))])


def _red(f: Float, left: Complex, free: Float, power: Float) -> Float:
    """(q,) g in Hz^2 of each sensor: its power in a block is 1 + g/f^2 times a constant, beside
    what disturbs the rig. By multiplicative steps of Whittle's likelihood (Fevotte, Bertin and
    Durrieu 2009, Neural Comput. 21, eq. 2.11, to the power 1/2 for it to grow at every step)."""
    some = free > LITTLE
    if f[-1] / f[0] <= WIDE or np.count_nonzero(some) <= 2 * left.shape[1]:
        return np.zeros(left.shape[1])
    w = free[some]
    shapes = np.stack([np.ones(w.size), power[some], (f[0] / f[some]) ** 2])
    P = (np.abs(left[some]) ** 2 / w[:, None]).T
    size = np.repeat(np.mean(P, axis=1)[:, None], len(shapes), axis=1)
    for _ in range(RED_TURNS):
        S = size @ shapes
        size = size * np.sqrt(((w * P / S**2) @ shapes.T) / ((w / S) @ shapes.T))
    return np.asarray(size[:, 2] / size[:, 0] * f[0] ** 2)


def _fitted(left: Complex, free: Float, power: Float) -> tuple[Complex, Complex]:
    """C0 and C1 of one block: lines left (n, q) with their freedom (n,), and a^2 (n,)."""
    q = left.shape[1]
    # A complex Wishart matrix of nu degrees of freedom: the inverse's mean is nu/(nu - q).
    total = float(np.sum(free))
    fair = total / max(total - q, 1.0)
    C = left.T @ left.conj() / max(total, 1.0)
    some = free > LITTLE
    if np.count_nonzero(some) <= 2 * q:
        return C * fair, np.zeros_like(C)
    w, a2 = free[some], power[some][:, None, None]
    e = left[some] / np.sqrt(w)[:, None]
    weight = (w / np.sum(w))[:, None, None]
    C0, C1 = C, C / float(np.max(a2))
    for _ in range(TURNS):
        part = a2 * C1
        gain = part @ np.linalg.inv(C0 + part)
        u = (gain @ e[:, :, None])[:, :, 0]
        spread = part - gain @ part
        rest = e - u
        C0 = np.sum(weight * (rest[:, :, None] * rest.conj()[:, None, :] + spread), axis=0)
        C1 = np.sum(weight / a2 * (u[:, :, None] * u.conj()[:, None, :] + spread), axis=0)
    return C0 * fair, C1 * fair
