"""`samii-rig prove`: concealed trials, diagnosed and scored."""

from __future__ import annotations

from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from samii_rig.cli.common import JsonOption, RigOption, SchedulerOption, WorkersOption, say_json

if TYPE_CHECKING:
    from samii_rig.prove.score import Score


def prove(
    out: Annotated[Path, typer.Option("--out", help="Folder of trials, answers and the page.")] = (
        Path("proof")
    ),
    rig: RigOption = "samii",
    nothing: Annotated[int, typer.Option(min=0, help="Trials that conceal nothing.")] = 300,
    one: Annotated[int, typer.Option(min=0, help="Trials that conceal one effect.")] = 430,
    two: Annotated[int, typer.Option(min=0, help="Trials that conceal two.")] = 150,
    joints: Annotated[
        int, typer.Option(min=0, help="Trials that conceal every joint's give.")
    ] = 40,
    outside: Annotated[
        int, typer.Option(min=0, help="Trials that conceal what the vocabulary has no word for.")
    ] = 150,
    seed: Annotated[
        int,
        typer.Option(help="Seed of the first trial of each kind. Thresholds were set below 1e6."),
    ] = 1_000_000,
    workers: WorkersOption = None,
    scheduler: SchedulerOption = "",
    keep: Annotated[
        bool, typer.Option("--keep", help="Keep the recordings (12 MB a trial).")
    ] = False,
    calibrate: Annotated[
        Path | None,
        typer.Option(
            help="Write the weights of stated probabilities that these trials give to this file."
        ),
    ] = None,
    json: JsonOption = False,
) -> None:
    """Conceal physics from the diagnosis, trial by trial, and score what it says.

    Trials that have an answer are not done again: stop at any time, call again to go on.

    Example: samii-rig prove --nothing 6 --one 28 --two 4 --outside 3 --out proof
    """
    from samii_rig.cli.arguments import check_rig

    check_rig(rig)

    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TimeRemainingColumn

    from samii_rig.files import check_file, check_folder
    from samii_rig.prove import campaign as trials
    from samii_rig.prove.page import write_page
    from samii_rig.prove.score import scores
    from samii_rig.rig.load import load_rig
    from samii_rig.workers import workers as at_work

    check_folder("--out", out)
    if calibrate is not None:
        check_file("--calibrate", calibrate)
    console = Console(highlight=False)
    _, text = load_rig(rig)
    campaign = trials.Campaign(out.resolve(), text, keep=keep)
    counts = {"nothing": nothing, "one": one, "two": two, "outside": outside, "joints": joints}
    todo = trials.jobs(counts, seed)
    trials.plant(campaign.plant)
    bar = Progress(
        "concealed trials",
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
        console=console,
    )
    with nullcontext() if json else bar, at_work(workers, scheduler) as executor:
        task = bar.add_task("trials", total=len(todo))
        failures = trials.carry_out(
            campaign, todo, executor, lambda n, _all: bar.update(task, completed=n)
        )
    found = trials.results(campaign.out)
    page = write_page(campaign.out / "proof.html", found)
    result = scores(found)
    if json:
        say_json(
            {
                "trials": len(found),
                "failures": failures,
                "scores": [_plain(s) for s in result],
                "page": page,
            }
        )
    else:
        for s in result:
            console.print(_line(s), soft_wrap=True)
        for failure in failures:
            console.print(f"failed     {failure}", soft_wrap=True)
        console.print(f"\npage       {page}", soft_wrap=True)
    if calibrate is not None:
        from samii_rig.prove import calibrate as regression

        rows = trials.evidence(campaign.out)
        origin = f"{len(rows)} trials with an effect found, of seeds from {seed}"
        place = regression.fit(trials.place_evidence(campaign.out))
        regression.write(calibrate, regression.fit(rows), origin, place)
    if failures:
        raise typer.Exit(1)


def _plain(s: Score) -> dict[str, Any]:
    return {
        "what": s.what,
        "value": s.value,
        "low": s.low,
        "high": s.high,
        "n": s.n,
        "goal": s.goal,
        "met": s.met,
    }


def _line(s: Score) -> str:
    word = {True: "met", False: "missed", None: ""}[s.met]
    return f"{s.what:<60} {s.value:7.3f}  ({s.low:.3f} to {s.high:.3f}, n = {s.n})  {word}"
