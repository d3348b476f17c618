"""`samii-rig run`: the main job."""

from __future__ import annotations

import inspect
import sys
from contextlib import nullcontext
from dataclasses import dataclass
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
from samii_rig.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from rich.console import Console

    from samii_rig.diagnose.result import Diagnosis
    from samii_rig.report.compare import ModelCurve
    from samii_rig.report.modes import Modes
    from samii_rig.rig.schema import Rig
    from samii_rig.run.dryrun import DryRun
    from samii_rig.run.order import Order, RunOrder
    from samii_rig.run.outcome import Outcome
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
    from rich.console import Console

    from samii_rig.cli.arguments import check_experiment, check_rig

    check_rig(rig)
    check_experiment(experiment)
    if out is not None and out.suffix != ".mcap":
        raise InputError("samii-rig run", "--out", str(out), "a name that ends in .mcap")
    if describe:
        _describe(experiment, rig)
        return
    said = _Said(
        Console(highlight=False),
        out,
        seed,
        operator,
        heartbeat=heartbeat,
        report=not no_report,
        diagnosis=not no_diagnosis,
        json=json,
    )
    raise typer.Exit(_ordered(experiment, rig, said, dry_run=dry_run))


@dataclass(frozen=True, slots=True)
class _Said:
    """What the command line says beside rig and experiment, and where it is answered."""

    console: Console
    out: Path | None
    seed: int | None
    operator: str
    heartbeat: float | None
    report: bool
    diagnosis: bool
    json: bool

    def settings(self, i: int) -> dict[str, object]:
        """Of the device, in run number `i`: no two runs have the same noise."""
        return {} if self.seed is None else {"seed": self.seed + i}


def _ordered(experiment: str, rig: str, said: _Said, *, dry_run: bool) -> int:
    """Predict, and unless that is all, carry out; the exit code."""
    from samii_rig.files import check_folder, make_folder
    from samii_rig.report.summary import working
    from samii_rig.rig.load import load_rig
    from samii_rig.run.experiments import recording_stem
    from samii_rig.run.order import Order, refuse

    check_folder("--out", said.out.parent if said.out else Path("runs"))
    the_rig, rig_text = load_rig(rig)
    order = Order.named(experiment, the_rig, rig_text)
    planned = order.runs()
    with working(said.console, "predicting the run", quiet=said.json):
        runs = [run.predict(said.settings(i), said.operator) for i, run in enumerate(planned)]
    _say_predictions(order.setups, [run.predicted for run in runs], said, dry_run=dry_run)
    path = said.out or Path("runs") / f"{recording_stem(the_rig, runs[0].plan.experiment)}.mcap"
    refuse(runs, path)
    if dry_run:
        return 0
    make_folder("--out", path.parent)
    done = _carry_out(order.setups, runs, path, said)
    last = done[-1].outcome.stop.status
    if last == "completed" and len(done) < len(runs):
        # A signal came while the last run was estimated or diagnosed: nothing moves any more.
        last = "stopped"
    concluded = _Concluded()
    if last == "completed":
        concluded = _conclude(order, [d.outcome for d in done], path)
    _say_conclusion(done, len(runs), last, concluded, said)
    return EXIT.get(last, 1) or concluded.defect


def _say_predictions(
    setups: Sequence[Setup], predicted: Sequence[DryRun], said: _Said, *, dry_run: bool
) -> None:
    from samii_rig.report.summary import show_dry_run

    if said.json:
        if dry_run and len(setups) == 1:
            say_json({"status": "predicted", "dry_run": _prediction(predicted[0])})
        elif dry_run:
            say_json({"status": "predicted", "dry_runs": [_prediction(p) for p in predicted]})
        return
    # Of several runs the one that comes nearest to a limit.
    worst = min(range(len(setups)), key=lambda i: predicted[i].margins[0].margin)
    if len(setups) > 1:
        which = f"{setups[worst].instruction}, nearest to a limit of {len(setups)} runs"
        said.console.print(f"run {worst + 1}, {which}:")
    show_dry_run(predicted[worst], said.console)


def _carry_out(
    setups: Sequence[Setup], runs: Sequence[RunOrder], path: Path, said: _Said
) -> list[_Done]:
    """One after the other, until one does not go through or somebody asks for an end."""
    done: list[_Done] = []
    for i, (setup, run) in enumerate(zip(setups, runs, strict=True)):
        if setup.instruction:
            _ask(setup, i, len(setups), said)
        own = path.with_name(f"{path.stem}_{setup.name}.mcap") if setup.name else path
        # Between runs a person waits; `samii-rig diagnose` takes them all together.
        done.append(_one(run, own, said, diagnosis=said.diagnosis and len(runs) == 1))
        if not done[-1].outcome.completed:
            break
    return done


@dataclass(frozen=True, slots=True)
class _Concluded:
    """What an experiment made of its runs. defect : exit code of a failure of the experiment
    itself, which the recordings do not suffer from; 0 for none."""

    lines: tuple[str, ...] = ()
    written: tuple[Path, ...] = ()
    defect: int = 0


def _conclude(order: Order, outcomes: Sequence[Outcome], path: Path) -> _Concluded:
    from samii_rig.errors import EstimateError
    from samii_rig.run.setups import Concludes, conclusion_of

    if not isinstance(order.experiment, Concludes):
        return _Concluded()
    try:
        rigs = [s.rig for s in order.setups]
        found = conclusion_of(order.experiment, rigs, outcomes, path.with_suffix(""))
        return _Concluded(found.lines, found.written)
    except (EstimateError, InputError) as error:
        defect = error.exit_code if isinstance(error, InputError) else 0
        return _Concluded((f"no conclusion: {error}",), defect=defect)


