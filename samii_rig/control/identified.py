"""The rig that an identification found: its values in the rig file's text, its covariance."""

from __future__ import annotations

import json
import math
import re
import tomllib
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from samii_rig.control.plants import Known
from samii_rig.errors import InputError
from samii_rig.rig.load import parse, read_text
from samii_rig.rig.schema import Rig

# One parameter of the rig file: an inline table, which TOML keeps on one line.
PARAMETER = re.compile(r"^(\s*)([A-Za-z]\w*)(\s*=\s*)\{(.*)\}(.*)$")
EXPECTED = "what `samii-rig identify --json` printed"


@dataclass(frozen=True, slots=True)
class Identified:
    """A rig with the values found, the text of its file, and how well they are known."""

    rig: Rig
    text: str
    known: Known


def identified(text: str, path: Path) -> Identified:
    """The rig file `text` with the parameters of an identification (JSON) in it.

    InputError if the file is none, or names a parameter that the rig does not have.
    """
    try:
        data = json.loads(read_text(path, "identification"))
        found = {str(k): float(v["value"]) for k, v in data["parameters"].items()}
        covariance = np.array(data["log_covariance"], dtype=np.float64)
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise InputError(str(path), "", str(error), EXPECTED) from error
    if covariance.shape != (len(found), len(found)) or not np.isfinite(covariance).all():
        raise InputError(str(path), "log_covariance", covariance.shape, EXPECTED)
    keys = []
    for i, (name, value) in enumerate(found.items()):
        element, _, symbol = name.partition(".")
        keys.append((element, symbol))
        text = _changed(text, element, symbol, value, math.sqrt(covariance[i, i]), path)
    rig = parse(Rig, text, f"{path}: the rig")
    return Identified(rig, text, Known(tuple(keys), covariance))


def _changed(text: str, element: str, symbol: str, value: float, sd: float, path: Path) -> str:
    """The text with one parameter's value and tolerance; everything else as it was."""
    lines = text.split("\n")
    starts = [i for i, line in enumerate(lines) if line.strip().startswith("[")]
    for start, stop in zip(starts, [*starts[1:], len(lines)], strict=True):
        block = "\n".join(lines[start:stop])
        if not lines[start].strip().startswith("[[element]]"):
            continue
        if tomllib.loads(block)["element"][0].get("name") != element:
            continue
        for i in range(start, stop):
            match = PARAMETER.match(lines[i])
            if match and match[2] == symbol:
                old = tomllib.loads(f"x = {{{match[4]}}}")["x"]
                new = {**old, "value": value, "tolerance": sd, "source": "identified from data"}
                items = ", ".join(f"{k} = {json.dumps(v)}" for k, v in new.items())
                lines[i] = f"{match[1]}{symbol}{match[3]}{{ {items} }}{match[5]}"
                return "\n".join(lines)
    raise InputError(str(path), "parameters", f"{element}.{symbol}", "a parameter of the rig file")
