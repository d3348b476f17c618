"""Identification and modal estimation: speed and error beside their peers.

    python benchmarks/bench_identify.py             # maximum likelihood against Nelder-Mead
    python benchmarks/bench_identify.py modes       # against sdypy-EMA, if it is installed

The first fits 8 parameters of SAMII to 2 channels at 400 frequencies, from starts within 30 %
of the truth. The peer is what is usual: Nelder-Mead on the same cost, the response by the
plain product of the 5 x 5 transfer matrices, all frequencies at once.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.optimize import minimize

from samii_rig.identify.bootstrap import redraw
from samii_rig.identify.maximum_likelihood import Problem, problem
from samii_rig.identify.modal import estimate_modes
from samii_rig.identify.parameters import Free
from samii_rig.model.realise import realise
from samii_rig.model.sampled import hold_response, sampled_response, sensor_response
from samii_rig.model.tmm import Chain
from samii_rig.rig.load import load_rig
from samii_rig.rig.schema import Rig, parameters
from samii_rig.types import Channel, FrequencyResponse

JOINTS = ("clamp", "joint_1", "joint_2", "joint_3")
KEYS = tuple((joint, symbol) for joint in JOINTS for symbol in "kc")
CHANNELS = ("theta_2", "a_0")
NOISE = 0.01  # of each response's own size and of its median


def measurement(rig: Rig, channels: tuple[str, ...], n: int, seed: int) -> FrequencyResponse:
    """A response with noise of `NOISE` and a covariance of 40 degrees of freedom."""
    f = np.geomspace(0.5, 40.0, n)
    at = [[s.name for s in rig.sensor].index(c) for c in channels]
    H = sampled_response(rig, f)[:, at]
    sd = NOISE * (np.abs(H[:, :, 0]) + np.median(np.abs(H[:, :, 0]), axis=0)) / 2
    C = sd[:, :, None] * np.eye(len(at)) * sd[:, None, :] + 0j
    clean = FrequencyResponse(
        frequency=f, H=H, covariance=C, dof=np.full(n, 40.0), coherence=np.ones(sd.shape),
        inputs=(Channel("v_2", "V", "command"),),
        outputs=tuple(Channel(c, rig.units()[c]) for c in channels),
        level=1.0, level_unit="V", input_rms=np.ones((n, 1)), rate_hz=rig.rate_hz,
        n_averages=41, method="burst", why="drawn",
    )  # fmt: skip
    return redraw(clean, H, np.random.default_rng(seed))


class PlainProduct:
    """theta_2 and a_0 of SAMII from the product of its matrices (paper 2, eq. 12)."""

    def __init__(self, rig: Rig, f: np.ndarray) -> None:
        self.s = 2j * np.pi * f
        self.elements = [
            (e.name, e.kind, {k: p.value for k, p in parameters(e).items()}) for e in rig.element
        ]

    def __call__(self, values: dict[tuple[str, str], float]) -> np.ndarray:
        s, n = self.s, self.s.size
        U = np.broadcast_to(np.eye(5, dtype=complex), (n, 5, 5))
        states = {}
        for name, kind, pars in self.elements:
            T = np.zeros((n, 5, 5), complex)
            T[:, range(5), range(5)] = 1.0
            p = {k: values.get((name, k), v) for k, v in pars.items()}
            if kind == "torsional_spring":
                T[:, 1, 2] = 1 / (p["c"] * s + p["k"])
            elif kind == "angular_velocity_source":
                T[:, 1, 4] = p["K"] * p["p"] / (s * (s + p["p"]))
            elif kind == "rigid_link":
                L, r, ms, Is = p["L"], p["r"], p["m"] * s**2, p["I"] * s**2
                T[:, 0, 1] = T[:, 2, 3] = L
                T[:, 2, 0], T[:, 2, 1] = -(L - r) * ms, Is - (L - r) * r * ms
                T[:, 3, 0], T[:, 3, 1] = -ms, -r * ms
            else:
                T[:, :4, :4] = beam(s, p)
            states[name] = (U, T)
            U = T @ U
        # Clamped base: M and V are free; free tip: M = V = 0.
        free = np.linalg.solve(U[:, 2:4, 2:4], -U[:, 2:4, 4:5])[:, :, 0]
        z0 = np.stack([0 * s, 0 * s, free[:, 0], free[:, 1], 1 + 0 * s], axis=1)[:, :, None]
        before = (states["joint_2_source"][0] @ z0)[:, :, 0]
        at, last = states["joint_2"]
        after = (last @ at @ z0)[:, :, 0]
        link = (states["link_0"][0] @ z0)[:, :, 0]
        return np.stack(
            [after[:, 1] - before[:, 1], s**2 * (link[:, 0] + 0.0902 * link[:, 1])], axis=1
        )


def beam(s: np.ndarray, p: dict[str, float]) -> np.ndarray:
    """The Euler-Bernoulli beam's 4 x 4 matrix (paper 1, eq. 6 to 9)."""
    EI = p["EI"] * (1 + 1j * p["eta"] + s * p["tau"])
    b = (-(s**2) * p["mu"] / EI) ** 0.25
    x = b * p["L"]
    c0, c2 = (np.cosh(x) + np.cos(x)) / 2, (np.cosh(x) - np.cos(x)) / 2 / b**2
    c1, c3 = (np.sinh(x) + np.sin(x)) / 2 / b, (np.sinh(x) - np.sin(x)) / 2 / b**3
    b4 = b**4
    rows = [
        [c0, c1, c2 / EI, c3 / EI],
        [b4 * c3, c0, c1 / EI, c2 / EI],
        [EI * b4 * c2, EI * b4 * c3, c0, c1],
        [EI * b4 * c1, EI * b4 * c2, b4 * c3, c0],
    ]
    return np.stack([np.stack(row, axis=1) for row in rows], axis=1)


