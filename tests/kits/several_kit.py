"""Recordings of a small plant of two inputs and three outputs, with the truth beside them.

The plant is two masses on springs, each pushed by one input: x'' = M^-1 (v - K x - D x'), sampled
by a zero-order hold. Outputs are both displacements and their difference seen by a third sensor.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import signal

from samii_rig.types import Channel, Recording, Segment

RATE = 50.0
INPUTS, OUTPUTS = ("v_1", "v_2"), ("x_1", "x_2", "x_3")
NOISE = 2e-5  # m rms a sample; the displacements are some 2 mm


@dataclass(frozen=True)
class Masses:
    """Sampled state space; y[n] does not see v[n]."""

    A: np.ndarray
    B: np.ndarray
    C: np.ndarray

    def response(self, frequency: np.ndarray) -> np.ndarray:
        """(n_freq, 3, 2)."""
        z = np.exp(2j * np.pi * np.asarray(frequency) / RATE)
        return self.C @ np.linalg.inv(z[:, None, None] * np.eye(4) - self.A) @ self.B


def masses() -> Masses:
    """Modes at 2.1 and 4.6 Hz, 6 to 8 % damped."""
    K = np.array([[400.0, -150.0], [-150.0, 600.0]])
    D = np.array([[2.2, -0.4], [-0.4, 3.0]])
    M = np.diag([1.5, 0.9])
    A = np.block([[np.zeros((2, 2)), np.eye(2)], [-np.linalg.solve(M, np.hstack([K, D]))]])
    B = np.vstack([np.zeros((2, 2)), np.linalg.inv(M)])
    C = np.array([[1.0, 0, 0, 0], [0, 1.0, 0, 0], [0.5, -0.4, 0, 0]])
    Ad, Bd, Cd, _, _ = signal.cont2discrete((A, B, C, np.zeros((3, 2))), 1 / RATE)
    return Masses(Ad, Bd, Cd)


def driven(
    u: np.ndarray,
    rng: np.random.Generator,
    *,
    loop: float = 0.0,
    noise: float = NOISE,
    cubic: float = 0.0,
) -> np.ndarray:
    """(n, 7) columns u_1, u_2, v_1, v_2, x_1, x_2, x_3 of a run from rest.

    loop : v_i = u_i - loop x_i, of what the noisy sensor reads. cubic : N/m^3, a hardening spring
    of the first mass.
    """
    system = masses()
    x, out = np.zeros(4), np.empty((len(u), 7))
    for n, now in enumerate(u):
        y = system.C @ x + noise * rng.normal(size=3)
        v = now - loop * y[:2]
        out[n] = np.concatenate([now, v, y])
        x = system.A @ x + system.B @ (v - np.array([cubic * x[0] ** 3, 0.0]))
    return out


def recording(
    columns: list[np.ndarray],
    kind: str,
    *,
    level: float | list[float] = 1.0,
    source: str = "run",
    keep: tuple[str, ...] | None = None,
) -> Recording:
    """Segments of equal length, one after the other. keep : names of the channels that were
    recorded; all without."""
    names = [("u_1", "N", "reference"), ("u_2", "N", "reference")]
    names += [(n, "N", "command") for n in INPUTS] + [(n, "m", "sensor") for n in OUTPUTS]
    chosen = [i for i, (n, _, _) in enumerate(names) if keep is None or n in keep]
    n = len(columns[0])
    count = np.arange(n * len(columns), dtype=np.int64)
    levels = level if isinstance(level, list) else [level] * len(columns)
    return Recording(
        channels=tuple(Channel(*names[i]) for i in chosen),
        rate_hz=RATE,
        time=(count * round(1e9 / RATE)).astype(np.int64),
        sequence=count,
        values=np.concatenate(columns)[:, chosen],
        quality=np.zeros((count.size, len(chosen)), np.uint8),
        segments=tuple(
            Segment(f"{kind} {i + 1}", kind, i * n, (i + 1) * n, levels[i], "N", i)
            for i in range(len(columns))
        ),
        source=source,
    )


def sweep(which: int, *, level: float = 1.0) -> np.ndarray:
    """(n, 2) 0.5 to 10 Hz in 5 s by one input; 1 s of rest before, 14 s after."""
    t = np.arange(round(20 * RATE)) / RATE - 1.0
    growth = np.log(10 / 0.5)
    phase = 2 * np.pi * 0.5 * 5 / growth * (np.exp(np.clip(t, 0, 5) / 5 * growth) - 1)
    ramp = np.clip(np.minimum(t / 0.3, (5 - t) / 0.3), 0, 1)
    u = np.zeros((t.size, 2))
    u[:, which] = level * np.sin(phase) * np.sin(ramp * np.pi / 2) ** 2
    return u


def multisines(realisations: int, rng: np.random.Generator, *, seconds: float = 8.0) -> list:
    """Periods (n, 2) of rms 1, lines to 10 Hz; two a realisation, in the second v_2 reversed."""
    n = round(seconds * RATE)
    lines = np.arange(4, round(10 * seconds))
    out = []
    for _ in range(realisations):
        S = np.zeros((n // 2 + 1, 2), complex)
        S[lines] = np.exp(2j * np.pi * rng.random((lines.size, 2)))
        u = np.fft.irfft(S, n, axis=0)
        u /= u.std(axis=0)
        out += [u, u * np.array([1.0, -1.0])]
    return out


def repeated(u: np.ndarray, periods: int, rng: np.random.Generator, **options) -> np.ndarray:
    """The last `periods` periods of a run of one period u more than thrice as long."""
    return driven(np.tile(u, (periods + 3, 1)), rng, **options)[3 * len(u) :]