def _say_conclusion(
    done: Sequence[_Done], of: int, last: str, concluded: _Concluded, said: _Said
) -> None:
    lines, written = concluded.lines, concluded.written
    if said.json:
        runs = [d.as_json() for d in done]
        more = {"conclusion": lines, "written": written} if lines else {}
        say_json({**(runs[0] if of == 1 else {"status": last, "runs": runs}), **more})
        return
    if lines:
        said.console.print()
    for line in lines:
        said.console.print(line, soft_wrap=True)
    for file in written:
        said.console.print(f"written    {file}", soft_wrap=True)


def _describe(name: str, rig: str) -> None:
    """The file as it is, then what each of its classes says of the fields."""
    from samii_rig.rig.load import load_rig
    from samii_rig.rig.schema import Strict
    from samii_rig.run.experiments import load_experiment

    experiment, text = load_experiment(name, load_rig(rig)[0])
    typer.echo(text.rstrip())
    for kind in type(experiment).__mro__:
        if issubclass(kind, Strict) and kind is not Strict and kind.__doc__:
            typer.echo(f"\n{inspect.cleandoc(kind.__doc__)}")


def _ask(setup: Setup, i: int, n: int, said: _Said) -> None:
    """Have a person do what comes before a run; a simulated rig is so by itself."""
    text = f"run {i + 1} of {n}: {setup.instruction}"
    if setup.rig.device.simulated:
        if not said.json:
            said.console.print(f"\n{text} (simulated)")
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


def _one(order: RunOrder, path: Path, said: _Said, *, diagnosis: bool) -> _Done:
    """One run with its page, and its summary on the console."""
    from samii_rig.cli.diagnose import keep_diagnosis
    from samii_rig.report.compare import model_curve
    from samii_rig.report.modes import modes_of_all

    outcome = _driven(order, path, said)
    curve = model_curve(order.rig, outcome.responses)
    found = _diagnosed(order.rig, outcome, said) if diagnosis else None
    if found:
        keep_diagnosis([path], found)
    modes = modes_of_all(outcome.responses, order.rig) if said.report or not said.json else ()
    page = _page(order.rig, outcome, curve, found, modes) if said.report else None
    done = _Done(outcome, order.predicted, curve, page, found)
    if not said.json:
        _show(done, modes, said.console)
    return done


def _driven(order: RunOrder, path: Path, said: _Said) -> Outcome:
    """The run itself, with its progress on the console."""
    from samii_rig.report.summary import LiveProgress
    from samii_rig.run.campaign import carry_out
    from samii_rig.run.heartbeat import Pipe
    from samii_rig.run.pace import LoopSettings

    device, heartbeat = order.rig.device, said.heartbeat
    # Simulated time runs as fast as the processor can, unless it is told a pace.
    own_time = device.simulated and not device.settings.get("pace")
    live = LiveProgress(said.console, order.plan.duration, "rig time" if own_time else "")
    with nullcontext() if said.json else live:
        return carry_out(
            order,
            path,
            progress=None if said.json else live,
            alive=Pipe(sys.stdin.fileno()) if heartbeat else None,
            loop=LoopSettings(heartbeat_age=heartbeat) if heartbeat else None,
        )


def _show(done: _Done, modes: Sequence[Modes], console: Console) -> None:
    from samii_rig.report.summary import summary

    outcome = done.outcome
    console.print()
    console.print(summary([outcome.recording], outcome.responses, done.curve, modes=modes))
    if outcome.trouble:
        console.print(f"\nno frequency response: {outcome.trouble}")
    if done.diagnosis:
        console.print()
        for line in done.diagnosis.lines():
            console.print(line, soft_wrap=True)
    console.print(f"\nrecording  {outcome.path}", soft_wrap=True)
    if done.page:
        console.print(f"report     {done.page}", soft_wrap=True)


def _page(
    rig: Rig,
    outcome: Outcome,
    curve: ModelCurve | None,
    found: Diagnosis | None,
    modes: Sequence[Modes],
) -> Path | None:
    """The run's page, beside its recording; None where it cannot be written, which is said."""
    from samii_rig.record.reader import read_events
    from samii_rig.report.page import write_report

    try:
        return write_report(
            outcome.path.with_suffix(".html"),
            outcome.recording,
            outcome.responses,
            rig=rig,
            model=curve,
            events=read_events(outcome.path),
            diagnosis=found,
            modes=modes,
        )
    except (InputError, OSError) as error:
        # The run is over and its recording whole: what is known of it is still to be told.
        typer.echo(f"samii-rig: no page: {error}; samii-rig report makes it", err=True)
        return None


def _diagnosed(rig: Rig, outcome: Outcome, said: _Said) -> Diagnosis | None:
    """What the rig file leaves out; None where the run has nothing to tell that from."""
    from samii_rig.diagnose.diagnose import diagnose
    from samii_rig.errors import EstimateError
    from samii_rig.report.summary import working

    # Who stopped a run, or whose run tripped, wants to see that first.
    if not outcome.responses or not outcome.completed:
        return None
    try:
        with working(said.console, "diagnosis", quiet=said.json) as say:
            runs = [outcome.recording]
            return diagnose(outcome.responses, rig, progress=say, runs=runs)
    except (EstimateError, InputError) as error:
        why = str(error)
    except KeyboardInterrupt:
        # The run itself is over and whole; its page is still to be written.
        why = "stopped by Ctrl-C; `samii-rig diagnose` makes it up"
    if not said.json:
        said.console.print(f"no diagnosis: {why}", soft_wrap=True)
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
