"""Nine responses of a real steering mirror, noise and distortion apart, at two levels.

The CubeSpec fine steering mirror (Floren et al., ISMA 2024, CC BY 4.0; public copy
github.com/merijnfloren/fsm-benchmark-data): volts to three piezo-actuators, displacements at three
points, orthogonal random-phase multisines of 6 realisations and 2 periods.

    python benchmarks/mirror_study.py FOLDER
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np

from samii_rig.signal.coherence import partial_coherence
from samii_rig.signal.estimate import estimate
from samii_rig.signal.statistics import difference
from samii_rig.types import Channel, FrequencyResponse, Recording, Segment

RATE = 6400.0  # samples/s
LEVELS = {100: 0.1, 200: 0.2}  # V, rms, by the number in the files' names
BAND = (0.5, 3000.0)  # Hz, of the multisines
BANDS = (0.5, 50.0, 200.0, 800.0, 1600.0, 2350.0, 3000.0)  # Hz


def recordings(folder: Path, level: int) -> Iterator[Recording]:
    """One recording a realisation, with one segment a period."""
    u, y = (np.load(folder / f"{x}_{level}mV_train.npy") for x in "uy")
    n, _, realisations, periods = u.shape
    channels = [Channel(f"u_{k}", "V", "command") for k in (1, 2, 3)]
    channels += [Channel(f"y_{k}", "m", "sensor") for k in (1, 2, 3)]
    count = np.arange(n * periods, dtype=np.int64)
    for r in range(realisations):
        both = np.concatenate([u[:, :, r], y[:, :, r]], axis=1)
        yield Recording(
            channels=tuple(channels),
            rate_hz=RATE,
            time=(count * 1e9 / RATE).astype(np.int64),
            sequence=count,
            values=both.transpose(2, 0, 1).reshape(n * periods, 6),
            quality=np.zeros((n * periods, 6), np.uint8),
            segments=tuple(
                Segment(f"period {p}", "periodic", p * n, (p + 1) * n, LEVELS[level], "V", p)
                for p in range(periods)
            ),
            source=f"realisation {r} at {level} mV",
        )


@dataclass(frozen=True)
class Mirror:
    """One level: the response, and noise of a period and distortion of a realisation over the
    output, all lines and outputs together."""

    response: FrequencyResponse
    noise: float
    distortion: float
    sd: float
    seconds: float


def measured(folder: Path, level: int) -> Mirror:
    """The nine responses at one level."""
    start = time.process_time()
    found = estimate(list(recordings(folder, level)), band=BAND)
    (r,) = found
    seconds = time.process_time() - start
    assert r.noise is not None
    assert r.distortion is not None
    power = output_power(r)

    def over(relative: np.ndarray) -> float:
        return float(np.sqrt(np.sum(relative**2 * power) / np.sum(power)))

    sd = float(np.sqrt(np.sum(r.variance()) / np.sum(np.abs(r.H) ** 2)))
    return Mirror(r, over(r.noise), over(r.distortion), sd, seconds)


def by_difference(folder: Path, level: int, *, offset: bool) -> float:
    """Noise of a period over the output, straight from the difference of the two periods, over the
    driven lines and, with `offset`, line 0: the level drifts from period to period."""
    Y = np.fft.rfft(np.load(folder / f"y_{level}mV_train.npy"), axis=0)
    Y = Y[0 if offset else 1 : round(BAND[1] * len(Y) / (RATE / 2))]
    half = np.abs(Y[..., 0] - Y[..., 1]) ** 2 / 2
    return float(np.sqrt(np.sum(half) / np.sum(np.abs(Y.mean(axis=-1)) ** 2)))


def output_power(r: FrequencyResponse) -> np.ndarray:
    """(n_freq, 3) what orthogonal inputs of one size make of each output, relative."""
    return np.asarray(np.sum(np.abs(r.H * r.input_rms[:, None, :]) ** 2, axis=2))


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("folder", type=Path)
    folder = parser.parse_args().folder
    found = {level: measured(folder, level) for level in LEVELS}
    print("| level, mV rms | lines | noise of a period | by difference, with line 0 "
          "| distortion of a realisation | sd of H | partial coherence, median | s |")  # fmt: skip
    print("|---|---|---|---|---|---|---|---|")
    for level, m in found.items():
        straight = [100 * by_difference(folder, level, offset=x) for x in (False, True)]
        partial = np.median(partial_coherence(m.response))
        print(
            f"| {level} | {m.response.frequency.size} | {100 * m.noise:.2f} % "
            f"| {straight[0]:.2f} %, {straight[1]:.2f} % | {100 * m.distortion:.2f} % "
            f"| {100 * m.sd:.2f} % | {partial:.4f} | {m.seconds:.0f} |"
        )
    print("\n| band, Hz | noise, distortion at 100 mV | at 200 mV | level changes H by |")
    print("|---|---|---|---|")
    a, b = (found[level].response for level in LEVELS)
    changed = difference(a, b, list(pairwise(BANDS)))
    for d in changed:
        cells = []
        for r in (a, b):
            inside = (r.frequency >= d.low_hz) & (r.frequency < d.high_hz)
            power = output_power(r)[inside]
            assert r.noise is not None
            assert r.distortion is not None
            parts = [
                100 * np.sqrt(np.sum(x[inside] ** 2 * power) / np.sum(power))
                for x in (r.noise, r.distortion)
            ]
            cells.append(f"{parts[0]:.2f} %, {parts[1]:.2f} %")
        print(f"| {d.low_hz:g} to {d.high_hz:g} | {' | '.join(cells)} | {100 * d.change:.1f} % |")
    for m in found.values():
        print(f"\n{m.response.method}. {m.response.why}")
        print("\n".join(f"- {f.severity}: {f.message}" for f in m.response.findings))


if __name__ == "__main__":
    main()
