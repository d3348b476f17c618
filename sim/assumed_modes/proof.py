"""Trials of this plant as `samii-rig prove` has them made: the entry point `assumed_modes`.

    OUT/recordings/<id>/run_01.mcap ...   say nothing of the truth, but carry its SHA-256
    OUT/truth/<id>.json                   written before them

`<id>` is a hash of kind, seed and rig. The truth's `size` is what whole records hold of the effect
(`sigma`), in the data alone, the noise known.
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from samii_rig.errors import InputError, SamiiRigError
from samii_rig.record.export import replacing
from samii_rig.rig.load import parse
from samii_rig.rig.schema import Rig
from sim.assumed_modes.parts import JOINTS, setup_of
from sim.assumed_modes.trial import KINDS, POOLS, Conceals, conceal, logged, save

NAME = "assumed_modes"
# s of records of a trial, drawn evenly in the logarithm: what a lab records of one rig in one go.
SECONDS = (30.0, 120.0)
CLOSE = 3.0  # ratio of a size to the drawn one that is near enough: the truth says what it is
PARTIAL = ".partial"


class Plant:
    """`plant(kind, seed, out, rig_toml)` makes a trial, or finds it made."""

    def refuses(self, kind: str, rig_toml: str) -> str:
        """Why there is no trial of this kind with this rig; "" where there is."""
        if kind not in KINDS:
            return f"no trials of kind {kind!r}"
        try:
            rig = parse(Rig, rig_toml, "rig file")
            setup = setup_of(rig, {})
        except InputError as error:
            return str(error)
        springs = [p for p in setup.parts if p.kind in JOINTS and p.values["k"] > 0]
        if kind in POOLS and not springs:
            return f"{rig.name}: element has no spring that could be another; expected one"
        return ""

    def __call__(self, kind: str, seed: int, out: Path, rig_toml: str) -> Path:
        """The folder of the recordings.

        Raises InputError for what it refuses, SamiiRigError where no effect had a size.
        """
        rig = parse(Rig, rig_toml, "rig file")
        name = hashlib.sha256(f"{NAME} {kind} {seed} {rig.name}".encode()).hexdigest()[:12]
        folder, truths = out / "recordings" / name, out / "truth"
        if folder.is_dir():
            return folder
        try:
            made = conceal(kind, seed, rig, seconds=_seconds(seed), close=CLOSE)
        except ArithmeticError as error:
            raise SamiiRigError(f"{rig.name}: {error}") from error
        scene, rngs = made.scene, made.rngs
        logs = [
            logged(i, scene, made.found, rngs[3], rngs[4]) for i in range(len(scene.style.files))
        ]
        truths.mkdir(parents=True, exist_ok=True)
        text = json.dumps(_truth(made, [log.faults for log in logs]), indent=1) + "\n"
        with replacing(truths / f"{name}.json") as part:
            part.write_text(text, encoding="utf-8")
        work = folder.with_name(name + PARTIAL)
        work.mkdir(parents=True, exist_ok=True)
        notes = {"truth_sha256": hashlib.sha256(text.encode()).hexdigest()}
        for i, log in enumerate(logs):
            save(work, i, scene, replace(log, notes=notes))
        work.rename(folder)
        return folder


def _seconds(seed: int) -> float:
    low, high = np.log(SECONDS)
    return float(np.exp(np.random.default_rng([seed, 1]).uniform(low, high)))


def _truth(made: Conceals, faults: list[Any]) -> dict[str, Any]:
    """The truth as `samii_rig.prove` reads it: parameters as numbers, other names in `also`."""
    full = made.truth(faults)
    effects = [
        {
            **e,
            "parameters": {name: p["value"] for name, p in e["parameters"].items()},
            "units": {name: p["unit"] for name, p in e["parameters"].items()},
            "also": [[n["physics"], n["site"]] for n in e["also"]],
        }
        for e in full["effects"]
    ]
    return {
        **full,
        "effects": effects,
        "size": min((e["sigma_data"] for e in effects), default=0.0),
        "size_is": "whole records",
        "styles": [full["style"]["excitation"], *full["style"]["options"]],
    }


plant = Plant()
