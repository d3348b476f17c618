"""The concealed plant as `samii-rig prove` has its trials made: entry point `concealed`."""

from __future__ import annotations

from pathlib import Path
from typing import get_args

from samii_rig.errors import InputError, SamiiRigError
from samii_rig.rig.load import parse
from samii_rig.rig.schema import Rig
from sim.concealed.draw import DRAWN, Kind
from sim.concealed.effects import ROWS, TABLES, places
from sim.concealed.parts import described
from sim.concealed.trial import make


class Plant:
    """`plant(kind, seed, out, rig_toml)` makes a trial, or finds it made."""

    def refuses(self, kind: str, rig_toml: str) -> str:
        """Why there is no trial of this kind with this rig; "" where there is."""
        if kind not in DRAWN:
            return f"no trials of kind {kind!r}"
        try:
            plant = described(parse(Rig, rig_toml, "rig file"))
        except InputError as error:
            return str(error)
        if unread := [s.name for s in plant.sensors if s.kind == "moment"]:
            return f"sensor {unread[0]} reads a moment, which this plant does not"
        joints = sum(p.kind == "torsional_spring" for p in plant.parts)
        if kind == "joints" and joints < 2:
            return "fewer than two joints"
        if kind in TABLES and not any(places(plant, row) for row in TABLES[kind]):
            return "no joint for such an effect"
        if kind in ("one", "two") and not any(places(plant, row) for row in ROWS):
            return "no place for any effect"
        return ""

    def __call__(self, kind: str, seed: int, out: Path, rig_toml: str) -> Path:
        """The folder of the recordings.

        Raises InputError for a rig or kind that it refuses, SamiiRigError for a loop that is not
        stable with what is concealed.
        """
        known: tuple[Kind, ...] = get_args(Kind)
        for name in known:
            if name == kind:
                try:
                    return make(name, seed, out, rig_toml)
                except ArithmeticError as error:
                    raise SamiiRigError(str(error)) from error
        raise InputError("concealed plant", "kind", kind, f"one of {', '.join(DRAWN)}")


plant = Plant()
