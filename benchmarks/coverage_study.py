"""Are the intervals and the covariance of `samii_rig.signal` true? A study by simulation.

A linear sampled plant whose frequency response is known exactly runs in closed loop with a
disturbance through its resonances and noise on every sensor. Every run has fresh noise. The
study counts how often the 90 % intervals hold the truth, and holds T^2 against Hotelling's
distribution with the stated degrees of freedom.

    python benchmarks/coverage_study.py --runs 500 --seed 1
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import signal, stats

from experiments.swept_sine import SweptSine
from samii_rig.model.sampled import sampled_response
from samii_rig.rig.load import load_rig
from samii_rig.run.loop import run
from samii_rig.signal import statistics
from samii_rig.signal.estimate import estimate
from samii_rig.types import Channel, FrequencyResponse, Recording, SampleBlock, Segment
from sim.rig import open_rig

RATE = 200.0
MODES_HZ = np.array([3.0, 8.0, 19.0])
DAMPING = np.array([0.03, 0.02, 0.015])
CHANNELS = ("theta", "a_0", "a_1", "a_2")
SAMII_CHANNELS = ("theta_2", "a_0", "a_1", "a_2")
LEVEL = 90.0


@dataclass(frozen=True)
class Plant:
    """x[n+1] = A x[n] + B v[n] + E w[n], y[n] = C x[n] + D v[n], v = u - kp y_0.

    A joint turned by an integrating actuator with a lag, and three modes that its
    acceleration drives. y_0 is the angle; it does not see v[n] at once.
    """

    A: np.ndarray
    B: np.ndarray
    C: np.ndarray
    D: np.ndarray
    E: np.ndarray
    kp: float = 4.0

    def response(self, frequency: np.ndarray) -> np.ndarray:
        """(n_freq, n_out) exact response from the sequence v to the sequences y."""
        z = np.exp(2j * np.pi * frequency / RATE)
        inverse = np.linalg.inv(z[:, None, None] * np.eye(len(self.A)) - self.A)
        return inverse_times(self.C, inverse, self.B) + self.D


def inverse_times(C: np.ndarray, inverse: np.ndarray, B: np.ndarray) -> np.ndarray:
    return np.einsum("ij,fjk,k->fi", C, inverse, B)


def plant(damping: np.ndarray = DAMPING, kp: float = 4.0) -> Plant:
    K, p = 0.5, 60.0  # rad/s per V, rad/s
    w = 2 * np.pi * MODES_HZ
    n = 2 + 2 * len(w)
    A, B, E = np.zeros((n, n)), np.zeros(n), np.zeros(n)
    A[0, 1], A[1, 1], B[1] = 1.0, -p, K * p
    for i, (wi, zi) in enumerate(zip(w, damping, strict=True)):
        j = 2 + 2 * i
        A[j, j + 1] = 1.0
        A[j + 1, j], A[j + 1, j + 1] = -(wi**2), -2 * zi * wi
        A[j + 1, 1], B[j + 1] = p, -K * p  # driven by minus the joint's acceleration
        E[j + 1] = 1.0
    shape = np.array([[0.03, 0.02, 0.01], [1.0, 0.6, 0.3], [0.5, -0.8, 0.6], [0.3, 0.5, -1.0]])
    C, D = np.zeros((4, n)), np.zeros(4)
    C[0, 0] = 1.0
    C[0, 2::2] = shape[0]
    for k in range(1, 4):
        C[k] = shape[k] @ A[3::2] + A[1]  # modal accelerations and the joint's own
        D[k] = shape[k] @ B[3::2] + B[1]
    Ad, BE, Cd, Dd, _ = signal.cont2discrete(
        (A, np.stack([B, E], axis=1), C, np.stack([D, 0 * D], axis=1)), 1 / RATE
    )
    return Plant(Ad, BE[:, 0], Cd, Dd[:, 0], BE[:, 1], kp)


def swept_sine(
    duration: float, sweep: float, low: float = 0.8, high: float = 30.0, lead: float = 0.5
) -> np.ndarray:
    """Logarithmic sweep with ramps, `lead` s of rest before, ring-down after."""
    t = np.arange(round(duration * RATE)) / RATE - lead
    growth = np.log(high / low)
    phase = 2 * np.pi * low * sweep / growth * (np.exp(np.clip(t, 0, sweep) / sweep * growth) - 1)
    ramp = np.clip(np.minimum(t / 0.3, (sweep - t) / 0.3), 0, 1)
    return np.sin(phase) * np.sin(ramp * np.pi / 2) ** 2


def simulate(
    system: Plant,
    u: np.ndarray,
    shape: tuple[int, ...],
    rng: np.random.Generator,
    *,
    sensor: np.ndarray,
    disturbance: float,
    friction: float = 0.0,
) -> np.ndarray:
    """Columns u, v, theta, a_0, ... of many runs at once: shape + (n, 2 + 4).

    friction : Coulomb torque in units of the actuator's input, against the joint's speed.
    """
    x = np.zeros((*shape, len(system.A)))
    out = np.empty((*shape, u.size, 2 + len(CHANNELS)))
    # The disturbance has been there for ever: let it settle before the record starts.
    settle = 800 if disturbance else 0
    for n in range(-settle, u.size):
        theta_only = x @ system.C[0]
        noise = rng.normal(size=(*shape, len(CHANNELS))) * sensor
        now = u[n] if n >= 0 else 0.0
        v = now - system.kp * (theta_only + noise[..., 0])
        drive = v - friction * np.sign(x[..., 1]) if friction else v
        if n >= 0:
            out[..., n, 0] = now
            out[..., n, 1] = v
            out[..., n, 2:] = x @ system.C.T + drive[..., None] * system.D + noise
        x = x @ system.A.T + drive[..., None] * system.B
        if disturbance:
            x += disturbance * rng.normal(size=shape)[..., None] * system.E
    return out


def recording(columns: np.ndarray, kind: str = "burst", level: float = 1.0) -> Recording:
    """Repeats (n_repeats, n, 6) one after the other, as one recording."""
    repeats, n, width = columns.shape
    names = [("u", "reference"), ("v", "command"), *((c, "sensor") for c in CHANNELS)]
    count = np.arange(repeats * n, dtype=np.int64)
    return Recording(
        channels=tuple(Channel(name, "V", role) for name, role in names),
        rate_hz=RATE,
        time=(count * round(1e9 / RATE)).astype(np.int64),
        sequence=count,
        values=columns.reshape(-1, width),
        quality=np.zeros((repeats * n, width), np.uint8),
        segments=tuple(
            Segment(f"sweep {i + 1}", kind, i * n, (i + 1) * n, level, "V", i)
            for i in range(repeats)
        ),
        source="simulated",
    )


# White sensor noise, and a disturbance that drives all modes: at the resonances the second
# is some ten times the first. Amplitude 1 V.
SENSOR = np.array([2e-5, 0.02, 0.02, 0.02])
DISTURBANCE = 0.3


def runs(
    total: int, seed: int, *, repeats: int, u: np.ndarray, kind: str, chunk: int = 50, **options
) -> Iterator[FrequencyResponse]:
    """Estimates of fresh runs of the standard plant."""
    rng = np.random.default_rng(seed)
    system = plant()
    for first in range(0, total, chunk):
        shape = (min(chunk, total - first), repeats)
        data = simulate(system, u, shape, rng, sensor=SENSOR, disturbance=DISTURBANCE)
        for columns in data:
            yield estimate([recording(columns, kind)], **options)[0]


@dataclass
class Coverage:
    """Counts of truths inside 90 % intervals, and T^2 over its stated distribution.

    other_grid : runs left out because other lines were estimated (a single burst taken for
        one that still rings has no lines near the ends of its sweep).
    """

    frequency: np.ndarray
    inside: dict[str, np.ndarray]
    ratio: np.ndarray
    p_values: np.ndarray
    error_sigma: np.ndarray
    dof: float
    other_grid: int
    resonances_hz: np.ndarray

    def bands(self) -> dict[str, np.ndarray]:
        f = self.frequency
        near = np.any(np.abs(f[:, None] / self.resonances_hz - 1) < 0.06, axis=1)
        ends = (f < f[0] + 0.08 * (f[-1] - f[0])) | (f > f[-1] - 0.08 * (f[-1] - f[0]))
        ends &= ~near
        return {"at resonances": near, "between": ~near & ~ends, "at the ends": ends}


def coverage(
    estimates: Iterator[FrequencyResponse],
    truth_of: Callable[[np.ndarray], np.ndarray] | None = None,
    resonances_hz: np.ndarray = MODES_HZ,
) -> Coverage:
    """`truth_of` gives (n_freq, n_out) at frequencies in Hz; by default the standard plant."""
    truth_of = truth_of or plant().response
    hits: dict[str, list[np.ndarray]] = {k: [] for k in ("real", "imag", "magnitude", "phase")}
    t2s, ps, errors, first, other_grid = [], [], [], None, 0
    for r in estimates:
        first = first or r
        if r.frequency.size != first.frequency.size:
            other_grid += 1
            continue
        truth = truth_of(r.frequency)[:, :, None]
        for name, interval, value in (
            ("real", statistics.real_interval(r), truth.real),
            ("imag", statistics.imag_interval(r), truth.imag),
            ("magnitude", statistics.magnitude_interval(r), np.abs(truth)),
        ):
            hits[name].append(((interval.low <= value) & (value <= interval.high))[:, :, 0])
        half = statistics.phase_half_width(r)
        turn = np.degrees(np.abs(np.angle(r.H * truth.conj())))
        hits["phase"].append((turn <= half)[:, :, 0])
        t2, p = statistics.model_distance(r, truth)
        scale = statistics.hotelling_mean(truth.shape[1], r.dof)
        t2s.append(t2 / scale)
        ps.append(p)
        errors.append(((r.H - truth) / np.sqrt(r.variance()))[:, :, 0])
    assert first is not None
    return Coverage(
        first.frequency,
        {k: np.array(v) for k, v in hits.items()},
        np.array(t2s),
        np.array(ps),
        np.array(errors),
        float(np.median(first.dof)),
        other_grid,
        resonances_hz,
    )


def summary(result: Coverage, channels: tuple[str, ...] = CHANNELS) -> str:
    lines = []
    both = (result.inside["real"] + 0.0 + result.inside["imag"]) / 2
    lines.append("| 90 % interval of | " + " | ".join((*result.bands(), "all")) + " |")
    lines.append("|---|" + "---|" * 4)
    masks = [*result.bands().values(), np.ones(result.frequency.size, bool)]
    for k, name in enumerate(channels):
        cells = [f"{100 * both[:, m, k].mean():.1f}" for m in masks]
        lines.append(f"| real, imaginary part, {name} | " + " | ".join(cells) + " |")
    for kind in ("magnitude", "phase"):
        cells = [f"{100 * result.inside[kind][:, m].mean():.1f}" for m in masks]
        lines.append(f"| {kind}, all channels | " + " | ".join(cells) + " |")
    cells = [f"{result.ratio[:, m].mean():.3f}" for m in masks]
    lines.append("| mean of T^2 over nu p/(nu - p) | " + " | ".join(cells) + " |")
    cells = [f"{percentile_ratio(result, m):.3f}" for m in masks]
    lines.append("| 95th percentile of T^2 over Hotelling's | " + " | ".join(cells) + " |")
    cells = [f"{100 * (result.p_values[:, m] > 0.1).mean():.1f}" for m in masks]
    lines.append("| joint 90 % region | " + " | ".join(cells) + " |")
    d, p = kolmogorov(result)
    lines.append("")
    lines.append(
        f"Median nu = {result.dof:.1f}; Kolmogorov-Smirnov, one line of each run: "
        f"D = {d:.4f}, p = {p:.3f}; largest mean error "
        f"{largest_bias(result):.2f} sigma/sqrt(runs); "
        f"{result.other_grid} runs on other lines left out"
    )
    return "\n".join(lines)


def percentile_ratio(result: Coverage, mask: np.ndarray) -> float:
    """95th percentile of T^2 over that of Hotelling's distribution with the stated nu."""
    p = len(CHANNELS)
    scale, dfn, dfd = statistics.hotelling_distribution(p, np.array([result.dof]))
    stated = float(scale[0] * stats.f.ppf(0.95, dfn[0], dfd[0]))
    mean = float(statistics.hotelling_mean(p, np.array([result.dof]))[0])
    return float(np.quantile(result.ratio[:, mask] * mean, 0.95)) / stated


