"""`samii-rig run`: the main job."""

from __future__ import annotations

import re
from contextlib import nullcontext
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from samii_rig.cli.common import (
    JsonOption,
    RigOption,
    comparisons,
    model_curve,
    response_json,
    say_json,
)

if TYPE_CHECKING:
    from samii_rig.run.dryrun import DryRun

# Exit codes of a run that did not go through; the recording is whole in each case.
EXIT = {"completed": 0, "stopped": 130, "tripped": 5, "failed": 6}


def run(
    experiment: Annotated[
        str, typer.Argument(help="Name of a shipped experiment, or the path of its file.")
    ],
    rig: RigOption = "samii",
    out: Annotated[
        Path | None,
        typer.Option(help="The recording's name [default: runs/TIME_RIG_EXPERIMENT.mcap]"),
    ] = None,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Predict, say the margins, move nothing.")
    ] = False,
    seed: Annotated[
        int | None,
        typer.Option(
            help="Seed of the simulated rig's noise [default: drawn, and recorded]", min=0
        ),
    ] = None,
    operator: Annotated[str, typer.Option(help="Who stands at the rig; recorded.")] = "",
    no_report: Annotated[bool, typer.Option("--no-report", help="Write no HTML page.")] = False,
    json: JsonOption = False,
) -> None:
    """Run an experiment: predict, drive, record, estimate, report.

    Before anything moves, the model predicts every peak; a plan that would break a limit is
    refused with the amplitude that would not. Ctrl-C ends at zero output with a whole recording.

    Example: samii-rig run swept_sine --rig samii
    """
    from rich.console import Console

    from samii_rig.errors import InputError
    from samii_rig.report.summary import LiveProgress, show_dry_run, summary
    from samii_rig.rig.load import load_rig
    from samii_rig.run.campaign import carry_out
    from samii_rig.run.dryrun import predict
    from samii_rig.run.experiments import load_experiment

    console = Console(highlight=False)
    if out is not None and out.suffix != ".mcap":
        raise InputError("samii-rig run", "--out", str(out), "a name that ends in .mcap")
    the_rig, rig_text = load_rig(rig)
    plan_file, experiment_text = load_experiment(experiment, the_rig)
    plan = plan_file.plan(the_rig)
    with nullcontext() if json else console.status("predicting the run ..."):
        predicted = predict(plan, the_rig)
    if not json:
        show_dry_run(predicted, console)
    elif dry_run:
        say_json({"status": "predicted", "dry_run": _prediction(predicted)})
    predicted.refuse()
    if dry_run:
        return
    slug = re.sub(r"[^a-z0-9]+", "_", the_rig.name.lower()).strip("_")
    path = out or Path("runs") / f"{datetime.now():%Y-%m-%dT%H-%M-%S}_{slug}_{plan.experiment}.mcap"
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        expected = f"a folder that can be made ({error.strerror})"
        raise InputError("samii-rig run", "--out", str(path.parent), expected) from error
    live = LiveProgress(console, plan.duration)
    with nullcontext() if json else live:
        outcome = carry_out(
            the_rig,
            rig_text,
            experiment_text,
            plan,
            predicted,
            path,
            settings={} if seed is None else {"seed": seed},
            operator=operator,
            progress=None if json else live,
        )
    curve = model_curve(the_rig, outcome.responses)
    page = None
    if not no_report:
        from samii_rig.record.reader import read_events
        from samii_rig.report.page import write_report

        page = write_report(
            path.with_suffix(".html"),
            outcome.recording,
            outcome.responses,
            rig=the_rig,
            model=curve,
            events=read_events(path),
        )
    if json:
        say_json(
            {
                "status": outcome.stop.status,
                "reason": outcome.stop.reason,
                "recording": path,
                "report": page,
                "trouble": outcome.trouble,
                "dry_run": _prediction(predicted),
                "responses": [response_json(r) for r in outcome.responses],
                "model_over_measurement": comparisons(outcome.responses, curve),
            }
        )
    else:
        console.print()
        console.print(summary([outcome.recording], outcome.responses, curve))
        if outcome.trouble:
            console.print(f"\nno frequency response: {outcome.trouble}")
        console.print(f"\nrecording  {path}", soft_wrap=True)
        if page:
            console.print(f"report     {page}", soft_wrap=True)
    raise typer.Exit(EXIT.get(outcome.stop.status, 1))


def _prediction(predicted: DryRun) -> dict[str, Any]:
    return {
        "duration_s": predicted.duration,
        "margins": [
            {
                "channel": m.channel,
                "what": m.what,
                "predicted": m.predicted,
                "limit": m.limit,
                "unit": m.unit,
                "margin": m.margin,
                "largest_level": m.largest_level,
                "level_unit": m.level_unit,
            }
            for m in predicted.margins
        ],
        "bands": [
            {
                "channel": b.channel,
                "level": b.level,
                "low_hz": b.low_hz,
                "high_hz": b.high_hz,
                "std": b.std,
                "relative": b.relative,
            }
            for b in predicted.bands
        ],
    }
