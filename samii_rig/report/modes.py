"""Modes as tables: for the page, the terminal and machines, beside the rig's model or another
recording."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from samii_rig.errors import EstimateError, InputError
from samii_rig.modal.match import Known, Pair, known_of, model_modes, pairs
from samii_rig.modal.modes import LEVEL, ModalModel, Mode, Value, find_modes
from samii_rig.progress import Progress, counted
from samii_rig.report.facts import names
from samii_rig.rig.schema import Rig
from samii_rig.types import FrequencyResponse

_NONE = "\u2013"
_DIGITS = 5  # of a value at most: finer differences are those of two days
# Difference of two measured values, in standard deviations, that chance makes once in a thousand.
_DIFFERENT = 3.3


@dataclass(frozen=True, slots=True)
class Modes:
    """The modes of one response, and what they are held against.

    name : of the response, which tells it from the others: `0.5 V`.
    known : of the rig's model, `paired` with them. other : of another recording, `matched`.
    """

    found: ModalModel
    response: FrequencyResponse
    name: str
    known: tuple[Known, ...] = ()
    paired: tuple[Pair, ...] = ()
    other: ModalModel | None = None
    matched: tuple[Pair, ...] = ()

    def of_model(self, mode: int) -> tuple[Known, Pair] | None:
        """The model's mode that belongs to a measured one."""
        return next(((self.known[p.other], p) for p in self.paired if p.mode == mode), None)

    def of_other(self, mode: int) -> tuple[Mode, Pair] | None:
        """The other recording's mode that belongs to one of these."""
        if self.other is None:
            return None
        return next(((self.other.modes[p.other], p) for p in self.matched if p.mode == mode), None)

    def plain(self) -> dict[str, Any]:
        """The modes, with what they are held against, as plain data."""
        data = self.found.plain()
        for i, row in enumerate(data["modes"]):
            model, other = self.of_model(i), self.of_other(i)
            row["model"] = _known_plain(*model) if model else None
            if self.other is not None:
                row["against"] = _other_plain(self.found.modes[i], *other) if other else None
        return data


def modes_of(
    responses: Sequence[FrequencyResponse],
    rig: Rig | None,
    *,
    band: tuple[float, float] | None = None,
    outputs: Sequence[str] | None = None,
    pick: Sequence[float] = (),
    against: Sequence[FrequencyResponse] = (),
    progress: Progress = lambda _stage: None,
) -> tuple[tuple[Modes, ...], tuple[str, ...]]:
    """Modes of each response, and why others have none.

    against : responses of another recording; each level is held against its like, or the
        last one where there is none. progress : is told which response is looked at.
    Raises what `find_modes` raises for a band, an output or a pick that there is not.
    """
    out, lost = [], []
    known: tuple[Known, ...] = ()
    if rig is not None and responses:
        top = max(float(r.frequency[-1]) for r in responses)
        known = model_modes(rig, min(top, band[1]) if band else top)
    others = [
        find_modes(r, rig, band=band, outputs=outputs)
        for r in counted(against, progress, "poles and shapes of the other")
    ]
    every = list(zip(responses, names(responses), strict=True))
    for r, name in counted(every, progress, "poles and shapes", lambda one: one[1]):
        try:
            found = find_modes(r, rig, band=band, outputs=outputs, pick=pick)
        except EstimateError as error:
            lost.append(f"{name}: {error}")
            continue
        like = [o for o in others if (o.level, o.level_unit) == (r.level, r.level_unit)]
        other = (like or others)[-1] if others else None
        matched = pairs(found, known_of(other)) if other else ()
        out.append(Modes(found, r, name, known, pairs(found, known), other, matched))
    return tuple(out), tuple(lost)


