"""The figures of frequency responses on the page."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from samii_rig.report.canvas import (
    MODEL,
    Figure,
    band,
    level_line,
    line,
    log_scale,
    points,
    shade,
    stacked,
    ticked,
    unpacked,
)
from samii_rig.report.compare import BAND, Comparison, ModelCurve, telling
from samii_rig.report.entries import Entry, channels, has, indices
from samii_rig.report.modes import Modes
from samii_rig.signal.coherence import partial_coherence
from samii_rig.signal.statistics import magnitude_interval, phase, phase_half_width
from samii_rig.types import Channel, Float, FrequencyResponse, Int
from samii_rig.units import pretty

_PANEL_BINS = 280  # of log-frequency, two points each: the pixels of the panel
_NOISE_PART = 0.004  # of the lines may lie outside a gain axis
_LEAST_PHASE = 40.0  # degrees of phase shown, so that a constant looks like one
DEGREES = "%{y:.1f}\u00b0"
_LABELS = 4  # more would stand on each other


@dataclass(frozen=True, slots=True)
class Curves:
    """A response with the bands that are drawn around it, (n_freq, n_out, n_in) each."""

    response: FrequencyResponse
    low: Float
    high: Float
    angle: Float
    half: Float
    order: int = 0

    @classmethod
    def of(cls, response: FrequencyResponse, order: int = 0) -> Curves:
        """Bands of 90 % of gain and phase (degrees). order : among all levels, by which it has its
        colour in every figure."""
        gain = magnitude_interval(response, BAND)
        half = phase_half_width(response, BAND)
        return cls(response, gain.low, gain.high, phase(response), half, order)


def curves_of(responses: Sequence[FrequencyResponse]) -> list[Curves]:
    """Of every level."""
    return [Curves.of(r, k) for k, r in enumerate(responses)]


def showing_curves(curves: Sequence[Curves], entry: Entry) -> list[Curves]:
    """Those whose responses have an entry."""
    return [c for c in curves if has(c.response, entry)]


def _mode_labels(
    r: FrequencyResponse, entry: Entry, modes: Sequence[Modes]
) -> list[dict[str, Any]]:
    """The natural frequencies of the response's modes, written at its curve."""
    own = next((m for m in modes if m.response is r), None)
    found = sorted(own.found.modes, key=lambda m: -m.sigma)[:_LABELS] if own else []
    i, j = indices(r, entry)
    gain = np.abs(r.H[:, i, j])
    out = []
    for mode in found:
        k = int(np.argmin(np.abs(r.frequency - mode.frequency_hz.value)))
        if not (np.isfinite(gain[k]) and gain[k] > 0):
            continue
        out.append(
            {
                "x": float(np.log10(mode.frequency_hz.value)),
                "y": float(np.log10(gain[k])),
                "text": f"{mode.frequency_hz.value:.3g} Hz",
                "ax": 0,
                "ay": -26,
                "arrowcolor": "@muted",
                "arrowwidth": 1,
                "arrowhead": 0,
                "font": {"size": 12, "color": "@ink"},
            }
        )
    return out


