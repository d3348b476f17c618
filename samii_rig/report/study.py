"""A parameter study as a CSV file, as a picture and as a table for the terminal."""

from __future__ import annotations

import csv
from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter
from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from samii_rig.model.study import Study, Varied
from samii_rig.types import Float

SHOWN = 6  # modes in a picture, the lowest
NAMED = 6  # curves in the legend, about
LEAST = 1e-4  # % of change, under which a mode does not answer
FLAT = 0.01  # of a value: what moves by less is drawn flat


def write_csv(path: Path, found: Study) -> None:
    """One row a point: the parameters, f and zeta of every mode (empty outside the band), a note
    where the point is unstable or has no answer. Numbers have all their digits."""
    low, high = found.band
    columns = [c for n in found.number for c in (f"f_{n} [Hz]", f"zeta_{n} [1]")]
    pairs = np.stack([found.hz, found.ratio], axis=2).reshape(len(found.note), -1)
    with path.open("w", encoding="utf-8", newline="") as stream:
        stream.write(f"# modes of {' '.join(found.rig.split())} from {low:g} to {high:g} Hz\n")
        out = csv.writer(stream, lineterminator="\n")
        out.writerow([*(f"{v.name} [{v.unit}]" for v in found.varied), *columns, "note"])
        for point, row, note in zip(found.point, pairs, found.note, strict=True):
            values = ["" if np.isnan(x) else float(x) for x in row]
            out.writerow([*point.tolist(), *values, note])


def table(found: Study) -> RenderableType:
    """What was varied, through which range each mode moves, and how sensitive it is."""
    points = len(found.note)
    said = [f"{found.rig}: modes from {found.band[0]:g} to {found.band[1]:g} Hz, {points} points"]
    for v in found.varied:
        how = f"{v.values[0]:g} to {v.values[-1]:g} {v.unit}, {len(v.values)} values"
        said.append(f"{v.name}: {how} (rig file: {v.own:g})")
    parts: list[RenderableType] = [Text("\n".join(said))]
    for what, of in (("frequency, Hz", found.hz), ("damping ratio", found.ratio)):
        rows = Table(box=None, pad_edge=False, header_style="bold", padding=(0, 3, 0, 0))
        heads = [f"1 % {'more' if v.one_sign else 'of range'}\n{v.name}" for v in found.varied]
        for head in ("\nmode", f"\n{what:16}", *heads):
            rows.add_column(head, no_wrap=True)
        for number, y, slopes in zip(found.number, of.T, found.sensitivity(of), strict=True):
            there = int(np.isfinite(y).sum())
            mode = f"{number}" if there == points else f"{number} ({there} of {points} points)"
            rows.add_row(mode, _span(y), *map(_percent, slopes))
        parts += [Text(), rows]
    wrong = [i for i, note in enumerate(found.note) if note]
    if wrong:
        first = zip(found.varied, found.point[wrong[0]], strict=True)
        at = ", ".join(f"{v.name} = {x:g}" for v, x in first)
        line = f"\n{len(wrong)} of {points} points are unstable or have no answer; first {at}: "
        parts.append(Text(line + found.note[wrong[0]]))
    return Group(*parts)


def figure(found: Study) -> Figure:
    """Frequency and damping ratio of each mode over the first parameter, a curve for each value of
    the second, if there is one; the lowest `SHOWN` modes."""
    x, *second = found.varied
    curves = second[0].values if second else np.zeros(1)
    n = max(1, min(found.number.size, SHOWN))
    picture = Figure(figsize=(1.2 + 2.6 * max(n, 2), 4.8), layout="constrained")
    FigureCanvasAgg(picture)
    axes = picture.subplots(2, n, sharex=True, squeeze=False)
    colours = matplotlib.colormaps["viridis"](np.linspace(0.0, 0.85, len(curves)))
    every = -(-len(curves) // NAMED)
    for m, number in enumerate(found.number[:n]):
        for of, panel in ((found.hz, axes[0, m]), (found.ratio, axes[1, m])):
            for k, value in enumerate(curves):
                name = f"{value:.5g}" if second and k % every == 0 else None
                y = of[k :: len(curves), m]
                panel.plot(x.values, y, ".-", ms=3, lw=1.3, color=colours[k], label=name)
            _dress(panel, x, of[:, m])
        axes[0, m].set_title(f"mode {number}", fontsize=9)
        axes[1, m].set_xlabel(f"{x.name} [{x.unit}]", fontsize=9)
    axes[0, 0].set_ylabel("frequency [Hz]", fontsize=9)
    axes[1, 0].set_ylabel("damping ratio", fontsize=9)
    if second:
        title = f"{second[0].name}\n[{second[0].unit}]"
        lines = axes[0, 0].get_legend_handles_labels()
        picture.legend(*lines, title=title, loc="outside right upper", fontsize=8, frameon=False)
    what = "Modes" if found.number.size else "No mode in the band at any point"
    dashed = f"; dashed: the rig file's {x.own:g} {x.unit}" if _holds(x) else ""
    picture.suptitle(f"{what} of {found.rig}{dashed}", fontsize=10)
    return picture


def _dress(panel: Axes, x: Varied, y: Float) -> None:
    low, high = float(np.nanmin(y)), float(np.nanmax(y))
    room = max(0.06 * (high - low), FLAT * abs(high), 1e-4)
    panel.set_ylim(low - room, high + room)
    if _holds(x):
        panel.axvline(x.own, color="0.5", ls="--", lw=0.9)
    if x.log:
        panel.set_xscale("log")
        panel.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        panel.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        panel.xaxis.set_minor_formatter(NullFormatter())
    panel.grid(visible=True, color="0.9", lw=0.5)
    panel.tick_params(labelsize=8)
    panel.spines[["top", "right"]].set_visible(False)


def _holds(x: Varied) -> bool:
    return bool(x.values[0] <= x.own <= x.values[-1])


def _span(y: Float) -> str:
    low, high = (f"{x:.4g}" for x in (np.nanmin(y), np.nanmax(y)))
    return low if low == high else f"{low} to {high}"


def _percent(slope: float) -> str:
    if np.isnan(slope):
        return "-"
    return f"{slope:+.2g} %" if abs(slope) >= LEAST else "0 %"
