"""Lines of fixed columns, as Fortran writes them: a card is a line's fields by name."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

Value = str | int | float | None

_FORMAT = re.compile(r"^(?P<kind>[AIEX])(?P<width>\d+)(\.(?P<digits>\d+))?$")
_NO_E = re.compile(r"(?<=[0-9.])(?=[+-]\d)")  # where Fortran leaves the E of 1.0-100 out


@dataclass(frozen=True, slots=True)
class Field:
    """One field: `A` text, `I` whole number, `E` number, `X` blank columns."""

    name: str
    kind: str
    width: int
    digits: int = 0

    def parsed(self, text: str) -> Value:
        """What stands in the field, None in an empty one of numbers; ValueError for no number."""
        text = text.rstrip() if self.kind == "A" else text.strip()
        if self.kind == "A":
            return text
        if not text:
            return None
        return int(text) if self.kind == "I" else number(text)

    def written(self, value: Value) -> str:
        """The field's columns. ValueError for a whole number that does not fit."""
        if self.kind == "A":
            return f"{value or '':<{self.width}.{self.width}}"
        if value is None:
            return " " * self.width
        if self.kind == "E":
            return exponent(float(value), self.width, self.digits)
        text = f"{value:{self.width}d}"
        if len(text) > self.width:
            raise ValueError(f"{self.name} is {value}; expected {self.width} digits at most")
        return text


@dataclass(frozen=True, slots=True)
class Card:
    """The fields of one line, in order."""

    fields: tuple[Field, ...]

    def parsed(self, line: str) -> dict[str, Value]:
        """The fields by name. Numbers that ignore the columns are taken one after the other.

        ValueError for a field that is no number.
        """
        found: dict[str, Value] = {}
        at = 0
        try:
            for field in self.fields:
                if field.kind != "X":
                    found[field.name] = field.parsed(line[at : at + field.width])
                at += field.width
        except ValueError:
            parts = line.split()
            if any(f.kind in "AX" for f in self.fields) or len(parts) > len(self.fields):
                raise
            given = [*parts, *[""] * (len(self.fields) - len(parts))]
            return {f.name: f.parsed(p) for f, p in zip(self.fields, given, strict=True)}
        return found

    def written(self, values: Mapping[str, Any]) -> str:
        """The line of these values."""
        return "".join(f.written(values.get(f.name)) for f in self.fields).rstrip()


def card(text: str) -> Card:
    """A card from its description: `name:I10 other:E13.5 X1 label:A20`."""
    fields = []
    for part in text.split():
        name, _, form = part.rpartition(":")
        match = _FORMAT.match(form)
        assert match, part
        fields.append(Field(name, match["kind"], int(match["width"]), int(match["digits"] or 0)))
    return Card(tuple(fields))


def number(text: str) -> float:
    """A number as Fortran writes it, with E, D or neither before its exponent."""
    plain = text.upper().replace("D", "E")
    try:
        return float(plain)
    except ValueError:
        return float(_NO_E.sub("E", plain))


def exponent(value: float, width: int, digits: int) -> str:
    """`value` in `width` columns with a blank before it, and `digits` after the point.

    A number that is not negative gets one digit more where it is needed and has its place: some
    programs use the columns of the sign.
    """
    text = f"{value:.{digits}E}"
    if value >= 0.0 and float(text) != value:
        more = f"{value:.{digits + 1}E}"
        if len(more) < width and float(more) == value:
            text = more
    return f"{text:>{width}}"


def numbers(values: Iterable[float], width: int, digits: int, a_line: int) -> list[str]:
    """Numbers, `a_line` of them a line."""
    made = [exponent(float(v), width, digits) for v in values]
    return ["".join(made[i : i + a_line]) for i in range(0, len(made), a_line)]


def wholes(values: Iterable[int], a_line: int = 8) -> list[str]:
    """Whole numbers of ten columns, `a_line` of them a line."""
    made = [f"{int(v):10d}" for v in values]
    return ["".join(made[i : i + a_line]) for i in range(0, len(made), a_line)]
