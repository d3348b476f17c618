"""Bode figures for a paper: PNG, SVG or PDF by matplotlib, without its global state."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, MultipleLocator, NullFormatter

from samii_rig.errors import InputError
from samii_rig.record.export import replacing
from samii_rig.report.compare import ModelCurve
from samii_rig.report.entries import Entry, channels, entries, indices
from samii_rig.report.plots import Curves, curves_of, label, lines_of, showing_curves, unit
from samii_rig.types import FrequencyResponse

SUFFIXES = (".png", ".svg", ".pdf")
# Okabe and Ito's colours, which people of any colour vision tell apart.
_COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#8C6D00", "#56B4E9")
_COLUMN_INCH = 3.5  # one column of a two-column page
_ROW_INCH = 3.6
_LEFT_INCH, _BOTTOM_INCH, _TOP_INCH = 0.7, 0.48, 0.28
_DPI = 300
_BINS = 180  # of log-frequency, two points each: 100 a inch of a column
_DIGITS = re.compile(r"(\.\d\d)\d+")  # of a path: a hundredth of a point is no ink
_NOISE_PART = 0.004  # of the lines may lie below the gain axis


def bode_figure(responses: Sequence[FrequencyResponse], model: ModelCurve | None = None) -> Figure:
    """Gain and phase of every output (one column each) to every input (one below the other), bands
    of 90 %.

    Levels are told apart by colour, the model is dashed black.
    """
    responses = sorted(responses, key=lambda r: (not np.isfinite(r.level), r.level))
    shown = entries(responses)
    outputs, inputs = (list(dict.fromkeys(names)) for names in zip(*shown, strict=True))
    rows = len(inputs)
    figure = Figure(figsize=(_COLUMN_INCH * len(outputs), _ROW_INCH * rows))
    FigureCanvasAgg(figure)
    axes = figure.subplots(
        2 * rows, len(outputs), sharex=True, squeeze=False, height_ratios=(1.5, 1.0) * rows
    )
    width, height = figure.get_size_inches()
    # Fixed margins: matplotlib's layout engine draws everything three times to find them.
    figure.subplots_adjust(
        left=_LEFT_INCH / width,
        right=1 - 0.1 / width,
        bottom=_BOTTOM_INCH / height,
        top=1 - _TOP_INCH / height,
        wspace=_LEFT_INCH / (_COLUMN_INCH - _LEFT_INCH),
        hspace=0.1 if rows == 1 else 0.3,
    )
    curves = curves_of(responses)
    drawn: dict[str, Artist] = {}
    for i, j in np.ndindex(len(outputs), rows):
        entry, (gain, angle) = (outputs[i], inputs[j]), axes[2 * j : 2 * j + 2, i]
        if entry not in shown:
            gain.set_axis_off()
            angle.set_axis_off()
            continue
        _entry(gain, angle, showing_curves(curves, entry), entry, model)
        drawn |= {str(line.get_label()): line for line in gain.lines}
    levels = [label(r) for r in responses if label(r) in drawn]
    names = list(dict.fromkeys((*levels, *drawn)))
    axes[0, 0].legend([drawn[n] for n in names], names, fontsize=7, frameon=False)
    return figure


def _entry(
    gain: Axes, angle: Axes, curves: Sequence[Curves], entry: Entry, model: ModelCurve | None
) -> None:
    """One output over one input, and the model's."""
    responses = [c.response for c in curves]
    for c in curves:
        _draw(gain, angle, c, entry)
    if model is not None:
        f = responses[0].frequency
        f = np.union1d(f, model.frequency[(model.frequency > f[0]) & (model.frequency < f[-1])])
        H = model.at(f, *entry)
        last = responses[-1]
        nearest = np.interp(f, last.frequency, curves[-1].angle[:, *indices(last, entry)])
        turn = np.rad2deg(np.unwrap(np.angle(np.where(np.isfinite(H), H, 1.0))))
        turn += 360.0 * np.round(np.median(nearest - turn) / 360.0)
        gain.plot(f, np.abs(H), "k--", lw=1.1, label=f"model {model.name}")
        angle.plot(f, np.where(np.isfinite(H), turn, np.nan), "k--", lw=1.1)
    size = np.abs(np.concatenate([r.H[:, *indices(r, entry)] for r in responses]))
    size = size[np.isfinite(size) & (size > 0)]
    if size.size:
        low, high = np.quantile(np.log10(size), [_NOISE_PART, 1.0])
        if model is not None and np.isfinite(H).any():
            low = min(low, float(np.log10(np.nanmin(np.abs(H)))))
            high = max(high, float(np.log10(np.nanmax(np.abs(H)))))
        room = 0.05 * (high - low) + 0.05
        gain.set_ylim(10 ** (low - room), 10 ** (high + room))
    _dress(gain, angle, f"{'/'.join(entry)} [{unit(*channels(responses[0], entry))}]")
    positive = responses[0].frequency[responses[0].frequency > 0]
    angle.set_xlim(positive[0], positive[-1])