def starts(rig: Rig, seed: int) -> list[Free]:
    rng = np.random.default_rng(seed)
    chain = Chain(rig)
    value = dict(zip(chain.parameters, chain.values(), strict=True))
    return [Free(*k, start=value[k] * (1 + rng.uniform(-0.3, 0.3))) for k in KEYS]


def nelder_mead(rig: Rig, posed: Problem) -> tuple[float, float, int]:
    """Seconds, cost and evaluations of Nelder-Mead on the plain product."""
    d = posed.data.lines[0]
    plain = PlainProduct(rig, d.frequency)
    at = [[s.name for s in rig.sensor].index(c) for c in CHANNELS]
    seen = sensor_response(rig.sensor, d.frequency)[:, at]
    seen = seen * hold_response(d.frequency, rig.rate_hz)[:, None]
    weight = np.sqrt(2 * d.factor)[:, None, None] * d.root

    def cost(x: np.ndarray) -> float:
        error = plain(posed.space.mapping(x)) * seen - d.H
        return 0.5 * float(np.sum(np.abs(weight @ error[:, :, None]) ** 2))

    begin = time.perf_counter()
    n = len(KEYS)
    found = minimize(
        cost, np.zeros(n), method="Nelder-Mead",
        options={"maxfev": 20000, "maxiter": 20000, "xatol": 1e-6, "fatol": 1e-4, "adaptive": True},
    )  # fmt: skip
    return time.perf_counter() - begin, float(found.fun), int(found.nfev)


def speed(runs: int, peers: int) -> None:
    rig = load_rig("samii")[0]
    response = measurement(rig, CHANNELS, 400, 1)
    times, used, costs = [], [], []
    for i in range(runs + 1):
        posed = problem([response], rig, starts(rig, i))
        begin, busy = time.perf_counter(), time.process_time()
        found = posed.from_start(np.zeros(len(KEYS)))
        times.append(time.perf_counter() - begin)
        used.append(time.process_time() - busy)
        costs.append(found.cost)
    begin = time.perf_counter()
    posed.polished(found)
    aliases = time.perf_counter() - begin
    best = min(costs)
    ours = float(np.median(times[1:]))
    there = sum(1 for c in costs[1:] if c - best < 0.01)
    print(
        f"maximum likelihood: median {1e3 * ours:.1f} ms, least {1e3 * min(times[1:]):.1f} ms, of "
        f"the processor {1e3 * float(np.median(used[1:])):.1f} ms; {there} of {runs} starts at "
        "the optimum"
    )
    print(f"aliases at the optimum and the last steps with them: {1e3 * aliases:.0f} ms more, once")
    for i in range(1, peers + 1):
        taken, cost, count = nelder_mead(rig, problem([response], rig, starts(rig, i)))
        print(
            f"Nelder-Mead on the plain product: {taken:.1f} s, {count} evaluations, "
            f"cost {cost:.2f} against {best:.2f}; ours is {taken / ours:.0f} times faster"
        )


