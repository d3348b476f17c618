"""`samii-rig run`: the main job."""

from __future__ import annotations

import inspect
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from samii_rig.cli.common import JsonOption, RigOption, experiments, say_json
from samii_rig.cli.one_run import Done, Said, one_run
from samii_rig.cli.options import takes
from samii_rig.cli.predicted import say_predictions
from samii_rig.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from samii_rig.run.order import Order, RunOrder
    from samii_rig.run.outcome import Outcome
    from samii_rig.run.setups import Setup

# Exit codes of a run that did not go through; the recording is whole in each case.
EXIT = {"completed": 0, "stopped": 130, "tripped": 5, "failed": 6}


@dataclass(frozen=True, kw_only=True)
class RunOptions:
    """Words of `samii-rig run`."""

    experiment: Annotated[
        str,
        typer.Argument(
            help="Name of a shipped experiment (swept_sine, stepped_sine, multisine, torque_test, "
            "mode_scan, step), or the path of its file.",
            autocompletion=experiments,
        ),
    ]
    rig: RigOption = "samii"
    out: Annotated[
        Path | None,
        typer.Option(help="The recording's name [default: runs/TIME_RIG_EXPERIMENT.mcap]"),
    ] = None
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Predict, say the margins, move nothing.")
    ] = False
    describe: Annotated[
        bool, typer.Option("--describe", help="Say what the experiment's file can hold, and end.")
    ] = False
    seed: Annotated[
        int | None,
        typer.Option(
            help="Seed of the simulated rig's noise [default: drawn, and recorded]", min=0
        ),
    ] = None
    pose: Annotated[
        str | None,
        typer.Option(
            help='The pose the rig stands in, from the way down, such as "30 deg"; recorded '
            "[default: the rig file's]"
        ),
    ] = None
    operator: Annotated[str, typer.Option(help="Who stands at the rig; recorded.")] = ""
    heartbeat: Annotated[
        float | None,
        typer.Option(
            help="Seconds without a byte on standard input, held by the operator's client, after "
            "which the run trips [default: none is needed]",
            min=0.1,
        ),
    ] = None
    no_report: Annotated[bool, typer.Option("--no-report", help="Write no HTML page.")] = False
    no_diagnosis: Annotated[
        bool, typer.Option("--no-diagnosis", help="Do not look for what the model leaves out.")
    ] = False
    json: JsonOption = False


@takes(RunOptions)
def run(o: RunOptions) -> None:
    """Run an experiment: predict, drive, record, estimate, report.

    Before anything moves, the model predicts every peak; a plan that would break a limit is
    refused with the amplitude that would not. Ctrl-C ends at zero output with a whole recording.
    An experiment of several runs asks, on a real rig, for what is to be changed between them.

    Example: samii-rig run swept_sine --rig samii
    """
    from samii_rig.cli.arguments import check_experiment, check_rig
    from samii_rig.files import check_folder

    check_rig(o.rig)
    if o.out is not None and o.out.suffix != ".mcap":
        raise InputError("samii-rig run", "--out", str(o.out), "a name that ends in .mcap")
    if not o.describe:
        check_folder("--out", o.out.parent if o.out else Path("runs"))
    check_experiment(o.experiment)
    if o.describe:
        _describe(o.experiment, o.rig)
        return
    # Last: what is wrong in the words before is said without it.
    from rich.console import Console

    said = Said(
        Console(highlight=False),
        o.out,
        o.seed,
        o.operator,
        heartbeat=o.heartbeat,
        report=not o.no_report,
        diagnosis=not o.no_diagnosis,
        json=o.json,
    )
    raise typer.Exit(_ordered(o.experiment, o.rig, said, o.pose, dry_run=o.dry_run))


def _ordered(experiment: str, rig: str, said: Said, pose: str | None, *, dry_run: bool) -> int:
    """Predict, and unless that is all, carry out; the exit code."""
    from samii_rig.files import make_folder
    from samii_rig.report.summary import working
    from samii_rig.rig.load import load_rig
    from samii_rig.rig.pose import posed, posed_text
    from samii_rig.run.experiments import recording_stem
    from samii_rig.run.order import Order, refuse

    the_rig, rig_text = load_rig(rig)
    if pose is not None:
        the_rig, rig_text = posed(the_rig, pose), posed_text(rig_text, pose)
    order = Order.named(experiment, the_rig, rig_text)
    planned = order.runs()
    with working("predicting the run", quiet=said.json, console=said.console):
        runs = [run.predict(said.settings(i), said.operator) for i, run in enumerate(planned)]
    predicted = [run.predicted for run in runs]
    say_predictions(order.setups, predicted, said.console, dry_run=dry_run, json=said.json)
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


def _carry_out(
    setups: Sequence[Setup], runs: Sequence[RunOrder], path: Path, said: Said
) -> list[Done]:
    """One after the other, until one does not go through or somebody asks for an end."""
    done: list[Done] = []
    for i, (setup, run) in enumerate(zip(setups, runs, strict=True)):
        if setup.instruction:
            _ask(setup, i, len(setups), said)
        own = path.with_name(f"{path.stem}_{setup.name}.mcap") if setup.name else path
        # Between runs a person waits; `samii-rig diagnose` takes them all together.
        done.append(one_run(run, own, said, diagnosis=said.diagnosis and len(runs) == 1))
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
    done: Sequence[Done], of: int, last: str, concluded: _Concluded, said: Said
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


def _ask(setup: Setup, i: int, n: int, said: Said) -> None:
    """Have a person do what comes before a run; a simulated rig is so by itself."""
    text = f"run {i + 1} of {n}: {setup.instruction}"
    if setup.rig.device.simulated:
        if not said.json:
            said.console.print(f"\n{text} (simulated)")
        return
    typer.confirm(f"{text}. Done?", abort=True, err=True)
