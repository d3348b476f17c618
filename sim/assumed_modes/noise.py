"""What disturbs the rig and its sensors, and the exact predictor of a record under it.

Disturbances enter the mechanism (a torque across a joint, a force on a link, the floor's
acceleration) or the valve, each white noise behind a first-order filter, held over a sample.
Through the rig and the loop they colour all channels together. Each sensor adds white noise and
wanders slowly; mains hum and spikes come on top. All but those two is one linear system driven
by white noise, so a Kalman predictor turns a record's noise into white noise, however long.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from scipy.linalg import block_diag
from scipy.signal import lfilter

from samii_rig.errors import SamiiRigError
from samii_rig.types import Float
from sim.assumed_modes.plant import Push
from sim.assumed_modes.sampled import Loop, impulse


@dataclass(frozen=True, slots=True)
class Noise:
    """One drawn set.

    pushes, push_rms (n_d,), push_corner (n_d,) Hz : disturbances, rms in their own unit.
    white (n_y,) : rms of each sensor's white noise, its converter's rounding not included.
    rounding (n_y,) : step/sqrt(12) of the converter.
    wander (n_y,), wander_hz : rms and corner of slow wandering. offset (n_y,) constant.
    hum (n_y,), hum_hz, hum_phase (n_y,) : amplitude of the mains line.
    spikes : expected spikes a second and channel; spike (n_y,) their rms.
    """

    pushes: tuple[Push, ...]
    push_rms: Float
    push_corner: Float
    white: Float
    rounding: Float
    wander: Float
    wander_hz: float
    offset: Float
    hum: Float
    hum_hz: float
    hum_phase: Float
    spikes: float = 0.0
    spike: Float = field(default_factory=lambda: np.zeros(0))


def first_order(corner_hz: float, rate_hz: float) -> tuple[float, float]:
    """a and g of x' = a x + g w, which has the variance of w."""
    a = float(np.exp(-2 * np.pi * corner_hz / rate_hz))
    return a, float(np.sqrt(1.0 - a * a))


def coloured(rng: np.random.Generator, corner_hz: float, rate_hz: float, n: int) -> Float:
    """(n,) unit-rms noise behind a first-order filter, stationary from the first sample."""
    a, g = first_order(corner_hz, rate_hz)
    white = rng.standard_normal(n)
    out, _ = lfilter([g], [1.0, -a], white, zi=[a * rng.standard_normal()])
    return np.asarray(out, dtype=np.float64)


@dataclass(frozen=True, slots=True)
class NoiseModel:
    """s' = A s + G w, y = C s + H w with white unit w, at the loop's rate."""

    A: Float
    G: Float
    C: Float
    H: Float


def noise_model(loop: Loop, noise: Noise, rate_hz: float) -> NoiseModel:
    """The closed loop driven by all its noise but hum and spikes."""
    n, n_y, n_d = len(loop.A), len(loop.C), len(noise.pushes)
    pairs = [first_order(c, rate_hz) for c in noise.push_corner]
    slow = [first_order(noise.wander_hz, rate_hz)] * n_y
    A = block_diag(loop.A, np.diag([a for a, _ in (*pairs, *slow)]))
    A[:n, n : n + n_d] = loop.E * noise.push_rms
    A[:n, n + n_d :] = loop.f * noise.wander
    e = np.sqrt(noise.white**2 + noise.rounding**2)
    G = np.zeros((len(A), n_d + 2 * n_y))
    G[n:, : n_d + n_y] = np.diag([g for _, g in (*pairs, *slow)])
    G[:n, n_d + n_y :] = loop.f * e
    C = np.hstack([loop.C, np.zeros((n_y, n_d)), np.diag(noise.wander)])
    H = np.hstack([np.zeros((n_y, n_d + n_y)), np.diag(e)])
    return NoiseModel(A, G, C, H)


def unit_effect(loop: Loop, corners: Float, rate_hz: float, seconds: float = 20.0) -> Float:
    """(n_y, n_d) rms in each channel of each disturbance at unit rms, from rest for `seconds`."""
    n, n_d = loop.E.shape
    pairs = [first_order(c, rate_hz) for c in corners]
    A = block_diag(loop.A, np.diag([a for a, _ in pairs]))
    A[:n, n:] = loop.E
    G = np.vstack([np.zeros((n, n_d)), np.diag([g for _, g in pairs])])
    C = np.hstack([loop.C, np.zeros((len(loop.C), n_d))])
    h = impulse(A, G, C, round(seconds * rate_hz))
    return np.asarray(np.sqrt((h**2).sum(axis=0)))


@dataclass(frozen=True, slots=True)
class Whitener:
    """The predictor's innovations of a record, scaled to unit variance: whitened noise is white.

    x' = A x + B y, nu = D (y - C x). response : (n, n_y, n_y) its impulse response.
    """

    A: Float
    B: Float
    C: Float
    D: Float

    def response(self, n: int) -> Float:
        """(n, n_y, n_y) impulse response from channels to innovations."""
        out = np.empty((n, *self.D.shape))
        out[0] = self.D
        if n > 1:
            out[1:] = -self.D @ impulse(self.A, self.B, self.C, n - 1)
        return out


def whitener(model: NoiseModel, every: int = 1) -> Whitener:
    """The stationary Kalman predictor of every `every`-th sample."""
    A, C = model.A, model.C
    n = len(A)
    step, W = np.eye(n), np.zeros((n, n))
    for _ in range(every):
        W = W + step @ model.G @ model.G.T @ step.T
        last = step
        step = A @ step
    R = model.H @ model.H.T
    N = last @ model.G @ model.H.T  # the oldest sample's error went round the loop since
    RiC = np.linalg.solve(R, C)
    P = _riccati(step - N @ RiC, C.T @ RiC, W - N @ np.linalg.solve(R, N.T))
    S = C @ P @ C.T + R
    gain: Float = np.linalg.solve(S, (step @ P @ C.T + N).T).T.astype(np.float64)
    D: Float = np.linalg.inv(np.linalg.cholesky(S)).astype(np.float64)
    return Whitener(step - gain @ C, gain, C, D)


DOUBLINGS = 40  # 2^40 samples: longer than any record


def _riccati(A: Float, G: Float, Q: Float) -> Float:
    """P = A P (I + G P)^-1 A^T + Q by doubling (structure-preserving, Chu et al. 2004)."""
    F, H = A.T.copy(), 0.5 * (Q + Q.T)
    eye = np.eye(len(A))
    for _ in range(DOUBLINGS):
        inv = np.linalg.inv(eye + G @ H)
        more = F.T @ H @ inv @ F
        G = G + F @ inv @ G @ F.T
        F = F @ inv @ F
        H = H + more
        H, G = 0.5 * (H + H.T), 0.5 * (G + G.T)
        if np.abs(more).max() <= 1e-12 * np.abs(H).max():
            return H
    raise SamiiRigError("the noise has no stationary predictor: the doubling did not converge")
