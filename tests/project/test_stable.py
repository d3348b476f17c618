"""What docs/reference/stable.md promises: what 0.1.0 wrote is read to the last bit, names stay.

Plan: a recording that 0.1.0 made is whole and gives the same samples, times, marks, segments,
words and responses; the rig and the experiment in it still say the same; the entry points that the
page lists are those that exist.
"""

from __future__ import annotations

import hashlib
import json
import re
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import ROOT
from numpy.typing import NDArray

from samii_rig.record.reader import (
    read_events,
    read_frequency_responses,
    read_notes,
    read_recording,
)
from samii_rig.record.verify import verify
from samii_rig.rig.load import parse
from samii_rig.rig.schema import Rig
from samii_rig.run.experiments import load_experiment, plan_of
from samii_rig.types import FrequencyResponse, Recording

KEPT = Path(__file__).resolve().parents[1] / "data" / "run_0_1_0.mcap"
EXPECTED = json.loads(KEPT.with_suffix(".json").read_text("utf-8"))


def digest(array: NDArray[Any]) -> str:
    """SHA-256 of the numbers, little-endian in order of rows, and their shape."""
    kind = array.dtype.newbyteorder("<")
    data = np.ascontiguousarray(array, dtype=kind).tobytes()
    return f"{kind.str} {array.shape} {hashlib.sha256(data).hexdigest()}"


def seen(recording: Recording) -> dict[str, Any]:
    """What a reader finds in the samples of a recording, to the last bit."""
    return {
        "channels": [
            [c.name, c.unit, c.role, c.low.hex(), c.high.hex(), c.resolution.hex(), c.description]
            for c in recording.channels
        ],
        "rate_hz": recording.rate_hz,
        "arrays": {
            name: digest(getattr(recording, name))
            for name in ("time", "sequence", "values", "quality", "wall_time")
        },
        "some_values": [x.hex() for x in recording.values[400].tolist()],
        "segments": [
            [s.name, s.kind, s.start, s.stop, s.level, s.unit, s.repeat] for s in recording.segments
        ],
        "metadata": recording.metadata,
        "stop": [recording.stop.status, recording.stop.reason],
    }


def estimated(response: FrequencyResponse) -> dict[str, Any]:
    """What a reader finds in a response, to the last bit."""
    return {
        "channels": [[c.name, c.unit] for c in (*response.inputs, *response.outputs)],
        "method": response.method,
        "arrays": {
            name: digest(getattr(response, name))
            for name in ("frequency", "H", "covariance", "dof", "coherence", "input_rms")
        },
        "findings": [[f.kind, f.severity, f.channel] for f in response.findings],
    }


@pytest.fixture(scope="module")
def recording() -> Recording:
    return read_recording(KEPT)


def test_what_0_1_0_recorded_is_whole_and_read_to_the_last_bit(recording: Recording) -> None:
    assert verify(KEPT).status == "whole"
    assert seen(recording) == EXPECTED["recording"]


def test_its_responses_events_and_notes_are_read_to_the_last_bit() -> None:
    assert [estimated(r) for r in read_frequency_responses(KEPT)] == EXPECTED["responses"]
    events = [[e.time, e.name, e.payload] for e in read_events(KEPT)]
    assert events == EXPECTED["events"]
    assert read_notes(KEPT) == EXPECTED["recording"]["metadata"]


def test_its_rig_and_its_experiment_still_say_the_same(recording: Recording, tmp_path) -> None:
    rig = parse(Rig, recording.rig_toml, str(KEPT))
    said = {
        e.name: [e.kind, *(getattr(e, s).value for s in "kmK" if hasattr(e, s))]
        for e in rig.element
    }
    assert said == {
        "spring": ["spring", 6000.0],
        "mass": ["mass", 1.2],
        "coil": ["force_source", 4.0],
    }
    path = tmp_path / "kept.toml"
    path.write_text(recording.experiment_toml, "utf-8")
    experiment, _ = load_experiment(str(path), rig)
    u = plan_of(experiment, rig).segments[0].u
    # Not to the bit: a sine is the machine's.
    assert u[50::100].tolist() == pytest.approx(EXPECTED["excitation"], abs=1e-12)


def test_the_entry_points_of_the_page_are_those_that_exist() -> None:
    declared = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    page = (ROOT / "docs" / "reference" / "stable.md").read_text("utf-8")
    told = set(re.findall(r"^\| `(samii_rig\.\w+)` \|", page, re.M))
    # Effects ship as rows of the vocabulary; the group is for those of a lab.
    groups = {g for g in declared["entry-points"] if g != "pytest11"} | {"samii_rig.effects"}
    assert told == groups
