"""docs/evidence/papers.md: the tables between its markers are written by `samii-rig papers --page`.

<!-- result ID -->
...
<!-- end -->
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path

from samii_rig.errors import InputError
from samii_rig.papers.equations import EQUATIONS
from samii_rig.papers.result import Number, Result
from samii_rig.record.export import replacing
from samii_rig.rig.load import read_text

BLOCK = re.compile(r"<!-- result (?P<id>[\w-]+) -->\n(?P<body>.*?)<!-- end -->", re.DOTALL)
HEAD = ("| | published | ours | deviation | asked for | agreement |", "|---|---|---|---|---|---|")
EQUATION_TABLE = "equations"


def table(result: Result) -> str:
    """The numbers as a Markdown table, the sentences below it."""
    lines = [*HEAD, *(row(n) for n in result.numbers)]
    for sentence in result.sentences:
        lines += ["", _cell(sentence)]
    return "\n".join(lines) + "\n"


def row(n: Number) -> str:
    """One line of the table."""
    ours = n.shown() if n.holds else f"**{n.shown()}**"
    cells = (n.what, n.published, ours, n.shown_deviation(), n.must, n.agreement)
    return "| " + " | ".join(_cell(c) for c in cells) + " |"


def equation_table() -> str:
    """Equation, what it is, where it lives."""
    lines = ["| paper | equation | what | where |", "|---|---|---|---|"]
    for e in EQUATIONS:
        where = ", ".join(f"`{w.removeprefix('samii_rig.')}`" for w in e.where)
        lines.append(f"| {e.paper} | {e.number} | {_cell(e.what)} | {where} |")
    return "\n".join(lines) + "\n"


def blocks(text: str) -> dict[str, str]:
    """What stands between the markers, by name."""
    return {m["id"]: m["body"] for m in BLOCK.finditer(text)}


def renewed(text: str, results: Mapping[str, Result]) -> str:
    """`text` with the blocks of `results` and the table of equations written anew."""
    made = {name: table(result) for name, result in results.items()}
    made[EQUATION_TABLE] = equation_table()

    def write(match: re.Match[str]) -> str:
        body = made.get(match["id"], match["body"])
        return f"<!-- result {match['id']} -->\n{body}<!-- end -->"

    return BLOCK.sub(write, text)


def renew(path: Path, results: Mapping[str, Result]) -> None:
    """Write the blocks of a page anew; InputError if it lacks one of them."""
    text = read_text(path, "page")
    have = blocks(text)
    for name in results:
        if name not in have:
            raise InputError(str(path), "marker", name, f"<!-- result {name} --> in the page")
    with replacing(path) as part:
        part.write_text(renewed(text, results), encoding="utf-8")


def _cell(text: str) -> str:
    """Text that Markdown leaves as it is."""
    return (
        text.replace("|", "\\|").replace("*", "\\*").replace("_", "\\_")
        if text[:2] != "**"
        else text
    )