def modes_of_all(responses: Sequence[FrequencyResponse], rig: Rig | None) -> tuple[Modes, ...]:
    """`modes_of` for a page that has other things to say: a response without modes has none."""
    out: list[Modes] = []
    for r, name in zip(responses, names(responses), strict=True):
        try:
            out += [replace(m, name=name) for m in modes_of([r], rig)[0]]
        except InputError:  # no line below half the sample rate: `modes_of` says so when asked
            continue
    return tuple(out)


def sentences(all_modes: Sequence[Modes], lost: Sequence[str] = ()) -> list[str]:
    """What has to be said of the tables: what the poles are, what fits, what is not resolved."""
    said: list[str] = []
    for of in dict.fromkeys(m.found.of for m in all_modes):
        said.append(f"{of[0].upper()}{of[1:]}.")
    if any(m.found.closed_loop and m.known for m in all_modes):
        said.append("The model's modes beside them are those of the chain without the loop.")
    for m in all_modes:
        f = m.found
        if not f.fit.holds:
            said.append(
                f"{m.name}: the modal model leaves {math.sqrt(f.fit.ratio):.3g} times the noise "
                f"(p = {f.fit.p_value:.1g}); intervals are wider by {f.inflation:.3g}."
            )
        if f.unresolved:
            places = ", ".join(f"{hz:.3g}" for hz in f.unresolved)
            said.append(
                f"{m.name}: the stepped sine's grid steps over what resonates near {places} Hz; "
                "a sweep or a finer grid would show it as a mode."
            )
        if not f.modes and not f.unresolved:
            said.append(f"{m.name}: no mode stands above the noise.")
    return said + [f"{line[0].upper()}{line[1:]}." for line in lost]


def rows(all_modes: Sequence[Modes]) -> list[dict[str, str]]:
    """One row a mode for the page, level by level."""
    out = []
    for m in all_modes:
        for i, mode in enumerate(m.found.modes):
            model, other = m.of_model(i), m.of_other(i)
            out.append(
                {
                    "level": m.name,
                    "number": str(i + 1),
                    "frequency": f"{pm(mode.frequency_hz)} Hz",
                    "damping": f"{pm(mode.damping, 100)} %",
                    "sigma": f"{mode.sigma:.3g}",
                    "model": _model_cell(model),
                    "mac": _mac(model[1]) if model else _NONE,
                    "other": _other_cell(mode, other) if m.other else "",
                }
            )
    return out


def best_known(all_modes: Sequence[Modes]) -> Modes | None:
    """The level with the most modes, and of these the one that knows them best: its shapes are
    shown, those of all are in the JSON."""
    shown = [m for m in all_modes if m.found.modes]
    return max(
        shown,
        key=lambda m: (len(m.found.modes), max(x.sigma for x in m.found.modes)),
        default=None,
    )


def modes_table(all_modes: Sequence[Modes], lost: Sequence[str] = ()) -> RenderableType:
    """Modes with half the width of their 90 % intervals, for the terminal."""
    parts: list[RenderableType] = [Text(line) for line in sentences(all_modes, lost)]
    shown = [m for m in all_modes if m.found.modes]
    if shown:
        parts.append(Text(f"Values with half the width of their {100 * LEVEL:.0f} % intervals."))
        parts += [Text(""), _frequencies(shown)]
        best = best_known(shown)
        parts += [Text(""), _shapes(best)] if best else []
    return Group(*parts)


def _frequencies(all_modes: Sequence[Modes]) -> Table:
    table = _table(["level", "mode", "frequency, Hz", "damping, %"])
    model = any(m.known for m in all_modes)
    other = any(m.other for m in all_modes)
    for name in (["model, Hz; %", "MAC"] if model else []) + (["against"] if other else []):
        table.add_column(name, overflow="fold")
    for m in all_modes:
        for i, mode in enumerate(m.found.modes):
            row = [
                m.name if i == 0 else "",
                str(i + 1),
                pm(mode.frequency_hz),
                pm(mode.damping, 100),
            ]
            held = m.of_model(i)
            row += [_model_cell(held), _mac(held[1]) if held else _NONE] if model else []
            row += [_other_cell(mode, m.of_other(i))] if other else []
            table.add_row(*map(Text, row))
    return table


