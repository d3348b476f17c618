"""What an identification found, as a table for the terminal."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from samii_rig.identify.from_modes import FromModes
from samii_rig.identify.methods import Found
from samii_rig.identify.modal import Modes
from samii_rig.identify.result import Identification, Residual
from samii_rig.modal.modes import Value
from samii_rig.units import pretty


def summary_table(found: Identification) -> RenderableType:
    """The verdict in words, parameters with 90 % intervals, what is left per channel."""
    return Group(*_said(found, found.sentences()), _channels(found))


def from_modes_table(found: FromModes) -> RenderableType:
    """The same of modes: what is left mode by mode."""
    table = Table(box=None, pad_edge=False, header_style="bold", padding=(0, 2, 0, 0))
    columns = ("level", "mode, Hz", "model", "damping, %", "model", "left, in units of the noise")
    for column in columns:
        table.add_column(column)
    for m in found.modes:
        hz = f"{m.frequency_hz:.5g}", f"{m.model_hz:.5g}"
        damping = f"{100 * m.damping:.3g}", f"{100 * m.model_damping:.3g}"
        table.add_row(m.level, *hz, *damping, f"{m.ratio**0.5:.2f}")
    lost = [Text(f"Not in the model, and left out: {words}.") for words in found.without]
    return Group(*lost, *_said(found.found, found.sentences()), table)


def _said(found: Identification, sentences: Sequence[str]) -> list[RenderableType]:
    """The verdict in words, and the parameters."""
    table = Table(box=None, pad_edge=False, header_style="bold", padding=(0, 2, 0, 0))
    table.add_column("parameter", no_wrap=True)
    for column in ("identified", "90 % interval", "change"):
        table.add_column(column, justify="right", no_wrap=True)
    table.add_column("unit")
    low, high = found.interval()
    for i, name in enumerate(found.names):
        half = (high[i] - low[i]) / 2 / found.values[i]
        table.add_row(
            name,
            f"{found.values[i]:.5g}",
            pretty(found.limit(i)) or f"\u00b1 {100 * half:.2g} %",
            f"{100 * (found.values[i] / found.start[i] - 1):+.1f} %",
            pretty(found.units[i]),
        )
    said = (Text(line) for line in sentences)
    return [*said, Text(""), table, Text("")]


def _channels(found: Identification) -> Table:
    table = Table(box=None, pad_edge=False, header_style="bold", padding=(0, 2, 0, 0))
    for column in ("what is left of", "level", "in units of the noise (1: noise alone)"):
        table.add_column(column)
    rows: dict[tuple[str, str], list[Residual]] = {}
    for r in found.residuals:
        key = f"{r.output}/{r.input}", f"{r.level:g} {r.level_unit}"
        rows.setdefault(key, []).append(r)
    for (channel, level), parts in rows.items():
        worst = max(parts, key=lambda r: r.ratio)
        table.add_row(
            channel,
            level,
            f"{np.mean([r.ratio for r in parts]) ** 0.5:.2f}, at most {worst.ratio**0.5:.2f} "
            f"at {worst.low_hz:.2g} to {worst.high_hz:.2g} Hz",
        )
    return table


def method_table(found: Found) -> RenderableType:
    """What method 1 or 2 measured, what the model has instead, and the parameters."""
    numbers = Table(box=None, pad_edge=False, header_style="bold", padding=(0, 2, 0, 0))
    for column in ("number", "measured", "model"):
        numbers.add_column(column)
    for (name, value), model in zip(found.numbers.items(), found.match.model, strict=True):
        numbers.add_row(name, _value(value), f"{model:.5g}")
    table = Table(box=None, pad_edge=False, header_style="bold", padding=(0, 2, 0, 0))
    for column in ("parameter", "identified", "change"):
        table.add_column(column)
    m = found.match
    for name, value, start in zip(m.names, m.values, found.start, strict=True):
        table.add_row(name, f"{value:.5g}", f"{100 * (value / start - 1):+.1f} %")
    if found.gain:
        for name, value in zip(found.gain.names, found.gain.values, strict=True):
            table.add_row(f"{name} (from the amplitude)", f"{value:.5g}", "")
    said = Text(
        f"Method {found.method} of paper 1 at {found.level:g} {found.level_unit}, "
        f"e = {m.error:.2g}. It gives no intervals; without --method maximum likelihood does."
    )
    return Group(said, Text(""), numbers, Text(""), table)


def modes_table(modes: Modes) -> RenderableType:
    """Frequencies, damping and shapes of modes, and zeros, with 90 % intervals."""
    table = Table(title="Modes, with half the width of the 90 % interval")
    for column in ("mode", "frequency, Hz", "damping, %"):
        table.add_column(column, justify="right")
    for name in modes.outputs:
        table.add_column(f"shape at {name}", justify="right")
    for i, mode in enumerate(modes.modes, 1):
        shape = [
            f"{z.real:.4g} {z.imag:+.2g}j" if k != mode.reference else "1"
            for k, z in enumerate(mode.shape)
        ]
        table.add_row(str(i), _value(mode.frequency_hz), _value(mode.damping, 100), *shape)
    zeros = Table(title="Zeros")
    for column in ("output", "frequency, Hz", "damping, %"):
        zeros.add_column(column, justify="right")
    for zero in modes.zeros:
        zeros.add_row(zero.output, _value(zero.frequency_hz), _value(zero.damping, 100))
    return Group(table, zeros)


def _value(x: Value, scale: float = 1.0) -> str:
    half = scale * (x.interval()[1] - x.value)
    return f"{scale * x.value:.5g} \u00b1 {half:.2g}"
