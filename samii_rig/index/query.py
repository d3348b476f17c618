"""What is asked of the index, as SQL with every value bound."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass, field, fields
from datetime import UTC, datetime
from functools import wraps
from inspect import Parameter, signature
from typing import Annotated, Any

from samii_rig.errors import InputError

MOST = 1000  # entries in one answer
_DAY = re.compile(r"\d{4}-\d\d-\d\d")


def _asked(said: str, default: Any = "") -> Any:
    """A field, with what it is in the words of a help."""
    return field(default=default, metadata={"help": said})


@dataclass(frozen=True, slots=True)
class Query:
    """Which recordings. "" asks nothing of a field.

    rig, experiment, operator, status, verdict, tag : equal, upper and lower case alike.
    since, until : a day or a time in ISO 8601, UTC where it names no zone; `until` a day means
        its end.
    text : words that all stand somewhere in name, rig, experiment, operator, reason, tags, notes.
    """

    rig: str = _asked("Name of the rig, as its file says.")
    experiment: str = _asked("Name of the experiment.")
    operator: str = _asked("Who stood at the rig.")
    status: str = _asked("completed, stopped, tripped, failed, unfinished, damaged or unreadable.")
    verdict: str = _asked("Of the diagnosis: no_mismatch, named, ambiguous or unknown.")
    tag: str = _asked("A tag.")
    since: str = _asked("First day or time, such as 2026-11-01.")
    until: str = _asked("Last day or time.")
    text: str = _asked("Words in name, tags, notes, reason.")
    limit: int = _asked("How many are shown.", 100)
    offset: int = _asked("How many of the newest are passed over.", 0)

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


def each_by_name(metadata: Callable[[str, str], Any]) -> Callable[[Callable[..., Any]], Any]:
    """Decorates a function of a `query` into one of its fields, each by its own name: for what
    makes options of a signature, as typer and FastAPI do.

    metadata : of a field's annotation, from its name and its help.
    """
    asked = [
        Parameter(
            f.name,
            Parameter.KEYWORD_ONLY,
            default=f.default,
            annotation=Annotated[type(f.default), metadata(f.name, f.metadata["help"])],
        )
        for f in fields(Query)
    ]

    def decorated(function: Callable[..., Any]) -> Any:
        @wraps(function)
        def taken(*others: Any, **given: Any) -> Any:
            query = Query(**{p.name: given.pop(p.name) for p in asked})
            return function(*others, query=query, **given)

        own = signature(function, eval_str=True).parameters.values()
        all_ = [*(p for p in own if p.name != "query"), *asked]
        all_.sort(key=lambda p: p.kind)
        taken.__signature__ = signature(function).replace(parameters=all_)  # type: ignore[attr-defined]
        taken.__annotations__ = {p.name: p.annotation for p in all_}
        return taken

    return decorated


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
