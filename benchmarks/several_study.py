"""Are the intervals of responses to several inputs true? A study by simulation.

A sampled plant of two inputs and three outputs, whose responses are known exactly, is driven in
turn, together and in closed loop, with sensor noise and a disturbance at each input. The study
counts how often the 90 % intervals and the joint regions of all six entries hold the truth.

    python benchmarks/several_study.py --runs 500 --seed 101
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from scipy import signal

from samii_rig.signal import statistics
from samii_rig.signal.estimate import estimate
from samii_rig.types import Channel, FrequencyResponse, Recording, Segment

RATE = 100.0
MODES_HZ, DAMPING = np.array([3.0, 8.0]), np.array([0.1, 0.05])
INPUTS, OUTPUTS = ("v_2", "v_3"), ("theta_2", "theta_3", "a")
SENSOR = np.array([2e-5, 2e-5, 2e-2])  # rad, rad, m/s^2: rms of a sample
DISTURBANCE = 0.001  # V, rms of a sample, at each input, as long as the actuator holds it
LEVEL = 90.0
LOOP = np.array([3.0, 5.0])  # V/rad; the bandwidths are 0.2 and 0.4 Hz
REPEATS = 3


@dataclass(frozen=True)
class Plant:
    """x[n+1] = A x[n] + B v[n], y[n] = C x[n] + D v[n]; no angle sees v[n] at once."""

    A: np.ndarray
    B: np.ndarray
    C: np.ndarray
    D: np.ndarray

    def response(self, frequency: np.ndarray) -> np.ndarray:
        """(n_freq, 3, 2) exact response from the sequences v to the sequences y."""
        z = np.exp(2j * np.pi * frequency / RATE)
        inverse = np.linalg.inv(z[:, None, None] * np.eye(len(self.A)) - self.A)
        return self.C @ inverse @ self.B + self.D


def plant() -> Plant:
    """Two joints, each turned by an actuator with a lag, and two modes that both drive."""
    lag, gain = 25.0, np.array([0.5, 0.4])  # rad/s, rad/s per V
    w = 2 * np.pi * MODES_HZ
    A, B = np.zeros((8, 8)), np.zeros((8, 2))
    for i in range(2):
        A[2 * i, 2 * i], A[2 * i, 2 * i + 1] = -2.0, 1.0  # a joint that sags back
        A[2 * i + 1, 2 * i + 1], B[2 * i + 1, i] = -lag, gain[i] * lag
    drives = np.array([[1.0, 0.6], [-0.5, 1.0]])
    for m in range(2):
        j = 4 + 2 * m
        A[j, j + 1], A[j + 1, j], A[j + 1, j + 1] = 1.0, -(w[m] ** 2), -2 * DAMPING[m] * w[m]
        A[j + 1, 1], A[j + 1, 3] = drives[m] * lag
        B[j + 1] = -drives[m] * gain * lag
    C, D = np.zeros((3, 8)), np.zeros((3, 2))
    C[0, [0, 4, 6]] = 1.0, 0.03, 0.02
    C[1, [2, 4, 6]] = 1.0, -0.02, 0.04
    shape = np.array([1.0, 0.7])
    C[2] = shape @ A[5::2]
    D[2] = shape @ B[5::2]
    Ad, Bd, Cd, Dd, _ = signal.cont2discrete((A, B, C, D), 1 / RATE)
    return Plant(Ad, Bd, Cd, Dd)


def simulate(
    system: Plant, u: np.ndarray, shape: tuple[int, ...], rng: np.random.Generator, loop: np.ndarray
) -> np.ndarray:
    """Columns u_2, u_3, v_2, v_3, theta_2, theta_3, a of many runs: shape + (n, 7); u (n, 2)."""
    x = np.zeros((*shape, len(system.A)))
    out = np.empty((*shape, len(u), 7))
    settle = 600  # samples; the disturbance has been there for ever
    for n in range(-settle, len(u)):
        noise = rng.normal(size=(*shape, 3)) * SENSOR
        y = x @ system.C.T + noise
        now = u[n] if n >= 0 else np.zeros(2)
        v = now - loop * y[..., :2]
        drive = v + DISTURBANCE * rng.normal(size=v.shape)
        if n >= 0:
            out[..., n, :2], out[..., n, 2:4] = now, v
            out[..., n, 4:] = y + drive @ system.D.T
        x = x @ system.A.T + drive @ system.B.T
    return out


def recording(columns: np.ndarray, kind: str, source: str) -> Recording:
    """Segments (n_segments, n, 7) of one experiment as one recording."""
    segments, n, width = columns.shape
    count = np.arange(segments * n, dtype=np.int64)
    names = [(f"u_{k}", "V", "reference") for k in (2, 3)]
    names += [(n_, "V", "command") for n_ in INPUTS]
    names += [(n_, "rad", "sensor") for n_ in OUTPUTS[:2]] + [("a", "m/s^2", "sensor")]
    return Recording(
        channels=tuple(Channel(*c) for c in names),
        rate_hz=RATE,
        time=(count * round(1e9 / RATE)).astype(np.int64),
        sequence=count,
        values=columns.reshape(-1, width),
        quality=np.zeros((segments * n, width), np.uint8),
        segments=tuple(
            Segment(f"{kind} {i + 1}", kind, i * n, (i + 1) * n, 1.0, "V", i)
            for i in range(segments)
        ),
        source=source,
    )


def swept(driven: int) -> np.ndarray:
    """(n, 2) a sweep of 0.5 to 20 Hz in 6 s of one input; 1 s of rest before, 7 s after."""
    t = np.arange(round(14 * RATE)) / RATE - 1.0
    growth = np.log(20 / 0.5)
    phase = 2 * np.pi * 0.5 * 6 / growth * (np.exp(np.clip(t, 0, 6) / 6 * growth) - 1)
    ramp = np.clip(np.minimum(t / 0.3, (6 - t) / 0.3), 0, 1)
    u = np.zeros((t.size, 2))
    u[:, driven] = np.sin(phase) * np.sin(ramp * np.pi / 2) ** 2
    return u


def orthogonal(realisations: int, rng: np.random.Generator) -> list[np.ndarray]:
    """Periods (n, 2) of 6 s, two a realisation: the second with one input reversed."""
    n, lines = round(6 * RATE), np.arange(3, 120)
    out = []
    for _ in range(realisations):
        spectrum = np.zeros((n // 2 + 1, 2), complex)
        spectrum[lines] = np.exp(2j * np.pi * rng.random((lines.size, 2)))
        u = np.fft.irfft(spectrum, n, axis=0)
        u *= 0.3 / u.std(axis=0)
        out += [u, u * np.array([1.0, -1.0])]
    return out


def in_turn(total: int, seed: int, loop: np.ndarray) -> Iterator[FrequencyResponse]:
    """Each input three times by a sweep."""
    rng, system = np.random.default_rng(seed), plant()
    data = [simulate(system, swept(i), (total, REPEATS), rng, loop) for i in range(2)]
    for run in zip(*data, strict=True):
        yield estimate([recording(d, "burst", f"input {i}") for i, d in enumerate(run)])[0]


def at_once(
    total: int, seed: int, loop: np.ndarray, realisations: int, periods: int
) -> Iterator[FrequencyResponse]:
    """Orthogonal multisines; two periods come before the recorded ones."""
    rng, system = np.random.default_rng(seed), plant()
    data = []
    for u in orthogonal(realisations, rng):
        whole = simulate(system, np.tile(u, (periods + 3, 1)), (total,), rng, loop)
        data.append(whole[:, 3 * len(u) :])
    for run in zip(*data, strict=True):
        made = [recording(d[None], "periodic", f"experiment {k}") for k, d in enumerate(run)]
        yield estimate(made)[0]


def random(total: int, seed: int, loop: np.ndarray) -> Iterator[FrequencyResponse]:
    """Filtered noise at both inputs for 30 s, once."""
    rng, system = np.random.default_rng(seed), plant()
    b, a = signal.butter(4, 20 / (RATE / 2))
    u = 0.4 * signal.lfilter(b, a, rng.normal(size=(round(30 * RATE), 2)), axis=0)
    data = simulate(system, u, (total,), rng, loop)
    for d in data:
        yield estimate([recording(d[None], "single", "random")], band=(0.5, 20.0))[0]


@dataclass(frozen=True)
class Held:
    """Parts of the truths that 90 % intervals hold: real and imaginary parts of each entry
    (3, 2), magnitudes, and the joint region; T^2 over its mean, largest mean error in its
    standard deviations, and how the intervals compare with the scatter."""

    parts: np.ndarray
    magnitude: float
    joint: float
    ratio: float
    largest: float
    dof: float
    method: str


def held(estimates: Iterator[FrequencyResponse]) -> Held:
    """Counts over all lines and runs."""
    system = plant()
    parts, magnitude, joint, ratio, errors, dofs, method = [], [], [], [], [], [], ""
    for r in estimates:
        truth = system.response(r.frequency)
        real, imag = statistics.real_interval(r), statistics.imag_interval(r)
        size = statistics.magnitude_interval(r)
        inside = [(i.low <= x) & (x <= i.high) for i, x in ((real, truth.real), (imag, truth.imag))]
        parts.append(np.mean(inside, axis=(0, 1)))
        magnitude.append(np.mean((size.low <= np.abs(truth)) & (np.abs(truth) <= size.high)))
        t2, p = statistics.model_distance(r, truth)
        joint.append(np.mean(p > 0.1))
        ratio.append(np.mean(t2 / statistics.hotelling_mean(6, r.dof)))
        errors.append((r.H - truth) / np.sqrt(r.variance()))
        dofs.append(np.median(r.dof))
        method = r.method
    lines = min(e.shape[0] for e in errors)
    mean = np.mean([e[:lines] for e in errors], axis=0) * np.sqrt(2 * len(errors))
    largest = float(np.abs(np.concatenate([mean.real, mean.imag])).max())
    return Held(
        np.mean(parts, axis=0),
        float(np.mean(magnitude)),
        float(np.mean(joint)),
        float(np.mean(ratio)),
        largest,
        float(np.median(dofs)),
        method,
    )


OPEN = np.zeros(2)
CASES: dict[str, Callable[[int, int], Iterator[FrequencyResponse]]] = {
    "in turn": lambda n, s: in_turn(n, s, OPEN),
    "together, 3 realisations": lambda n, s: at_once(n, s, OPEN, 3, 2),
    "together, 1 realisation": lambda n, s: at_once(n, s, OPEN, 1, 4),
    "closed loop, in turn": lambda n, s: in_turn(n, s, LOOP),
    "closed loop, together": lambda n, s: at_once(n, s, LOOP, 3, 2),
    # A fifth of the runs: its bias, not its scatter, is in question.
    "closed loop, random": lambda n, s: random(max(n // 5, 2), s, LOOP),
}


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--runs", type=int, default=500)
    parser.add_argument("--seed", type=int, default=101)
    parser.add_argument("--only", default="", help="part of a case's name")
    options = parser.parse_args()
    print("| 90 % regions hold, % | entries, least to most | magnitude | joint | T^2/mean "
          "| largest mean error | nu | s |")  # fmt: skip
    print("|---|---|---|---|---|---|---|---|")
    for k, (name, case) in enumerate(CASES.items()):
        if options.only not in name:
            continue
        start = time.process_time()
        h = held(case(options.runs, options.seed + 1000 * k))
        span = f"{100 * h.parts.min():.1f} to {100 * h.parts.max():.1f}"
        print(
            f"| {name} | {span} | {100 * h.magnitude:.1f} | {100 * h.joint:.1f} | {h.ratio:.3f} "
            f"| {h.largest:.1f} | {h.dof:.0f} | {time.process_time() - start:.0f} |"
        )
        print(f"  {h.method}")


if __name__ == "__main__":
    main()
