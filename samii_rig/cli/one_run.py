"""One run of `samii-rig run`, with its page, its diagnosis and what is said of it."""

from __future__ import annotations

import sys
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from samii_rig.cli.common import comparisons, response_json
from samii_rig.cli.predicted import prediction
from samii_rig.errors import NO_MEMORY, InputError, RecordedError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from rich.console import Console

    from samii_rig.diagnose.result import Diagnosis
    from samii_rig.report.compare import ModelCurve
    from samii_rig.report.modes import Modes
    from samii_rig.rig.schema import Rig
    from samii_rig.run.dryrun import DryRun
    from samii_rig.run.order import RunOrder
    from samii_rig.run.outcome import Outcome


@dataclass(frozen=True, slots=True)
class Said:
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


@dataclass(frozen=True, slots=True)
class Done:
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
            "dry_run": prediction(self.predicted),
            "responses": [response_json(r) for r in o.responses],
            "model_over_measurement": comparisons(o.responses, self.curve),
            "diagnosis": self.diagnosis.plain() if self.diagnosis else None,
        }


def one_run(order: RunOrder, path: Path, said: Said, *, diagnosis: bool) -> Done:
    """One run with its page, and its summary on the console."""
    outcome = _driven(order, path, said)
    try:
        return _evaluated(order, outcome, said, diagnosis=diagnosis)
    except MemoryError as error:
        raise RecordedError(path, outcome.stop.status, NO_MEMORY) from error


def _evaluated(order: RunOrder, outcome: Outcome, said: Said, *, diagnosis: bool) -> Done:
    """What is said of a run that is over."""
    from samii_rig.cli.diagnose import keep_diagnosis
    from samii_rig.report.compare import model_curve
    from samii_rig.report.modes import modes_of_all

    curve = model_curve(order.rig, outcome.responses)
    found = _diagnosed(order.rig, outcome, said) if diagnosis else None
    if found:
        keep_diagnosis([outcome.path], found)
    modes = modes_of_all(outcome.responses, order.rig) if said.report or not said.json else ()
    page = _page(order.rig, outcome, curve, found, modes) if said.report else None
    done = Done(outcome, order.predicted, curve, page, found)
    if not said.json:
        _show(done, modes, said.console)
    return done


def _driven(order: RunOrder, path: Path, said: Said) -> Outcome:
    """The run itself, with its progress on the console."""
    from samii_rig.report.summary import LiveProgress
    from samii_rig.run.campaign import carry_out
    from samii_rig.run.client import Client
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
            Client(
                progress=None if said.json else live,
                alive=Pipe(sys.stdin.fileno()) if heartbeat else None,
            ),
            loop=LoopSettings(heartbeat_age=heartbeat) if heartbeat else None,
        )


def _show(done: Done, modes: Sequence[Modes], console: Console) -> None:
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
    from samii_rig.report.page import Subject, write_report

    try:
        return write_report(
            outcome.path.with_suffix(".html"),
            Subject(
                [outcome.recording],
                outcome.responses,
                rig,
                curve,
                events=read_events(outcome.path),
                modes=modes,
            ),
            diagnosis=found,
        )
    except (InputError, OSError) as error:
        # The run is over and its recording whole: what is known of it is still to be told.
        typer.echo(f"samii-rig: no page: {error}; samii-rig report makes it", err=True)
        return None


def _diagnosed(rig: Rig, outcome: Outcome, said: Said) -> Diagnosis | None:
    """What the rig file leaves out; None where the run has nothing to tell that from."""
    from samii_rig.diagnose.diagnose import diagnose
    from samii_rig.errors import EstimateError
    from samii_rig.report.summary import working

    # Who stopped a run, or whose run tripped, wants to see that first.
    if not outcome.responses or not outcome.completed:
        return None
    try:
        with working("diagnosis", quiet=said.json, console=said.console) as say:
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
