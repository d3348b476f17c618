"""The parts that the page's figures are made of, as plain plotly descriptions.

Colours are names that start with "@" (`@ink`, `@level0`); the page's script puts in those
of the reader's light or dark scheme. Arrays go as base64 of float32.
"""

from __future__ import annotations

import base64
from collections.abc import Sequence
from typing import Any

import numpy as np

from samii_rig.types import Float

Figure = dict[str, Any]
Stroke = dict[str, Any]  # width in pixels, colour and dash, as plotly has them
MODEL: Stroke = {"width": 2.2, "color": "@ink", "dash": "dash"}
N_COLOURS = 6
_STEPS, _MISSING = 65534, 65535  # of uint16
_DECADES = 50.0  # largest over smallest, from which an array is stored by its logarithm


def packed(values: Float) -> dict[str, str]:
    """An array as plotly reads it fast: little-endian float32 in base64."""
    array = np.ascontiguousarray(values, dtype="<f4")
    out = {"dtype": "f4", "bdata": base64.b64encode(array.tobytes()).decode("ascii")}
    if array.ndim == 2:
        out["shape"] = f"{array.shape[0]}, {array.shape[1]}"
    return out


def unpacked(array: dict[str, str]) -> Float:
    """What `packed` was given, of one dimension."""
    return np.frombuffer(base64.b64decode(array["bdata"]), "<f4").astype(np.float64)


def halved(node: Any) -> Any:
    """A description with its arrays in half of the bytes, as the page's script reads them.

    An array becomes {"q": base64 of uint16, "from", "to", "log"}: `_STEPS` even steps of its range,
    or of the range's logarithm where it spans decades, which is a hundredth of a pixel; `_MISSING`
    stands for what is no number.
    """
    if isinstance(node, list):
        return [halved(item) for item in node]
    if not isinstance(node, dict):
        return node
    if "bdata" not in node:
        return {key: halved(item) for key, item in node.items()}
    values = unpacked(node)
    known = np.isfinite(values)
    log = bool(known.any() and values[known].min() > 0)
    log = log and bool(values[known].max() > _DECADES * values[known].min())
    scaled = np.log(values) if log else values
    low = float(scaled[known].min()) if known.any() else 0.0
    high = float(scaled[known].max()) if known.any() else 0.0
    steps = np.full(len(values), _MISSING)
    steps[known] = np.round((scaled[known] - low) * (_STEPS / ((high - low) or 1.0)))
    raw = base64.b64encode(steps.astype("<u2").tobytes()).decode("ascii")
    shape = {"shape": node["shape"]} if "shape" in node else {}
    return {"q": raw, "from": low, "to": high, "log": log, **shape}


def restored(array: dict[str, Any]) -> Float:
    """(n,) what `halved` made of an array, as the page's script restores it."""
    steps = np.frombuffer(base64.b64decode(array["q"]), "<u2").astype(np.float64)
    values = array["from"] + steps / _STEPS * (array["to"] - array["from"])
    return np.where(steps == _MISSING, np.nan, np.exp(values) if array["log"] else values)


def axis(title: str) -> dict[str, Any]:
    """What every axis has in common."""
    return {
        "title": {"text": title, "standoff": 8},
        "gridcolor": "@grid",
        "linecolor": "@muted",
        "zeroline": False,
        "ticks": "outside",
        "tickcolor": "@muted",
        "automargin": True,
    }


def base_layout(height: int) -> dict[str, Any]:
    """What every figure has in common."""
    return {
        "height": height,
        "margin": {"l": 64, "r": 16, "t": 62, "b": 44},
        "modebar": {"bgcolor": "rgba(0,0,0,0)", "color": "@muted", "activecolor": "@ink"},
        "paper_bgcolor": "rgba(0,0,0,0)",
        "plot_bgcolor": "rgba(0,0,0,0)",
        "font": {"family": "system-ui, sans-serif", "size": 13, "color": "@ink"},
        "hovermode": "x unified",
        "hoverlabel": {"bgcolor": "@panel", "bordercolor": "@grid", "font": {"color": "@ink"}},
        "legend": {"orientation": "h", "x": 0, "y": 1, "yanchor": "bottom", "xanchor": "left"},
    }


def stacked(
    rows: int, titles: Sequence[str], height: int, weights: Sequence[float] | None = None
) -> Figure:
    """An empty figure of `rows` panels over one logarithmic frequency axis."""
    layout = base_layout(height)
    share = np.array(weights or [1.0] * rows)
    share = share / share.sum()
    gap = 0.035
    top = 1.0
    for row, title in enumerate(titles, 1):
        bottom = top - share[row - 1] * (1 - gap * (rows - 1))
        number = "" if row == 1 else str(row)
        layout[f"yaxis{number}"] = axis(title) | {
            "domain": [max(float(bottom), 0.0), float(top)],
            "anchor": "x",
        }
        top = bottom - gap
    last = "y" if rows == 1 else f"y{rows}"
    layout["xaxis"] = axis("frequency [Hz]") | {"anchor": last, "hoverformat": ".4g"}
    log_scale(layout["xaxis"])
    return {"data": [], "layout": layout}


