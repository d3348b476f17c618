"""`samii-rig study`: how the modes of a rig move with its parameters."""

from __future__ import annotations

from contextlib import ExitStack
from pathlib import Path
from typing import Annotated

import typer

from samii_rig.cli.common import (
    FIGURES,
    JsonOption,
    RigOption,
    SchedulerOption,
    WorkersOption,
    check_target,
    say_json,
)
from samii_rig.cli.estimate import BandOption


def study(
    vary: Annotated[
        list[str],
        typer.Option(
            help="element.symbol=LOW:HIGH:N in equal steps, or LOW:HIGH:N:log in equal ratios; may "
            "be repeated for a grid."
        ),
    ],
    rig: RigOption = "samii",
    band: BandOption = None,
    out: Annotated[Path | None, typer.Option(help="Write every point to this .csv file.")] = None,
    plot: Annotated[
        Path | None,
        typer.Option(help="Draw it, over one or two parameters (.png, .svg or .pdf)."),
    ] = None,
    workers: WorkersOption = None,
    scheduler: SchedulerOption = "",
    json: JsonOption = False,
) -> None:
    """Vary parameters over a grid: frequency and damping of every mode in the band.

    Without --band the modes up to a tenth of the sample rate.

    Example: samii-rig study --rig samii --vary joint_1.k=6800:27200:21:log --plot study.png
    """
    from samii_rig.cli.arguments import check_rig

    check_rig(rig)
    for option, path, suffixes in (("--out", out, (".csv",)), ("--plot", plot, FIGURES)):
        if path is not None:
            check_target(option, path, suffixes)

    from samii_rig.errors import InputError
    from samii_rig.model.vary import vary as values_of
    from samii_rig.rig.load import load_rig

    the_rig, text = load_rig(rig)
    varied = [values_of(the_rig, given) for given in vary]

    from rich.console import Console

    from samii_rig.model.study import study as modes_over
    from samii_rig.progress import Counted
    from samii_rig.record.export import replacing
    from samii_rig.report.figures import save_figure
    from samii_rig.report.study import figure, table, write_csv
    from samii_rig.report.summary import working
    from samii_rig.workers import workers as at_work

    if plot is not None and len(varied) > 2:
        raise InputError("--plot", "", [v.name for v in varied], "one or two --vary to draw")
    console = Console(highlight=False)
    with ExitStack() as stack:
        # Opened first: a place that cannot be written to is said before the work, not after it.
        parts = [stack.enter_context(replacing(p)) if p else None for p in (out, plot)]
        say = stack.enter_context(
            working(Console(stderr=True, highlight=False), "study", quiet=json)
        )
        executor = stack.enter_context(at_work(workers, scheduler))
        found = modes_over(
            text,
            varied,
            band or (0.0, the_rig.rate_hz / 10),
            executor,
            lambda done, of: say(Counted("points", done, of)),
        )
        if parts[0]:
            write_csv(parts[0], found)
        if parts[1]:
            save_figure(parts[1], figure(found))
    written = [str(p) for p in (out, plot) if p]
    if json:
        say_json(
            {
                "varied": [v.name for v in varied],
                "modes": found.number.tolist(),
                "points": found.point.tolist(),
                "hz": found.hz.tolist(),
                "ratio": found.ratio.tolist(),
                "notes": list(found.note),
                "written": written,
            }
        )
        return
    console.print(table(found))
    for name in written:
        console.print(f"written  {name}", soft_wrap=True)