def kolmogorov(result: Coverage) -> tuple[float, float]:
    """Test of uniform p-values. Lines of one run share a covariance, so each run gives one,
    a different one for each run."""
    n_runs, n_lines = result.p_values.shape
    pick = (np.arange(n_runs) * 97) % n_lines
    test = stats.kstest(result.p_values[np.arange(n_runs), pick], "uniform")
    return float(test.statistic), float(test.pvalue)


def largest_bias(result: Coverage) -> float:
    mean = result.error_sigma.mean(axis=0) * np.sqrt(2 * result.error_sigma.shape[0])
    return float(np.abs(np.concatenate([mean.real, mean.imag])).max())


BURST = {"duration": 30.0, "sweep": 14.0, "lead": 2.0}


@dataclass(frozen=True)
class LoopBias:
    """Errors of the mean over all runs, in its standard deviations: medians over lines.

    0.83 is the median where there is no bias (Rayleigh).
    """

    runs: int

    h1_sigma: float
    ours_sigma: float
    h1_relative: float


def loop_bias(total: int, seed: int) -> LoopBias:
    """Noise that comes back through the loop: H1 from v against the way through u.

    A stiffer loop (40 V/rad) and an angle sensor of 5 mrad noise; both estimates from the
    same leakage-free spectra.
    """
    system = plant(kp=40.0)
    u = swept_sine(**BURST)
    rng = np.random.default_rng(seed)
    noise = SENSOR * np.array([250.0, 1.0, 1.0, 1.0])
    data = simulate(system, u, (total, 3), rng, sensor=noise, disturbance=DISTURBANCE)
    ours = [estimate([recording(c)], outputs=["theta"], method="burst")[0] for c in data]
    frequency = ours[0].frequency
    lines = np.round(frequency * u.size / RATE).astype(int)
    spectra = np.fft.rfft(data, axis=2)[:, :, lines]
    V, Y = spectra[..., 1], spectra[..., 2]
    h1 = np.sum(Y * V.conj(), axis=1) / np.sum(np.abs(V) ** 2, axis=1)
    truth = system.response(frequency)[:, 0]
    through = np.array([r.H[:, 0, 0] for r in ours])

    def sigma(estimates: np.ndarray) -> float:
        bias = np.abs(estimates.mean(axis=0) - truth)
        return float(np.median(bias / estimates.std(axis=0)) * np.sqrt(total))

    relative = np.median(np.abs(h1.mean(axis=0) / truth - 1))
    return LoopBias(total, sigma(h1), sigma(through), float(relative))


