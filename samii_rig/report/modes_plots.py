"""The stabilisation diagram and the mode shapes, for the page and as pictures."""

from __future__ import annotations

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure as Picture
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from samii_rig.modal.match import placed
from samii_rig.modal.modes import ModalModel, Mode
from samii_rig.modal.stabilisation import Stability
from samii_rig.report.canvas import Figure, axis, base_layout, log_scale, packed, ticked
from samii_rig.report.modes import Modes
from samii_rig.types import Float, FrequencyResponse

# What is said of a pole, its sign and colour: by the page's names, and for a picture on paper.
_SIGNS = {
    Stability.NEW: ("new", "circle-open", "@muted", "o", "#7b8590"),
    Stability.FREQUENCY: ("frequency stable", "triangle-up-open", "@level4", "^", "#8C6D00"),
    Stability.DAMPING: ("frequency and damping stable", "diamond-open", "@level1", "D", "#D55E00"),
    Stability.SHAPE: ("shape, too", "circle", "@level0", "o", "#0072B2"),
}
_INCH = (7.0, 4.2)  # two columns of a page
_PANEL_PIXELS = 460
_SHAPE_PIXELS = 300


def response_sum(response: FrequencyResponse) -> Float:
    """(n_freq,) sum of |H| of all entries, each over its own median."""
    size = np.abs(response.H).reshape(len(response.frequency), -1)
    middle = np.median(np.where(np.isfinite(size), size, 0.0), axis=0)
    return np.asarray(np.sum(size / np.where(middle > 0, middle, 1.0), axis=1))


def stabilisation(response: FrequencyResponse, found: ModalModel) -> Figure:
    """Poles over frequency and order, the sum of responses behind them, modes as lines."""
    f, total = response.frequency, response_sum(response)
    use = (f >= found.frequency[0]) & (f <= found.frequency[-1]) & (total > 0)
    f, total = f[use], total[use]
    layout = base_layout(_PANEL_PIXELS)
    d = found.diagram
    layout["xaxis"] = axis("frequency [Hz]") | {"hoverformat": ".4g"}
    log_scale(layout["xaxis"])
    layout["xaxis"] |= ticked(float(np.log10(f[0])), float(np.log10(f[-1])))
    layout["yaxis"] = axis("order") | {"rangemode": "tozero"}
    layout["yaxis2"] = axis("sum of responses") | {
        "overlaying": "y", "side": "right", "showgrid": False, "showticklabels": False,
        "ticks": "",
    }  # fmt: skip
    log_scale(layout["yaxis2"])
    layout["yaxis2"].pop("minor")
    layout["hovermode"] = "closest"
    behind = {
        "type": "scatter", "mode": "lines", "name": "sum of responses", "x": packed(f),
        "y": packed(total), "yaxis": "y2", "line": {"width": 1.4, "color": "@muted"},
        "hoverinfo": "skip",
    }  # fmt: skip
    figure: Figure = {"data": [behind], "layout": layout}
    for state, (name, symbol, colour, _, _) in _SIGNS.items():
        at = d.stability == state
        if not at.any():
            continue
        figure["data"].append(
            {
                "type": "scatter", "mode": "markers", "name": name, "x": packed(d.hz[at]),
                "y": packed(d.order[at].astype(float)), "yaxis": "y",
                "marker": {"size": 6, "symbol": symbol, "color": colour},
                "customdata": [round(100 * z, 3) for z in d.damping[at].tolist()],
                "hovertemplate": "%{x:.4g} Hz, damping %{customdata} %, order %{y}",
            }
        )  # fmt: skip
    layout["shapes"] = [_stroke(m) for m in found.modes]
    return figure


def _stroke(mode: Mode) -> dict[str, object]:
    x = mode.frequency_hz.value
    return {
        "type": "line", "xref": "x", "yref": "paper", "x0": x, "x1": x, "y0": 0, "y1": 1,
        "line": {"color": "@ink", "width": 1, "dash": "dot"}, "layer": "below",
    }  # fmt: skip


