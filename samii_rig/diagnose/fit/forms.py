"""Chi-square as a quadratic form in what one part changes, one complex number at each frequency.

A part at a place changes every output by b phi, with b (n, q) of the place and phi (n,) of its law
and strength. Directions that may still move for nothing are projected out.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from samii_rig.diagnose.physics.effect import Unknown
from samii_rig.levenberg import ByFactor, step
from samii_rig.types import Complex, Float

LONGEST_STEP = 3.0  # a step of a logarithm
DESCENT_ROUNDS = 6  # of a descent, at most
# Of the diagonal: few rounds, so it changes fast.
FORM_DAMPING = ByFactor(1e-2, shrink=0.1, grow=30.0)
DESCENT_ENDS = 0.05  # of chi-square, gained in one of them: less and they end
LAW_STEP = 1e-4  # of a logarithm, for derivatives of a law


class Form(Protocol):
    """Chi-square of phi, and its derivatives."""

    def cost(self, phi: Complex) -> Float:
        """(m,) chi-square of phi (m, n)."""
        ...

    def normal(self, phi: Complex, d: Complex) -> tuple[Float, Float]:
        """Half the gradient (m, k), and the Gauss-Newton matrix (m, k, k), along d (m, k, n)."""
        ...


@dataclass(frozen=True, slots=True)
class Lines:
    """Of lines with independent noise: residuals r + v phi.

    lin (n,) : conj(r) v. square (n,) : |v|^2. P (n, m) : directions on v. power, q (m,) : of r.
    """

    lin: Complex
    square: Float
    P: Complex
    power: float
    q: Float

    def cost(self, phi: Complex) -> Float:
        """As of `Form`."""
        q = self.q + (phi @ self.P).real
        power = self.power + 2 * (phi @ self.lin).real + (np.abs(phi) ** 2) @ self.square
        cost = power - np.sum(q**2, axis=1)
        return np.where(np.isfinite(cost), cost, np.inf)

    def normal(self, phi: Complex, d: Complex) -> tuple[Float, Float]:
        """As of `Form`."""
        q = self.q + (phi @ self.P).real
        own = (d @ self.P).real
        pull = self.lin.conj() + self.square * phi
        g = np.einsum("mkn,mn->mk", d.conj(), pull).real - np.einsum("mkj,mj->mk", own, q)
        H = ((d.conj() * self.square) @ d.swapaxes(1, 2)).real - own @ own.swapaxes(1, 2)
        return np.asarray(g), np.asarray(H)


@dataclass(frozen=True, slots=True)
class Dense:
    """Of residuals r + K x that are not one frequency's each, x of each frequency Re phi, Im phi.

    square (2 n, 2 n) : K'K. lin (2 n,) : K'r. power : of r. on : of all frequencies, the n that
    count.
    """

    square: Float
    lin: Float
    power: float
    on: slice

    @classmethod
    def of(cls, b: Complex, A: Float, pull: Float, turn: Float, power: float, on: slice) -> Dense:
        """Of a part that moves the prediction by b phi.

        b : (n, q). A : (n, 2 q, n, 2 q), pull (n, 2 q) and turn (m, n, 2 q) : products of the
        changes of each frequency (real parts of all sensors, then imaginary ones) with each other,
        with what is left, and with the directions that are projected out.
        """
        n, q = b.shape
        one, other = (np.concatenate([x.real, x.imag], axis=1) for x in (b, 1j * b))
        moved = np.stack([one, other], axis=2)
        half = moved.swapaxes(1, 2) @ A.reshape(n, 2 * q, -1)
        half = half.reshape(2 * n, n, 2 * q).swapaxes(0, 1) @ moved
        along = (turn.swapaxes(0, 1) @ moved).swapaxes(0, 1).reshape(len(turn), 2 * n)
        square = half.swapaxes(0, 1).reshape(2 * n, 2 * n) - along.T @ along
        return cls(square, (pull[:, None, :] @ moved).ravel(), power, on)

    def cost(self, phi: Complex) -> Float:
        """As of `Form`."""
        x = self._parts(phi)
        cost = self.power + np.sum(x * (x @ self.square + 2 * self.lin), axis=1)
        return np.where(np.isfinite(cost), cost, np.inf)

    def normal(self, phi: Complex, d: Complex) -> tuple[Float, Float]:
        """As of `Form`."""
        m, k, n = d.shape
        down = self._parts(phi) @ self.square + self.lin
        x = self._parts(d.reshape(m * k, n))
        g = np.einsum("mkp,mp->mk", x.reshape(m, k, -1), down)
        H = (x @ self.square).reshape(m, k, -1) @ x.reshape(m, k, -1).swapaxes(1, 2)
        return np.asarray(g), np.asarray(H)

    def _parts(self, phi: Complex) -> Float:
        """(m, 2 n) real and imaginary parts of phi (m, n_all) side by side."""
        return np.ascontiguousarray(phi[:, self.on], np.complex128).view(np.float64)


def descend(
    form: Form,
    phi_of: Callable[[Float], Complex],
    y: Float,
    cost: Float,
    unknowns: tuple[Unknown, ...],
) -> tuple[Float, Float]:
    """Chi-square and logarithms (m, k) after a few damped Gauss-Newton steps from y."""
    low, high = np.log([(u.low, u.high) for u in unknowns]).T
    m, k = y.shape
    damping = np.full(m, FORM_DAMPING.value)
    for turn in range(DESCENT_ROUNDS):
        ahead = (y[:, None, :] + LAW_STEP * np.eye(k)).reshape(-1, k)
        every = phi_of(np.exp(np.concatenate([y, ahead])))
        phi = every[:m]
        d = (every[m:].reshape(m, k, -1) - phi[:, None, :]) / LAW_STEP
        g, H = form.normal(phi, d)
        if not (np.all(np.isfinite(H)) and np.all(np.isfinite(g))):
            break
        new = np.clip(y + bounded_step(H, g, damping[:, None]), low, high)
        there = form.cost(phi_of(np.exp(new)))
        better = there < cost
        settled = turn > 0 and not np.any(cost - there > DESCENT_ENDS)
        y = np.where(better[:, None], new, y)
        cost = np.where(better, there, cost)
        damping *= np.where(better, FORM_DAMPING.shrink, FORM_DAMPING.grow)
        if settled:
            break
    return cost, y


def bounded_step(A: Float, g: Float, damping: float | Float) -> Float:
    """(..., k) damped step of logarithms, none longer than `LONGEST_STEP`.

    A : (..., k, k). g : (..., k). damping : of the diagonal, one or (..., 1).
    """
    size = np.abs(np.einsum("...kk->...k", A))
    floor = 1e-9 * np.max(size, axis=-1, initial=1e-30, keepdims=True)
    return np.asarray(np.clip(step(A, g, damping * size + floor), -LONGEST_STEP, LONGEST_STEP))
