"""`samii-rig study`: how the modes of a rig move with its parameters."""

from __future__ import annotations

from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

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
from samii_rig.cli.estimate import BandOption, say_written
from samii_rig.cli.options import takes

if TYPE_CHECKING:
    from samii_rig.model.study import Study


@dataclass(frozen=True, kw_only=True)
class StudyOptions:
    """Words of `samii-rig study`."""

    vary: Annotated[
        list[str],
        typer.Option(
            help="element.symbol=LOW:HIGH:N in equal steps, or LOW:HIGH:N:log in equal ratios; may "
            "be repeated for a grid."
        ),
    ]
    rig: RigOption = "samii"
    band: BandOption = None
    out: Annotated[Path | None, typer.Option(help="Write every point to this .csv file.")] = None
    plot: Annotated[
        Path | None,
        typer.Option(help="Draw it, over one or two parameters (.png, .svg or .pdf)."),
    ] = None
    workers: WorkersOption = None
    scheduler: SchedulerOption = ""
    json: JsonOption = False


@takes(StudyOptions)
def study(o: StudyOptions) -> None:
    """Vary parameters over a grid: frequency and damping of every mode in the band.

    Without --band the modes up to a tenth of the sample rate.

    Example: samii-rig study --rig samii --vary joint_1.k=6800:27200:21:log --plot study.png
    """
    from samii_rig.cli.arguments import check_rig

    check_rig(o.rig)
    for option, path, suffixes in (("--out", o.out, (".csv",)), ("--plot", o.plot, FIGURES)):
        if path is not None:
            check_target(option, path, suffixes)

    found = _found(o)
    written = [str(p) for p in (o.out, o.plot) if p]
    if o.json:
        say_json(
            {
                "varied": [v.name for v in found.varied],
                "modes": found.number.tolist(),
                "points": found.point.tolist(),
                "hz": found.hz.tolist(),
                "ratio": found.ratio.tolist(),
                "notes": list(found.note),
                "written": written,
            }
        )
        return

    from rich.console import Console

    from samii_rig.report.study import table

    console = Console(highlight=False)
    console.print(table(found))
    say_written(console, written)


def _found(o: StudyOptions) -> Study:
    """The modes at every point, written where it is asked for."""
    from samii_rig.errors import InputError
    from samii_rig.model.vary import vary as values_of
    from samii_rig.rig.load import load_rig

    rig, text = load_rig(o.rig)
    varied = [values_of(rig, given) for given in o.vary]

    from samii_rig.model.study import study as modes_over
    from samii_rig.progress import Counted
    from samii_rig.record.export import replacing
    from samii_rig.report.figures import save_figure
    from samii_rig.report.study import figure, write_csv
    from samii_rig.report.summary import working
    from samii_rig.workers import workers as at_work

    if o.plot is not None and len(varied) > 2:
        raise InputError("--plot", "", [v.name for v in varied], "one or two --vary to draw")
    with ExitStack() as stack:
        # Opened first: a place that cannot be written to is said before the work, not after it.
        parts = [stack.enter_context(replacing(p)) if p else None for p in (o.out, o.plot)]
        say = stack.enter_context(working("study", quiet=o.json))
        executor = stack.enter_context(at_work(o.workers, o.scheduler))
        found = modes_over(
            text,
            varied,
            o.band or (0.0, rig.rate_hz / 10),
            executor,
            lambda done, of: say(Counted("points", done, of)),
        )
        if parts[0]:
            write_csv(parts[0], found)
        if parts[1]:
            save_figure(parts[1], figure(found))
    return found
