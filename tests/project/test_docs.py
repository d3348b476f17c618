"""Every link in every page leads somewhere, and every page stands on a shelf of the site."""

from __future__ import annotations

import re
from fnmatch import fnmatch
from pathlib import Path

import pytest
from conftest import ROOT

SHELVES = (ROOT / "docs" / "index.md").read_text("utf-8")
PAGES = sorted(p for p in (*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md")))
PAGES = [p for p in PAGES if (ROOT / "docs" / "reference" / "api") not in p.parents]


def text_of(page: Path) -> str:
    """A page without its code."""
    text = re.sub(r"^( *)```.*?^\1```", "", page.read_text("utf-8"), flags=re.M | re.S)
    return re.sub(r"`[^`\n]*`", "", text)


def anchors(page: Path) -> set[str]:
    """Names of the headings, as a forge and the site make them."""
    plain = re.sub(r"^( *)```.*?^\1```", "", page.read_text("utf-8"), flags=re.M | re.S)
    found: list[str] = []
    for heading in re.findall(r"^#+ +(.*)$", plain, re.M):
        words = re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", heading).replace("`", "").strip().lower()
        slug = re.sub(r"[^\w\- ]", "", words).replace(" ", "-")
        times = sum(re.fullmatch(rf"{re.escape(slug)}(-\d+)?", f) is not None for f in found)
        found.append(f"{slug}-{times}" if times else slug)
    return set(found)


@pytest.mark.parametrize("page", PAGES, ids=lambda p: str(p.relative_to(ROOT)))
def test_no_link_is_dead(page: Path) -> None:
    for target in re.findall(r"\]\(\s*<?([^)\s>]+)>?[^)]*\)", text_of(page)):
        if re.match(r"(https?|mailto):", target):
            continue
        name, _, anchor = target.partition("#")
        there = (page.parent / name) if name else page
        assert there.exists(), f"{target}: there is no {there}"
        if anchor and there.suffix == ".md":
            assert anchor in anchors(there), f"{target}: {there.name} has no such heading"


def test_every_page_stands_on_the_shelf_of_its_folder() -> None:
    shelves = re.findall(r"^:caption: (\w+)\n(.*?)^```", SHELVES, re.M | re.S)
    rows = [
        (shelf.lower(), r)
        for shelf, body in shelves
        for r in re.findall(r"^[\w./*-]+$", body, re.M)
    ]
    for page in PAGES:
        name = page.relative_to(ROOT / "docs") if (ROOT / "docs") in page.parents else None
        if name is None or name.name == "index.md":
            continue
        on = [shelf for shelf, row in rows if fnmatch(str(name.with_suffix("")), row)]
        home = {"decisions": "method"}.get(name.parts[0], name.parts[0])
        assert on == [home], f"docs/index.md: {name} is on the shelves {on}; expected {home}"


def test_every_page_that_the_code_names_is_there() -> None:
    for room in ("samii_rig", "drivers", "sim", "experiments", "benchmarks", "tests", "tools"):
        for file in (ROOT / room).rglob("*.*"):
            if file.suffix not in {".py", ".j2", ".c", ".h", ".toml", ".js", ".html"}:
                continue
            for page in re.findall(r"\bdocs/[\w/-]+\.md", file.read_text("utf-8")):
                assert (ROOT / page).exists(), f"{file}: there is no {page}"
