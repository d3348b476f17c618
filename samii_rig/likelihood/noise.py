"""The noise of all sensors together.

In blocks of lines each sensor's own noise and what they share is one covariance C0. What disturbs
the rig itself, forces, a floor, the loop's own noise, comes out by the rig's poles, with another
covariance C1. So in a block

    C(f) = C0 + a(f)^2 C1,

a the size of what such a disturbance moves, with the poles of the rig; C0 and C1 by expectation
maximisation (Dempster, Laird and Rubin 1977, J. R. Stat. Soc. B 39).
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
        each = [_fitted(left[a:b], free[a:b], power[a:b]) for a, b in pairwise(ends)]
        edges = np.array([f[i] for i in ends[1:-1]])
        own, pushed = (np.stack(C) for C in zip(*each, strict=True))
        return cls(edges, own, pushed, shape)

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
