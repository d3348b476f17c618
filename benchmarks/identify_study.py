"""What identification is worth: coverage, starts, recordings, the encoder, g_v, the valley.

python benchmarks/identify_study.py coverage --seeds 200
python benchmarks/identify_study.py recordings --runs 20
python benchmarks/identify_study.py starts
python benchmarks/identify_study.py encoder
python benchmarks/identify_study.py gains
python benchmarks/identify_study.py modes --runs 60
python benchmarks/identify_study.py numbers
python benchmarks/identify_study.py valley --figure valley.svg
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from experiments.swept_sine import SweptSine
from samii_rig.devices.protocols import CommandBlock, DeviceLoop
from samii_rig.identify.actuator import (
    actuated_joint,
    choice,
    compare_variants,
    fit_actuator,
    with_encoder,
)
from samii_rig.identify.bootstrap import redraw
from samii_rig.identify.conservative import Conservative
from samii_rig.identify.maximum_likelihood import identify, problem
from samii_rig.identify.methods import LIGHT
from samii_rig.identify.modal import estimate_modes
from samii_rig.identify.parameters import Free
from samii_rig.identify.result import Identification
from samii_rig.identify.targets import Target, braced, method_1, method_2, valley
from samii_rig.identify.velocity_feedback import curves, fit_gain, in_series
from samii_rig.model.realise import realise
from samii_rig.model.sampled import sampled_response
from samii_rig.model.tmm import Chain
from samii_rig.rig.load import load_rig
from samii_rig.rig.schema import Rig
from samii_rig.signal.estimate import estimate
from samii_rig.types import FrequencyResponse, Recording, Segment
from sim.rig import open_rig

LEVEL = 0.9
JOINTS = ("clamp", "joint_1", "joint_2", "joint_3")
STIFFNESSES = tuple(f"{joint}.k" for joint in JOINTS)
# What a lab does not know of SAMII beside the stiffnesses: damping, gain and pole of the valve.
FREE = (*STIFFNESSES, *(f"{joint}.c" for joint in JOINTS), "joint_2_source.K", "joint_2_source.p")
SETTLED = 11.0  # s of rest behind a sweep


def swept(duration: float = 30.0, repeats: int = 3, level: float = 0.5) -> SweptSine:
    return SweptSine(
        experiment="swept_sine",
        name="study",
        actuator="v_2",
        unit="V",
        sweep="logarithmic",
        start_hz=0.5,
        stop_hz=40.0,
        duration=duration,
        ramp=1.0,
        lead_in=1.0,
        ring_down=SETTLED,
        schedule=((4.0, 1.0), (6.0, 0.35), (9.0, 0.35), (12.0, 1.0)),
        amplitudes=(level,),
        repeats=repeats,
    )


def record(rig: Rig, experiment: SweptSine, seed: int, disturbance: float = 0.01) -> Recording:
    """A run of the experiment on the simulated rig, with noise and a disturbance (V rms)."""
    plan = experiment.plan(rig)
    device = open_rig(rig, {"seed": seed, "disturbance_rms": disturbance})
    channel = rig.actuator[0]
    device.actuator.configure(DeviceLoop(plan.centring_sensor, plan.kp, channel.high, 1e9, 1e9))
    u = np.concatenate([s.u for s in plan.segments])
    device.actuator.write(CommandBlock(0, u, np.zeros_like(u)))
    device.clock.sleep(len(u) / rig.rate_hz)
    block = device.sensor.read()
    edges = np.cumsum([0, *(len(s.u) for s in plan.segments)])
    segments = tuple(
        Segment(s.name, s.kind, int(a), int(b), s.level, s.unit, s.repeat)
        for s, a, b in zip(plan.segments, edges[:-1], edges[1:], strict=True)
    )
    return Recording(
        block.channels,
        rig.rate_hz,
        block.time,
        block.sequence,
        block.values,
        block.quality,
        segments,
    )


def measured(seed: int, **options: float) -> FrequencyResponse:
    rig = load_rig("samii")[0]
    return estimate([record(rig, swept(**options), seed)])[0]


def away(rig: Rig, seed: int, spread: float = 0.3) -> list[Free]:
    """The free parameters with starts drawn within `spread` of the truth."""
    rng = np.random.default_rng(seed)
    values = {
        (e.name, s): getattr(e, s).value
        for e in rig.element
        for s in type(e).model_fields
        if hasattr(getattr(e, s), "value")
    }
    out = []
    for name in FREE:
        element, _, symbol = name.partition(".")
        start = values[element, symbol] * (1 + rng.uniform(-spread, spread))
        out.append(Free(element, symbol, start=start))
    return out


def truth(rig: Rig) -> np.ndarray:
    chain = Chain(rig)
    return np.array([chain.values()[chain.parameters.index(tuple(n.split(".")))] for n in FREE])


def report(found: list[Identification], exact: np.ndarray) -> None:
    """Coverage, bias and spread of many identifications."""
    inside = np.array(
        [(f.interval(LEVEL)[0] <= exact) & (exact <= f.interval(LEVEL)[1]) for f in found]
    )
    error = np.array([f.values / exact - 1 for f in found])
    sd = np.array([np.sqrt(np.diag(f.log_covariance)) for f in found])
    print(
        "| parameter | 90 % interval holds the truth, % | largest error, % | rms error, % "
        "| stated sd, % |"
    )
    print("|---|---|---|---|---|")
    for i, name in enumerate(FREE):
        print(
            f"| {name} | {100 * inside[:, i].mean():.1f} | {100 * np.abs(error[:, i]).max():.3g} | "
            f"{100 * np.sqrt(np.mean(error[:, i] ** 2)):.3g} | {100 * np.median(sd[:, i]):.3g} |"
        )
    n = inside.size
    print(f"| pooled | {100 * inside.mean():.1f} of {n} | | | |")
    ratio = np.array([f.fit.ratio for f in found])
    p = np.array([f.fit.p_value for f in found])
    print(
        f"\nchi-square per degree of freedom {ratio.mean():.3f} +- {ratio.std():.3f}; "
        f"p-values below 0.1: "
        f"{100 * (p < 0.1).mean():.0f} %, below 0.01: {100 * (p < 0.01).mean():.0f} %"
    )


def thinned(r: FrequencyResponse, step: int) -> FrequencyResponse:
    """Every `step`-th line."""
    per_line = ("frequency", "H", "covariance", "dof", "coherence", "input_rms")
    return replace(r, **{name: getattr(r, name)[::step] for name in per_line})


def shared_lines(r: FrequencyResponse) -> int:
    """Lines that share a covariance, as its degrees of freedom say."""
    return max(1, round(float(np.median(r.dof)) / max(r.n_averages - 1, 1)))


def coverage(options: argparse.Namespace) -> None:
    """Responses drawn with the noise of a real run, each with its own Wishart covariance."""
    rig = load_rig("samii")[0]
    like = thinned(measured(0), options.thin)
    shared = shared_lines(like)
    H = sampled_response(rig, like.frequency)
    print(
        f"{len(like.frequency)} lines, {H.shape[1]} outputs, median nu {np.median(like.dof):.3g}, "
        f"{shared} lines to a covariance; {options.seeds} seeds\n"
    )
    rng = np.random.default_rng(options.seed)
    found = []
    begin = time.perf_counter()
    for i in range(options.seeds):
        fresh = redraw(like, H, rng, shared)
        found.append(identify([fresh], rig, away(rig, i), starts=1))
    report(found, truth(rig))
    print(f"{time.perf_counter() - begin:.0f} s")


def recordings(options: argparse.Namespace) -> None:
    """Full simulated recordings: sweep, sampling, converters, loop, estimate, identify."""
    rig = load_rig("samii")[0]
    found = [
        identify([measured(100 + i)], rig, away(rig, i), starts=1) for i in range(options.runs)
    ]
    report(found, truth(rig))


def starts(options: argparse.Namespace) -> None:
    """From 100 starts within 30 % of the truth, on theta_2 and a_0 alone and on all channels."""
    rig = load_rig("samii")[0]
    response = measured(options.seed)
    for outputs in (["theta_2", "a_0"], None):
        costs, times = [], []
        for i in range(100):
            posed = problem([response], rig, away(rig, i), outputs=outputs)
            begin = time.perf_counter()
            costs.append(posed.from_start(np.zeros(len(FREE))).cost)
            times.append(time.perf_counter() - begin)
        best = min(costs)
        there = sum(1 for c in costs if c - best < 0.01)
        print(
            f"{outputs or 'all outputs'}, {len(response.frequency)} lines: {there} of 100 starts "
            f"at the optimum (chi-square within 0.02), median {1e3 * np.median(times):.0f} ms"
        )


SOURCE = "joint_2_source"
G_V = {"samii": (SOURCE, "theta_2", 500.0), "samii_joint_3": ("joint_3_source", "theta_3", 150.0)}
"""Source, encoder and gain of the velocity feedback, N m s/rad: paper 1, Table II."""


def encoder(options: argparse.Namespace) -> None:
    """Data of an encoder at one place, held against models with either place: with an ideal
    velocity source, and with paper 1's intrinsic velocity feedback."""
    base = load_rig("samii")[0]
    places = {
        "across source and spring": base,
        "at the actuator": with_encoder(base, "theta_2", (SOURCE,)),
    }
    fed = {name: in_series(rig, SOURCE, G_V["samii"][2]) for name, rig in places.items()}
    for said, rigs, free in (
        ("velocity source", places, FREE),
        ("velocity feedback", fed, (*FREE, f"{SOURCE}_feedback.c")),
    ):
        for name, rig in rigs.items():
            response = estimate([record(rig, swept(), options.seed)])[0]
            for outputs in (None, ["theta_2"]):
                done = compare_variants([response], rigs, free, outputs=outputs)
                print(f"{said}, truth {name}, {outputs or 'all outputs'}. {choice(done)}")
                for v in done:
                    error = 100 * (v.found.values[:4] / truth(rig)[:4] - 1)
                    print(f"  {v.name}: stiffnesses off by {np.round(error, 1)} %")