def save_figure(path: Path | str, figure: Figure) -> Path:
    """Write `figure` in the format of the suffix; whole or not at all.

    Raises
    ------
    InputError : another suffix, or a place that cannot be written to.
    """
    path = Path(path)
    if path.suffix.lower() not in SUFFIXES:
        raise InputError("figure", "suffix", path.suffix, f"one of {', '.join(SUFFIXES)}")
    # Text stays text in an SVG, and a figure of the same data is the same file.
    with (
        replacing(path) as part,
        matplotlib.rc_context({"svg.fonttype": "none", "svg.hashsalt": "samii-rig"}),
    ):
        dated = {"Date": None} if path.suffix.lower() == ".svg" else None
        figure.savefig(part, format=path.suffix[1:].lower(), dpi=_DPI, metadata=dated)
        if dated:
            text = part.read_text(encoding="utf-8")
            short = re.sub(r' d="[^"]*"', lambda m: _DIGITS.sub(r"\1", m[0]), text)
            part.write_text(short, encoding="utf-8")
    return path


def _draw(gain: Axes, angle: Axes, c: Curves, entry: Entry) -> None:
    r, (i, j), colour = c.response, indices(c.response, entry), _COLOURS[c.order % len(_COLOURS)]
    at = lines_of(r, i, j, _BINS)
    f, size = r.frequency[at], np.abs(r.H[at, i, j])
    low = np.maximum(c.low[at, i, j], 0.1 * size)  # zero is nowhere on a logarithmic axis
    gain.fill_between(f, low, c.high[at, i, j], color=colour, alpha=0.25, lw=0)
    gain.plot(f, size, color=colour, lw=0.9, label=label(r))
    half = np.where(c.half[at, i, j] < 180.0, c.half[at, i, j], np.nan)
    turn = c.angle[at, i, j]
    angle.fill_between(f, turn - half, turn + half, color=colour, alpha=0.25, lw=0)
    angle.plot(f, turn, color=colour, lw=0.9)


def _dress(gain: Axes, angle: Axes, title: str) -> None:
    gain.set_title(title, fontsize=9)
    gain.set_xscale("log")
    gain.set_yscale("log")
    gain.set_ylabel("gain", fontsize=9)
    angle.set_ylabel("phase [\u00b0]", fontsize=9)
    angle.set_xlabel("frequency [Hz]", fontsize=9)
    angle.yaxis.set_major_locator(MultipleLocator(90))
    angle.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    angle.xaxis.set_major_formatter(FuncFormatter(lambda x, _: f"{x:g}"))
    angle.xaxis.set_minor_formatter(NullFormatter())
    for axes in (gain, angle):
        axes.grid(visible=True, color="0.88", lw=0.5)
        axes.tick_params(labelsize=8)
        axes.spines[["top", "right"]].set_visible(False)