def bode(
    curves: Sequence[Curves],
    entry: Entry,
    model: ModelCurve | None,
    comparisons: Sequence[Comparison] = (),
    modes: Sequence[Modes] = (),
) -> Figure:
    """Gain, phase and coherence of one entry of H, every level with its 90 % band; below them
    even and odd distortion where the excitation shows them. Where the model differs by more than
    noise is shaded, and the modes of the last response are named."""
    responses = [c.response for c in curves]
    y, u = channels(responses[0], entry)
    several = len(responses[0].inputs) > 1
    coherences = "coherence: multiple, partial" if several else "coherence"
    titles = [f"gain [{unit(y, u)}]", "phase [\u00b0]", coherences]
    if _shows_distortion(responses):
        titles.append("distortion [%]")
        figure = stacked(4, titles, 920, weights=(0.36, 0.25, 0.14, 0.25))
        _distortion(figure, responses, entry)
    else:
        figure = stacked(3, titles, 720, weights=(0.46, 0.32, 0.22))
    log_scale(figure["layout"]["yaxis"])
    figure["layout"]["yaxis3"] |= {"range": [0, 1.04], "dtick": 0.5}
    anchor: Float | None = None
    for c in curves:
        k, r, (i, j) = c.order, c.response, indices(c.response, entry)
        at = lines_of(r, i, j)
        f = r.frequency[at]
        gain_curve(figure, c, entry)
        anchor = phase_curve(figure, c, entry, anchor)
        coherence = r.coherence[at, i]
        line(figure, f, coherence, label(r), "y3", k, legend=False, hover="%{y:.3f}")
        if len(r.inputs) > 1:
            partial = partial_coherence(r)[at, i, j]
            points(figure, f, partial, f"partial, {label(r)}", "y3", k, full=False)
    curve = np.empty(0)
    if model is not None and anchor is not None:
        curve = model_gain(figure, responses, model, entry)
        f = common(responses, model)
        angle = same_turn(f, np.rad2deg(unwrapped(model.at(f, *entry))), anchor)
        name = f"model {model.name}"
        line(figure, f, angle, name, "y2", MODEL, legend=False, hover=DEGREES)
    frame(figure, responses)
    fit_gain(figure, responses, entry, curve)
    fit_phase(figure)
    worst = telling(comparisons).get(entry)
    if worst is not None:
        figure["layout"]["shapes"] = [shade(span) for span in worst.spans_hz]
    figure["layout"]["annotations"] = _mode_labels(responses[-1], entry, modes)
    return figure


def distortion_caption(responses: Sequence[FrequencyResponse]) -> str:
    """What the points of the lowest panel are, "" where there is none."""
    if not _shows_distortion(responses):
        return ""
    if any(r.even is not None or r.odd is not None for r in responses):
        said = "full points odd, hollow points even"
    else:
        said = "full points what is not linear, hollow points the noise of one repeat"
    return f"distortion: {said}, as part of the output; line: standard deviation of the gain"


def _shows_distortion(responses: Sequence[FrequencyResponse]) -> bool:
    return any(x is not None for r in responses for x in (r.even, r.odd, r.noise, r.distortion))


def _distortion(figure: Figure, responses: Sequence[FrequencyResponse], entry: Entry) -> None:
    """Even and odd distortion as parts of the output, and the response's own relative
    standard deviation, below which they say nothing."""
    log_scale(figure["layout"]["yaxis4"])
    shown: list[Float] = []
    for k, r in enumerate(responses):
        i, j = indices(r, entry)
        f, level_name = r.frequency, label(r)
        sigma = 100 * np.sqrt(r.variance()[:, i, j]) / np.abs(r.H[:, i, j])
        name = f"standard deviation, {level_name}"
        line(figure, f, sigma, name, "y4", k, legend=False, hover="%{y:.2g} %")
        shown.append(sigma)
        for name, level, full in (
            ("even", r.even, False),
            ("odd", r.odd, True),
            ("noise", r.noise, False),
            ("distortion", r.distortion, True),
        ):
            if level is not None:
                at = slice(None) if name in ("even", "odd") else lines_of(r, i, j)
                values = 100 * level[at, i]
                points(figure, f[at], values, f"{name}, {level_name}", "y4", k, full=full)
                shown.append(values)
    logs = np.concatenate([np.log10(x[np.isfinite(x) & (x > 0)]) for x in shown])
    if logs.size:
        low, high = np.quantile(logs, [_NOISE_PART, 1.0])
        figure["layout"]["yaxis4"] |= ticked(low - 0.1, high + 0.1)


