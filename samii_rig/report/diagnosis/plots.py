"""The figures of a diagnosis: x(w) at a place with its law, and the models before and after."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from samii_rig.report.canvas import (
    MODEL,
    N_COLOURS,
    Figure,
    Stroke,
    band,
    level_line,
    line,
    log_scale,
    packed,
    stacked,
    ticked,
)
from samii_rig.report.compare import ModelCurve
from samii_rig.report.diagnosis.models import HALF, Strength
from samii_rig.report.entries import Entry, channels, indices, showing
from samii_rig.report.plots import (
    DEGREES,
    Curves,
    fit_gain,
    fit_phase,
    frame,
    gain_curve,
    phase_curve,
    same_turn,
    unit,
    unwrapped,
)
from samii_rig.types import Complex, Float, FrequencyResponse

BEFORE: Stroke = {"width": 2.2, "color": "@bad", "dash": "dot"}
AFTER = MODEL
_KNOWN = 0.5  # of |x|, a standard deviation from which x says nothing
_CUTS = (-180.0, -90.0, 0.0, -270.0)  # degrees
_NEAR_CUT = 40.0
_PER_OCTAVE = 4  # bins of the distance between model and measurement
_FLOOR = 0.1  # of the noise: the lowest distance shown


def strength(found: Sequence[Strength], quantity: str, unit_: str) -> Figure:
    """x(w) as magnitude and phase, each level with its 90 % band, and the law through it."""
    title = f"{quantity} [{unit_}]" if unit_ else quantity
    figure = stacked(2, [title, "phase [\u00b0]"], 500, weights=(0.6, 0.4))
    log_scale(figure["layout"]["yaxis"])
    turn = np.rad2deg(unwrapped(found[0].law))
    for k, s in enumerate(found):
        law = np.interp(np.log(s.frequency), np.log(found[0].frequency), turn)
        _dots(figure, s.frequency, s.x, s.sd, law, s.level, k)
    first = found[0]
    f = first.frequency
    line(figure, f, np.abs(first.law), "law of the named cause", "y", MODEL, hover="%{y:.4g}")
    line(figure, f, turn, "law of the named cause", "y2", MODEL, legend=False, hover=DEGREES)
    _fit(figure, [(s.x, s.sd) for s in found], np.abs(first.law), [s.frequency for s in found])
    return figure


def free(frequency: Float, x: Complex, sd: Float, quantity: str, unit_: str) -> Figure:
    """x(w) of a place with no law: the part that is missing there, if it is there.

    The frequencies may come level after level.
    """
    order = np.argsort(frequency, kind="stable")
    frequency, x, sd = frequency[order], x[order], sd[order]
    figure = stacked(2, [f"{quantity} [{unit_}]", "phase [\u00b0]"], 500, weights=(0.6, 0.4))
    log_scale(figure["layout"]["yaxis"])
    angle = np.rad2deg(np.angle(x[sd < _KNOWN * np.abs(x)]))
    # The cut of the circle where fewer points are near it, so that they do not jump across.
    near = [np.sum(np.abs((angle - cut + 180) % 360 - 180) < _NEAR_CUT) for cut in _CUTS]
    middle = _CUTS[int(np.argmin(near))] + 180.0
    _dots(figure, frequency, x, sd, np.full(x.size, middle), "measured", 0)
    _fit(figure, [(x, sd)], np.empty(0), [frequency])
    return figure


def _dots(figure: Figure, f: Float, x: Complex, sd: Float, turn: Float, name: str, k: int) -> None:
    """Points of x with a band; only where x is known. turn : degrees near which its phase is."""
    size, known = np.abs(x), sd < _KNOWN * np.abs(x)
    with np.errstate(divide="ignore", invalid="ignore"):
        half = np.where(known, HALF * sd, np.nan)
        width = np.rad2deg(np.arcsin(np.minimum(half / size, 1.0)))
    angle = np.rad2deg(np.angle(x * np.exp(-1j * np.deg2rad(turn)))) + turn
    band(figure, f, np.maximum(size - half, 0.1 * size), size + half, "y", k)
    band(figure, f, angle - width, angle + width, "y2", k)
    f, size, angle = f[known], size[known], angle[known]
    for values, axis, legend, hover in (
        (size, "y", True, "%{y:.4g}"),
        (angle, "y2", False, DEGREES),
    ):
        figure["data"].append(
            {
                "type": "scatter",
                "mode": "markers",
                "name": name,
                "x": packed(f),
                "y": packed(values),
                "yaxis": axis,
                "marker": {"size": 5, "color": f"@level{k % N_COLOURS}"},
                "legendgroup": f"level{k}",
                "showlegend": legend,
                "hovertemplate": hover,
            }
        )


def _fit(
    figure: Figure,
    points: Sequence[tuple[Complex, Float]],
    law: Float,
    frequency: Sequence[Float],
) -> None:
    """Axes over the points that are known, and the law."""
    fit_phase(figure)
    f = np.concatenate(frequency)
    figure["layout"]["xaxis"] |= ticked(np.log10(f.min()), np.log10(f.max()))
    shown = [np.abs(x)[sd < _KNOWN * np.abs(x)] for x, sd in points]
    values = np.concatenate([*shown, law])
    values = np.log10(values[np.isfinite(values) & (values > 0)])
    if values.size:
        low, high = float(values.min()), float(values.max())
        room = 0.08 * (high - low) + 0.1
        if high - low < 0.5:  # a constant is to look like one
            low, high = (low + high) / 2 - 0.5, (low + high) / 2 + 0.5
        axis = ticked(low - room, high + room)
        axis["ticktext"] = [_power(t) for t in axis["tickvals"]]
        figure["layout"]["yaxis"] |= axis


def _power(value: float) -> str:
    """`5\u00b710<sup>-5</sup>` for what is small or large, as plotly sets it."""
    if 1e-3 <= value < 1e5:
        return f"{value:g}"
    mantissa, power = f"{value:e}".split("e")
    digits = f"{float(mantissa):g}"
    times = "" if digits == "1" else f"{digits}\u00b7"
    return f"{times}10<sup>{int(power)}</sup>"


def before_after(
    curves: Sequence[Curves], entry: Entry, before: ModelCurve, after: ModelCurve | None
) -> Figure:
    """Gain and phase with both models, and how far each is from the measurement in units of
    its noise."""
    responses = [c.response for c in curves]
    titles = [
        f"gain [{unit(*channels(responses[0], entry))}]",
        "phase [\u00b0]",
        "distance [noise]",
    ]
    figure = stacked(3, titles, 640, weights=(0.46, 0.27, 0.27))
    log_scale(figure["layout"]["yaxis"])
    log_scale(figure["layout"]["yaxis3"])
    anchor: Float | None = None
    for c in curves:
        gain_curve(figure, c, entry)
        anchor = phase_curve(figure, c, entry, anchor)
    models = [(before, BEFORE), *([(after, AFTER)] if after else [])]
    shown, distances = [np.empty(0)], [np.array([1.0])]
    for model, stroke in models:
        f = model.frequency
        H = model.at(f, *entry)
        name = model.name
        line(figure, f, np.abs(H), name, "y", stroke, hover="%{y:.4g}")
        assert anchor is not None
        angle = same_turn(f, np.rad2deg(unwrapped(H)), anchor)
        line(figure, f, angle, name, "y2", stroke, legend=False, hover=DEGREES)
        at, far = distance(responses, model, entry)
        line(figure, at, far, name, "y3", stroke, legend=False, hover="%{y:.2g}")
        shown.append(np.abs(H))
        distances.append(far)
    frame(figure, responses)
    fit_gain(figure, responses, entry, np.concatenate(shown))
    fit_phase(figure)
    high = float(np.log10(np.nanmax(np.concatenate(distances))))
    low = float(np.log10(np.nanmin(np.concatenate(distances))))
    figure["layout"]["yaxis3"] |= ticked(min(low, -0.3) - 0.1, max(high, 0.5) + 0.15)
    figure["layout"]["shapes"] = [level_line("y3", 1.0) | {"line": {"color": "@muted", "width": 1}}]
    return figure


def distance(
    responses: Sequence[FrequencyResponse], model: ModelCurve, entry: Entry
) -> tuple[Float, Float]:
    """Frequencies, and the root mean square of |model - measured| over its standard deviation in
    bins about them; 1 is what noise alone leaves."""
    fs, squares = [], []
    for r in showing(responses, entry):
        i, j = indices(r, entry)
        e = np.abs(model.at(r.frequency, *entry) - r.H[:, i, j]) ** 2
        variance = r.variance()[:, i, j]
        use = np.isfinite(e) & (variance > 0) & (r.frequency > 0)
        fs.append(r.frequency[use])
        squares.append(e[use] / variance[use])
    f, square = np.concatenate(fs), np.concatenate(squares)
    order = np.argsort(f)
    f, square = f[order], square[order]
    if not f.size:
        return np.empty(0), np.empty(0)
    first = np.flatnonzero(np.diff(np.floor(_PER_OCTAVE * np.log2(f)), prepend=-np.inf))
    count = np.diff(np.append(first, f.size))
    middle = np.exp(np.add.reduceat(np.log(f), first) / count)
    return middle, np.maximum(np.sqrt(np.add.reduceat(square, first) / count), _FLOOR)
