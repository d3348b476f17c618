"""A hammer on two masses between springs, recorded through filters: by the matrix exponential."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy import linalg, signal

from samii_rig.diagnose.diagnose import diagnose
from samii_rig.diagnose.physics.effect import Effect
from samii_rig.diagnose.result import Diagnosis
from samii_rig.rig.load import parse
from samii_rig.rig.schema import Rig
from samii_rig.signal.estimate import estimate
from samii_rig.types import Channel, Recording, Segment

RATE, FINE = 1000.0, 16  # samples/s, and steps of the simulation a sample
M1, M2, K1, K2, C1, C2 = 2.0, 1.5, 54e3, 42e3, 9.0, 6.0
TOML = (
    f"""
name = "frame"
motion = "axial"
base = "clamped"
tip = "free"
rate_hz = {RATE}
"""
    + "".join(
        f"""
[[element]]
name = "columns_{i}"
kind = "spring"
k = {{ value = {k}, unit = "N/m", tolerance = 0.05, source = "drawing" }}
c = {{ value = {c}, unit = "N s/m", tolerance = 0.3, source = "guess" }}

[[element]]
name = "floor_{i}"
kind = "mass"
m = {{ value = {m}, unit = "kg", tolerance = 0.01, source = "weighed" }}

[[sensor]]
name = "a_{i}"
kind = "acceleration"
on = "floor_{i}"
unit = "m/s^2"
noise_rms = 0.01
"""
        for i, m, k, c in ((1, M1, K1, C1), (2, M2, K2, C2))
    )
    + """
[[element]]
name = "hammer"
kind = "force_source"
input = "F"
K = { value = 1.0, unit = "N/N", tolerance = 0.01, source = "calibration of the hammer" }

[[actuator]]
name = "F"
unit = "N"
low = -1000.0
high = 1000.0
"""
)
RIG = parse(Rig, TOML, "frame")
HITS = ((0.3003, 80.0, 4.1e-3), (1.1508, 120.0, 5.2e-3), (1.9001, 50.0, 3.4e-3))  # s, N, s


def struck(
    seed: int,
    *,
    kg: float = 0.0,
    k2: float = K2,
    filtered: bool = True,
    of_force: float = 0.02,
) -> Recording:
    """`HITS` on the second mass. kg : N/m of a spring from there to the ground. k2 :
    N/m of the columns between both. of_force : its noise, N."""
    n = 3000
    t = np.arange(n * FINE) / (RATE * FINE)
    F = np.zeros(t.size)
    for at, height, width in HITS:
        on = (t >= at) & (t < at + width)
        F[on] += height * np.sin(np.pi * (t[on] - at) / width)
    A = np.zeros((4, 4))
    A[:2, 2:] = np.eye(2)
    A[2] = np.array([-K1 - k2, k2, -C1 - C2, C2]) / M1
    A[3] = np.array([k2, -k2 - kg, C2, -C2]) / M2
    B = np.array([[0.0], [0.0], [0.0], [1 / M2]])
    h = t[1]
    whole = linalg.expm(h * np.block([[A, B, 0 * B], [np.zeros((1, 5)), np.eye(1) / h],
                                      [np.zeros((1, 6))]]))  # fmt: skip
    step, now, ahead = whole[:4, :4], whole[:4, 4], whole[:4, 5]
    # Linear between the steps: what the slope adds is what `ahead` has.
    pushed = np.outer(F[:-1], now - ahead) + np.outer(F[1:], ahead)
    x = np.zeros((t.size, 4))
    for i in range(t.size - 1):
        x[i + 1] = step @ x[i] + pushed[i]
    a = x @ A[2:].T
    a[:, 1] += F / M2
    every = np.column_stack([F, a])
    if filtered:
        taps = signal.firwin(64 * FINE + 1, 0.45 * RATE, fs=RATE * FINE, window=("kaiser", 9.0))
        every = signal.fftconvolve(every, taps[:, None], mode="same")
    rng = np.random.default_rng(seed)
    values = every[::FINE] + rng.standard_normal((n, 3)) * [of_force, 0.01, 0.01]
    channels = (
        Channel("F", "N", "command", low=-1000.0, high=1000.0),
        Channel("a_1", "m/s^2"),
        Channel("a_2", "m/s^2"),
    )
    at = np.arange(n)
    return Recording(
        channels, RATE, at * 1_000_000, at, values, np.zeros(values.shape, np.uint8),
        (Segment("hits", "single", 0, n, 1.0, "N"),), rig_toml=TOML, source=f"hits_{seed}.mcap",
    )  # fmt: skip


def diagnosed(run: Recording, effects: Sequence[Effect] | None = None, rig: Rig = RIG) -> Diagnosis:
    """effects : the linear ones to try, the whole table if None."""
    return diagnose(estimate([run], gaps="auto"), rig, runs=[run], effects=effects)
