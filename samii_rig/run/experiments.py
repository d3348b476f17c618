"""Find an experiment by name or path; experiments are known by their entry points alone."""

from __future__ import annotations

import re
import tomllib
from importlib import metadata, resources
from importlib.resources.abc import Traversable
from pathlib import Path

from pydantic import BaseModel

from samii_rig.errors import InputError
from samii_rig.rig.load import parse, read_text
from samii_rig.rig.schema import Rig
from samii_rig.run.protocols import Experiment

GROUP = "samii_rig.experiments"


def kinds() -> dict[str, metadata.EntryPoint]:
    """Entry points by the kind of experiment that they load (`experiment = "..."`)."""
    return {point.name: point for point in metadata.entry_points(group=GROUP)}


def shipped() -> dict[str, Traversable]:
    """Experiment files by name, from the `data` folder of every package with experiments."""
    found: dict[str, Traversable] = {}
    for package in dict.fromkeys(point.module.partition(".")[0] for point in kinds().values()):
        folder = resources.files(package) / "data"
        if folder.is_dir():
            for file in sorted(folder.iterdir(), key=lambda f: f.name):
                if file.name.endswith(".toml"):
                    found.setdefault(file.name.removesuffix(".toml"), file)
    return found


def fitting(rig: Rig) -> dict[str, Traversable]:
    """Shipped experiments for this rig, by the name under which `load_experiment` finds them:
    its own variants in place of the general ones, and no variant of another rig."""
    files = shipped()
    own = _slug(rig.name)
    return {
        name: files.get(f"{name}_{own}", file)
        for name, file in files.items()
        if not any(name.startswith(f"{other}_") for other in files)
    }


def _slug(name: str) -> str:
    return re.sub(r"[^a-z0-9]+", "_", name.lower()).strip("_")


def load_experiment(name: str, rig: Rig) -> tuple[Experiment, str]:
    """The experiment called `name` and the text of its file.

    name : a shipped file's, or a path. `swept_sine` finds `swept_sine_sflr` on the rig
        SFLR and `swept_sine_samii_braced` on "SAMII braced" if there is one: a rig's own
        variant comes first.

    InputError if there is none, if its kind is not known, or if a field is wrong.
    """
    files = shipped()
    own = _slug(rig.name)
    for candidate in (f"{name}_{own}", name):
        if candidate in files:
            return _load(files[candidate].read_text("utf-8"), f"{candidate}.toml")
    path = Path(name)
    if not path.exists():
        expected = f"the path of an experiment file or one of {', '.join(files)}"
        raise InputError("EXPERIMENT", "", name, expected)
    return _load(read_text(path, "experiment file"), str(path))


def _load(text: str, where: str) -> tuple[Experiment, str]:
    known = kinds()
    try:
        kind = tomllib.loads(text).get("experiment")
    except (tomllib.TOMLDecodeError, RecursionError) as error:
        raise InputError(where, "", str(error) or "nested too deep", "valid TOML") from error
    if not isinstance(kind, str) or kind not in known:
        raise InputError(where, "experiment", kind, f"one of {', '.join(sorted(known))}")
    model = known[kind].load()
    if not (isinstance(model, type) and issubclass(model, BaseModel)):
        raise InputError(where, "experiment", kind, f"a pydantic model behind {known[kind].value}")
    experiment = parse(model, text, where)
    if not isinstance(experiment, Experiment):
        raise InputError(where, "experiment", kind, f"a plan() in {known[kind].value}")
    return experiment, text