@dataclass(frozen=True)
class Friction:
    """Coulomb friction at 1 to 3 Hz: median ratio to the linear response at each level, of H1
    and through the reference, and whether the levels are found to differ."""

    levels: tuple[float, ...]
    h1: tuple[float, ...]
    ours: tuple[float, ...]
    p_value: float


def friction(seed: int, levels: tuple[float, ...] = (0.5, 1.0, 2.0)) -> Friction:
    system = plant(damping=10 * DAMPING)
    rng = np.random.default_rng(seed)
    u = swept_sine(**BURST)
    responses, h1s, ours = [], [], []
    for level in levels:
        data = simulate(system, level * u, (3,), rng, sensor=SENSOR, disturbance=0.0, friction=0.1)
        made = recording(data, level=level)
        r = estimate([made], outputs=["theta"], method="burst")[0]
        band = (r.frequency > 1) & (r.frequency < 3)
        lines = np.round(r.frequency[band] * u.size / RATE).astype(int)
        spectra = np.fft.rfft(data, axis=1)[:, lines]
        V, Y = spectra[..., 1], spectra[..., 2]
        truth = system.response(r.frequency[band])[:, 0]
        h1 = np.sum(Y * V.conj(), axis=0) / np.sum(np.abs(V) ** 2, axis=0)
        h1s.append(float(np.median(np.abs(h1 / truth))))
        ours.append(float(np.median(np.abs(r.H[band, 0, 0] / truth))))
        responses.append(r)
    found = statistics.difference(responses[0], responses[-1], [(1.0, 3.0)])[0]
    return Friction(levels, tuple(h1s), tuple(ours), found.p_value)


