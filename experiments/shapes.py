"""Mode shapes by position along a chain: from runs to values with intervals, table, figure."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from scipy import special

from samii_rig.errors import EstimateError
from samii_rig.identify.modal import Modes
from samii_rig.modal.modes import Value
from samii_rig.model.shapes import ModeShape, mode_shape
from samii_rig.rig.schema import Acceleration, Rig
from samii_rig.types import Float

if TYPE_CHECKING:
    from matplotlib.axes import Axes

NEAR = 0.2  # how far from where it is looked for a mode may lie, relative
LEVEL = 0.9  # probability of the intervals
COLUMNS = (
    *("mode", "frequency [Hz]", "sensor", "on", "position [m]", "x [m]"),
    *("shape", "sd", "low 90 %", "high 90 %", "model"),
)


@dataclass(frozen=True, slots=True)
class ShapePoint:
    """The mode shape at one accelerometer over that at the reference.

    x : m from the base along the chain. value : measured. model : the rig file's.
    """

    mode: int
    sensor: str
    on: str
    position: float
    x: float
    value: Value
    model: float


@dataclass(frozen=True, slots=True)
class ScanShapes:
    """All points of all modes, by x, and the modes' frequencies (one value a run, combined).

    curves : of each mode x in m and the rig file's shape, scaled to 1 at the reference.
    """

    points: tuple[ShapePoint, ...]
    frequencies: tuple[Value, ...]
    curves: tuple[tuple[Float, Float], ...]


def scan_shapes(
    rigs: Sequence[Rig],
    found: Sequence[Modes],
    modes_hz: Sequence[float],
    roving: str,
    reference: str,
) -> ScanShapes:
    """Shapes from the modes of each run, each with the roving sensor at another place.

    Each run gives phi(sensor)/phi(reference) by itself; the fixed sensors' values of all runs
    are combined by their weights. EstimateError if a run shows no mode within 20 % of where
    one is looked for.
    """
    points, frequencies, curves = [], [], []
    for m, hz in enumerate(modes_hz):
        at = [_nearest(modes, hz, k + 1) for k, modes in enumerate(found)]
        frequency = _combined([f.modes[i].frequency_hz for f, i in zip(found, at, strict=True)])
        frequencies.append(frequency)
        poles = [f.modes[i].pole for f, i in zip(found, at, strict=True)]
        shapes = [mode_shape(rig, complex(p)) for rig, p in zip(rigs, poles, strict=True)]
        # An accelerometer reads s^2 w.
        at_reference = shapes[0].readings[reference] / shapes[0].s ** 2
        curves.append((shapes[0].x, (shapes[0].w / at_reference).real))
        values: dict[str, list[Value]] = {}
        for k, (modes, i) in enumerate(zip(found, at, strict=True)):
            for name in modes.outputs:
                sensor = next(s for s in rigs[k].sensor if s.name == name)
                if name == reference or not isinstance(sensor, Acceleration):
                    continue
                value = modes.shape_ratio(i, name, reference)
                if name != roving:
                    values.setdefault(name, []).append(value)
                    continue
                points.append(_point(m, rigs[k], sensor, value, _model(shapes[k], name, reference)))
        for name, several in values.items():
            sensor = next(s for s in rigs[0].sensor if s.name == name)
            model = _model(shapes[0], name, reference)
            points.append(_point(m, rigs[0], sensor, _combined(several), model))
        sensor = next(s for s in rigs[0].sensor if s.name == reference)
        points.append(_point(m, rigs[0], sensor, Value(1.0, 0.0), 1.0))
    points.sort(key=lambda p: (p.mode, p.x))
    return ScanShapes(tuple(points), tuple(frequencies), tuple(curves))


def _nearest(modes: Modes, hz: float, run: int) -> int:
    away = [abs(m.frequency_hz.value / hz - 1) for m in modes.modes]
    if not away or min(away) > NEAR:
        seen = ", ".join(f"{m.frequency_hz.value:.4g}" for m in modes.modes) or "none"
        raise EstimateError(f"run {run}: no mode within 20 % of {hz:g} Hz; found {seen}")
    return int(np.argmin(away))


def _combined(values: Sequence[Value]) -> Value:
    weight = np.array([1 / max(v.sd, 1e-300) ** 2 for v in values])
    mean = float(np.sum(weight * [v.value for v in values]) / weight.sum())
    return Value(mean, float(weight.sum() ** -0.5))


def _model(shape: ModeShape, top: str, bottom: str) -> float:
    """As `Modes.shape_ratio`: the real part, also where damping makes the shape complex."""
    return float((shape.readings[top] / shape.readings[bottom]).real)


def _point(m: int, rig: Rig, sensor: object, value: Value, model: float) -> ShapePoint:
    assert isinstance(sensor, Acceleration)
    x = 0.0
    for e in rig.element:
        if e.name == sensor.on:
            break
        x += e.L.value if hasattr(e, "L") else 0.0
    x += sensor.position
    return ShapePoint(m, sensor.name, sensor.on, sensor.position, x, value, model)


def write_table(path: Path, shapes: ScanShapes) -> Path:
    """A CSV file of all points, replaced if it exists."""
    half = float(special.ndtri((1 + LEVEL) / 2))
    with path.open("w", newline="", encoding="utf-8") as file:
        out = csv.writer(file)
        out.writerow(COLUMNS)
        for p in shapes.points:
            f = shapes.frequencies[p.mode].value
            v = p.value
            numbers = (p.x, v.value, v.sd, v.value - half * v.sd, v.value + half * v.sd, p.model)
            out.writerow(
                [p.mode + 1, f"{f:.6g}", p.sensor, p.on, f"{p.position:g}"]
                + [f"{x:.6g}" for x in numbers]
            )
    return path


def draw(path: Path, shapes: ScanShapes, joints: Sequence[tuple[str, float]]) -> Path:
    """A figure of all modes, measured over the rig file's model; joints as (name, x)."""
    from matplotlib.figure import Figure

    n = len(shapes.frequencies)
    figure = Figure(figsize=(4.2 * n, 4.0), layout="constrained")
    axes = figure.subplots(1, n, squeeze=False)[0]
    for m, ax in enumerate(axes):
        _draw_mode(ax, shapes, m, joints)
    figure.savefig(path, metadata={"Date": None} if path.suffix == ".svg" else None)
    return path


def _draw_mode(ax: Axes, shapes: ScanShapes, m: int, joints: Sequence[tuple[str, float]]) -> None:
    half = float(special.ndtri((1 + LEVEL) / 2))
    ax.plot(*shapes.curves[m], color="0.45", lw=1.3, label="model")
    inside = [p for p in shapes.points if p.mode == m]
    ax.errorbar(
        [p.x for p in inside],
        [p.value.value for p in inside],
        [half * p.value.sd for p in inside],
        fmt="o",
        ms=4,
        color="#b03030",
        capsize=3,
        label="measured, 90 %",
    )
    for i, (name, x) in enumerate(joints):
        ax.axvline(x, color="0.85", lw=0.8, zorder=0)
        ax.text(x, 1.01 + 0.045 * (i % 2), name, fontsize=6, ha="center",
                transform=ax.get_xaxis_transform())  # fmt: skip
    ax.axhline(0, color="0.8", lw=0.8, zorder=0)
    ax.set_xlabel("along the chain, m")
    ax.set_ylabel("shape over that at the reference")
    ax.set_title(f"mode {m + 1}, {shapes.frequencies[m].value:.3f} Hz", pad=18, fontsize=10)
    ax.legend(frameon=False, fontsize=8)
