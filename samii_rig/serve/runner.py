"""One run in a process of its own.

    python -m samii_rig.serve.runner JOB_FOLDER RECORDINGS LOCK

LOCK is the descriptor of the job's lock, held by whoever started this and from now on by this
process alone. It shares no pipe, no terminal and no parent with the service, so that it goes on
when the service is killed; how it stands is in the job's folder and in the live data. A signal
ends it at zero.
"""

from __future__ import annotations

import math
import os
import sys
from contextlib import suppress
from dataclasses import asdict, replace
from pathlib import Path
from threading import Event
from typing import Any

from samii_rig.errors import GateError, SamiiRigError
from samii_rig.index.remarks import add_note, set_diagnosis
from samii_rig.rig.load import parse
from samii_rig.rig.schema import Rig
from samii_rig.run.campaign import Outcome, carry_out
from samii_rig.run.dryrun import predict
from samii_rig.run.experiments import load_experiment
from samii_rig.run.progress import Progress
from samii_rig.run.protocols import Plan
from samii_rig.run.setups import Setup, setups_of
from samii_rig.serve.job import EXPERIMENT, RIG, Job, JobState
from samii_rig.serve.live import LiveWriter, live_folder
from samii_rig.types import SampleBlock

# s without a sign of the service after which it counts as gone: it gives one every half second.
LOST_AFTER = 5.0


class Runner:
    """One run. recordings : the folder in which its recording will lie."""

    def __init__(self, job: Job, recordings: Path) -> None:
        self.job, self.request = job, job.request
        self.path = recordings / self.request.recording
        self.state = JobState()
        self.live: LiveWriter | None = None
        self.stop = Event()
        self.lost = False

    def go(self) -> None:
        """From the files of the job to the recording and its diagnosis."""
        live = live_folder() / f"{self.job.id}.live"
        self._set(phase="starting", pid=os.getpid(), live=str(live))
        try:
            setup, text, plan = self._planned()
            outcome = self._carry_out(setup, text, plan, live)
            self._set(
                phase="analysing",
                status=outcome.stop.status,
                reason=outcome.stop.reason,
                trouble=outcome.trouble,
            )
            self._note()
            verdict = self._diagnosed(setup, outcome)
            self._set(phase="done", verdict=verdict)
        except SamiiRigError as error:
            self._set(phase="refused", error=str(error))
            raise
        except BaseException as error:
            self._set(phase="refused", error=f"{type(error).__name__}: {error}")
            raise
        finally:
            if self.live is not None:
                self.live.close()

    def _set(self, **changes: Any) -> None:
        self.state = replace(self.state, **changes)
        self.job.set(self.state)

    def _planned(self) -> tuple[Setup, str, Plan]:
        rig_toml = (self.job.folder / RIG).read_text(encoding="utf-8")
        rig = parse(Rig, rig_toml, RIG)
        experiment, text = load_experiment(str(self.job.folder / EXPERIMENT), rig)
        setup = setups_of(experiment, rig, rig_toml)[self.request.setup]
        return setup, text, experiment.plan(setup.rig)

    def _carry_out(self, setup: Setup, text: str, plan: Plan, live: Path) -> Outcome:
        predicted = predict(plan, setup.rig)
        if self.job.stops():
            raise GateError("stopped before anything moved")
        self._set(phase="running")

        def watch(block: SampleBlock) -> None:
            # A display that fails is none of the run's business.
            with suppress(Exception):
                if self.live is None:
                    self.live = LiveWriter(live, block.channels, plan.rate_hz)
                self.live.samples(block)

        def progress(now: Progress) -> None:
            if self.live is not None:
                # JSON says neither "not a number" nor "infinite".
                about = {"duration": plan.duration, "broadband": math.isinf(now.frequency)}
                self.live.progress({**_numbers(asdict(now)), **about})

        def alive() -> bool:
            gone = self.live is not None and self.live.silence() > LOST_AFTER
            if gone and setup.rig.service.when_lost == "stop":
                self.lost = True
                self.stop.set()
            return True

        return carry_out(
            setup.rig,
            setup.rig_toml,
            text,
            plan,
            predicted,
            self.path,
            settings=self.request.settings,
            operator=self.request.operator,
            progress=progress,
            stop=self.stop,
            alive=alive,
            watch=watch,
        )

    def _note(self) -> None:
        """Who stopped it, beside the recording."""
        said = [f"stop asked by {s['by']} at {s['time']}" for s in self.job.stops()]
        if self.lost:
            said.append(f"stopped, as the service gave no sign for {LOST_AFTER:g} s")
        if said:
            add_note(self.path, "service", "; ".join(said)[:2000])

    def _diagnosed(self, setup: Setup, outcome: Outcome) -> str:
        """The verdict; "" where there is nothing to tell it from."""
        if not self.request.diagnosis or not outcome.responses:
            return ""
        if outcome.stop.status != "completed" or outcome.interrupted:
            return ""
        from samii_rig.diagnose.diagnose import diagnose

        with suppress(SamiiRigError):
            found = diagnose(outcome.responses, setup.rig)
            set_diagnosis(self.path, {**found.plain(), "lines": list(found.lines())})
            return found.verdict
        return ""


def _numbers(data: dict[str, Any]) -> dict[str, Any]:
    """What is no number as null, which JSON can say."""
    return {
        k: None if isinstance(v, float) and not math.isfinite(v) else v for k, v in data.items()
    }


def main() -> None:
    """Entry point."""
    folder, recordings, lock = Path(sys.argv[1]), Path(sys.argv[2]), int(sys.argv[3])
    os.set_inheritable(lock, False)
    try:
        Runner(Job(folder), recordings).go()
    except SamiiRigError as error:
        print(f"samii-rig: {error}", file=sys.stderr)
        sys.exit(error.exit_code)


if __name__ == "__main__":
    main()
