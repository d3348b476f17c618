"""`samii-rig recordings` and `samii-rig replay`: what there is, and whether it repeats."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from samii_rig.cli.common import JsonOption, say_json
from samii_rig.index.query import Query, each_by_name

if TYPE_CHECKING:
    from samii_rig.index.entry import Entry


@each_by_name(lambda _, said: typer.Option(help=said))
def recordings(
    folder: Annotated[Path, typer.Argument(help="Folder of recordings.")] = Path("runs"),
    *,
    query: Query,
    json: JsonOption = False,
) -> None:
    """Find recordings in a folder, newest first.

    The index of the folder, .samii-rig/index.sqlite, is brought up to date first; it can be
    deleted at any time. Every new recording is read once: one whose bytes changed is `damaged`.

    Example: samii-rig recordings runs --experiment swept_sine --since 2026-11-01
    """
    from samii_rig.cli.arguments import check_recordings

    check_recordings(folder)
    query.where()  # a wrong time is said before a large folder is read
    query.page()

    from dataclasses import asdict

    from rich.console import Console

    from samii_rig.index.store import index_for_reading

    console = Console(highlight=False, stderr=json)
    with console.status("index ...") as shown, index_for_reading(folder) as index:
        index.refresh(lambda done, of: shown.update(f"index: {done:,} of {of:,} recordings ..."))
        found = index.search(query)
    if json:
        say_json({"total": found.total, "recordings": [asdict(e) for e in found.entries]})
        return
    for entry in found.entries:
        console.print(_line(entry), soft_wrap=True)
    shown_of = "" if len(found.entries) == found.total else f"{len(found.entries)} of "
    console.print(f"{shown_of}{found.total:,} recording{'' if found.total == 1 else 's'}")


def _line(e: Entry) -> str:
    from rich.markup import escape

    parts = (
        e.started[:16].replace("T", " "),
        e.path,
        ", ".join(p for p in (e.rig, e.experiment, e.operator) if p),
        f"{e.duration_s:.0f} s, {e.status}" + (f": {e.problem or e.reason}" if e.problem else ""),
        e.verdict.replace("_", " "),
        " ".join(f"#{t}" for t in e.tags),
    )
    return escape("  ".join(p for p in parts if p))


def replay(
    log: Annotated[Path, typer.Argument(help="A recording (.mcap).", show_default=False)],
    check: Annotated[
        bool, typer.Option("--check", help="Fail if any digit differs from what the run logged.")
    ] = False,
    json: JsonOption = False,
) -> None:
    """Estimate a run's frequency responses again from its samples, as the run itself did.

    Exit code with --check: 0 every digit is as it was, 3 one differs.

    Example: samii-rig replay runs/2026-11-22_samii_swept_sine.mcap --check
    """
    from samii_rig.cli.arguments import check_logs

    check_logs([log])

    from samii_rig.cli.common import response_json
    from samii_rig.run.repeat import repeat

    done = repeat(log)
    if json:
        say_json(
            {
                "recording": log,
                "same": not done.differences,
                "numbers": done.numbers,
                "differences": done.differences,
                "versions": done.versions,
                "responses": [response_json(r) for r in done.responses],
            }
        )
    else:
        for line in (*done.differences, *(done.versions if done.differences else ())):
            typer.echo(line)
        typer.echo(
            f"{log}: {len(done.responses)} frequency responses, {done.numbers:,} numbers; "
            + ("other than logged" if done.differences else "every digit as logged")
        )
    if check and done.differences:
        raise typer.Exit(3)
