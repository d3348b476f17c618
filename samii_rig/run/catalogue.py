"""Which experiments there are, without what it takes to load one."""

from __future__ import annotations

from importlib import metadata, resources
from importlib.resources.abc import Traversable

from samii_rig.installed import points

GROUP = "samii_rig.experiments"


def kinds() -> dict[str, metadata.EntryPoint]:
    """Entry points by the kind of experiment that they load (`experiment = "..."`)."""
    return {point.name: point for point in points(GROUP)}


def shipped() -> dict[str, Traversable]:
    """Experiment files by name, from the `data` folder of every package with experiments."""
    found: dict[str, Traversable] = {}
    for package in dict.fromkeys(point.module.partition(".")[0] for point in kinds().values()):
        try:
            folder = resources.files(package) / "data"
        except (Exception, SystemExit):
            continue  # what is wrong with it is said to who asks for it; the others are well
        if folder.is_dir():
            for file in sorted(folder.iterdir(), key=lambda f: f.name):
                if file.name.endswith(".toml"):
                    found.setdefault(file.name.removesuffix(".toml"), file)
    return found
