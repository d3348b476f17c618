"""How a text of numbers is written: its comment, delimiter, decimal mark and header.

Delimiters and decimal marks are tried until the most fields of the last lines are numbers.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from samii_rig.errors import InputError
from samii_rig.record.delimited import fields, uncommented
from samii_rig.record.maps import CsvFormat, TextFormat
from samii_rig.record.text import decoded

_LINES = 200  # of a text, by which its delimiter and decimal mark are found
_COMMENTS = ("#", "%", "//", "!")
_DELIMITERS = (";", "\t", ",", "|", "")  # the first that fits is taken; "" is white space
_NO_NUMBER = {"", "nan", "na", "n/a", "null", "none", "-", "inf", "-inf", "+inf"}


def text_format(path: Path) -> TextFormat | CsvFormat:
    """The format of the text at `path`, by its first lines; InputError without lines of numbers."""
    lines = []
    with path.open("rb") as stream:
        for raw in stream:
            lines.append(decoded(raw))
            if len(lines) >= _LINES:
                break
    marks = [m for m in _COMMENTS if any(line.lstrip().startswith(m) for line in lines)]
    comment = marks[0] if marks else "#"
    plain = [uncommented(line, comment) for line in lines]
    best, first, delimiter, decimal = 0, 0, ",", "."
    for delimiter_tried in _DELIMITERS:
        for decimal_tried in (".", ","):
            if decimal_tried != delimiter_tried:
                score, begins = _numeric_tail(plain, delimiter_tried, decimal_tried)
                if score > best:
                    best, first = score, begins
                    delimiter, decimal = delimiter_tried, decimal_tried
    if not best:
        said = "no lines of numbers" if any(plain[1:]) else "header without data, no data"
        raise InputError(str(path), "", said, "columns of numbers")
    return _headed(lines, plain, first, comment, delimiter, decimal)


def _headed(
    lines: list[str], plain: list[str], first: int, comment: str, delimiter: str, decimal: str
) -> TextFormat | CsvFormat:
    """The format whose data begin in line `first`: where the names of its columns stand."""
    width = len(fields(plain[first], delimiter))
    given: dict[str, Any] = {"comment": comment, "decimal": decimal}
    above = [i for i in range(first) if plain[i]]
    fits = [i for i in above if len(fields(plain[i], delimiter)) == width]
    if fits and fits[-1] == above[-1]:
        units = len(fits) > 1 and fits[-2:] == above[-2:]
        head = fits[-2] if units else fits[-1]
        given |= {"header": "row", "skip_lines": head, "units_row": units}
    else:
        comments = [i for i in range(first) if lines[i].strip() and not plain[i]]
        label = lines[comments[-1]].strip().removeprefix(comment).strip() if comments else ""
        given["skip_lines"] = above[-1] + 1 if above else 0
        if len(fields(label, delimiter)) == width and width > 1:
            given["header"] = "comment"
            given["skip_lines"] = min(given["skip_lines"], comments[-1])
        else:
            names = tuple(f"column_{i + 1}" for i in range(width))
            given |= {"header": "none", "columns": names}
    if delimiter:
        return CsvFormat(kind="csv", delimiter=delimiter, **given)
    return TextFormat(kind="text", delimiter="", **given)


def _numeric_tail(plain: list[str], delimiter: str, decimal: str) -> tuple[int, int]:
    """How well these fit the rows that end the lines, and the line where those rows begin.

    The score is the count of numbers less that of words, in rows of one width.
    """
    score, width, begins = 0, 0, 0
    for i in range(len(plain) - 1, -1, -1):
        if not plain[i]:
            continue
        found = fields(plain[i], delimiter)
        numbers, words = _counted(found, decimal)
        if (width and len(found) != width) or not numbers or words > numbers:
            break
        score, width, begins = score + numbers - words, len(found), i
    return score, begins


def _counted(found: list[str], decimal: str) -> tuple[int, int]:
    """How many fields are numbers, and how many are words; what stands for none is neither."""
    numbers = words = 0
    for one in found:
        if one.lower() in _NO_NUMBER:
            continue
        try:
            float(one.replace(decimal, "."))
        except ValueError:
            words += 1
        else:
            numbers += 1
    return numbers, words