@dataclass(frozen=True)
class FastSweep:
    """Relative error (median over the half-power band) and Welch's coherence there."""

    welch_error: float
    welch_coherence: float
    local_error: float
    local_sigma: float
    local_method: str


def fast_sweep(seed: int, mode_hz: float = 4.0, damping: float = 0.002) -> FastSweep:
    """A sweep of 10 s over a lightly damped mode, cut off while it still rings.

    Open loop, one output, noise of 1e-3 of the peak. Welch with windows of 4 s.
    """
    w, n = 2 * np.pi * mode_hz, round(16 * RATE)
    A = np.array([[0.0, 1.0], [-(w**2), -2 * damping * w]])
    Ad, Bd, Cd, _, _ = signal.cont2discrete(
        (A, np.array([[0.0], [1.0]]), np.eye(2)[:1], np.zeros((1, 1))), 1 / RATE
    )
    v = swept_sine(16.0, 10.0, low=0.5, high=20.0, lead=1.0)
    x, y = np.zeros(2), np.empty(n)
    for i in range(n):
        y[i] = Cd[0] @ x
        x = Ad @ x + Bd[:, 0] * v[i]
    y += np.random.default_rng(seed).normal(size=n) * 1e-3 * np.abs(y).max()
    made = Recording(
        (Channel("v", "V", "command"), Channel("y", "m", "sensor")),
        RATE,
        np.arange(n, dtype=np.int64) * round(1e9 / RATE),
        np.arange(n, dtype=np.int64),
        np.stack([v, y], axis=1),
        np.zeros((n, 2), np.uint8),
    )

    def truth(frequency: np.ndarray) -> np.ndarray:
        z = np.exp(2j * np.pi * frequency / RATE)
        return np.array([(Cd @ np.linalg.solve(zi * np.eye(2) - Ad, Bd))[0, 0] for zi in z])

    windows = estimate([made], method="h1", nperseg=round(4 * RATE))[0]
    ours = estimate([made], method="local")[0]

    def near(r: FrequencyResponse) -> np.ndarray:
        # Where a window of 4 s has lines: its nearest, and ours as far around.
        return np.abs(r.frequency - mode_hz) <= 0.13

    def error(r: FrequencyResponse) -> float:
        at = near(r)
        exact = truth(r.frequency[at])
        return float(np.median(np.abs(r.H[at, 0, 0] - exact) / np.abs(exact)))

    sigma = np.sqrt(ours.variance()[near(ours), 0, 0]) / np.abs(truth(ours.frequency[near(ours)]))
    return FastSweep(
        error(windows),
        float(np.median(windows.coherence[near(windows), 0])),
        error(ours),
        float(np.median(sigma)),
        ours.method,
    )


