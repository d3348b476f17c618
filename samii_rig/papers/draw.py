"""Pictures of the papers' results by matplotlib, in the style of the report's figures."""

from __future__ import annotations

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, MultipleLocator, NullFormatter

from samii_rig.papers.result import Curve, Panel, Picture
from samii_rig.types import Float, Int

# Okabe and Ito's colours, which people of any colour vision tell apart.
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#8C6D00", "#56B4E9")
PUBLISHED = "#8a5a00"  # what the paper says: spans and dashed lines
SMALL = 7.5  # points
WIDE = 2000.0  # greatest over least x from which only powers of ten are written out
SHOWN = 140  # points of a dense curve
FEW_POINTS = 40  # points; more are drawn without error bars of their own


def draw(picture: Picture) -> Figure:
    """The picture as a matplotlib figure."""
    rows = -(-len(picture.panels) // picture.columns)
    weights = [p.weight for p in picture.panels[:: picture.columns]]
    with matplotlib.rc_context({"font.size": 9.0}):
        figure = Figure(figsize=(picture.width, picture.height), layout="constrained")
        FigureCanvasAgg(figure)
        axes = figure.subplots(
            rows, picture.columns, squeeze=False, height_ratios=weights, sharex="col"
        )
        for at, panel in enumerate(picture.panels):
            row, column = divmod(at, picture.columns)
            _panel(axes[row, column], panel, last=row == rows - 1)
        for empty in axes.ravel()[len(picture.panels) :]:
            empty.set_visible(False)
        figure.suptitle(picture.title, fontsize=10)
    return figure


def _panel(axes: Axes, panel: Panel, last: bool) -> None:
    if panel.log_x:
        axes.set_xscale("log")
        ends = panel.x_range or _reach(panel)
        wide = ends[1] > WIDE * ends[0]
        axes.xaxis.set_major_locator(LogLocator(subs=(1.0,) if wide else (1.0, 2.0, 5.0)))
        axes.xaxis.set_major_formatter(FuncFormatter(lambda x, _: f"{x:g}"))
        axes.xaxis.set_minor_formatter(NullFormatter())
    if panel.log_y:
        axes.set_yscale("log")
    if panel.y_step:
        axes.yaxis.set_major_locator(MultipleLocator(panel.y_step))
    for curve in panel.curves:
        _curve(axes, curve)
    if panel.x_range:
        axes.set_xlim(*panel.x_range)
    if panel.y_range:
        axes.set_ylim(*panel.y_range)
    for mark in panel.marks:
        if mark.axis == "y":
            _horizontal(axes, mark.low, mark.high, mark.text)
        else:
            _vertical(axes, mark.low, mark.high, mark.text, mark.foot)
    for label in panel.labels:
        axes.annotate(
            label.text,
            (label.x, label.y),
            (label.dx, label.dy),
            textcoords="offset points",
            fontsize=SMALL,
            va="center",
            ha="left" if label.dx >= 0 else "right",
            arrowprops={"arrowstyle": "-", "color": "0.4", "lw": 0.7},
        )
    axes.set_title(panel.title, fontsize=9)
    axes.set_ylabel(panel.y)
    if last:
        axes.set_xlabel(panel.x)
    axes.grid(visible=True, color="0.9", lw=0.5)
    axes.spines[["top", "right"]].set_visible(False)
    axes.tick_params(labelsize=8)
    if panel.legend:
        axes.legend(fontsize=SMALL, frameon=False, loc=panel.legend)


def _reach(panel: Panel) -> tuple[float, float]:
    """Least and greatest x of all curves."""
    x = np.concatenate([c.x for c in panel.curves])
    return float(x.min()), float(x.max())


def _curve(axes: Axes, c: Curve) -> None:
    colour = COLOURS[c.colour % len(COLOURS)]
    label = c.name or None
    match c.kind:
        case "broad":
            axes.plot(c.x, c.y, color=colour, alpha=0.3, lw=4.5, label=label, zorder=1)
        case "dashed":
            axes.plot(c.x, c.y, color=colour, lw=1.4, ls=(0, (4, 2)), label=label, zorder=3)
        case "line":
            axes.plot(c.x, c.y, color=colour, lw=1.4, label=label, zorder=3)
            if c.low is not None and c.high is not None:
                axes.fill_between(c.x, c.low, c.high, color=colour, alpha=0.25, lw=0)
        case "points":
            few = c.x.size <= FEW_POINTS
            if few and c.low is not None and c.high is not None:
                bars = np.array([c.y - c.low, c.high - c.y])
                axes.errorbar(
                    c.x,
                    c.y,
                    bars,
                    fmt="o",
                    ms=4,
                    color=colour,
                    capsize=3,
                    lw=1,
                    label=label,
                    zorder=4,
                )
                return
            if c.low is not None and c.high is not None:
                band = _thin(axes, c.x, 3 * SHOWN)
                axes.fill_between(
                    c.x[band], c.low[band], c.high[band], color=colour, alpha=0.25, lw=0
                )
            at = np.arange(c.x.size) if few else _thin(axes, c.x, SHOWN)
            axes.plot(
                c.x[at], c.y[at], "o", ms=4 if few else 3, color=colour, label=label, zorder=2
            )


def _thin(axes: Axes, x: Float, count: int) -> Int:
    """Indices of points that are evenly spread along the axis and can be told apart."""
    place = np.log(x) if axes.get_xscale() == "log" else x
    return np.unique(np.searchsorted(place, np.linspace(place[0], place[-1], count)))


def _vertical(axes: Axes, low: float, high: float | None, text: str, foot: bool) -> None:
    if high is not None:
        axes.axvspan(low, high, color=PUBLISHED, alpha=0.13, lw=0, zorder=0)
        middle = float(np.sqrt(low * high)) if axes.get_xscale() == "log" else (low + high) / 2
    else:
        axes.axvline(low, color=PUBLISHED, lw=0.9, ls=":", zorder=0)
        middle = low
    if text:
        axes.annotate(
            text,
            (middle, 0.02 if foot else 0.98),
            xycoords=("data", "axes fraction"),
            rotation=90,
            fontsize=SMALL,
            color=PUBLISHED,
            ha="center" if high is not None else "right",
            va="bottom" if foot else "top",
        )


def _horizontal(axes: Axes, low: float, high: float | None, text: str) -> None:
    if high is not None:
        axes.axhspan(low, high, color=PUBLISHED, alpha=0.13, lw=0, zorder=0)
    else:
        axes.axhline(low, color=PUBLISHED, lw=0.9, ls=":", zorder=0)
    if text:
        at = low if high is None else (low + high) / 2
        axes.annotate(
            text,
            (0.01, at),
            xycoords=("axes fraction", "data"),
            fontsize=SMALL,
            color=PUBLISHED,
            va="bottom" if high is None else "center",
        )
