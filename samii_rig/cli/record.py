"""`samii-rig run`: the main job."""

from __future__ import annotations

import inspect
import re
import sys
from contextlib import nullcontext
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from samii_rig.cli.common import (
    JsonOption,
    RigOption,
    comparisons,
    experiments,
    response_json,
    say_json,
)

if TYPE_CHECKING:
    from collections.abc import Sequence

    from rich.console import Console

    from samii_rig.diagnose.result import Diagnosis
    from samii_rig.report.compare import ModelCurve
    from samii_rig.report.modes import Modes
    from samii_rig.run.campaign import Outcome
    from samii_rig.run.dryrun import DryRun
    from samii_rig.run.plan import Plan
    from samii_rig.run.setups import Setup

# Exit codes of a run that did not go through; the recording is whole in each case.
EXIT = {"completed": 0, "stopped": 130, "tripped": 5, "failed": 6}


def run(
    experiment: Annotated[
        str,
        typer.Argument(
            help="Name of a shipped experiment (swept_sine, stepped_sine, multisine, torque_test, "
            "mode_scan, step), or the path of its file.",
            autocompletion=experiments,
        ),
    ],
    rig: RigOption = "samii",
    out: Annotated[
        Path | None,
        typer.Option(help="The recording's name [default: runs/TIME_RIG_EXPERIMENT.mcap]"),
    ] = None,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Predict, say the margins, move nothing.")
    ] = False,
    describe: Annotated[
        bool, typer.Option("--describe", help="Say what the experiment's file can hold, and end.")
    ] = False,
    seed: Annotated[
        int | None,
        typer.Option(
            help="Seed of the simulated rig's noise [default: drawn, and recorded]", min=0
        ),
    ] = None,
    operator: Annotated[str, typer.Option(help="Who stands at the rig; recorded.")] = "",
    heartbeat: Annotated[
        float | None,
        typer.Option(
            help="Seconds without a byte on standard input, held by the operator's client, after "
            "which the run trips [default: none is needed]",
            min=0.1,
        ),
    ] = None,
    no_report: Annotated[bool, typer.Option("--no-report", help="Write no HTML page.")] = False,
    no_diagnosis: Annotated[
        bool, typer.Option("--no-diagnosis", help="Do not look for what the model leaves out.")
    ] = False,
    json: JsonOption = False,
) -> None:
    """Run an experiment: predict, drive, record, estimate, report.

    Before anything moves, the model predicts every peak; a plan that would break a limit is
    refused with the amplitude that would not. Ctrl-C ends at zero output with a whole recording.
    An experiment of several runs asks, on a real rig, for what is to be changed between them.

    Example: samii-rig run swept_sine --rig samii
    """
    from samii_rig.cli.arguments import check_experiment, check_rig

    check_rig(rig)
    check_experiment(experiment)

    from rich.console import Console

    from samii_rig.devices.opening import check_device
    from samii_rig.errors import EstimateError, InputError
    from samii_rig.files import check_folder, make_folder
    from samii_rig.report.summary import show_dry_run, working
    from samii_rig.rig.load import load_rig
    from samii_rig.run.dryrun import predict
    from samii_rig.run.experiments import load_experiment, plan_of
    from samii_rig.run.setups import Concludes, conclusion_of, setups_of
    from samii_rig.run.space import room_for

    console = Console(highlight=False)
    if out is not None and out.suffix != ".mcap":
        raise InputError("samii-rig run", "--out", str(out), "a name that ends in .mcap")
    if not describe:
        check_folder("--out", out.parent if out else Path("runs"))
    the_rig, rig_text = load_rig(rig)
    the_experiment, experiment_text = load_experiment(experiment, the_rig)
    if describe:
        _describe(the_experiment, experiment_text)
        return
    setups = setups_of(the_experiment, the_rig, rig_text)
    plans = [plan_of(the_experiment, s.rig) for s in setups]
    for s in setups:
        check_device(s.rig)
    with working(console, "predicting the run", quiet=json):
        predicted = [predict(p, s.rig) for p, s in zip(plans, setups, strict=True)]
    if not json:
        # Of several runs the one that comes nearest to a limit.
        worst = min(range(len(setups)), key=lambda i: predicted[i].margins[0].margin)
        if len(setups) > 1:
            which = f"{setups[worst].instruction}, nearest to a limit of {len(setups)} runs"
            console.print(f"run {worst + 1}, {which}:")
        show_dry_run(predicted[worst], console)
    elif dry_run and len(setups) == 1:
        say_json({"status": "predicted", "dry_run": _prediction(predicted[0])})
    elif dry_run:
        say_json({"status": "predicted", "dry_runs": [_prediction(p) for p in predicted]})
    for p in predicted:
        p.refuse()
    slug = re.sub(r"[^a-z0-9]+", "_", the_rig.name.lower()).strip("_")
    name = plans[0].experiment
    path = out or Path("runs") / f"{datetime.now():%Y-%m-%dT%H-%M-%S}_{slug}_{name}.mcap"
    room_for(path, plans, [s.rig for s in setups])
    if dry_run:
        return
    make_folder("--out", path.parent)
    done: list[_Done] = []
    for i, (setup, plan) in enumerate(zip(setups, plans, strict=True)):
        if setup.instruction:
            _ask(setup, i, len(setups), console, json)
        own = path.with_name(f"{path.stem}_{setup.name}.mcap") if setup.name else path
        settings: dict[str, object] = {} if seed is None else {"seed": seed + i}
        done.append(
            _carry_out(
                setup,
                experiment_text,
                plan,
                predicted[i],
                own,
                settings,
                operator,
                console,
                heartbeat=heartbeat,
                report=not no_report,
                # Between runs a person waits; `samii-rig diagnose` takes them all together.
                diagnosis=not no_diagnosis and len(setups) == 1,
                json=json,
            )
        )
        if done[-1].outcome.stop.status != "completed" or done[-1].outcome.interrupted:
            break
    lines: tuple[str, ...] = ()
    written: tuple[Path, ...] = ()
    defect = 0  # of the experiment itself, which the recordings do not suffer from
    last = done[-1].outcome.stop.status
    if last == "completed" and len(done) < len(setups):
        # A signal came while the last run was estimated or diagnosed: nothing moves any more.
        last = "stopped"
    if last == "completed" and isinstance(the_experiment, Concludes):
        outcomes = [d.outcome for d in done]
        try:
            rigs = [s.rig for s in setups]
            found = conclusion_of(the_experiment, rigs, outcomes, path.with_suffix(""))
            lines, written = found.lines, found.written
        except (EstimateError, InputError) as error:
            lines = (f"no conclusion: {error}",)
            defect = error.exit_code if isinstance(error, InputError) else 0
    if json:
        runs = [d.as_json() for d in done]
        concluded = {"conclusion": lines, "written": written} if lines else {}
        say_json({**(runs[0] if len(setups) == 1 else {"status": last, "runs": runs}), **concluded})
    else:
        if lines:
            console.print()
        for line in lines:
            console.print(line, soft_wrap=True)
        for file in written:
            console.print(f"written    {file}", soft_wrap=True)
    raise typer.Exit(EXIT.get(last, 1) or defect)


