"""Pictures of a design: Bode and Nyquist, root locus, margins, and steps as recorded."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from samii_rig.control.design import Design
from samii_rig.control.plants import alone
from samii_rig.control.settle import BAND, Settling
from samii_rig.model.loops import Loops, closed_poles
from samii_rig.types import Complex

# Okabe and Ito's colours, which people of any colour vision distinguish.
BLUE, RED, GREEN, GREY = "#0072B2", "#D55E00", "#009E73", "#888888"
DPI = 130
FACTORS = np.concatenate([[0.0], np.geomspace(0.01, 4.0, 120)])  # of the gain, in the locus
LOCUS_HZ = 10.0  # edge of the root locus
ORDERS = {"damping": "damping of mode 1", "gain_db": "gain margin [dB]"}
ORDERS |= {"phase_deg": "phase margin [deg]"}


def write_pictures(design: Design, steps: Sequence[Settling], folder: Path) -> list[Path]:
    """All pictures as PNG files in `folder`; their paths."""
    figures = {
        "loop.png": loop_figure(design),
        "root_locus.png": locus_figure(design),
        "margins.png": margins_figure(design),
    }
    if steps:
        figures["steps.png"] = steps_figure(steps)
    out = []
    for name, figure in figures.items():
        figure.savefig(folder / name, dpi=DPI)
        out.append(folder / name)
    return out


def loop_figure(design: Design) -> Figure:
    """Bode and Nyquist plot of the loop cut at the actuator, and of the feedback alone."""
    figure = _figure(10.5, 5.2)
    grid = figure.add_gridspec(2, 2, width_ratios=(1.25, 1), height_ratios=(1.4, 1))
    gain, phase = figure.add_subplot(grid[0, 0]), figure.add_subplot(grid[1, 0])
    nyquist = figure.add_subplot(grid[:, 1])
    f = design.plant.frequency
    both, feedback = _gains(design)
    shown = (f >= 0.05) & (f <= 50)
    for L, colour, name, m, side in (
        (both, BLUE, "cut at the actuator", design.nominal.actuator, "left"),
        (feedback, RED, "feedback alone, centring closed", design.nominal.feedback, "right"),
    ):
        gain.loglog(f[shown], np.abs(L[shown]), color=colour, lw=1.5, label=name)
        degrees = np.angle(L[shown], deg=True)
        degrees[1:][np.abs(np.diff(degrees)) > 180] = np.nan
        phase.semilogx(f[shown], degrees, color=colour, lw=1.5)
        nyquist.plot(L.real, L.imag, color=colour, lw=1.5, label=name)
        if np.isfinite(m.gain_hz):
            level = np.interp(m.gain_hz, f, np.abs(L))
            gain.plot([m.gain_hz] * 2, [level, 1], color=colour, lw=3, alpha=0.5)
            gain.annotate(
                f"{m.gain_db:.1f} dB",
                (m.gain_hz, level),
                (0 if side == "left" else -6, -13 if side == "left" else 3),
                textcoords="offset points",
                ha=side,
                color=colour,
            )
        if np.isfinite(m.phase_hz):
            at = np.interp(m.phase_hz, f, np.arange(f.size))
            value = complex(np.interp(at, np.arange(f.size), L.real))
            value += 1j * np.interp(at, np.arange(f.size), L.imag)
            nyquist.plot([0, value.real], [0, value.imag], color=colour, lw=0.8)
            nyquist.annotate(
                f"{m.phase_deg:.0f}\u00b0",
                (value.real, value.imag),
                (5, 5),
                textcoords="offset points",
                color=colour,
            )
    gain.axhline(1, color=GREY, lw=0.8)
    gain.set(ylabel="loop gain", xlim=(0.05, 50), ylim=(1e-3, 30))
    gain.legend(frameon=False, fontsize=8, loc="lower left")
    gain.tick_params(labelbottom=False)
    phase.axhline(-180, color=GREY, lw=0.8)
    phase.set(
        ylabel="phase [deg]",
        xlabel="frequency [Hz]",
        xlim=(0.05, 50),
        ylim=(-190, 190),
        yticks=(-180, -90, 0, 90, 180),
    )
    angle = np.linspace(0, 2 * np.pi, 200)
    nyquist.plot(np.cos(angle), np.sin(angle), color=GREY, lw=0.8)
    nyquist.plot(-1, 0, "k+", ms=10, mew=2)
    nyquist.set(xlim=(-2.5, 2.5), ylim=(-2.5, 2.5), xlabel="Re L", ylabel="Im L", aspect="equal")
    nyquist.set_title("Nyquist; -1 marked, unit circle", fontsize=9)
    return figure


def locus_figure(design: Design) -> Figure:
    """Closed-loop poles as the feedback's gain goes from none to four times what it is, and
    where they lie on the rigs within the range."""
    figure = _figure(6.6, 5.4)
    axes = figure.add_subplot()
    edge = 2 * np.pi * LOCUS_HZ
    every = [_poles(design, x, edge) for x in FACTORS]
    for p, x in zip(every, FACTORS, strict=True):
        axes.plot(p.real, p.imag, ".", ms=2.5, color=BLUE if x <= 1 else GREY)
    for j in (*design.corners, *design.draws):
        p = j.poles[np.abs(j.poles) < edge]
        axes.plot(p.real, p.imag, ".", ms=3, color=GREEN, alpha=0.35)
    start = every[0]
    chosen = _poles(design, 1.0, edge)
    axes.plot(start.real, start.imag, "x", color=BLUE, ms=8, mew=1.5, label="no feedback")
    axes.plot(chosen.real, chosen.imag, "s", color=RED, ms=6, mfc="none", label="as designed")
    axes.plot([], [], ".", color=BLUE, label="gain from none to the design's")
    axes.plot([], [], ".", color=GREY, label="up to 4 times that")
    axes.plot([], [], ".", color=GREEN, label=f"rigs, \u00b1{100 * design.goals.spread:g} %")
    slope = np.sqrt(1 / design.goals.damping**2 - 1)
    axes.plot([0, -edge], [0, edge * slope], "k--", lw=0.8)
    top = 50.0
    axes.annotate(
        f"damping {design.goals.damping:g}",
        (-0.8 * top / slope, 0.8 * top),
        (-4, 0),
        textcoords="offset points",
        ha="right",
        fontsize=8,
    )
    axes.axvline(0, color="k", lw=0.8)
    axes.set(xlim=(-20, 3), ylim=(-1, top), xlabel="Re s [rad/s]", ylabel="Im s [rad/s]")
    axes.legend(frameon=False, fontsize=8, loc="upper left")
    axes.set_title("Poles of the sampled closed loop", fontsize=10)
    return figure


def margins_figure(design: Design) -> Figure:
    """Damping and margins over the rigs within the range, and as uncertain as they are."""
    figure = _figure(10, 3.0)
    asked = {
        "damping": design.goals.damping,
        "gain_db": design.goals.gain_db,
        "phase_deg": design.goals.phase_deg,
    }
    groups = (
        (f"every stiffness at \u00b1{100 * design.goals.spread:g} %", design.corners, BLUE),
        ("inside that range", design.draws, GREEN),
        ("as uncertain as the rig file says", design.uncertain, RED),
    )
    for axes, (what, title) in zip(figure.subplots(1, 3), ORDERS.items(), strict=True):
        for name, judgements, colour in groups:
            x = np.sort([getattr(j, what) for j in judgements])
            axes.step(x, (np.arange(x.size) + 0.5) / x.size, where="mid", color=colour, label=name)
        axes.axvline(asked[what], color="k", ls="--", lw=1)
        axes.axvline(getattr(design.nominal, what), color=GREY, lw=1)
        axes.set(xlabel=title, ylim=(0, 1))
        axes.set_xlim(left=min(0.9 * asked[what], axes.get_xlim()[0]))
    figure.axes[0].set_ylabel("part of the rigs below")
    figure.axes[0].axvline(np.nan, color="k", ls="--", lw=1, label="asked")
    figure.axes[0].axvline(np.nan, color=GREY, lw=1, label="nominal")
    handles, names = figure.axes[0].get_legend_handles_labels()
    figure.legend(handles, names, loc="outside upper center", ncols=5, frameon=False, fontsize=8)
    return figure


def steps_figure(steps: Sequence[Settling]) -> Figure:
    """What was recorded after a step, over the model's closed loop."""
    figure = _figure(8, 2.4 * len(steps) + 0.4)
    span = 1.5 * max([s.measured_s for s in steps if np.isfinite(s.measured_s)], default=5.0)
    for axes, s in zip(np.atleast_1d(figure.subplots(len(steps), 1)), steps, strict=True):
        _step(axes, s, span)
    figure.axes[-1].set_xlabel("time after the step [s]")
    return figure


