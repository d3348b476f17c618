"""What `benchmarks/endurance.py` makes of a run without a recording: one that was refused before it
was opened says why, one that was opened must have left it; and of one that was never armed.

None of these runs is in real time: either no run begins, or the rig is the one of simulated time,
which a late machine cannot refuse or trip. The node on the wire is asked how it is, and is at rest.
"""

from __future__ import annotations

import importlib.util
import random
from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import pytest
from fault_host import plan_of

from samii_rig.errors import DeviceError
from samii_rig.rig.load import load_rig
from samii_rig.run import campaign
from samii_rig.run.dryrun import predict

STUDY = Path(__file__).resolve().parents[2] / "benchmarks" / "endurance.py"
SPEC = importlib.util.spec_from_file_location("endurance", STUDY)
assert SPEC is not None
assert SPEC.loader is not None
endurance = importlib.util.module_from_spec(SPEC)
SPEC.loader.exec_module(endurance)

WHEN = {"while it runs": 0.0, "at any moment": 0.9}  # what the fault's moment is drawn from


@pytest.fixture(scope="module")
def shared(tmp_path_factory: pytest.TempPathFactory) -> Iterator[endurance.Endured]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("SAMII_RIG_STATE", str(tmp_path_factory.mktemp("state")))
        patch.setattr(endurance, "FAULTS", ("",))
        made = endurance.Endured(tmp_path_factory.mktemp("runs"), 1)
        made.plan = plan_of(made.wire.rig, 0.3)
        made.predicted = predict(made.plan, made.wire.rig)
        with closing(made):
            yield made


@pytest.fixture(params=WHEN)
def endured(request, shared, monkeypatch):
    monkeypatch.setattr(shared, "rng", random.Random(1))
    monkeypatch.setattr(shared.rng, "random", lambda: WHEN[request.param])
    for found in (shared.wrong, shared.refused):
        found.clear()
    return shared


def test_a_run_that_was_refused_before_it_was_recorded_says_why_and_is_not_lost(endured):
    with closing(endured.wire.open()):
        endured.one(0)
    assert endured.wrong == []
    assert len(endured.refused) == 1
    assert "in use by" in endured.refused[0]


@pytest.mark.parametrize("ends", ["well", "with an error"])
def test_a_recording_that_was_opened_and_is_not_there_is_lost(endured, ends, monkeypatch):
    carry_out = campaign.carry_out

    def losing(*given, **named):
        outcome = carry_out(*given, **named)
        outcome.path.unlink()
        if ends != "well":
            raise DeviceError("the device did not close")
        return outcome

    monkeypatch.setattr(campaign, "carry_out", losing)
    monkeypatch.setattr(endured.wire, "rig", load_rig("samii")[0])
    endured.one(1)
    assert endured.refused == []
    assert len(endured.wrong) == 1
    assert "is not there" in endured.wrong[0]


def test_a_run_that_was_never_armed_has_nothing_to_latch(endured, monkeypatch):
    """What a late machine does to one: samples are stale before it is armed."""

    def stale(*given, **named):
        outcome = carry_out(*given, **named)
        return replace(outcome, stop=replace(outcome.stop, status="failed", reason="stale"))

    carry_out = campaign.carry_out
    monkeypatch.setattr(campaign, "carry_out", lambda order, path, client: stale(order, path))
    monkeypatch.setattr(endured.wire, "rig", load_rig("samii")[0])
    endured.one(2)
    assert endured.wrong == []