def gains(options: argparse.Namespace) -> None:
    """Modes over g_v by both methods; g_v of joints 2 and 3 from the amplitudes of recordings."""
    rig = with_encoder(load_rig("samii")[0], "theta_2", (SOURCE,))
    grid = np.array([1e5, 1e4, 1000, 500, 300, 200, 100, 50, 30, 10])
    fine = np.union1d(np.geomspace(10, 1e5, 80), grid)
    found = {by: curves(rig, SOURCE, fine, by=by) for by in ("tmm", "fem")}
    of = found["tmm"]
    print("| g_v | mode 1, Hz | damping | mode 2, Hz | damping |\n|---|---|---|---|---|")
    for g in grid:
        i = int(np.flatnonzero(of.g_v == g)[0])
        cells = [f"{of.frequency_hz[i, k]:.3f} | {of.damping[i, k]:.3f}" for k in range(2)]
        print(f"| {g:g} | {' | '.join(cells)} |")
    for k in range(2):
        where = ", ".join(f"{100 * x:g} % at {of.leaves(k, x):.3g}" for x in (0.01, 0.02, 0.05))
        print(f"mode {k + 1} has moved by {where} N m s/rad")
    apart = np.nanmax(np.abs(found["fem"].frequency_hz / of.frequency_hz - 1))
    print(f"finite elements against transfer matrices: frequencies within {apart:.1g}")
    for name, (source, output, g_v) in G_V.items():
        base = load_rig(name)[0]
        rig = with_encoder(base, output, (source,))
        sweep = {**swept().model_dump(), "actuator": rig.actuator[0].name}
        run = record(in_series(rig, source, g_v), SweptSine.model_validate(sweep), options.seed)
        response = estimate([run])[0]
        for off in (0.3, 3.0):
            fit = fit_gain([response], in_series(rig, source, off * g_v), output, band=(0.8, 30.0))
            print(
                f"{name}, start {off:g} of the truth: g_v = {fit.values[0]:.1f} from the amplitude "
                f"(truth {g_v:g}), {fit.gain_db:.2g} dB and {fit.phase_deg:.2g} degrees left"
            )
        free = (*STIFFNESSES, f"{source}_feedback.c")
        best = identify([response], in_series(rig, source, 0.7 * g_v), free, starts=1)
        low, high = (x[-1] for x in best.interval())
        print(f"  maximum likelihood: {best.values[-1]:.1f}, 90 % {low:.1f} to {high:.1f}")


