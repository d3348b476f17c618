"""Find an experiment by name or path; experiments are known by their entry points alone."""

from __future__ import annotations

import re
from datetime import datetime
from importlib.resources.abc import Traversable
from pathlib import Path

from pydantic import BaseModel

from samii_rig.devices.plugins import asked, named
from samii_rig.errors import InputError, one_of
from samii_rig.rig.load import parse, read_text, tables
from samii_rig.rig.schema import Rig
from samii_rig.run.catalogue import kinds as kinds
from samii_rig.run.catalogue import shipped as shipped
from samii_rig.run.outputs import completed
from samii_rig.run.plan import Experiment, Plan
from samii_rig.run.plugins import checked_plan


def fitting(rig: Rig) -> dict[str, Traversable]:
    """Shipped experiments for this rig, by the name under which `load_experiment` finds them:
    its own variants in place of the general ones, and no variant of another rig."""
    files = shipped()
    own = slug(rig.name)
    return {
        name: files.get(f"{name}_{own}", file)
        for name, file in files.items()
        if not any(name.startswith(f"{other}_") for other in files)
    }


def slug(name: str) -> str:
    """A name as a part of a file's: small letters and digits, and one underscore for the rest."""
    return re.sub(r"[^a-z0-9]+", "_", name.lower()).strip("_")


def recording_stem(rig: Rig, experiment: str) -> str:
    """Name, without its ending, of a recording that is begun now: time, rig and experiment."""
    return f"{datetime.now():%Y-%m-%dT%H-%M-%S}_{slug(f'{rig.name}_{experiment}')}"


def load_experiment(name: str, rig: Rig) -> tuple[Experiment, str]:
    """The experiment called `name` and the text of its file.

    name : a shipped file's, or a path. `swept_sine` finds `swept_sine_sflr` on the rig
        SFLR and `swept_sine_samii_braced` on "SAMII braced" if there is one: a rig's own
        variant comes first.

    InputError if there is none, if its kind is not known, or if a field is wrong.
    """
    files = shipped()
    own = slug(rig.name)
    for candidate in (f"{name}_{own}", name):
        if candidate in files:
            return parse_experiment(files[candidate].read_text("utf-8"), f"{candidate}.toml")
    path = Path(name)
    if not path.exists():
        expected = f"the path of an experiment file or {one_of(name, files)}"
        raise InputError("EXPERIMENT", "", name, expected)
    return parse_experiment(read_text(path, "experiment file"), str(path))


def parse_experiment(text: str, where: str) -> tuple[Experiment, str]:
    """The experiment of a file's text, and that text with line breaks alone at its lines' ends.

    where : what errors call it. InputError as of `load_experiment`.
    """
    text = text.replace("\r\n", "\n").replace("\r", "\n")
    known = kinds()
    kind = tables(text, where).get("experiment")
    if kind is None:
        expected = f"one of {', '.join(sorted(known))}"
        raise InputError.saying(where, "", f"experiment is missing; expected {expected}")
    if not isinstance(kind, str) or kind not in known:
        raise InputError(where, "experiment", kind, one_of(kind, sorted(known)))
    who = named(known[kind])
    with asked(who, ""):
        model = known[kind].load()
    if not (isinstance(model, type) and issubclass(model, BaseModel)):
        raise InputError(where, "experiment", kind, f"a pydantic model behind {known[kind].value}")
    with asked(who, where):
        experiment = parse(model, text, where)
    if not isinstance(experiment, Experiment):
        raise InputError(where, "experiment", kind, f"a plan() in {known[kind].value}")
    return experiment, text


def origin(experiment: object) -> str:
    """The entry point that an experiment came from, in words for an error's line."""
    kind = type(experiment)
    value = f"{kind.__module__}:{kind.__qualname__}"
    return next((named(p) for p in kinds().values() if p.value == value), f"experiment {value}")


def plan_of(experiment: Experiment, rig: Rig) -> Plan:
    """The plan of an experiment for this rig, with an output for each of its actuators.

    InputError if the rig cannot be asked this, or if what the experiment gives is no plan.
    """
    who = origin(experiment)
    with asked(who, "plan()"):
        return completed(checked_plan(experiment.plan(rig), rig, who), rig)