def _shapes(m: Modes) -> RenderableType:
    """Shapes of one level, an output a row, a mode a column."""
    found = m.found
    table = _table([f"shape at {m.name}", *(f"mode {i + 1}" for i in range(len(found.modes)))])
    halves = [mode.shape_interval() for mode in found.modes]
    for k, (name, unit) in enumerate(zip(found.outputs, found.units, strict=True)):
        cells = []
        for mode, (real, imag) in zip(found.modes, halves, strict=True):
            x = complex(mode.shape[k])
            turned = f", {x.imag:+.2g}j" if abs(x.imag) > imag[k] else ""
            cells.append("1" if k == mode.reference else f"{_number(x.real, real[k])}{turned}")
        table.add_row(*map(Text, (f"{name}, {unit}", *cells)))
    return table


def _table(columns: Sequence[str]) -> Table:
    table = Table(box=None, pad_edge=False, header_style="bold", padding=(0, 2, 0, 0))
    for name in columns:
        table.add_column(name, overflow="fold")
    return table


def pm(x: Value, scale: float = 1.0) -> str:
    """`1.7013 ± 0.0002`: as many digits as the interval knows."""
    return _number(scale * x.value, scale * x.half())


def _number(value: float, half: float) -> str:
    """A value and half its interval: two digits of that, and of the value five at most."""
    if not (math.isfinite(half) and half > 0 and value != 0):
        return f"{value:.4g}"
    finest = math.floor(math.log10(abs(value))) - _DIGITS + 1
    place = max(finest, math.floor(math.log10(half)) - 1)
    if place < -6:
        return f"{value:.3g} \u00b1 {half:.1g}"
    # Never narrower than it is.
    half = math.ceil(half / 10.0**place - 1e-9) * 10.0**place
    return f"{value:.{max(0, -place)}f} \u00b1 {half:.{max(0, -place)}f}"


def _model_cell(held: tuple[Known, Pair] | None) -> str:
    if held is None:
        return _NONE
    return f"{held[0].frequency_hz:.4g}; {100 * held[0].damping:.3g}"


def _mac(pair: Pair) -> str:
    return f"{pair.mac:.4f}" if math.isfinite(pair.mac) else _NONE


def _other_cell(mode: Mode, held: tuple[Mode, Pair] | None) -> str:
    if held is None:
        return _NONE
    other, pair = held
    word = "within chance"
    if _distance(mode, other) > _DIFFERENT:
        word = f"{100 * (other.frequency_hz.value / mode.frequency_hz.value - 1):+.2g} %: differs"
    return f"{other.frequency_hz.value:.5g} Hz, {word}; MAC {_mac(pair)}"


def _distance(a: Mode, b: Mode) -> float:
    """The larger of the distances of frequencies and damping, in standard deviations."""
    both = ((a.frequency_hz, b.frequency_hz), (a.damping, b.damping))
    with np.errstate(divide="ignore", invalid="ignore"):
        return max(abs(x.value - y.value) / math.hypot(x.sd, y.sd) for x, y in both)


def _known_plain(known: Known, pair: Pair) -> dict[str, Any]:
    return {"frequency_hz": known.frequency_hz, "damping": known.damping, "mac": pair.mac}


def _other_plain(mode: Mode, other: Mode, pair: Pair) -> dict[str, Any]:
    low, high = other.frequency_hz.interval()
    least, most = other.damping.interval()
    return {
        "frequency_hz": other.frequency_hz.value,
        "frequency_hz_90": [low, high],
        "damping": other.damping.value,
        "damping_90": [least, most],
        "mac": pair.mac,
        "sigma": _distance(mode, other),
        "differs": _distance(mode, other) > _DIFFERENT,
    }
