"""A FAULT outlives the program: only a person's name and reason lead back; one program a rig."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from fake_device import FakeDevice
from loop_kit import Memory, RealTime, patient_rig, plan

from samii_rig.errors import DeviceError, GateError, InputError
from samii_rig.run import campaign
from samii_rig.run.client import Client
from samii_rig.run.dryrun import predict
from samii_rig.run.heartbeat import Pipe
from samii_rig.run.loop import run
from samii_rig.run.order import RunOrder
from samii_rig.run.pace import LoopSettings
from samii_rig.safety.latch import Latch, state_folder

RIG = patient_rig()


@pytest.fixture(autouse=True)
def state(tmp_path, monkeypatch):
    monkeypatch.setenv("SAMII_RIG_STATE", str(tmp_path / "state"))
    return tmp_path / "state"


def test_without_a_fault_nothing_is_refused_and_nothing_is_written(state):
    Latch("SAMII").refuse()
    assert Latch("SAMII").fault is None
    assert Latch("SAMII").cleared is None
    assert not state.exists()


def test_a_fault_refuses_until_a_person_clears_it():
    Latch("SAMII").set("theta_2 over its limit")
    with pytest.raises(GateError, match=r"in FAULT since 20.*: theta_2 over its limit; .*clear-f"):
        Latch("SAMII").refuse()
    Latch("SFLR").refuse()
    Latch("SAMII").set("and then the cable fell out")
    assert Latch("SAMII").fault.reason == "theta_2 over its limit"
    cleared = Latch("SAMII").clear("Ada", "the hose was replaced")
    assert (cleared.person, cleared.fault) == ("Ada", "theta_2 over its limit")
    Latch("SAMII").refuse()
    assert Latch("SAMII").cleared == cleared


@pytest.mark.parametrize(("person", "reason"), [("", "fine"), ("Ada", " ")])
def test_nobody_and_nothing_clears_no_fault(person, reason):
    Latch("SAMII").set("smoke")
    with pytest.raises(InputError, match="who clears it"):
        Latch("SAMII").clear(person, reason)
    assert Latch("SAMII").fault


def test_there_is_nothing_to_clear_without_a_fault():
    with pytest.raises(InputError, match="it has none"):
        Latch("SAMII").clear("Ada", "to be sure")


@pytest.mark.parametrize("text", ["{", "[1]", '{"fault": {"reason": 3, "new": 1}}', "\xff"])
def test_a_latch_that_cannot_be_read_is_a_fault(state, text):
    state.mkdir()
    (state / "samii.json").write_bytes(text.encode("latin-1"))
    with pytest.raises(GateError, match="cannot be read"):
        Latch("SAMII").refuse()
    Latch("SAMII").clear("Ada", "looked at the file")
    Latch("SAMII").refuse()


@pytest.mark.real_time
def test_a_latch_that_cannot_be_written_is_said(state):
    state.write_text("a file where the folder should be")
    with pytest.raises(GateError, match="cannot be read"):
        Latch("SAMII").refuse()
    with (
        pytest.raises(DeviceError, match="expected a file that can be written"),
        Latch("SAMII").held(RealTime().open()),
    ):
        pass


def test_a_fault_that_cannot_be_kept_is_said(monkeypatch):
    def full(*_):
        raise OSError("no space left")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(DeviceError, match="could not be latched: no space left"):
        Latch("SAMII").set("smoke")


def test_the_folder_is_the_users(monkeypatch, tmp_path):
    monkeypatch.delenv("SAMII_RIG_STATE")
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    assert state_folder() == tmp_path / "samii-rig"
    monkeypatch.delenv("XDG_STATE_HOME")
    assert state_folder().parts[-3:] == (".local", "state", "samii-rig")


HOLDER = """
import sys, time
from samii_rig.safety.latch import Latch
from fake_device import FakeDevice
device = FakeDevice().open()
device.metadata.clear()
with Latch("SAMII").held(device):
    print("held", flush=True)
    sys.stdin.read()