def ratio(
    curves: Sequence[Curves],
    entry: Entry,
    model: ModelCurve,
) -> Figure:
    """Model over measurement: gain and phase, with the measurement's 90 % band around it."""
    responses = [c.response for c in curves]
    figure = stacked(2, ["model/measured", "phase [\u00b0]"], 520)
    log_scale(figure["layout"]["yaxis"])
    quotients: list[Float] = []
    for c in curves:
        k, r, (i, j) = c.order, c.response, indices(c.response, entry)
        at = lines_of(r, i, j)
        f = r.frequency[at]
        H = model.at(f, *entry)
        size = np.abs(H)
        low, high = c.low[at, i, j], c.high[at, i, j]
        with np.errstate(divide="ignore", invalid="ignore"):
            quotient = H / r.H[at, i, j]
            upper = np.where(low > 0, size / low, np.nan)
            band(figure, f, size / high, upper, "y", k)
        quotients.append(np.abs(quotient))
        line(figure, f, np.abs(quotient), label(r), "y", k, hover="\u00d7 %{y:.3f}")
        angle = np.rad2deg(np.angle(quotient))
        half = c.half[at, i, j]
        band_half = np.where(half < 180.0, half, np.nan)
        band(figure, f, angle - band_half, angle + band_half, "y2", k)
        line(figure, f, angle, label(r), "y2", k, legend=False, hover="%{y:.1f}\u00b0")
    frame(figure, responses)
    fit_phase(figure)
    shown = np.concatenate(quotients)
    shown = np.log10(shown[np.isfinite(shown) & (shown > 0)])
    if shown.size:
        low, high = np.quantile(shown, [_NOISE_PART, 1 - _NOISE_PART])
        figure["layout"]["yaxis"] |= ticked(min(low, 0.0) - 0.06, max(high, 0.0) + 0.06)
    figure["layout"]["shapes"] = [level_line(axis, at) for axis, at in (("y", 1.0), ("y2", 0.0))]
    return figure


def unit(output: Channel, input: Channel) -> str:
    """Unit of a response for a person: `(m/s\u00b2)/V`."""
    over, under = pretty(output.unit), pretty(input.unit)
    return f"({over})/{under}" if "/" in over else f"{over}/{under}"


def phase_curve(figure: Figure, c: Curves, entry: Entry, anchor: Float | None) -> Float:
    """Add the phase of a response with its band to the second panel, in the turns of
    `anchor`, (2, n) frequency and angle of the first; returns the anchor."""
    k, r, (i, j) = c.order, c.response, indices(c.response, entry)
    at = lines_of(r, i, j)
    f, angle = r.frequency[at], c.angle[at, i, j]
    if anchor is None:
        anchor = np.stack([f, angle])
    angle = same_turn(f, angle, anchor)
    half = c.half[at, i, j]
    known = half < 90.0  # beyond, the curve would be noise over whole turns
    width = np.where(known, half, np.nan)
    band(figure, f, angle - width, angle + width, "y2", k)
    shown = np.where(known, angle, np.nan)
    line(figure, f, shown, label(r), "y2", k, legend=False, hover=DEGREES)
    return anchor


def fit_phase(figure: Figure) -> None:
    """Phase axis, that of the second panel, over what is drawn there, with ticks that suit it."""
    drawn = [
        unpacked(trace["y"])
        for trace in figure["data"]
        if trace["yaxis"] == "y2" and trace.get("fill") is None
    ]
    values = np.concatenate([x[np.isfinite(x)] for x in drawn])
    if not values.size:
        return
    low, high = float(values.min()), float(values.max())
    if high - low < _LEAST_PHASE:
        low, high = (low + high - _LEAST_PHASE) / 2, (low + high + _LEAST_PHASE) / 2
    room = 0.08 * (high - low)
    step = next((d for d in (10, 30, 45) if (high - low) / d <= 6), 90)
    figure["layout"]["yaxis2"] |= {"dtick": step, "range": [low - room, high + room]}


