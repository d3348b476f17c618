"""Experiments of several runs, and what an experiment makes of its own recordings."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol, runtime_checkable

from samii_rig.devices.plugins import asked, wrong
from samii_rig.rig.schema import Rig
from samii_rig.run.experiments import origin
from samii_rig.run.outcome import Outcome


@dataclass(frozen=True, slots=True)
class Setup:
    """The rig as one run of an experiment needs it.

    rig_toml : its file, which the recording keeps. name : a word for the recording's name,
    "" where there is but one run. instruction : what a person does before it, "" for nothing;
    a simulated rig is as the file says by itself.
    """

    rig: Rig
    rig_toml: str
    name: str = ""
    instruction: str = ""


@dataclass(frozen=True, slots=True)
class Conclusion:
    """What came out: lines for a person, and the files that hold it."""

    lines: tuple[str, ...]
    written: tuple[Path, ...] = ()


@runtime_checkable
class HasSetups(Protocol):
    """An experiment that is several runs, between which something on the rig is changed."""

    def setups(self, rig: Rig, rig_toml: str) -> tuple[Setup, ...]:
        """One for each run, in order; InputError if the rig cannot be set up so."""


@runtime_checkable
class Concludes(Protocol):
    """An experiment that yields more than the frequency responses of its runs."""

    def conclude(self, rigs: Sequence[Rig], outcomes: Sequence[Outcome], stem: Path) -> Conclusion:
        """From completed runs and the rig of each; writes files whose names begin with `stem`.

        EstimateError if the recordings do not give it.
        """


def setups_of(experiment: object, rig: Rig, rig_toml: str) -> tuple[Setup, ...]:
    """The runs of an experiment; a single one on the rig as it is unless it says otherwise."""
    if not isinstance(experiment, HasSetups):
        return (Setup(rig, rig_toml),)
    who = origin(experiment)
    with asked(who, "setups()"):
        found = tuple(experiment.setups(rig, rig_toml))
    if not found or not all(isinstance(s, Setup) for s in found):
        raise wrong(who, "setups()", found, "a Setup for each run, at least one")
    return found


def conclusion_of(
    experiment: Concludes, rigs: Sequence[Rig], outcomes: Sequence[Outcome], stem: Path
) -> Conclusion:
    """What an experiment makes of its own recordings; raises as `Concludes.conclude`, and
    InputError if what it gives is no conclusion."""
    who = origin(experiment)
    with asked(who, "conclude()"):
        found = experiment.conclude(rigs, outcomes, stem)
    if not isinstance(found, Conclusion):
        raise wrong(who, "conclude()", found, "a Conclusion")
    return found