def modes(options: argparse.Namespace) -> None:
    """Intervals of the modes, and methods 1 and 2 and the actuator fit from such numbers."""
    rig = load_rig("samii")[0]
    poles = realise(rig).poles
    poles = np.sort_complex(poles[poles.imag > 0])
    poles = poles[np.argsort(np.abs(poles))][:3]
    like = thinned(measured(0), options.thin)
    H = sampled_response(rig, like.frequency)
    rng = np.random.default_rng(options.seed)
    hits, errors, ratios = [], [], []
    for _ in range(options.runs):
        found = estimate_modes(redraw(like, H, rng, shared_lines(like)), rig, band=(0.5, 39.0))
        ratios.append(found.fit.ratio)
        for pole in poles:
            mode = min(found.modes, key=lambda m: abs(m.pole - pole))
            pairs = (
                (mode.frequency_hz, abs(pole) / 2 / np.pi),
                (mode.damping, -pole.real / abs(pole)),
            )
            for value, exact in pairs:
                low, high = value.interval(LEVEL)
                hits.append(low <= exact <= high)
                errors.append(abs(value.value / exact - 1))
    inside = np.array(hits).reshape(options.runs, len(poles), 2)
    worst = np.array(errors).reshape(options.runs, len(poles), 2).max(axis=0)
    print(
        f"{options.runs} draws, {len(like.frequency)} lines, "
        f"chi-square {np.mean(ratios):.3f} per degree"
    )
    print(
        "90 % intervals hold frequency and damping, %: "
        f"{np.round(100 * inside.mean(axis=0), 1).tolist()}"
    )
    print(f"pooled {100 * inside.mean():.1f} %; largest errors {worst.tolist()}")


