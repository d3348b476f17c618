"""The order of a run: what was asked for, checked in all that can be known before anything opens.

Command line, service and test fixture ask for runs here, each in its own words, and get the same
refusals in the same order. An `Order` is an experiment on a rig; a `PlannedRun` is one of its runs;
a `RunOrder` is one with its prediction, which is all that `campaign.carry_out` takes. That one
looks at the refusals again itself: nobody can hand it a run that would break a limit.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from samii_rig.devices import opening
from samii_rig.devices.plugins import asked
from samii_rig.rig.schema import Rig
from samii_rig.run import dryrun, experiments
from samii_rig.run.dryrun import DryRun
from samii_rig.run.plan import Experiment, Plan
from samii_rig.run.setups import Setup, setups_of
from samii_rig.run.space import room_for


@dataclass(frozen=True, slots=True)
class RunOrder:
    """One run that can be carried out.

    rig, rig_toml, experiment_toml : as they are and as they are recorded. predicted : of `plan`
    on `rig`. settings : of the device, over those of the rig file. operator : recorded.
    """

    rig: Rig
    rig_toml: str
    experiment_toml: str
    plan: Plan
    predicted: DryRun
    settings: dict[str, object] = field(default_factory=dict)
    operator: str = ""

    def refuse(self, path: Path) -> None:
        """LimitError if it would break a limit, DiskError without room for the recording `path`."""
        refuse([self], path)


@dataclass(frozen=True, slots=True)
class PlannedRun:
    """One run, not predicted yet: the rig as it needs it, the experiment's text, its plan."""

    setup: Setup
    experiment_toml: str
    plan: Plan

    def predict(self, settings: dict[str, object] | None = None, operator: str = "") -> RunOrder:
        """With what the model says of it; settings, operator : as of `RunOrder`.

        Raises as `dryrun.predict` does, and InputError for whatever else a plan makes it raise.
        """
        rig = self.setup.rig
        with asked(f"experiment {self.plan.experiment!r}", "prediction"):
            predicted = dryrun.predict(self.plan, rig)
        text = self.experiment_toml
        return RunOrder(
            rig, self.setup.rig_toml, text, self.plan, predicted, settings or {}, operator
        )


@dataclass(frozen=True, slots=True)
class Order:
    """An experiment on a rig: one run, or several between which something on it is changed."""

    experiment: Experiment
    experiment_toml: str
    setups: tuple[Setup, ...]

    @classmethod
    def named(cls, name: str, rig: Rig, rig_toml: str) -> Order:
        """Of an experiment by its name, or the path of its file; InputError if it is wrong."""
        experiment, text = experiments.load_experiment(name, rig)
        return cls(experiment, text, setups_of(experiment, rig, rig_toml))

    @classmethod
    def written(cls, text: str, where: str, rig: Rig, rig_toml: str) -> Order:
        """Of the text of an experiment's file, which errors call `where`; InputError as above."""
        experiment, text = experiments.parse_experiment(text, where)
        return cls(experiment, text, setups_of(experiment, rig, rig_toml))

    def run(self, i: int) -> PlannedRun:
        """Its run number `i`, from 0; InputError if the rig cannot be asked this."""
        setup = self.setups[i]
        plan = experiments.plan_of(self.experiment, setup.rig)
        return PlannedRun(setup, self.experiment_toml, plan)

    def runs(self) -> list[PlannedRun]:
        """All of them; InputError also for what the driver of the device could not run."""
        planned = [self.run(i) for i in range(len(self.setups))]
        for one in planned:
            opening.check_device(one.setup.rig)
        return planned


def refuse(runs: Sequence[RunOrder], path: Path) -> None:
    """LimitError if any of these would break a limit, DiskError unless the recordings of all, of
    which `path` is the first, fit on the disk beside each other."""
    for one in runs:
        one.predicted.refuse()
    room_for(path, [one.plan for one in runs], [one.rig for one in runs])
