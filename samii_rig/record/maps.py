"""The map file: how the columns of a foreign recording become channels.

A TOML file of four tables. `[format]` says how the file is read, `[time]` where the time
base is, each `[[channel]]` turns one column into one channel,

    value = (raw - offset) * scale,

and `[segment]` says what was done in the file, or in its parts. Maps that come with the
package are found by name, as rigs are.
"""

from __future__ import annotations

import re
from datetime import datetime
from importlib import resources
from itertools import pairwise
from typing import Annotated, Literal, Self

from pydantic import AfterValidator, AwareDatetime, Field, field_validator, model_validator

from samii_rig.rig.load import load_named, names_in
from samii_rig.rig.schema import Finite, Name, NonNegative, Positive, Strict
from samii_rig.types import Kind, Role

MAX_YEAR = 2100  # stamps are 64 bits of ns

_FOLDER = resources.files("samii_rig.record") / "data"


def _pattern(text: str) -> str:
    try:
        re.compile(text)
    except (re.error, OverflowError, RecursionError) as error:
        raise ValueError(f"{text!r} is no regular expression ({error})") from error
    return text


def _level(value: float | str) -> float | str:
    if isinstance(value, str):
        return _pattern(value)
    if not 0 <= value < float("inf"):
        raise ValueError(f"level is {value:g}; expected 0 or more, or a pattern")
    return value


Pattern = Annotated[str, AfterValidator(_pattern)]
Level = Annotated[float | str, AfterValidator(_level)]  # a number or a pattern


class _Delimited(Strict):
    """Lines of numbers.

    header : where the names of the columns stand: in the last comment before the data,
        in the first row, or in `columns` ("none").
    A name may carry a unit in square brackets, `theta [rad]`, which is then checked.
    units_row : the row after the row of names holds the units, which are checked likewise.
    decimal : the decimal mark.
    """

    comment: Annotated[str, Field(max_length=4)] = "#"
    skip_lines: Annotated[int, Field(ge=0)] = 0
    columns: tuple[str, ...] = ()
    decimal: Literal[".", ","] = "."
    units_row: bool = False

    @model_validator(mode="after")
    def _names(self) -> Self:
        header = getattr(self, "header", "none")
        if (header == "none") != bool(self.columns):
            raise ValueError('columns go with header = "none", and only with it')
        if header == "comment" and not self.comment:
            raise ValueError('header = "comment" needs a comment character')
        if self.units_row and header != "row":
            raise ValueError('units_row goes with header = "row"')
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


class JsonFormat(Strict):
    """JSON: an object of arrays, `{"t": [0, 1], "u": [2, 3]}`, an array of objects, or of arrays
    whose columns `columns` names; or one object or array a line.

    under : keys down to it, joined by dots; "" for the whole file.
    """

    kind: Literal["json"]
    under: str = ""
    columns: tuple[str, ...] = ()


class ParquetFormat(Strict):
    """Apache Parquet; a column's unit is its metadata `unit`, or stands in its name."""

    kind: Literal["parquet"]


Format = Annotated[
    TextFormat | CsvFormat | MatFormat | UffFormat | JsonFormat | ParquetFormat,
    Field(discriminator="kind"),
]


class TimeBase(Strict):
    """Where time comes from: a column of time, a column that counts samples, a rate.

    column, unit : instants of sampling. sequence : counts every sample that the device
    took, so that a jump is a loss. rate_hz : nominal rate; without it the median step of
    `column` decides. A step of more than one period is a loss, never filled.
    start : date and time of the first sample, with its offset from UTC.
    """

    column: str = ""
    unit: Literal["s", "ms", "us", "ns"] = "s"
    sequence: str = ""
    rate_hz: Positive | None = None
    start: AwareDatetime | None = None

    @field_validator("start")
    @classmethod
    def _dated(cls, start: datetime | None) -> datetime | None:
        if start is not None and not 1970 <= start.year <= MAX_YEAR:
            raise ValueError(f"start is in {start.year}; expected 1970 to {MAX_YEAR}")
        return start


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


class PartMap(Strict):
    """A stretch of a file: from `start` up to `stop`, in s after the file's first sample."""

    start: NonNegative
    stop: Positive
    level: NonNegative
    kind: Kind | None = None

    @model_validator(mode="after")
    def _forwards(self) -> Self:
        if not self.start < self.stop:
            raise ValueError(f"part: start {self.start:g} s is not before stop {self.stop:g} s")
        return self


class SegmentMap(Strict):
    """What was done in the file. It is one segment, unless a column or parts divide it.

    kind_by_name : pattern of the file's name -> kind; the first that is found decides,
        otherwise `kind`.
    level : the level of every file; or a pattern with a group of that name, searched in the
        file's name. level_column : the column that holds it instead; stretches of level 0
        belong to no segment.
    column : a column that numbers the segments: where its value changes, another one begins.
        pause : its value where nothing is done.
    part : stretches in s, each with its level, instead of columns.
    repeat : pattern with a group of that name, searched in the file's name; segments of one
        file are counted. first_repeat : the number that the files give the first repeat.
    """

    kind: Kind = "single"
    kind_by_name: dict[Pattern, Kind] = Field(default_factory=dict)
    level: Level | None = None
    level_column: str = ""
    level_unit: str = Field(min_length=1)
    column: str = ""
    pause: Finite | None = None
    part: tuple[PartMap, ...] = ()
    repeat: Pattern = ""
    first_repeat: Annotated[int, Field(ge=0)] = 1

    @field_validator("level", "repeat")
    @classmethod
    def _group(cls, pattern: object, info: object) -> object:
        name = str(getattr(info, "field_name", ""))
        if isinstance(pattern, str) and pattern and name not in re.compile(pattern).groupindex:
            raise ValueError(f"{pattern!r} has no group (?P<{name}>...)")
        return pattern

    @model_validator(mode="after")
    def _one_way(self) -> Self:
        ways = [self.level is not None, bool(self.level_column), bool(self.part)]
        if sum(ways) != 1:
            raise ValueError("segment: expected one of level, level_column and part")
        if self.part and self.column:
            raise ValueError("segment: part and column both divide the file; expected one of them")
        if self.pause is not None and not self.column:
            raise ValueError("segment: pause is a value of column; expected a column")
        if self.divided and self.repeat:
            raise ValueError("segment: repeats within a file are counted; expected no repeat")
        for before, after in pairwise(self.part):
            if after.start < before.stop:
                raise ValueError(f"part: {after.start:g} s is inside the part before it")
        return self

    @property
    def divided(self) -> bool:
        """Whether the file may hold several segments."""
        return bool(self.part or self.column or self.level_column)

    @property
    def columns(self) -> tuple[str, ...]:
        """The columns of the file that are read to divide it."""
        return tuple(name for name in (self.column, self.level_column) if name)


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