def samii(total: int, seed: int) -> str:
    """The rig that ships, driven through its gate: a plant that nothing was tuned on.

    Three bursts of 24 s a run, shorter than mode 1 rings, with a disturbance that adds 5 mV rms
    to the valve, encoder steps, converter steps and noise. The truth is the transfer matrix
    model seen through hold, filters and sampling.
    """
    rig, _ = load_rig("samii")
    experiment = SweptSine(
        experiment="swept_sine",
        name="short",
        actuator="v_2",
        unit="V",
        sweep="logarithmic",
        start_hz=1.0,
        stop_hz=30.0,
        duration=12.0,
        ramp=0.5,
        lead_in=2.0,
        ring_down=10.0,
        amplitudes=(0.5,),
        repeats=3,
    )
    plan = experiment.plan(rig)

    def estimates() -> Iterator[FrequencyResponse]:
        for i in range(total):
            device = open_rig(rig, {"seed": seed * 1_000_000 + i, "disturbance_rms": 0.005})
            memory = Memory()
            stop = run(plan, rig, device, memory)
            assert stop.status == "completed", stop
            yield estimate([memory.recording(device.sensor.channels, rig.rate_hz)])[0]

    known: dict[int, np.ndarray] = {}

    def truth(frequency: np.ndarray) -> np.ndarray:
        if frequency.size not in known:
            known[frequency.size] = sampled_response(rig, frequency)[:, :, 0]
        return known[frequency.size]

    return summary(coverage(estimates(), truth, np.array([1.70, 7.42, 23.0])), SAMII_CHANNELS)


