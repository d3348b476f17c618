"""What is asked of the index, as SQL with every value bound."""

from __future__ import annotations

import re
from dataclasses import dataclass
from datetime import UTC, datetime

from samii_rig.errors import InputError

MOST = 1000  # entries in one answer
_DAY = re.compile(r"\d{4}-\d\d-\d\d")


@dataclass(frozen=True, slots=True)
class Query:
    """Which recordings. "" asks nothing of a field.

    rig, experiment, operator, status, verdict, tag : equal, upper and lower case alike.
    since, until : a day or a time in ISO 8601, UTC where it names no zone; `until` a day means
        its end.
    text : words that all stand somewhere in name, rig, experiment, operator, reason, tags, notes.
    """

    rig: str = ""
    experiment: str = ""
    operator: str = ""
    status: str = ""
    verdict: str = ""
    tag: str = ""
    since: str = ""
    until: str = ""
    text: str = ""
    limit: int = 100
    offset: int = 0

    def where(self) -> tuple[str, list[str]]:
        """The condition and its values; InputError for a time that is none."""
        parts, values = ["1"], list[str]()
        for column in ("rig", "experiment", "operator", "status", "verdict"):
            wanted = getattr(self, column)
            if wanted:
                parts.append(f"{column} = ? COLLATE NOCASE")
                values.append(wanted)
        if self.tag:
            parts.append("instr(tags, ?) > 0")
            values.append(f"\n{self.tag.lower()}\n")
        if self.since:
            parts.append("started >= ?")
            values.append(moment("since", self.since))
        if self.until:
            parts.append("started <= ?")
            values.append(moment("until", self.until, end=True))
        for word in self.text.lower().split():
            parts.append("instr(text, ?) > 0")
            values.append(word)
        return " AND ".join(parts), values

    def page(self) -> tuple[int, int]:
        """Limit and offset; InputError beyond what one answer holds."""
        if not 0 < self.limit <= MOST:
            raise InputError("search", "limit", self.limit, f"1 to {MOST}")
        if not 0 <= self.offset < 2**31:
            raise InputError("search", "offset", self.offset, "0 or more")
        return self.limit, self.offset


def moment(field: str, text: str, *, end: bool = False) -> str:
    """A time as the index holds it; InputError if it is none."""
    try:
        found = datetime.fromisoformat(text)
        if end and _DAY.fullmatch(text):
            found = found.replace(hour=23, minute=59, second=59)
        if found.tzinfo is None:
            found = found.replace(tzinfo=UTC)
        return found.astimezone(UTC).isoformat(timespec="seconds")
    except (ValueError, OverflowError) as error:
        raise InputError("search", field, text, "a day or time such as 2026-11-22") from error
