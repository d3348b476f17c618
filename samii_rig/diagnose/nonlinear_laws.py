"""Describing functions: what a nonlinear force is at one frequency, by the amplitude there.

A force f(y) that meets a sine of amplitude A answers with N(A) y and harmonics (Gelb and Vander
Velde, Multiple-Input Describing Functions, 1968). One that meets a random-phase multisine of
standard deviation sigma answers with E[f'] y and distortion (Bussgang's theorem).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numba import njit
from scipy.special import erf

from samii_rig.types import Complex, Float

PHASES = 32  # instants of a period over which the flow's fundamental is summed


Strength = float | Float


@dataclass(frozen=True, slots=True)
class Law:
    """A force with one strength p.

    sine : (A (n,), p) -> N (n,). gauss : (sigma (n,), p) -> N (n,). force : (y, p) -> f.
    of_speed : whether y is the speed of what is read, not its place.
    """

    sine: Callable[[Float, Strength], Float]
    gauss: Callable[[Float, Strength], Float]
    force: Callable[[Float, float], Float]
    of_speed: bool = False


def clipped(A: Float, limit: Strength) -> Float:
    """N of clip(y, -limit, limit): 1 below the limit."""
    r = np.minimum(limit / np.maximum(A, 1e-300), 1.0)
    return np.asarray(2 / np.pi * (np.arcsin(r) + r * np.sqrt(1 - r**2)))


def clipped_gauss(sigma: Float, limit: Strength) -> Float:
    """The same for a Gaussian y: the chance that it is below the limit."""
    return np.asarray(erf(limit / (np.sqrt(2) * np.maximum(sigma, 1e-300))))


FRICTION = Law(
    sine=lambda A, T: 4 * T / (np.pi * np.maximum(A, 1e-300)),
    gauss=lambda sigma, T: np.sqrt(2 / np.pi) * T / np.maximum(sigma, 1e-300),
    force=lambda y, T: T * np.sign(y),
    of_speed=True,
)
CUBIC = Law(
    sine=lambda A, k: 0.75 * k * A**2,
    gauss=lambda sigma, k: 3 * k * sigma**2,
    force=lambda y, k: k * y**3,
)
# What a dead zone of this whole width takes away from y.
GAP = Law(
    sine=lambda A, width: clipped(A, width / 2),
    gauss=lambda sigma, width: clipped_gauss(sigma, width / 2),
    force=lambda y, width: np.clip(y, -width / 2, width / 2),
)
# What a limit takes away from y.
EXCESS = Law(
    sine=lambda A, limit: 1 - clipped(A, limit),
    gauss=lambda sigma, limit: 1 - clipped_gauss(sigma, limit),
    force=lambda y, limit: y - np.clip(y, -limit, limit),
)


def starved(flow: Complex, M: Complex, T_s: Strength) -> Complex:
    """Fundamental of q sqrt(1 + sign(q) M/T_s) - q: an orifice whose supply holds a torque T_s.

    flow : (n,) that the valve is told to let through, M : (..., n) phasors, T_s : (..., 1); M is
    the chain's moment, which pushes against a positive flow when negative.
    """
    shape = np.broadcast_shapes(flow.shape, M.shape, np.shape(T_s))
    rows = [np.broadcast_to(x, shape).reshape(-1, shape[-1]) for x in (flow, M, np.asarray(T_s))]
    return np.asarray(_starved(*rows)).reshape(shape)


@njit(cache=True)
def _starved(flow: Complex, M: Complex, T_s: Float) -> Complex:
    """(m, n) each. Both halves of a period give the same, so that one is enough."""
    out = np.zeros(flow.shape, np.complex128)
    half = PHASES // 2
    for k in range(half):
        turn = np.exp(1j * np.pi * k / half)
        back = 2 / half * np.conj(turn)
        for i in range(flow.shape[0]):
            for j in range(flow.shape[1]):
                q, m = (flow[i, j] * turn).real, (M[i, j] * turn).real
                held = 1 + np.sign(q) * m / T_s[i, j]
                out[i, j] += q * (np.sqrt(max(held, 0.0)) - 1) * back
    return out


def starved_gauss(flow: Complex, M: Complex, power: Float, T_s: Strength) -> Complex:
    """The same for lines that act at once, of a supply that is far from its limit: the best
    linear approximation of |q| M/(2 T_s), for q and M that are Gaussian together.

    flow : (n,), M : (..., n) per unit command of mean square `power` (n,).
    """
    sd = np.sqrt(np.sum(np.abs(flow) ** 2 * power))
    both = np.sum(np.real(flow * M.conj()) * power, axis=-1, keepdims=True)
    if not sd > 0:
        return np.zeros_like(M)
    return np.asarray(np.sqrt(2 / np.pi) / (2 * np.asarray(T_s)) * (sd * M + both / sd * flow))
