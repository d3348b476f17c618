"""The two masses of the shipped rig file, integrated by themselves: Runge-Kutta on substeps."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numba import njit

from samii_rig.diagnose.diagnose import diagnose
from samii_rig.diagnose.physics.effect import Effect
from samii_rig.diagnose.result import Diagnosis
from samii_rig.rig.load import load_rig
from samii_rig.rig.schema import Rig
from samii_rig.signal.estimate import estimate
from samii_rig.types import Channel, Float, Recording, Segment

RIG, TEXT = load_rig("two_masses")
RATE, SUBSTEPS = 500.0, 20
# True values over those of the rig file, each within its tolerance.
K1, C1, M1 = 12e3 * 1.02, 8.0 * 1.1, 1.5
K2, C2, M2 = 8e3 * 0.98, 5.0 * 0.9, 0.8
GAIN, CORNER = 6.0 * 1.01, 2 * np.pi * 120.0


def recorded(
    v: Float,
    seed: int,
    *,
    k3: float = 0.0,
    gain: Callable[[float], float] = lambda t: 1.0,
    more: float = 0.0,
    pd: tuple[float, float] | None = None,
    every: int = 1,
    meter: float = 0.0,
    gap: float = 0.0,
    dry: tuple[float, float] = (0.0, 0.0),
) -> Recording:
    """A record from rest under a held command v (n,) V, with the noise that the rig file states.

    k3 : N/m^3 of the first spring. gap : m, of the second one, in which neither it nor its damper
    acts. dry : N and N/m of friction beside the first, after Dahl. gain : of the coil, over time in
    s. more : kg on the second mass. pd : V/m and V s/m of a loop around what x_1 reads, whose
    reference is v then, and is not recorded; what goes out is rounded to the converter's steps.
    every : samples of the command for one that is recorded. meter : V, noise of what showed the
    command, the mean of both sides of its edges; 0 where it was recorded as it was sent.
    """
    v = v.copy()
    noise = np.random.default_rng(seed).standard_normal((v.size, 2)) * [1e-6, 0.02]
    gains = np.array([gain(i / SUBSTEPS / RATE) for i in range(v.size * SUBSTEPS)])
    parts = (k3, gap, M2 + more, *dry, *(pd or ()))
    read, a_2 = _integrated(v, noise[:, 0], GAIN * gains, tuple(map(float, parts)))
    noisy = np.column_stack([read, a_2 + noise[:, 1]])
    channels = (
        Channel("v", "V", "command", low=-10.0, high=10.0),
        Channel("x_1", "m", resolution=0.5e-6),
        Channel("a_2", "m/s^2"),
    )
    if meter:
        v = (v + np.append(0.0, v[:-1])) / 2
        v += meter * np.random.default_rng([seed, 1]).standard_normal(v.size)
    values = np.column_stack([v, noisy])[::every]
    at = np.arange(len(values))
    return Recording(
        channels,
        RATE / every,
        at * 2_000_000 * every,
        at,
        values,
        np.zeros(values.shape, np.uint8),
        (Segment("random", "single", 0, at.size, float(np.max(np.abs(v))), "V"),),
        rig_toml=TEXT,
        source=f"two_masses_{seed}.mcap",
    )


@njit(cache=True)
def _integrated(
    v: Float, noise: Float, gains: Float, parts: tuple[float, ...]
) -> tuple[Float, Float]:  # pragma: no cover (compiled)
    """What the encoder reads (n,) m, and the acceleration of the second mass (n,) m/s^2.

    v : (n,) V, as of `recorded`; what goes out is written there. noise : (n,) m. gains : (n
    SUBSTEPS,) N/V. parts : k3, gap, the second mass, T_c and bristles of `dry`, then pd if there is
    a loop.
    """
    k3, gap, m2, T_c, bristles = parts[:5]
    h = 1 / (RATE * SUBSTEPS)
    read, a_2 = np.zeros(v.size), np.zeros(v.size)
    z = np.zeros(6)  # x_1, its speed, x_2, its speed, the coil's force, the friction's
    a, b, c, d = np.zeros(6), np.zeros(6), np.zeros(6), np.zeros(6)

    def rate_of(z: Float, force: float, out: Float) -> None:
        way = z[2] - z[0]
        inner = 0.0
        if 2 * abs(way) >= gap:
            inner = K2 * (way - 0.5 * np.copysign(gap, way)) + C2 * (z[3] - z[1])
        out[0], out[2], out[3] = z[1], z[3], -inner / m2
        out[1] = (z[4] + inner - K1 * z[0] - C1 * z[1] - k3 * z[0] ** 3 - z[5]) / M1
        out[4] = CORNER * (force - z[4])
        out[5] = bristles * (z[1] - abs(z[1]) * z[5] / T_c) if T_c else 0.0

    for i in range(v.size):
        rate_of(z, 0.0, a)
        a_2[i] = a[3]
        read[i] = np.round((z[0] + noise[i]) / 0.5e-6) * 0.5e-6
        if len(parts) > 5:
            back = parts[5] * read[i] + parts[6] * RATE * (read[i] - (read[i - 1] if i else 0.0))
            v[i] = np.round((v[i] - back) / 0.3e-3) * 0.3e-3
        for j in range(SUBSTEPS):
            force = gains[i * SUBSTEPS + j] * v[i]
            rate_of(z, force, a)
            rate_of(z + h / 2 * a, force, b)
            rate_of(z + h / 2 * b, force, c)
            rate_of(z + h * c, force, d)
            z = z + h / 6 * (a + 2 * b + 2 * c + d)
    return read, a_2


def random_command(n: int, rms: float, seed: int) -> Float:
    """(n,) V, random to 40 Hz, in the steps of the converter."""
    f = np.fft.rfftfreq(n, 1 / RATE)
    rng = np.random.default_rng(seed)
    shape = np.where((f > 0.5) & (f < 40.0), np.exp(2j * np.pi * rng.random(f.size)), 0.0)
    v = np.fft.irfft(shape, n)
    return np.round(v * rms / np.std(v) / 0.3e-3) * 0.3e-3


def diagnosed(
    *runs: Recording, effects: Sequence[Effect] | None = None, rig: Rig = RIG
) -> Diagnosis:
    """effects : the linear ones to try, the whole table if None; all forces are."""
    return diagnose(estimate(runs, gaps="auto"), rig, runs=runs, effects=effects)
