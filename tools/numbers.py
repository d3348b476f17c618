"""Every number typed into the diagnosis and its likelihood, with what it is, as a page.

python -m tools.numbers    writes docs/reference/diagnosis-numbers.md
"""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
PAGE = ROOT / "docs" / "reference" / "diagnosis-numbers.md"
ROOMS = ("samii_rig/diagnose", "samii_rig/likelihood")
SHORT = 60  # characters of a value; a longer one is a table, to be read where it stands
MARKS = re.compile(r"([|*<>_\[\]])")  # of Markdown, in words that are none of it
SAID = re.compile(r"# (?!fmt:)(.*)")
HEAD = """# The numbers of the diagnosis

Every number that is typed into `samii_rig/diagnose` and `samii_rig/likelihood`: its unit, its
reason, and what fixed it. `python -m tools.numbers` writes this page from the comments at the
numbers; a test compares both, and asks for the comments.
"""


@dataclass(frozen=True, slots=True)
class Number:
    """Names that are set together, their value as it is written, and the comment at it: in its
    line, else right above; "" for none."""

    names: tuple[str, ...]
    value: str
    said: str


def numbers(text: str) -> Iterator[Number]:
    """Those of a module, in order."""
    lines = text.splitlines()
    for node in ast.parse(text).body:
        if not isinstance(node, ast.Assign | ast.AnnAssign) or not _typed(node.value):
            continue
        targets = node.targets if isinstance(node, ast.Assign) else [node.target]
        each = (x for target in targets for x in ast.walk(target))
        names = tuple(x.id for x in each if isinstance(x, ast.Name) and x.id.isupper())
        if names:
            value = ast.unparse(node.value) if node.value else ""
            if len(value) <= SHORT:
                yield Number(names, value, _beside(lines, node) or _above(lines, node))


def _typed(value: ast.expr | None) -> bool:
    inside = ast.walk(value) if value else ()
    return any(isinstance(x, ast.Constant) and type(x.value) in (int, float) for x in inside)


def _beside(lines: list[str], node: ast.stmt) -> str:
    own = lines[node.lineno - 1 : node.end_lineno]
    return " ".join(found[1] for line in own if (found := SAID.search(line)))


def _above(lines: list[str], node: ast.stmt) -> str:
    out: list[str] = []
    for line in reversed(lines[: node.lineno - 1]):
        if not line.startswith("# "):
            break
        out.insert(0, line[2:])
    return " ".join(out)


def page() -> str:
    """The page's text."""
    out = [HEAD]
    for room in ROOMS:
        for file in sorted((ROOT / room).rglob("*.py")):
            rows = [_row(one) for one in numbers(file.read_text("utf-8"))]
            if rows:
                name = file.relative_to(ROOT).as_posix()
                out += [f"\n## {name}\n", "| number | value | what it is |", "|---|---|---|", *rows]
    return "\n".join(out) + "\n"


def _row(one: Number) -> str:
    words = re.split(r"(`[^`]*`)", one.said)  # what is between marks stands as it is
    said = "".join(w if w.startswith("`") else MARKS.sub(r"\\\1", w) for w in words)
    return f"| `{', '.join(one.names)}` | `{one.value}` | {said} |"


if __name__ == "__main__":
    PAGE.write_text(page(), "utf-8")