def picture(response: FrequencyResponse, found: ModalModel) -> Picture:
    """The stabilisation diagram for a paper."""
    figure = Picture(figsize=_INCH, layout="constrained")
    FigureCanvasAgg(figure)
    poles = figure.subplots()
    behind = poles.twinx()
    f, total = response.frequency, response_sum(response)
    use = (f >= found.frequency[0]) & (f <= found.frequency[-1]) & (total > 0)
    behind.plot(f[use], total[use], color="0.7", lw=1.0)
    behind.set_yscale("log")
    behind.set_yticks([])
    behind.set_ylabel("sum of responses", fontsize=9)
    # Poles stand before the curve.
    poles.set_zorder(behind.get_zorder() + 1)
    poles.patch.set_visible(False)
    d = found.diagram
    for state, (name, _, _, marker, colour) in _SIGNS.items():
        at = d.stability == state
        face = colour if state == Stability.SHAPE else "none"
        poles.plot(d.hz[at], d.order[at], marker, ms=3.5, color=colour, mfc=face, label=name)
    for mode in found.modes:
        poles.axvline(mode.frequency_hz.value, color="k", lw=0.8, ls=":")
        poles.annotate(
            f"{mode.frequency_hz.value:.4g}", (mode.frequency_hz.value, 1.0),
            xycoords=("data", "axes fraction"), xytext=(2, 2), textcoords="offset points",
            fontsize=7, rotation=60,
        )  # fmt: skip
    poles.set_xscale("log")
    poles.set_xlim(f[use][0], f[use][-1])
    poles.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    poles.xaxis.set_major_formatter(FuncFormatter(lambda x, _: f"{x:g}"))
    poles.xaxis.set_minor_formatter(NullFormatter())
    behind.minorticks_off()
    poles.set_ylim(bottom=0)
    poles.set_xlabel("frequency [Hz]", fontsize=9)
    poles.set_ylabel("order", fontsize=9)
    poles.tick_params(labelsize=8)
    poles.legend(fontsize=7, loc="lower left", framealpha=0.9)
    return figure


def shape(m: Modes, i: int) -> Figure:
    """Mode i at the sensors with its 90 % intervals, over the model's along the chain.

    Without a model's mode, or without accelerometers, the outputs stand side by side.
    """
    mode, held = m.found.modes[i], m.of_model(i)
    layout = base_layout(_SHAPE_PIXELS)
    figure: Figure = {"data": [], "layout": layout}
    seen = placed(m.found, mode, held[0]) if held else None
    if held and seen is not None:
        x, w, half = seen
        known = held[0]
        layout["xaxis"] = axis("m along the chain")
        layout["yaxis"] = axis("displacement, real part")
        figure["data"] = [
            _line("chain at rest", known.x, np.zeros(known.x.size), "@muted", "dot"),
            _line(f"model, {known.frequency_hz:.4g} Hz", known.x, known.w.real, "@ink", "dash"),
            _marks("measured", x, w.real, half),
        ]
        return figure
    names = list(m.found.outputs)
    layout["xaxis"] = axis("") | {"tickvals": list(range(len(names))), "ticktext": names}
    layout["yaxis"] = axis("shape, real part")
    at = np.arange(len(names), dtype=float)
    figure["data"] = [_marks("measured", at, mode.shape.real, mode.shape_interval()[0])]
    return figure


def _line(name: str, x: Float, y: Float, colour: str, dash: str) -> dict[str, object]:
    return {
        "type": "scatter", "mode": "lines", "name": name, "x": packed(x), "y": packed(y),
        "line": {"width": 1.6, "color": colour, "dash": dash}, "hoverinfo": "skip",
    }  # fmt: skip


def _marks(name: str, x: Float, y: Float, half: Float) -> dict[str, object]:
    return {
        "type": "scatter", "mode": "markers", "name": name, "x": packed(x), "y": packed(y),
        "error_y": {"type": "data", "array": packed(half), "color": "@level0"},
        "marker": {"size": 8, "color": "@level0"}, "hovertemplate": "%{y:.4g}",
    }  # fmt: skip
