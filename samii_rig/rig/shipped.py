"""Which rigs come with the package, without what it takes to load one."""

from __future__ import annotations

from importlib import resources
from importlib.resources.abc import Traversable

FOLDER = resources.files("samii_rig.rig") / "data"


def names_in(folder: Traversable) -> tuple[str, ...]:
    """Names of the TOML files that come with the package in `folder`."""
    return tuple(sorted(p.name.removesuffix(".toml") for p in folder.iterdir()))


def shipped() -> tuple[str, ...]:
    """Names of the rigs that come with the package."""
    return names_in(FOLDER)
