"""Speed of H1 by Welch: ours, pyFRF, scipy.signal.csd and the bare FFTs, in one run.

    python benchmarks/bench_frf.py --samples 10000000 --nperseg 8192 --rounds 5

One input, four outputs. Every method sees the same arrays; the medians of interleaved rounds
are printed with their ratios. "Bare FFTs" is `scipy.fft.rfft` of every frame of every
channel, in blocks of the same size as ours: what any implementation must at least do.
"""

from __future__ import annotations

import argparse
import time
import warnings
from collections.abc import Callable

import numpy as np
from scipy import fft, signal

from samii_rig.signal import welch

with warnings.catch_warnings():
    warnings.simplefilter("ignore")  # a peer's own warnings at import are not ours
    from pyFRF import FRF

OUTPUTS = 4
RATE = 500.0


def data(samples: int) -> np.ndarray:
    rng = np.random.default_rng(0)
    v = rng.normal(size=samples)
    y = [signal.lfilter([1.0], [1.0, -0.5 - 0.1 * i], v) for i in range(OUTPUTS)]
    return np.stack([v, *y], axis=1)


def bare(columns: list[np.ndarray], nperseg: int) -> None:
    step = nperseg // 2
    per_block = max(1, welch.BLOCK_SAMPLES // (nperseg * len(columns)))
    views = [np.lib.stride_tricks.sliding_window_view(x, nperseg)[::step] for x in columns]
    for first in range(0, views[0].shape[0], per_block):
        for view in views:
            fft.rfft(view[first : first + per_block], axis=1)


def by_pyfrf(z: np.ndarray, nperseg: int) -> np.ndarray:
    # Its own segmentation; it runs its FFTs on all cores.
    frf = FRF(
        int(RATE),
        exc=z[:, 0],
        resp=z[:, 1:].T[None],
        window="hann",
        resp_type="d",
        nperseg=nperseg,
        fft_len=nperseg,
        copy=False,
    )
    return np.asarray(frf.get_H1())


def by_scipy(columns: list[np.ndarray], nperseg: int) -> np.ndarray:
    out = []
    for y in columns[1:]:
        _, cross = signal.csd(columns[0], y, RATE, nperseg=nperseg)
        _, power = signal.welch(columns[0], RATE, nperseg=nperseg)
        out.append(cross / power)
    return np.array(out)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--samples", type=int, default=10_000_000)
    parser.add_argument("--nperseg", type=int, default=8192)
    parser.add_argument("--rounds", type=int, default=5)
    options = parser.parse_args()
    z = data(options.samples)
    columns = [np.ascontiguousarray(z[:, i]) for i in range(z.shape[1])]
    n = options.nperseg
    welch.frequency_response([z[: 4 * n]], RATE, nperseg=n)  # compile
    methods: dict[str, Callable[[], object]] = {
        "bare FFTs": lambda: bare(columns, n),
        "samii-rig H1": lambda: welch.frequency_response([z], RATE, nperseg=n),
        "scipy csd + welch": lambda: by_scipy(columns, n),
        "pyFRF H1": lambda: by_pyfrf(z, n),
    }
    seconds: dict[str, list[float]] = {name: [] for name in methods}
    for _ in range(options.rounds):
        for name, method in methods.items():
            start = time.perf_counter()
            method()
            seconds[name].append(time.perf_counter() - start)
    median = {name: float(np.median(s)) for name, s in seconds.items()}
    ours = median["samii-rig H1"]
    print(f"1 input, {OUTPUTS} outputs, {options.samples:,} samples, nperseg {n}")
    for name, value in median.items():
        print(f"{name:20s} {value:8.2f} s   {value / ours:6.2f} x ours")
    print(f"ours over the bare FFTs: {ours / median['bare FFTs']:.2f} (goal: at most 1.6)")
    print(f"pyFRF over ours: {median['pyFRF H1'] / ours:.2f} (goal: at least 3)")


if __name__ == "__main__":
    main()