class Memory:
    """A recorder that keeps everything in memory."""

    def __init__(self) -> None:
        self.blocks: list[SampleBlock] = []
        self.segments: list[Segment] = []

    def write(self, block: SampleBlock) -> None:
        self.blocks.append(block)

    def event(self, time: int, kind: str, fields: object) -> None:
        pass

    def segment(self, segment: Segment) -> None:
        self.segments.append(segment)

    def recording(self, channels: tuple[Channel, ...], rate_hz: float) -> Recording:
        b = self.blocks
        return Recording(
            channels,
            rate_hz,
            np.concatenate([x.time for x in b]),
            np.concatenate([x.sequence for x in b]),
            np.concatenate([x.values for x in b]),
            np.concatenate([x.quality for x in b]),
            tuple(self.segments),
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--runs", type=int, default=500)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", default="", help="part of a case's name")
    options = parser.parse_args()
    cases: dict[str, dict[str, Any]] = {
        "burst, 3 repeats": {
            "repeats": 3,
            "u": swept_sine(**BURST),
            "kind": "burst",
            "method": "burst",
        },
        "local, one burst": {
            "repeats": 1,
            "u": swept_sine(**BURST),
            "kind": "burst",
            "method": "local",
        },
        "local, one sweep cut off while it rings": {
            "repeats": 1,
            "u": swept_sine(16.0, 15.5),
            "kind": "single",
            "method": "local",
        },
    }
    for name, case in cases.items():
        if options.only not in name:
            continue
        start = time.perf_counter()
        result = coverage(runs(options.runs, options.seed, **case))
        span = f"{result.frequency[0]:.2g} to {result.frequency[-1]:.3g} Hz"
        print(f"\n### {name}: {options.runs} runs, {span}, {time.perf_counter() - start:.0f} s\n")
        print(summary(result))
    if options.only in "simulated SAMII":
        print(f"\n### simulated SAMII: {options.runs} runs\n\n{samii(options.runs, options.seed)}")
    for name, study in {
        "loop bias": lambda: loop_bias(min(options.runs, 200), options.seed),
        "friction": lambda: friction(options.seed),
        "fast sweep": lambda: fast_sweep(options.seed),
    }.items():
        if options.only in name:
            print(f"\n### {name}\n\n{study()}")


if __name__ == "__main__":
    main()