def _describe(experiment: object, text: str) -> None:
    """The file as it is, then what each of its classes says of the fields."""
    from samii_rig.rig.schema import Strict

    typer.echo(text.rstrip())
    for kind in type(experiment).__mro__:
        if issubclass(kind, Strict) and kind is not Strict and kind.__doc__:
            typer.echo(f"\n{inspect.cleandoc(kind.__doc__)}")


def _ask(setup: Setup, i: int, n: int, console: Console, json: bool) -> None:
    """Have a person do what comes before a run; a simulated rig is so by itself."""
    text = f"run {i + 1} of {n}: {setup.instruction}"
    if setup.rig.device.driver == "simulated":
        if not json:
            console.print(f"\n{text} (simulated)")
        return
    typer.confirm(f"{text}. Done?", abort=True, err=True)


@dataclass(frozen=True, slots=True)
class _Done:
    """One run, with what is said of it."""

    outcome: Outcome
    predicted: DryRun
    curve: ModelCurve | None
    page: Path | None
    diagnosis: Diagnosis | None

    def as_json(self) -> dict[str, Any]:
        """As plain data."""
        o = self.outcome
        return {
            "status": o.stop.status,
            "reason": o.stop.reason,
            "recording": o.path,
            "report": self.page,
            "trouble": o.trouble,
            "dry_run": _prediction(self.predicted),
            "responses": [response_json(r) for r in o.responses],
            "model_over_measurement": comparisons(o.responses, self.curve),
            "diagnosis": self.diagnosis.plain() if self.diagnosis else None,
        }


