"""Figures of what was recorded: the time series of each segment and one spectrogram."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.signal import ShortTimeFFT, get_window

from samii_rig.report.canvas import Figure, axis, base_layout, packed
from samii_rig.report.decimate import thin
from samii_rig.types import Float, Recording
from samii_rig.units import pretty

_POINTS = 50_000  # of all time series of a page, 5 bytes each
_PIXELS = 1200  # of one curve at most, and
_FEWEST = 100  # at least, however many segments there are
_WINDOWS_PER_SERIES = 240  # time resolution of the spectrogram
_DEPTH_DB = 80.0  # below the loudest spot; less than that is noise of the converter
_ROW = 118  # px
_NO_LEGEND = 34  # px above a figure that needs room for its buttons only


@dataclass(frozen=True, slots=True)
class Piece:
    """One segment of one recording, cut out."""

    name: str
    recording: Recording


def pieces(recordings: Sequence[Recording]) -> list[Piece]:
    """All segments in order; a recording without any is one piece."""
    out = []
    for r in recordings:
        for s in r.segments:
            label = f"{s.name} \u2013 {s.level:g} {s.unit}, repeat {s.repeat + 1}"
            out.append(Piece(label, r.cut(s)))
        if not r.segments:
            out.append(Piece(r.source or "recording", r))
    return [p for p in out if len(p.recording)]


def time_series(parts: Sequence[Piece]) -> Figure:
    """Every channel of every segment, decimated; `sets` holds one list of traces a segment."""
    channels = max((p.recording.channels for p in parts), key=len)
    rows = len(channels)
    layout = base_layout(_ROW * rows + 90) | {"showlegend": False}
    layout["margin"] |= {"t": _NO_LEGEND}
    gap = 0.03
    size = (1 - gap * (rows - 1)) / rows
    for row, channel in enumerate(channels):
        number = "" if row == 0 else str(row + 1)
        top = 1 - row * (size + gap)
        layout[f"yaxis{number}"] = axis(f"{channel.name}<br>[{pretty(channel.unit)}]") | {
            "domain": [max(top - size, 0.0), top],
            "anchor": "x",
            "nticks": 4,
        }
    layout["xaxis"] = axis("time [s]") | {"anchor": "y" if rows == 1 else f"y{rows}"}
    curves = sum(len(p.recording.channels) for p in parts)
    pixels = int(np.clip(_POINTS / 2 / curves, _FEWEST, _PIXELS))
    return {
        "layout": layout,
        "sets": [
            {"name": p.name, "data": _traces(p.recording, pixels), **_taken(p.recording)}
            for p in parts
        ],
    }


def _taken(r: Recording) -> dict[str, float]:
    """When the samples were taken. stamp : ms since 1970 in UTC of the first, 0 where nobody
    knows. lasts : s."""
    stamp = round(r.wall_time[0] * 1e-6, 3) if r.clock_offset else 0
    return {"stamp": stamp, "lasts": float(r.time[-1] - r.time[0]) * 1e-9}


def _traces(r: Recording, pixels: int) -> list[dict[str, Any]]:
    time = (r.time - r.time[0]) * 1e-9
    gaps = np.flatnonzero(np.diff(r.sequence) > 1)
    traces: list[dict[str, Any]] = []
    colours = {
        "reference": "@level3",
        "command": "@level1",
        "sensor": "@level0",
        "monitor": "@level2",
    }
    for row, channel in enumerate(r.channels):
        x, y = thin(time, r.values[:, row], pixels)
        place = "y" if row == 0 else f"y{row + 1}"
        traces.append(
            {
                "type": "scatter",
                "mode": "lines",
                "name": channel.name,
                "x": packed(x),
                "y": packed(y),
                "yaxis": place,
                "line": {"width": 1, "color": colours[channel.role]},
                "hovertemplate": f"%{{y:.4g}} {pretty(channel.unit)}",
            }
        )
        if gaps.size:
            traces.append(
                {
                    "type": "scatter",
                    "mode": "markers",
                    "name": "samples missing",
                    "x": packed(time[gaps]),
                    "y": packed(r.values[gaps, row]),
                    "yaxis": place,
                    "marker": {"symbol": "x", "size": 7, "color": "@bad"},
                    "hovertemplate": "samples missing after this",
                }
            )
    return traces


def spectrogram(piece: Piece, channel: str) -> Figure:
    """Power of one channel over time and frequency, dB below its loudest spot.

    A window that holds a missing sample is left blank.
    """
    r = piece.recording
    column = r.column(channel)
    n = int(r.sequence[-1] - r.sequence[0]) + 1
    values = np.full(n, np.nan)
    values[r.sequence - r.sequence[0]] = r.values[:, column]
    values -= np.nanmean(values)
    length = max(16, min(2 ** round(np.log2(np.sqrt(n * 8))), n))
    window = get_window("hann", length)
    hop = max(1, n // _WINDOWS_PER_SERIES)
    transform = ShortTimeFFT(window, hop, r.rate_hz, scale_to="psd")
    first, last = transform.lower_border_end[1], transform.upper_border_begin(n)[1]
    last = max(last, first + 1)
    power = np.abs(transform.stft(values, p0=first, p1=last)) ** 2
    time = transform.t(n, p0=first, p1=last)
    level = 10 * np.log10(power / max(float(np.nanmax(power, initial=0.0)), 1e-300) + 1e-30)
    shown = transform.f > 0
    layout = base_layout(360) | {"hovermode": "closest"}
    layout["margin"] |= {"t": _NO_LEGEND}
    layout["xaxis"] = axis("time [s]")
    layout["yaxis"] = axis("frequency [Hz]") | {"range": [0.0, _top(transform.f, level)]}
    return {
        "data": [
            {
                "type": "heatmap",
                "x": packed(time),
                "y": packed(transform.f[shown]),
                "z": packed(_floored(level[shown])),
                "zmin": -_DEPTH_DB,
                "zmax": 0.0,
                "colorscale": "Viridis",
                "colorbar": {"title": {"text": "dB", "side": "right"}, "thickness": 12},
                "hovertemplate": "%{x:.2f} s, %{y:.1f} Hz: %{z:.0f} dB<extra></extra>",
            }
        ],
        "layout": layout,
    }


def _floored(level: Float) -> Float:
    return np.maximum(level, -_DEPTH_DB - 20.0)


def _top(f: Float, level: Float) -> float:
    """Frequency to which the picture opens: where anything is louder than -40 dB."""
    with np.errstate(invalid="ignore"):
        loud = f[np.nanmax(np.where(np.isnan(level), -np.inf, level), axis=1) > -40.0]
    return float(min(f[-1], 1.3 * loud[-1])) if loud.size else float(f[-1])
