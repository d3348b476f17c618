"""A value as a notebook shows it: a few facts and a small table, as plain HTML; and other forms."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from html import escape
from typing import Any

Rows = Sequence[Sequence[object]]
_MOST_ROWS = 24  # of a table; the rest is counted


# By name, what makes another form of data: a picture, a table of another library. The package's own
# face says who: they stand above the data.
FORMS: dict[str, Callable[..., Any]] = {}


def card(title: str, facts: Mapping[str, object], head: Sequence[str] = (), rows: Rows = ()) -> str:
    """`title`, a line for each of `facts` that is not empty, and a table."""
    said = [f"{escape(k)}: {escape(str(v))}" for k, v in facts.items() if str(v)]
    parts = [f"<strong>{escape(title)}</strong>", *said]
    out = f"<div>{'<br>'.join(parts)}</div>"
    if not rows:
        return out
    body = [_row("td", row) for row in rows[:_MOST_ROWS]]
    if len(rows) > _MOST_ROWS:
        body.append(_row("td", [f"and {len(rows) - _MOST_ROWS} more"]))
    return f"{out}<table><thead>{_row('th', head)}</thead><tbody>{''.join(body)}</tbody></table>"


def _row(tag: str, cells: Sequence[object]) -> str:
    return "<tr>" + "".join(f"<{tag}>{escape(str(c))}</{tag}>" for c in cells) + "</tr>"
