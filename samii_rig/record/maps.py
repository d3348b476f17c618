"""The map file: how the columns of a foreign recording become channels.

A TOML file of four tables. `[format]` says how the file is read, `[time]` where the time
base is, each `[[channel]]` turns one column into one channel,

    value = (raw - offset) * scale,

and `[segment]` says what was done in the file (the whole file is one segment). Maps that
come with the package are found by name, as rigs are.
"""

from __future__ import annotations

import re
from importlib import resources
from typing import Annotated, Literal, Self

from pydantic import AfterValidator, Field, field_validator, model_validator

from samii_rig.rig.load import load_named, names_in
from samii_rig.rig.schema import Finite, Name, NonNegative, Positive, Strict
from samii_rig.types import Kind, Role

_FOLDER = resources.files("samii_rig.record") / "data"


def _pattern(text: str) -> str:
    try:
        re.compile(text)
    except (re.error, OverflowError, RecursionError) as error:
        raise ValueError(f"{text!r} is no regular expression ({error})") from error
    return text


Pattern = Annotated[str, AfterValidator(_pattern)]


class _Delimited(Strict):
    """Lines of numbers.

    header : where the names of the columns stand: in the last comment before the data,
        in the first row, or in `columns` ("none").
    A name may carry a unit in square brackets, `theta [rad]`, which is then checked.
    decimal : the decimal mark.
    """

    comment: Annotated[str, Field(max_length=4)] = "#"
    skip_lines: Annotated[int, Field(ge=0)] = 0
    columns: tuple[str, ...] = ()
    decimal: Literal[".", ","] = "."

    @model_validator(mode="after")
    def _names(self) -> Self:
        header = getattr(self, "header", "none")
        if (header == "none") != bool(self.columns):
            raise ValueError('columns go with header = "none", and only with it')
        if header == "comment" and not self.comment:
            raise ValueError('header = "comment" needs a comment character')
        if self.decimal == getattr(self, "delimiter", ""):
            raise ValueError("delimiter and decimal mark are the same")
        return self


class TextFormat(_Delimited):
    """Plain text; `delimiter` "" means any white space."""

    kind: Literal["text"]
    delimiter: Annotated[str, Field(max_length=1)] = ""
    header: Literal["comment", "row", "none"] = "comment"


class CsvFormat(_Delimited):
    """Comma-separated values (or another delimiter), names in the first row."""

    kind: Literal["csv"]
    delimiter: Annotated[str, Field(min_length=1, max_length=1)] = ","
    header: Literal["comment", "row", "none"] = "row"


class MatFormat(Strict):
    """MATLAB file up to version 7.2: one vector a column, or the columns of one matrix.

    variable : the matrix, whose columns are then named by `columns`; "" for vectors.
    """

    kind: Literal["mat"]
    variable: str = ""
    columns: tuple[str, ...] = ()

    @model_validator(mode="after")
    def _matrix(self) -> Self:
        if bool(self.variable) != bool(self.columns):
            raise ValueError("variable (a matrix) and columns (its names) go together")
        return self


class UffFormat(Strict):
    """Universal file, data sets 58 of time responses: a column is called by the first ID
    line of its set, or "#1", "#2", ... by its place among them. The time base is the
    abscissa; it needs no column."""

    kind: Literal["uff58"]


Format = Annotated[TextFormat | CsvFormat | MatFormat | UffFormat, Field(discriminator="kind")]


class TimeBase(Strict):
    """Where time comes from: a column of time, a column that counts samples, a rate.

    column, unit : instants of sampling. sequence : counts every sample that the device
    took, so that a jump is a loss. rate_hz : nominal rate; without it the median step of
    `column` decides. A step of more than one period is a loss, never filled.
    """

    column: str = ""
    unit: Literal["s", "ms", "us", "ns"] = "s"
    sequence: str = ""
    rate_hz: Positive | None = None


class ColumnMap(Strict):
    """One column and the channel that it becomes; `low`, `high`, `resolution` in `unit`.

    raw_unit : unit of the column in the file. Where the file names its units (a UFF set, a
    header `theta [rad]`) the two must agree; "" takes `unit` if nothing is rescaled.
    """

    column: str = Field(min_length=1)
    name: Name
    unit: str = Field(min_length=1)
    role: Role = "sensor"
    scale: Finite = 1.0
    offset: Finite = 0.0
    raw_unit: str = ""
    resolution: NonNegative = 0.0
    low: float = -float("inf")
    high: float = float("inf")
    description: str = ""

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if self.scale == 0:
            raise ValueError(f"channel {self.name}: scale 0 would make every value 0")
        if not self.low < self.high:
            raise ValueError(f"channel {self.name}: low {self.low:g} is not below {self.high:g}")
        return self

    def unit_in_file(self) -> str:
        """What a unit that the file itself states must be; "" when any will do."""
        plain = self.scale == 1.0 and self.offset == 0.0
        return self.raw_unit or (self.unit if plain else "")


class SegmentMap(Strict):
    """What was done in the file: it is one segment.

    kind_by_name : pattern of the file's name -> kind; the first that is found decides,
        otherwise `kind`.
    level, repeat : patterns with a group of that name, searched in the file's name.
    first_repeat : the number that the files give the first repeat.
    """

    kind: Kind = "single"
    kind_by_name: dict[Pattern, Kind] = Field(default_factory=dict)
    level: Pattern
    level_unit: str = Field(min_length=1)
    repeat: Pattern = ""
    first_repeat: Annotated[int, Field(ge=0)] = 1

    @field_validator("level", "repeat")
    @classmethod
    def _group(cls, pattern: str, info: object) -> str:
        name = str(getattr(info, "field_name", ""))
        if pattern and name not in re.compile(pattern).groupindex:
            raise ValueError(f"{pattern!r} has no group (?P<{name}>...)")
        return pattern


class ImportMap(Strict):
    """A map file, whole.

    file_name : pattern that the names of the files it is for are found by; "" for any.
    rig : the rig whose file goes into the recording; its channels' units are checked.
    """

    name: str = Field(min_length=1)
    description: str = ""
    file_name: Pattern = ""
    rig: str = ""
    format: Format
    time: TimeBase = TimeBase()
    channel: Annotated[tuple[ColumnMap, ...], Field(min_length=1)]
    segment: SegmentMap
    metadata: dict[str, str] = Field(default_factory=dict)

    @field_validator("channel")
    @classmethod
    def _unique(cls, channels: tuple[ColumnMap, ...]) -> tuple[ColumnMap, ...]:
        names = [c.name for c in channels]
        for name in names:
            if names.count(name) > 1:
                raise ValueError(f"channel {name!r} occurs twice; expected each once")
        return channels

    @model_validator(mode="after")
    def _time(self) -> Self:
        if not (self.time.column or self.time.rate_hz or self.format.kind == "uff58"):
            raise ValueError("time: neither column nor rate_hz")
        return self


def shipped_maps() -> tuple[str, ...]:
    """Names of the maps that come with the package."""
    return names_in(_FOLDER)


def load_map(name: str) -> tuple[ImportMap, str]:
    """The map called `name` (shipped, or the path of a file) and the text of its file."""
    return load_named(ImportMap, name, _FOLDER, "--map", "map file")