def log_scale(axis: dict[str, Any]) -> None:
    """Make an axis logarithmic."""
    axis |= {
        "type": "log",
        "exponentformat": "power",
        "minor": {"dtick": "D1", "ticks": "outside", "ticklen": 3, "tickcolor": "@muted"},
    }


def ticked(low: float, high: float) -> dict[str, Any]:
    """A logarithmic axis from 10^`low` to 10^`high` with round numbers written out in full."""
    if high - low < 0.02:  # a single line
        low, high = low - 0.1, high + 0.1
    span = high - low
    steps = (1,) if span > 3 else (1, 2, 5) if span > 0.6 else (1, 1.5, 2, 3, 4, 5, 6, 7, 8, 9)
    decades = range(int(np.floor(low)), int(np.ceil(high)) + 1)
    ticks = [s * 10.0**d for d in decades for s in steps if low <= np.log10(s * 10.0**d) <= high]
    return {
        "range": [float(low), float(high)],
        "tickmode": "array",
        "tickvals": ticks,
        "ticktext": [f"{tick:g}" for tick in ticks],
    }


def band(figure: Figure, f: Float, low: Float, high: Float, axis: str, level: int) -> None:
    """Add the area between two curves; nothing where either is NaN."""
    # One closed outline for each stretch without NaN: `tonexty` would fill across holes.
    good = np.isfinite(low) & np.isfinite(high)
    edges = np.flatnonzero(np.diff(np.concatenate([[False], good, [False]]).astype(int)))
    xs: list[Float] = []
    ys: list[Float] = []
    for a, b in zip(edges[::2], edges[1::2], strict=True):
        xs += [f[a:b], f[a:b][::-1], f[a : a + 1], np.array([np.nan])]
        ys += [high[a:b], low[a:b][::-1], high[a : a + 1], np.array([np.nan])]
    if not xs:
        return
    colour = level % N_COLOURS
    figure["data"].append(
        {
            "type": "scatter",
            "mode": "lines",
            "x": packed(np.concatenate(xs)),
            "y": packed(np.concatenate(ys)),
            "yaxis": axis,
            "line": {"width": 0},
            "fill": "toself",
            "fillcolor": f"@level{colour}soft",
            "legendgroup": f"level{level}",
            "showlegend": False,
            "hoverinfo": "skip",
        }
    )


def line(
    figure: Figure,
    f: Float,
    values: Float,
    name: str,
    axis: str,
    of: int | Stroke,
    *,
    hover: str,
    legend: bool = True,
) -> None:
    """Add a curve: of the measurement at the `of`-th amplitude, or of a model in its stroke."""
    if isinstance(of, int):
        group, stroke = f"level{of}", {"width": 1.4, "color": f"@level{of % N_COLOURS}"}
    else:
        group, stroke = name, of
    figure["data"].append(
        {
            "type": "scatter",
            "mode": "lines",
            "name": name,
            "x": packed(f),
            "y": packed(values),
            "yaxis": axis,
            "line": stroke,
            "legendgroup": group,
            "showlegend": legend,
            "hovertemplate": hover,
        }
    )


def points(
    figure: Figure, f: Float, values: Float, name: str, axis: str, level: int, *, full: bool
) -> None:
    """Add points at the `level`-th amplitude, full or hollow; none where a value is not above 0."""
    seen = values > 0
    figure["data"].append(
        {
            "type": "scatter",
            "mode": "markers",
            "name": name,
            "x": packed(f[seen]),
            "y": packed(values[seen]),
            "yaxis": axis,
            "marker": {
                "size": 5,
                "symbol": "circle" if full else "circle-open",
                "color": f"@level{level % N_COLOURS}",
            },
            "legendgroup": f"level{level}",
            "showlegend": False,
            "hovertemplate": "%{y:.2g} %",
        }
    )


def shade(span: tuple[float, float]) -> dict[str, Any]:
    """A frequency band in which the curves differ."""
    return {
        "type": "rect",
        "xref": "x",
        "yref": "paper",
        "x0": span[0],
        "x1": span[1],
        "y0": 0,
        "y1": 1,
        "fillcolor": "@differs",
        "line": {"width": 0},
        "layer": "below",
    }


def level_line(axis: str, at: float) -> dict[str, Any]:
    """A dashed line across the panel of `axis` at one value."""
    return {
        "type": "line",
        "xref": "paper",
        "x0": 0,
        "x1": 1,
        "yref": axis,
        "y0": at,
        "y1": at,
        "line": {"color": "@ink", "width": 1.5, "dash": "dash"},
    }