"""


@pytest.mark.real_time
def test_a_second_program_is_told_which_one_drives_the_rig():
    here = Path(__file__).resolve().parents[1] / "kits"
    first = subprocess.Popen(
        [sys.executable, "-c", HOLDER],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        cwd=here,
    )
    assert first.stdout.readline() == "held\n"
    device = RealTime().open()
    with pytest.raises(DeviceError, match=rf"SAMII: driven by process {first.pid} \(.*python"):
        Latch("SAMII").held(device).__enter__()
    with Latch("SAMII").held(FakeDevice().open()):
        pass  # simulated time disturbs nobody
    first.communicate("")
    with Latch("SAMII").held(device):
        pass


# Whole runs


def carried_out(tmp_path, monkeypatch, device, name="run.mcap", **how):
    monkeypatch.setattr(campaign, "open_device", lambda rig, settings: device.open())
    the_plan = plan(level=0.5, segments=1, duration=0.2)
    predicted = predict(the_plan, RIG)
    return campaign.carry_out(RunOrder(RIG, "", "", the_plan, predicted), tmp_path / name, **how)


class Tripping(RealTime):
    """Shows an angle over its limit once it moves."""

    def __init__(self):
        super().__init__()
        self.spoil = lambda b: replace(
            b, values=b.values + np.array([0.0, 0.4 if self.written else 0.0])
        )


def test_a_run_that_trips_latches_and_the_next_one_opens_nothing(tmp_path, monkeypatch):
    outcome = carried_out(tmp_path, monkeypatch, Tripping())
    assert outcome.stop.status == "tripped"
    assert Latch(RIG.name, RIG.device.driver).fault.reason == outcome.stop.reason

    def never(rig, settings):
        raise AssertionError("a device was opened")

    monkeypatch.setattr(campaign, "open_device", never)
    the_plan = plan(level=0.5, segments=1, duration=0.2)
    with pytest.raises(GateError, match=r"over its limit of 0\.35"):
        campaign.carry_out(
            RunOrder(RIG, "", "", the_plan, predict(the_plan, RIG)), tmp_path / "b.mcap"
        )
    assert not (tmp_path / "b.mcap").exists()


@pytest.mark.real_time
def test_how_a_fault_was_cleared_is_in_the_next_recording(tmp_path, monkeypatch):
    Latch(RIG.name, RIG.device.driver).set("smoke")
    Latch(RIG.name, RIG.device.driver).clear("Ada", "aired the room")
    outcome = carried_out(tmp_path, monkeypatch, RealTime())
    found = outcome.recording.metadata
    assert outcome.stop.status == "completed", outcome.stop.reason
    assert (found["fault_cleared_person"], found["fault_cleared_fault"]) == ("Ada", "smoke")


def test_a_simulated_rig_trips_without_a_latch(tmp_path, monkeypatch):
    device = FakeDevice()
    device.spoil = Tripping.spoil = lambda b: replace(
        b, values=b.values + np.array([0.0, 0.4 if device.written else 0.0])
    )
    assert carried_out(tmp_path, monkeypatch, device).stop.status == "tripped"
    assert Latch(RIG.name, RIG.device.driver).fault is None


@pytest.mark.real_time
def test_a_device_that_tripped_while_nobody_was_there_is_a_fault(tmp_path, monkeypatch):
    device = RealTime()
    opened = device.open()
    opened.metadata["tripped"] = "the emergency input"
    device.open = lambda: opened
    with pytest.raises(GateError, match="the emergency input"):
        carried_out(tmp_path, monkeypatch, device)
    assert device.written == []
    assert device.zeros
    assert Latch(RIG.name, RIG.device.driver).fault.reason == "the emergency input"


def test_a_latch_that_fails_is_in_the_reason_and_hides_nothing():
    def full(_):
        raise OSError("disk full")

    stop = run(plan(), RIG, Tripping().open(), Memory(), latch=full)
    assert stop.status == "tripped"
    assert stop.reason.endswith("then OSError: disk full")
    assert "over its limit" in stop.reason


def test_a_run_that_was_stopped_or_whose_disk_was_full_is_no_fault():
    from loop_kit import Broken, after

    from samii_rig.errors import RecordingError

    told = []
    assert run(
        plan(), RIG, FakeDevice().open(), Memory(), Client(stop=after(0.3)), latch=told.append
    )
    full = Broken("segment", RecordingError("recording failed: no space left"))
    stop = run(plan(), RIG, FakeDevice().open(), full, latch=told.append)
    assert (stop.status, stop.reason) == ("failed", "recording failed: no space left")
    assert told == []


# The operator's client


def test_a_pipe_is_alive_while_bytes_come():
    ours, theirs = os.pipe()
    alive = Pipe(ours)
    assert not alive()
    os.write(theirs, b"...")
    assert alive()
    assert not alive()
    os.write(theirs, b".")
    os.close(theirs)
    assert alive()
    assert not alive()
    os.close(ours)


def test_a_client_that_dies_ends_the_run(tmp_path, monkeypatch):
    ours, theirs = os.pipe()
    os.write(theirs, b".")
    os.close(theirs)
    outcome = carried_out(
        tmp_path,
        monkeypatch,
        FakeDevice(),
        client=Client(alive=Pipe(ours)),
        loop=LoopSettings(heartbeat_age=0.1),
    )
    os.close(ours)
    assert outcome.stop.status == "tripped"
    assert "operator's client" in outcome.stop.reason


def test_the_file_holds_words_for_a_person(state):
    Latch("My rig (left)").set("smoke")
    found = json.loads((state / "my_rig_left.json").read_text())
    assert set(found["fault"]) == {"reason", "time", "program"}
