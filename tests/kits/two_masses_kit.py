"""The two masses of the shipped rig file, integrated by themselves: Runge-Kutta on substeps."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

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
    h, v, m2 = 1 / (RATE * SUBSTEPS), v.copy(), M2 + more
    noise = np.random.default_rng(seed).standard_normal((v.size, 2)) * [1e-6, 0.02]
    read = np.zeros(v.size)
    z = np.zeros(6)  # x_1, its speed, x_2, its speed, the coil's force, the friction's
    T_c, bristles = dry
    out = np.zeros((v.size, 2))  # m, m/s^2

    def rate_of(z: Float, force: float) -> Float:
        x1, v1, x2, v2, f, h = z
        way = x2 - x1
        inner = K2 * (way - 0.5 * np.copysign(gap, way)) + C2 * (v2 - v1)
        if 2 * abs(way) < gap:
            inner = 0.0
        a1 = (f + inner - K1 * x1 - C1 * v1 - k3 * x1**3 - h) / M1
        rubs = bristles * (v1 - abs(v1) * h / T_c) if T_c else 0.0
        return np.array([v1, a1, v2, -inner / m2, CORNER * (force - f), rubs])

    for i, asked in enumerate(v):
        out[i] = z[0], rate_of(z, 0.0)[3]
        read[i] = np.round((z[0] + noise[i, 0]) / 0.5e-6) * 0.5e-6
        command = asked
        if pd is not None:
            back = pd[0] * read[i] + pd[1] * RATE * (read[i] - (read[i - 1] if i else 0.0))
            v[i] = command = np.round((asked - back) / 0.3e-3) * 0.3e-3
        for j in range(SUBSTEPS):
            force = GAIN * gain((i + j / SUBSTEPS) / RATE) * float(command)
            a = rate_of(z, force)
            b = rate_of(z + h / 2 * a, force)
            c = rate_of(z + h / 2 * b, force)
            d = rate_of(z + h * c, force)
            z = z + h / 6 * (a + 2 * b + 2 * c + d)
    noisy = np.column_stack([read, out[:, 1] + noise[:, 1]])
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