def modes(runs: int) -> None:
    from sdypy import EMA

    rig = load_rig("samii")[0]
    channels = ("a_0", "a_1", "a_2")
    poles = realise(rig).poles
    exact = np.sort(np.abs(poles[(poles.imag > 0) & (np.abs(poles) < 2 * np.pi * 30)])) / 2 / np.pi
    pole = {round(abs(p) / 2 / np.pi, 6): -p.real / abs(p) for p in poles if p.imag > 0}
    zeta = np.array([pole[round(f, 6)] for f in exact])
    errors: dict[str, list[np.ndarray]] = {"ours": [], "sdypy-EMA": []}
    times: dict[str, list[float]] = {"ours": [], "sdypy-EMA": []}
    f = np.arange(0.5, 40.0, 0.05)
    for seed in range(runs):
        r = even(rig, channels, f, seed)
        begin = time.perf_counter()
        found = estimate_modes(r, rig)
        times["ours"].append(time.perf_counter() - begin)
        near = [min(found.modes, key=lambda m: abs(m.frequency_hz.value - x)) for x in exact]
        got = np.array([[m.frequency_hz.value, m.damping.value] for m in near])
        errors["ours"].append(got.T / [exact, zeta] - 1)
        at = [[s.name for s in rig.sensor].index(c) for c in channels]
        seen = sensor_response(rig.sensor, f)[:, at] * hold_response(f, rig.rate_hz)[:, None]
        begin = time.perf_counter()
        peer = EMA.Model(
            (r.H[:, :, 0] / seen).T,
            f,
            lower=0.5,
            upper=f[-1],
            pol_order_high=30,
            frf_form="accelerance",
        )
        peer.get_poles(show_progress=False)
        times["sdypy-EMA"].append(time.perf_counter() - begin)
        errors["sdypy-EMA"].append(stable(peer, exact) / [exact, zeta] - 1)
    for name, e in errors.items():
        rms = 100 * np.sqrt(np.mean(np.array(e) ** 2, axis=0))
        print(
            f"{name}: {np.median(times[name]):.2f} s; rms error of {np.round(exact, 2)} Hz "
            f"{np.round(rms[0], 3)} %, of damping {np.round(rms[1], 2)} %"
        )


def stable(peer: Any, exact: np.ndarray) -> np.ndarray:
    """Frequencies and damping (2, n) of the peer: the median over its higher orders of the
    pole nearest to each true one. Kinder to it than the person who reads its diagram can be."""
    orders = list(zip(peer.pole_freq, peer.pole_xi, strict=True))[9:]
    chosen = []
    for f, xi in orders:
        usable = (f > 0) & (xi > 0)
        at = [np.argmin(np.abs(f[usable] - x)) for x in exact]
        chosen.append([f[usable][at], xi[usable][at]])
    return np.median(chosen, axis=0)


def even(rig: Rig, channels: tuple[str, ...], f: np.ndarray, seed: int) -> FrequencyResponse:
    """`measurement` on even lines, which the peer needs."""
    r = measurement(rig, channels, f.size, seed)
    at = [[s.name for s in rig.sensor].index(c) for c in channels]
    return redraw(
        replace(r, frequency=f), sampled_response(rig, f)[:, at], np.random.default_rng(seed)
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("what", nargs="?", choices=("speed", "modes"), default="speed")
    parser.add_argument("--runs", type=int, default=100)
    parser.add_argument("--peers", type=int, default=2, help="runs of Nelder-Mead")
    options = parser.parse_args()
    if options.what == "speed":
        speed(options.runs, options.peers)
    else:
        modes(min(options.runs, 10))


if __name__ == "__main__":
    main()
