"""`samii-rig papers`: both papers' results, ours beside the published ones."""

from __future__ import annotations

from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from samii_rig.cli.common import JsonOption, say_json

if TYPE_CHECKING:
    from collections.abc import Sequence

    from rich.console import Console
    from rich.table import Table

    from samii_rig.papers.catalogue import Entry
    from samii_rig.papers.result import Result

FORMATS = ("svg", "png", "pdf")  # of `report.figures`, which takes seconds to import


def papers(
    ids: Annotated[
        list[str] | None, typer.Argument(help="Results, as --list names them [default: all].")
    ] = None,
    list_: Annotated[bool, typer.Option("--list", help="Name the results and stop.")] = False,
    out: Annotated[
        Path | None, typer.Option(help="Folder for the pictures; none are drawn without.")
    ] = None,
    format_: Annotated[
        str, typer.Option("--format", help="Of the pictures: svg, png or pdf.")
    ] = "svg",
    page: Annotated[
        Path | None, typer.Option(help="A page to write its tables anew (docs/evidence/papers.md).")
    ] = None,
    json: JsonOption = False,
) -> None:
    """Regenerate the tables and figures of both papers: published, ours, deviation.

    Some results drive the simulated rig first; all of them take some minutes. The exit code is
    1 if a number does not lie where it must.

    Example: samii-rig papers table-1 p2-fig-12 --out pictures
    """
    from samii_rig.cli.arguments import check_choice
    from samii_rig.papers.catalogue import entries

    chosen = entries(ids or [])
    check_choice("--format", format_, FORMATS)

    from rich.console import Console

    from samii_rig.files import check_file, make_folder

    console = Console(highlight=False)
    if list_:
        _list(chosen, console, json=json)
        return
    if out is not None:
        make_folder("--out", out)
    if page is not None:
        check_file("--page", page)
    done: dict[str, Result] = {}
    plain: list[dict[str, Any]] = []
    for number, entry in enumerate(chosen, 1):
        doing = f"{number}/{len(chosen)} {entry.id}: {entry.title} ..."
        with nullcontext() if json else console.status(doing):
            result = entry.compute()
            written = _draw(result, out, format_)
        done[entry.id] = result
        plain.append(_plain(entry, result, written))
        if not json:
            _say(entry, result, written, console)
    if page is not None:
        from samii_rig.papers.page import renew

        renew(page, done)
    if json:
        say_json({"results": plain})
    if not all(result.holds for result in done.values()):
        raise typer.Exit(1)


def _list(chosen: Sequence[Entry], console: Console, *, json: bool) -> None:
    """Name the results."""
    if json:
        say_json({"results": [{"id": e.id, "where": e.where, "title": e.title} for e in chosen]})
    for e in () if json else chosen:
        console.print(f"{e.id:14} {e.where}: {e.title}", soft_wrap=True)


def _say(entry: Entry, result: Result, written: list[Path], console: Console) -> None:
    """One result for a person."""
    console.print(_table(entry, result))
    for sentence in result.sentences:
        console.print(sentence)
    for path in written:
        console.print(f"written  {path}", soft_wrap=True)
    console.print()


def _draw(result: Result, out: Path | None, format_: str) -> list[Path]:
    if out is None or not result.pictures:
        return []
    from samii_rig.papers.draw import draw
    from samii_rig.report.figures import save_figure

    return [save_figure(out / f"{p.name}.{format_}", draw(p)) for p in result.pictures]


def _table(entry: Entry, result: Result) -> Table:
    from rich import box
    from rich.table import Table

    table = Table(
        title=f"{entry.id}: {entry.where}, {entry.title}",
        title_justify="left",
        box=box.SIMPLE_HEAD,
    )
    for name in ("", "published", "ours", "deviation", "asked for", "", "agreement"):
        table.add_column(name)
    for n in result.numbers:
        verdict = "" if not n.must else "holds" if n.holds else "DOES NOT HOLD"
        table.add_row(
            n.what, n.published, n.shown(), n.shown_deviation(), n.must, verdict, n.agreement
        )
    return table


def _plain(entry: Entry, result: Result, written: list[Path]) -> dict[str, Any]:
    return {
        "id": entry.id,
        "where": entry.where,
        "title": entry.title,
        "holds": result.holds,
        "numbers": [
            {
                "what": n.what,
                "published": n.published,
                "ours": n.ours,
                "unit": n.unit,
                "deviation": n.deviation if n.reference == n.reference else None,
                "must": n.must,
                "holds": n.holds,
                "agreement": n.agreement,
            }
            for n in result.numbers
        ],
        "sentences": list(result.sentences),
        "pictures": written,
    }