def _carry_out(
    setup: Setup,
    experiment_text: str,
    plan: Plan,
    predicted: DryRun,
    path: Path,
    settings: dict[str, object],
    operator: str,
    console: Console,
    *,
    heartbeat: float | None,
    report: bool,
    diagnosis: bool,
    json: bool,
) -> _Done:
    """One run with its page, and its summary on the console."""
    from samii_rig.cli.diagnose import keep_diagnosis
    from samii_rig.report.compare import model_curve
    from samii_rig.report.modes import modes_of_all
    from samii_rig.report.summary import LiveProgress, summary
    from samii_rig.run.campaign import carry_out
    from samii_rig.run.heartbeat import Pipe
    from samii_rig.run.pace import LoopSettings

    device = setup.rig.device
    # Simulated time runs as fast as the processor can, unless it is told a pace.
    own_time = device.driver == "simulated" and not device.settings.get("pace")
    live = LiveProgress(console, plan.duration, "rig time" if own_time else "")
    with nullcontext() if json else live:
        outcome = carry_out(
            setup.rig,
            setup.rig_toml,
            experiment_text,
            plan,
            predicted,
            path,
            settings=settings,
            operator=operator,
            progress=None if json else live,
            alive=Pipe(sys.stdin.fileno()) if heartbeat else None,
            loop=LoopSettings(heartbeat_age=heartbeat) if heartbeat else None,
        )
    curve = model_curve(setup.rig, outcome.responses)
    found = _diagnosed(setup, outcome, console, json=json) if diagnosis else None
    if found:
        keep_diagnosis([path], found)
    modes = modes_of_all(outcome.responses, setup.rig) if report or not json else ()
    page = _page(setup, outcome, curve, found, modes) if report else None
    if not json:
        console.print()
        console.print(summary([outcome.recording], outcome.responses, curve, modes=modes))
        if outcome.trouble:
            console.print(f"\nno frequency response: {outcome.trouble}")
        if found:
            console.print()
            for line in found.lines():
                console.print(line, soft_wrap=True)
        console.print(f"\nrecording  {path}", soft_wrap=True)
        if page:
            console.print(f"report     {page}", soft_wrap=True)
    return _Done(outcome, predicted, curve, page, found)


def _page(
    setup: Setup,
    outcome: Outcome,
    curve: ModelCurve | None,
    found: Diagnosis | None,
    modes: Sequence[Modes],
) -> Path | None:
    """The run's page, beside its recording; None where it cannot be written, which is said."""
    from samii_rig.errors import InputError
    from samii_rig.record.reader import read_events
    from samii_rig.report.page import write_report

    try:
        return write_report(
            outcome.path.with_suffix(".html"),
            outcome.recording,
            outcome.responses,
            rig=setup.rig,
            model=curve,
            events=read_events(outcome.path),
            diagnosis=found,
            modes=modes,
        )
    except (InputError, OSError) as error:
        # The run is over and its recording whole: what is known of it is still to be told.
        typer.echo(f"samii-rig: no page: {error}; samii-rig report makes it", err=True)
        return None


def _diagnosed(setup: Setup, outcome: Outcome, console: Console, *, json: bool) -> Diagnosis | None:
    """What the rig file leaves out; None where the run has nothing to tell that from."""
    from samii_rig.diagnose.diagnose import diagnose
    from samii_rig.errors import EstimateError, InputError
    from samii_rig.report.summary import working

    # Who stopped a run, or whose run tripped, wants to see that first.
    if not outcome.responses or outcome.stop.status != "completed" or outcome.interrupted:
        return None
    try:
        with working(console, "diagnosis", quiet=json) as say:
            runs = [outcome.recording]
            return diagnose(outcome.responses, setup.rig, progress=say, runs=runs)
    except (EstimateError, InputError) as error:
        why = str(error)
    except KeyboardInterrupt:
        # The run itself is over and whole; its page is still to be written.
        why = "stopped by Ctrl-C; `samii-rig diagnose` makes it up"
    if not json:
        console.print(f"no diagnosis: {why}", soft_wrap=True)
    return None


def _prediction(predicted: DryRun) -> dict[str, Any]:
    return {
        "duration_s": predicted.duration,
        "shortest_s": predicted.shortest,
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
                **({"input": b.input} if b.input else {}),
            }
            for b in predicted.bands
        ],
    }