def frame(figure: Figure, responses: Sequence[FrequencyResponse]) -> None:
    """Frequency axis over the measured band, ticks at 1, 2, 5 until the reader zooms."""
    low = min(float(r.frequency[r.frequency > 0][0]) for r in responses)
    high = max(float(r.frequency[-1]) for r in responses)
    figure["layout"]["xaxis"] |= ticked(np.log10(low), np.log10(high))


def fit_gain(
    figure: Figure, responses: Sequence[FrequencyResponse], entry: Entry, model: Float
) -> None:
    """Gain axis over the curves; a few lines that are all noise do not stretch it."""
    parts = [np.abs(r.H[:, *indices(r, entry)]) for r in responses] + [model]
    logs = [np.log10(p[np.isfinite(p) & (p > 0)]) for p in parts]
    logs = [p for p in logs if p.size]
    if not logs:
        return
    low = min(float(np.quantile(p, _NOISE_PART)) for p in logs)
    high = max(float(p.max()) for p in logs)
    room = 0.06 * (high - low) + 0.05
    # The names of the modes need room above them.
    figure["layout"]["yaxis"] |= ticked(low - room, high + 4 * room)


def gain_curve(figure: Figure, c: Curves, entry: Entry) -> None:
    """Add the gain of a response with its band to the first panel."""
    k, r, (i, j) = c.order, c.response, indices(c.response, entry)
    at = lines_of(r, i, j)
    f = r.frequency[at]
    low, high = c.low[at, i, j], c.high[at, i, j]
    gain = np.abs(r.H[at, i, j])
    # On a logarithmic axis zero is nowhere; a tenth of the estimate is "may be nothing".
    band(figure, f, np.maximum(low, 0.1 * gain), high, "y", k)
    line(figure, f, gain, label(r), "y", k, hover="%{y:.4g}")


def model_gain(
    figure: Figure,
    responses: Sequence[FrequencyResponse],
    model: ModelCurve,
    entry: Entry,
) -> Float:
    """Add a model's gain to the first panel; returns it."""
    f = common(responses, model)
    gain = np.abs(model.at(f, *entry))
    line(figure, f, gain, f"model {model.name}", "y", MODEL, hover="%{y:.4g}")
    return gain


def label(r: FrequencyResponse) -> str:
    """A response by its level."""
    return f"{r.level:g} {r.level_unit}" if np.isfinite(r.level) else "measured"


def lines_of(r: FrequencyResponse, i: int, j: int, bins_: int = _PANEL_BINS) -> Int:
    """Indices of the lines to draw: all, or the extremes in each of `bins_` of log-frequency."""
    f, gain = r.frequency, np.abs(r.H[:, i, j])
    usable = np.flatnonzero((f > 0) & np.isfinite(gain))
    if len(usable) <= 2 * bins_:
        return usable
    x = np.log(f[usable])
    bins = np.minimum(((x - x[0]) / (x[-1] - x[0]) * bins_).astype(np.int64), bins_ - 1)
    order = np.lexsort((gain[usable], bins))
    ends = np.flatnonzero(np.diff(bins[order], prepend=-1, append=bins_))
    chosen = np.concatenate([order[ends[:-1]], order[ends[1:] - 1]])
    return np.unique(usable[chosen])


def common(responses: Sequence[FrequencyResponse], model: ModelCurve) -> Float:
    """The model's own lines within the band that was measured."""
    low = min(r.frequency[r.frequency > 0][0] for r in responses)
    high = max(r.frequency[-1] for r in responses)
    f = model.frequency
    return np.asarray(f[(f >= low) & (f <= high)])


def unwrapped(H: Any) -> Float:
    """Phase without jumps, rad."""
    return np.unwrap(np.angle(np.where(np.isfinite(H), H, 1.0)))


def same_turn(f: Float, angle: Float, anchor: Float) -> Float:
    """`angle` moved by whole turns to lie next to the first curve."""
    if not len(f):
        return angle
    difference = np.interp(f, anchor[0], anchor[1]) - angle
    return np.asarray(angle + 360.0 * np.round(np.nanmedian(difference) / 360.0))
