"""How far the modes of `samii-rig modes` can be trusted, counted on rigs whose modes are known.

    python benchmarks/modes_study.py coverage --runs 500
    python benchmarks/modes_study.py spurious --runs 100
    python benchmarks/modes_study.py missed --runs 100
    python benchmarks/modes_study.py samii --runs 200
    python benchmarks/modes_study.py peers --runs 20 --peers FOLDER

FOLDER is the site-packages of an environment with sdypy-EMA and pyOMA_2, which this project does
not need.

The rig is a sum of modes in closed form, two of them 3 % apart, driven through a hold and recorded
sample by sample; every run is simulated in time, estimated by `samii_rig.signal` and
given to `find_modes` as it comes. Nothing of the truth is told but the recording. `samii` does so
with the simulated rig that ships, in its loop, with a disturbance of the valve.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections import Counter
from dataclasses import dataclass

import numpy as np
from identify_study import record, swept
from scipy.signal import lfilter

from samii_rig.modal.lines import lines_of
from samii_rig.modal.modes import ModalModel, Mode, find_modes
from samii_rig.modal.refine import refine
from samii_rig.modal.selection import wald
from samii_rig.model.realise import realise
from samii_rig.rig.load import load_rig
from samii_rig.signal.estimate import estimate
from samii_rig.types import Channel, FrequencyResponse, Recording, Segment, StopRecord

RATE = 200.0  # Hz
SECONDS = 20.0  # of a burst; its last quarter is ring-down
BAND = (1.0, 40.0)  # Hz, of the sweep
# Damping of the first mode with which a burst still rings when the next begins.
RINGING = 0.015
OUTPUTS = ("y_1", "y_2", "y_3")


@dataclass(frozen=True)
class Plant:
    """hz, zeta : (m,). shape : (m, n_out) real, residues R = shape/(2 j Im a) of every mode."""

    hz: np.ndarray
    zeta: np.ndarray
    shape: np.ndarray

    @property
    def poles(self) -> np.ndarray:
        w = 2 * np.pi * self.hz
        return w * (-self.zeta + 1j * np.sqrt(1 - self.zeta**2))

    def residues(self) -> np.ndarray:
        """(m, n_out)."""
        return self.shape / (2j * self.poles.imag)[:, None]

    def respond(self, u: np.ndarray) -> np.ndarray:
        """(n, n_out) samples of the outputs to the samples u, held over each period."""
        y = np.zeros((u.size, self.shape.shape[1]))
        for a, R in zip(self.poles, self.residues(), strict=True):
            z = np.exp(a / RATE)
            # State of one pole under a hold: x_k+1 = z x_k + (z - 1)/a u_k.
            x = lfilter([0.0, (z - 1) / a], [1.0, -z], u.astype(complex))
            y += 2 * (x[:, None] * R[None, :]).real
        return y

    def response(self, f: np.ndarray) -> np.ndarray:
        """(n, n_out) of the continuous rig."""
        s = 2j * np.pi * f[:, None]
        H = np.zeros((f.size, self.shape.shape[1]), complex)
        for a, R in zip(self.poles, self.residues(), strict=True):
            H += R / (s - a) + R.conj() / (s - a.conj())
        return H


def plant(first: float = 0.03) -> Plant:
    """Five modes in the band, two of them 3 % apart; two beyond it. first : damping of mode 1."""
    hz = np.array([3.1, 8.0, 8.24, 14.5, 27.0, 58.0, 83.0])
    zeta = np.array([first, 0.010, 0.012, 0.03, 0.02, 0.02, 0.02])
    shape = np.array(
        [
            [1.0, 0.6, 0.3],
            [0.8, -0.5, 0.9],
            [-0.6, 0.7, 0.8],
            [0.5, 1.0, -0.7],
            [0.9, -0.8, 0.6],
            [0.7, 0.9, 1.0],
            [1.0, -0.7, 0.5],
        ]
    )
    return Plant(hz, zeta, shape * (2 * np.pi * hz[:, None]))


def sweep() -> np.ndarray:
    """One burst: an exponential sweep over the band, then rest."""
    t = np.arange(int(SECONDS * RATE)) / RATE
    last = 0.6 * SECONDS
    k = np.log(BAND[1] / BAND[0]) / last
    u = np.sin(2 * np.pi * BAND[0] * (np.exp(k * t) - 1) / k)
    edge = np.clip(np.minimum(t - 0.1, last - t) / 0.5, 0, 1)
    return u * np.sin(np.pi / 2 * edge) ** 2


def recorded(rig: Plant, noise: float, repeats: int, rng: np.random.Generator) -> Recording:
    """Repeats of the burst; the sensors' noise is white, `noise` of each output's largest value,
    half of it common to all of them."""
    u = np.tile(sweep(), repeats)
    clean = rig.respond(u) if rig.hz.size else np.zeros((u.size, rig.shape.shape[1]))
    size = np.maximum(np.abs(plant().respond(sweep())).max(axis=0), 1e-12)
    own, common = rng.standard_normal(clean.shape), rng.standard_normal((u.size, 1))
    y = clean + noise * size * (own + common) / np.sqrt(2)
    n = u.size // repeats
    names = OUTPUTS[: y.shape[1]]
    channels = (Channel("u", "N", "reference"), Channel("f", "N", "command"),
                *(Channel(name, "m/s") for name in names))  # fmt: skip
    values = np.column_stack([u, u, y])
    segments = tuple(
        Segment(f"burst_{k}", "burst", k * n, (k + 1) * n, 1.0, "N", k) for k in range(repeats)
    )
    at = np.arange(u.size)
    return Recording(
        channels, RATE, (at * int(1e9 / RATE)).astype(np.int64), at.astype(np.int64), values,
        np.zeros(values.shape, np.uint8), segments, stop=StopRecord("completed", ""),
        source="simulated",
    )  # fmt: skip


def measured(rig: Plant, noise: float, repeats: int, seed: int) -> FrequencyResponse:
    return estimate([recorded(rig, noise, repeats, np.random.default_rng(seed))])[0]


def inside(mode: Mode, rig: Plant, m: int) -> tuple[list[bool], list[bool], list[bool]]:
    """Whether the 90 % intervals of frequency, damping and shape hold the truth."""
    low, high = mode.frequency_hz.interval()
    f = [low <= rig.hz[m] <= high]
    low, high = mode.damping.interval()
    zeta = [low <= rig.zeta[m] <= high]
    truth = rig.shape[m] / rig.shape[m, mode.reference]
    real, imag = mode.shape_interval()
    off = mode.shape - truth
    others = [k for k in range(truth.size) if k != mode.reference]
    shape = [bool(abs(off[k].real) <= real[k]) for k in others]
    return f, zeta, shape + [bool(abs(off[k].imag) <= imag[k]) for k in others]


def measurable(f: np.ndarray, rig: Plant) -> np.ndarray:
    """Indices of the modes between the first and the last line that was measured."""
    return np.flatnonzero((rig.hz > f[0]) & (rig.hz < f[-1]))


def matched(found: ModalModel, rig: Plant) -> dict[int, Mode]:
    """The mode found for each true one in the band, nearest first; nothing twice."""
    out: dict[int, Mode] = {}
    left = list(found.modes)
    for m in measurable(found.frequency, rig):
        near = [x for x in left if abs(x.pole - rig.poles[m]) < 0.02 * abs(rig.poles[m])]
        if near:
            best = min(near, key=lambda x: abs(x.pole - rig.poles[m]))
            out[int(m)] = best
            left.remove(best)
    return out


def coverage(runs: int, noise: float, ringing: bool = False) -> None:
    rig = plant(RINGING if ringing else 0.03)
    kinds = ("frequency", "damping", "shape")
    hits: dict[tuple[int, str], list[bool]] = {}
    there, missed, spurious, refused, took = 0, 0, 0, 0, []
    methods: Counter[str] = Counter()
    for seed in range(runs):
        response = measured(rig, noise, 4, seed)
        methods[response.estimator] += 1
        began = time.perf_counter()
        found = find_modes(response)
        took.append(time.perf_counter() - began)
        match = matched(found, rig)
        there += measurable(found.frequency, rig).size
        missed += measurable(found.frequency, rig).size - len(match)
        spurious += len(found.modes) - len(match)
        refused += not found.fit.holds
        for m, mode in match.items():
            for kind, answers in zip(kinds, inside(mode, rig, m), strict=True):
                hits.setdefault((m, kind), []).extend(answers)
        show(seed + 1, runs)
    said = ", ".join(f"{n} {name}" for name, n in methods.items())
    print(f"{runs} runs ({said}), noise {noise:g}: {missed} of {there} modes missed, "
          f"{spurious} spurious, chi-square refused {refused}; "
          f"{np.median(took):.2f} s a response")  # fmt: skip
    for kind in kinds:
        cells = [f"{rig.hz[m]:g} Hz {np.mean(hits[m, kind]):.3f}" for m in range(5)]
        every = np.concatenate([hits[m, kind] for m in range(5)])
        print(f"{kind}: in {np.mean(every):.3f} of {every.size} intervals of 90 %; "
              + ", ".join(cells))  # fmt: skip


def samii(runs: int, first: int) -> None:
    """Frequencies and dampings of SAMII in three sweeps of 30 s with a disturbance of 10 mV, by the
    method that the estimate chose; first : seed of the first run."""
    rig = load_rig("samii")[0]
    poles = realise(rig).poles
    poles = poles[(poles.imag > 0) & (np.abs(poles) < 2 * np.pi * 40.0)]
    poles = poles[np.argsort(np.abs(poles))]
    hits: dict[str, list[list[bool]]] = {}
    lost = 0
    for i in range(runs):
        response = estimate([record(rig, swept(), first + i)])[0]
        modes = find_modes(response, rig).modes
        row: list[bool] = []
        for a in poles:
            near = [m for m in modes if abs(abs(m.pole) - abs(a)) < 0.1 * abs(a)]
            if not near:
                lost += 1
                continue
            mode = min(near, key=lambda m: abs(m.pole - a))
            for value, truth in (
                (mode.frequency_hz, abs(a) / (2 * np.pi)),
                (mode.damping, -a.real / abs(a)),
            ):
                low, high = value.interval()
                row.append(bool(low <= truth <= high))
        hits.setdefault(response.estimator, []).append(row)
        show(i + 1, runs)
    every = [x for rows in hits.values() for row in rows for x in row]
    print(f"{runs} runs from seed {first}: {100 * np.mean(every):.1f} % of {len(every)} intervals "
          f"of 90 % hold the truth, {lost} modes missed")  # fmt: skip
    for name, rows in hits.items():
        own = [x for row in rows for x in row]
        print(f"{name}: {len(rows)} runs, {100 * np.mean(own):.1f} % of {len(own)}")


def spurious(runs: int, noise: float) -> None:
    """Sensors that see nothing but noise, white or that of a resonance that no command drives."""
    nothing = Plant(np.zeros(0), np.zeros(0), np.zeros((0, len(OUTPUTS))))
    for name, coloured in (("white noise", False), ("noise with a resonance at 12 Hz", True)):
        called, sets = 0, 0
        for seed in range(runs):
            rng = np.random.default_rng(10_000 + seed)
            recording = recorded(nothing, noise, 4, rng)
            if coloured:
                z = np.exp(2 * np.pi * 12.0 / RATE * (-0.01 + 1j))
                rest = lfilter(
                    [1.0], [1.0, -2 * z.real, abs(z) ** 2], recording.values[:, 2:], axis=0
                )
                recording.values[:, 2:] += rest * rng.standard_normal(3)
            found = find_modes(estimate([recording])[0])
            called += len(found.modes)
            sets += bool(found.modes)
            show(seed + 1, runs)
        print(f"{name}: {called} modes called in {sets} of {runs} data sets")


def missed(runs: int, noise: float) -> None:
    """A weak mode beside the others, as far above the noise as is said; which are found."""
    rng = np.random.default_rng(77)
    rig, tried, extra = plant(), [], 0
    for seed in range(runs):
        hz, zeta = place(rng, rig)
        shape = rng.standard_normal((1, len(OUTPUTS))) * 2 * np.pi * hz
        loud = with_mode(rig, Plant(np.array([hz]), np.array([zeta]), shape))
        size = height(measured(loud, noise, 4, seed), loud, rig.hz.size)
        weak = with_mode(rig, Plant(np.array([hz]), np.array([zeta]),
                                    shape * rng.uniform(6.0, 18.0) / size))  # fmt: skip
        response = measured(weak, noise, 4, 50_000 + seed)
        modes = find_modes(response)
        match = matched(modes, weak)
        extra += len(modes.modes) - len(match)
        tried.append((height(response, weak, rig.hz.size), rig.hz.size in match))
        if not tried[-1][1]:
            print(f"missed: {hz:.3f} Hz, {zeta:.4f}, {tried[-1][0]:.1f} sigma")
        show(seed + 1, runs)
    for low, high in ((0, 6), (6, 8), (8, 10), (10, 12), (12, np.inf)):
        part = [found for sigma, found in tried if low <= sigma < high]
        print(f"a mode of {low} to {high} sigma: {sum(part)} of {len(part)} found")
    print(f"{extra} modes called that there are not, in {runs} runs")


def place(rng: np.random.Generator, rig: Plant) -> tuple[float, float]:
    """Frequency and damping of a mode whose pole lies more than the other's half width from every
    one of the rig: nearer ones are one resonance to any eye."""
    while True:
        hz, zeta = np.exp(rng.uniform(np.log(4.0), np.log(36.0))), rng.uniform(0.005, 0.05)
        pole = 2 * np.pi * hz * (-zeta + 1j)
        if np.all(np.abs(pole - rig.poles) > -rig.poles.real):
            return float(hz), float(zeta)


def with_mode(rig: Plant, other: Plant) -> Plant:
    return Plant(*(np.concatenate([getattr(rig, x), getattr(other, x)]) for x in
                   ("hz", "zeta", "shape")))  # fmt: skip


def height(response: FrequencyResponse, rig: Plant, m: int) -> float:
    """How far mode m of the truth stands above the noise of `response`: the root of the chi-square
    that its residues alone explain, all other parameters free (`selection`)."""
    d = lines_of(response)
    pairs = rig.poles / d.scale
    model = refine(d.s, d.G, d.W, d.scale, pairs, np.zeros(0))
    return float(np.sqrt(wald(model, int(np.argmin(np.abs(model.pairs - pairs[m]))))))


def peers(runs: int, noise: float) -> None:
    """Ours beside other people's least squares on the same responses.

    They give poles by order and leave the choice to a person. Here that person knows the truth:
    the median of their stable poles within 1 % of each true frequency counts.
    """
    rig = plant()
    errors: dict[str, list[list[float]]] = {}
    took: dict[str, list[float]] = {}
    programs = {"samii-rig": ours, "sdypy-EMA lscf": sdypy_poles, "pyOMA2 pLSCF": pyoma_poles}
    for seed in range(runs):
        response = measured(rig, noise, 4, seed)
        for name, program in programs.items():
            began = time.perf_counter()
            poles = program(response)
            took.setdefault(name, []).append(time.perf_counter() - began)
            for m in range(5):
                near = poles[np.abs(np.abs(poles) / (2 * np.pi * rig.hz[m]) - 1) < 0.01]
                hz, zeta = np.abs(near) / (2 * np.pi), -near.real / np.abs(near)
                error = [np.nan, np.nan]
                if near.size:
                    error = [np.median(hz) / rig.hz[m] - 1, np.median(zeta) / rig.zeta[m] - 1]
                errors.setdefault(name, []).append(error)
        show(seed + 1, runs)
    for name in programs:
        e = np.array(errors[name])
        lost = np.isnan(e[:, 0]).sum()
        f, z = 100 * np.sqrt(np.nanmean(e**2, axis=0))
        print(f"{name}: rms error of frequency {f:.4f} %, of damping {z:.2f} %; {lost} of {len(e)} "
              f"modes without a stable pole; {np.median(took[name]):.2f} s a response")  # fmt: skip


def ours(response: FrequencyResponse) -> np.ndarray:
    return np.array([m.pole for m in find_modes(response).modes])


def sdypy_poles(response: FrequencyResponse) -> np.ndarray:
    """Poles of sdypy-EMA that it calls stable, of all orders to 40."""
    from sdypy import EMA
    from sdypy.EMA import stabilization

    f = response.frequency
    model = EMA.Model(response.H[:, :, 0].T, f, lower=float(f[0]), upper=float(f[-1]),
                      pol_order_high=20, frf_form="mobility")  # fmt: skip
    model.get_poles(method="lscf", show_progress=False)
    with np.errstate(all="ignore"):
        fn, xi, same_fn, same_xi = stabilization._stabilization(
            model.all_poles, model.pol_order_high, err_fn=0.01, err_xi=0.05
        )
    stable = (same_fn > 0) & (same_xi > 0) & (xi > 0)
    w = 2 * np.pi * fn[stable]
    return w * (-xi[stable] + 1j * np.sqrt(1 - np.minimum(xi[stable], 1) ** 2))


def pyoma_poles(response: FrequencyResponse) -> np.ndarray:
    """Stable poles of pyOMA2's pLSCF, of all orders to 40, given responses in place of spectra.

    It wants lines from 0 Hz on: those below the band are zero, as sdypy-EMA puts them.
    """
    from pyoma2.functions import plscf

    plscf.trange = range  # no progress bar
    f = response.frequency
    step = f[1] - f[0]
    below = round(f[0] / step)
    H = np.concatenate([np.zeros((below, 3)), response.H[:, :, 0]]).T
    dt = 1 / (2 * (below + f.size - 1) * step)
    Ad, _ = plscf.pLSCF(H[:, None, :], dt, 40)
    out, last = [], np.zeros(0, complex)
    for A in Ad:
        z = np.roots(A[::-1, 0, 0])
        with np.errstate(all="ignore"):
            s = -np.log(z) / dt  # its basis is exp(-j w dt)
        s = s[np.isfinite(s) & (s.imag > 0) & (s.real < 0)]
        for a in s:
            near = last[np.argmin(np.abs(last - a))] if last.size else 0j
            zeta, before = -a.real / abs(a), -near.real / max(abs(near), 1e-300)
            if abs(abs(near) / abs(a) - 1) < 0.01 and abs(before / zeta - 1) < 0.05:
                out.append(a)
        last = s
    return np.array(out, dtype=complex)


def show(done: int, of: int) -> None:
    if sys.stderr.isatty() or done % max(1, of // 10) == 0:
        print(f"\r{done} of {of}", end="" if done < of else "\n", file=sys.stderr, flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("what", choices=("coverage", "samii", "spurious", "missed", "peers"))
    parser.add_argument("--runs", type=int, default=500)
    parser.add_argument("--noise", type=float, default=0.02, help="of each output's largest value")
    parser.add_argument("--ringing", action="store_true", help="bursts that run into each other")
    parser.add_argument("--first", type=int, default=6000, help="seed of the first run of samii")
    parser.add_argument("--peers", default="", help="site-packages that hold the peers")
    given = parser.parse_args()
    if given.peers:
        sys.path.append(given.peers)  # after ours: their numpy is not taken
    match given.what:
        case "coverage":
            coverage(given.runs, given.noise, given.ringing)
        case "samii":
            samii(given.runs, given.first)
        case "spurious":
            spurious(given.runs, given.noise)
        case "missed":
            missed(given.runs, given.noise)
        case "peers":
            peers(given.runs, given.noise)


if __name__ == "__main__":
    main()