def from_numbers(options: argparse.Namespace) -> None:
    """Methods 1 and 2 and the actuator fit on the modes of a simulated recording."""
    rig = load_rig("samii")[0]
    response = measured(options.seed)
    found = estimate_modes(response, rig, band=(0.5, 39.0))
    f = [m.frequency_hz.value for m in found.modes[:2]]
    light = [x for x in found.zeros_of("a_0") if abs(x.damping.value) < LIGHT]
    z = light[0].frequency_hz.value
    for damped in (False, True):
        one = method_1(rig, f, z, "a_0", STIFFNESSES, damped)
        print(
            f"method 1 on f = {np.round(f, 4)}, z_1 = {z:.4f} Hz, damping "
            f"{'as in the rig file' if damped else 'none'}: {one.values}, e = {one.error:.2g}"
        )
    held = braced(rig, "joint_1")
    sweep = SweptSine.model_validate({**swept().model_dump(), "amplitudes": (0.2,)})
    shapes = estimate_modes(
        estimate([record(held, sweep, options.seed)])[0], held, band=(0.8, 39.0)
    )
    ratio = shapes.shape_ratio(0, "a_1", "a_2")
    f1 = shapes.modes[0].frequency_hz
    two = method_2(held, f1.value, ratio.value, ("a_1", "a_2"), ["joint_1.k", "joint_2.k"])
    print(f"method 2 on f = {f1}, ratio {ratio}: {two.values}, e = {two.error:.2g}")
    joint = [f for f in away(rig, 0) if f.name in actuated_joint(rig, "theta_2")]
    fit = fit_actuator([response], rig, "theta_2", joint)
    print(
        f"actuator fit: {fit.names} {np.round(fit.values, 2)}, rms {fit.gain_db:.2g} dB, "
        f"{fit.phase_deg:.2g} degrees"
    )


def valleys(options: argparse.Namespace) -> None:
    """What method 1's three numbers leave open of four stiffnesses."""
    rig = load_rig("samii")[0]
    chain = Conservative(rig, (0.2, 60.0))
    f, z = chain.frequencies()[:2], chain.zeros("a_0")[0]
    targets = [*(Target("frequency", x, i) for i, x in enumerate(f)), Target("zero", z, 0, "a_0")]
    exact = truth(rig)[:4]
    print("| start over truth | " + " | ".join(STIFFNESSES) + " | e |\n|---|---|---|---|---|---|")
    for factor in (1.0, 0.6, 0.8, 1.5, 2.0):
        free = [Free(j, "k", start=factor * k) for j, k in zip(JOINTS, exact, strict=True)]
        got = method_1(rig, f, z, "a_0", free)
        cells = " | ".join(f"{v:.4g}" for v in got.values)
        print(f"| {factor:g} | {cells} | {got.error:.1g} |")
    line = valley(method_1(rig, f, z, "a_0", STIFFNESSES), targets)
    span = ", ".join(
        f"{n} {a:.4g} to {b:.4g}"
        for n, a, b in zip(line.names, line.values.min(0), line.values.max(0), strict=True)
    )
    print(
        f"\n{line.dimensions} direction {np.round(line.direction, 3)}; "
        f"along it e < {line.error.max():.1g}: {span}"
    )
    if options.figure:
        from matplotlib.figure import Figure

        figure = Figure(figsize=(5.0, 3.4), layout="constrained")
        axes = figure.subplots()
        for i, name in enumerate(line.names):
            axes.plot(line.values[:, 2] / 1e3, line.values[:, i] / exact[i], label=name)
        axes.axvline(exact[2] / 1e3, color="0.6", lw=0.8)
        axes.set(xlabel="joint_2.k, kN m/rad", ylabel="over the truth", yscale="log", xscale="log")
        axes.legend()
        figure.savefig(options.figure)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("study", choices=sorted(STUDIES))
    parser.add_argument("--seeds", type=int, default=200)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--thin", type=int, default=4, help="every n-th line (coverage)")
    parser.add_argument("--runs", type=int, default=20)
    parser.add_argument("--figure", type=Path)
    options = parser.parse_args()
    STUDIES[options.study](options)


STUDIES: dict[str, Callable[[argparse.Namespace], None]] = {
    "coverage": coverage,
    "recordings": recordings,
    "starts": starts,
    "encoder": encoder,
    "gains": gains,
    "modes": modes,
    "numbers": from_numbers,
    "valley": valleys,
}

if __name__ == "__main__":
    main()