def _step(axes: Axes, s: Settling, span: float) -> None:
    shown = s.time <= span
    axes.plot(s.time[shown], s.response[shown], color=RED, lw=1.2, label="recorded")
    axes.plot(s.time[shown], s.predicted[shown], "k--", lw=0.8, label="model")
    level = BAND * float(np.max(np.abs(s.response)))
    axes.axhspan(-level, level, color=GREEN, alpha=0.2, lw=0)
    axes.axvline(s.measured_s, color=BLUE, lw=1)
    loops = "with " + ", ".join(s.feedback) if s.feedback else "without feedback"
    axes.set_title(f"{loops}: within 5 % after {s.measured_s:.2f} s", fontsize=9, loc="left")
    axes.set(ylabel=f"{s.sensor} [{s.unit.replace('^2', chr(0xB2))}]", xlim=(0, span))
    axes.legend(frameon=False, fontsize=8, loc="upper right")


def _gains(design: Design) -> tuple[Complex, Complex]:
    p, loops = design.plant, design.loops
    z = np.exp(2j * np.pi * p.frequency / p.rig.rate_hz)
    L = loops.gain(p.response, loops.filters(z, p.rig.rate_hz))
    return L, alone(p.response, L, loops)


def _poles(design: Design, factor: float, edge: float) -> Complex:
    feedback = tuple(
        (i, loop.model_copy(update={"gain": factor * loop.gain}))
        for i, loop in design.loops.feedback
    )
    loops = Loops(design.loops.actuator, design.loops.theta, design.loops.kp, feedback)
    s = closed_poles(design.plant.system, loops).s
    return np.asarray(s[np.abs(s) < edge])


def _figure(width: float, height: float) -> Figure:
    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure
