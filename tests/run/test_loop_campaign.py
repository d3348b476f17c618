"""A run's recording is whole, with its stop record, whatever goes wrong after the last sample."""

from __future__ import annotations

import signal
from pathlib import Path

import numpy as np
import pytest
from burst_kit import PLAN, PREDICTED, RIG
from fake_device import FakeDevice
from typer.testing import CliRunner

from samii_rig.cli.app import app
from samii_rig.devices.protocols import CommandBlock
from samii_rig.errors import (
    DeviceError,
    EstimateError,
    GateError,
    InputError,
    RecordedError,
    RecordingError,
)
from samii_rig.record.reader import read_recording
from samii_rig.run import campaign
from samii_rig.run.campaign import Outcome, carry_out
from samii_rig.run.order import RunOrder
from samii_rig.types import Channel


@pytest.fixture
def device(monkeypatch: pytest.MonkeyPatch) -> FakeDevice:
    device = FakeDevice()
    monkeypatch.setattr(campaign, "open_device", lambda rig, settings: device.open())
    return device


def go(path: Path) -> Outcome:
    return carry_out(RunOrder(RIG, "", "", PLAN, PREDICTED), path)


@pytest.mark.parametrize(
    ("error", "words"),
    [
        (EstimateError("too short"), "too short"),
        (InputError("estimate", "band", 1, "another"), "estimate: band is 1; expected another"),
        (np.linalg.LinAlgError("SVD did not\nconverge"), "LinAlgError: SVD did not converge"),
        (MemoryError("none left"), "MemoryError: none left"),
        (KeyboardInterrupt("SIGINT"), "given up on SIGINT"),
    ],
)
@pytest.mark.usefixtures("device")
def test_an_estimate_that_fails_leaves_a_whole_recording(
    error: BaseException, words: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fails(recordings: object) -> None:
        raise error

    monkeypatch.setattr(campaign, "estimate", fails)
    outcome = go(tmp_path / "run.mcap")
    assert words in outcome.trouble
    assert outcome.responses == ()
    assert read_recording(tmp_path / "run.mcap").stop.status == "completed"
    assert not list(tmp_path.glob("*.partial"))


@pytest.mark.parametrize(
    ("error", "words"),
    [
        (MemoryError(), "there is no memory left"),
        (RecordingError("it cannot be read"), "it cannot be read"),
    ],
)
@pytest.mark.usefixtures("device")
def test_a_whole_recording_that_cannot_be_read_back_is_told_by_a_code_of_its_own(
    error: Exception, words: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fails(path: Path, **_: object) -> None:
        raise error

    monkeypatch.setattr(campaign, "read_recording", fails)
    with pytest.raises(RecordedError, match=words) as failed:
        go(tmp_path / "run.mcap")
    assert failed.value.exit_code == 7
    assert str(tmp_path / "run.mcap") in str(failed.value)
    assert read_recording(tmp_path / "run.mcap").stop.status == "completed"


@pytest.mark.parametrize(("status", "code"), [("completed", 7), ("tripped", 5), ("stopped", 130)])
def test_a_run_that_did_not_go_through_keeps_its_code(status: str, code: int) -> None:
    assert RecordedError("run.mcap", status, "no memory").exit_code == code


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.usefixtures("device")
def test_signals_while_estimating_give_the_estimate_up_and_nothing_else(
    number: signal.Signals, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def waits(recordings: object) -> None:
        try:
            signal.raise_signal(number)
        finally:
            signal.raise_signal(number)

    before = signal.getsignal(number)
    monkeypatch.setattr(campaign, "estimate", waits)
    outcome = go(tmp_path / "run.mcap")
    assert number.name in outcome.trouble
    assert read_recording(tmp_path / "run.mcap").stop.status == "completed"
    assert signal.getsignal(number) is before


def test_a_signal_while_running_ends_the_run_and_still_estimates(
    device: FakeDevice, tmp_path: Path
) -> None:
    def spoil(block):  # type: ignore[no-untyped-def] # as FakeDevice has it
        if len(block) and block.sequence[-1] == 400:
            signal.raise_signal(signal.SIGTERM)
        return block

    device.spoil = spoil
    outcome = go(tmp_path / "run.mcap")
    assert outcome.stop.status == "stopped"
    assert outcome.trouble == "no segment was completed"


def test_a_device_that_is_refused_leaves_a_recording_that_says_so(
    device: FakeDevice, tmp_path: Path
) -> None:
    device.channels = (Channel("v", "V", "command"),)
    with pytest.raises(GateError, match="theta"):
        go(tmp_path / "run.mcap")
    stop = read_recording(tmp_path / "run.mcap").stop
    assert stop.status == "failed"
    assert "theta" in stop.reason


def test_an_output_that_cannot_be_zeroed_is_in_the_recording(
    device: FakeDevice, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def breaks() -> None:
        raise OSError("bus off")

    monkeypatch.setattr(device, "zero", breaks)
    with pytest.raises(DeviceError, match="did not close: OSError: bus off"):
        go(tmp_path / "run.mcap")
    stop = read_recording(tmp_path / "run.mcap").stop
    assert stop.status == "failed"
    assert stop.reason.startswith("the output could not be zeroed: OSError: bus off")


@pytest.mark.parametrize(
    ("name", "words"),
    [("file/run.mcap", "folder"), ("run.html", ".mcap"), ("run", ".mcap")],
)
def test_a_place_that_cannot_hold_the_recording_costs_one_line(
    name: str, words: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def never(rig: object, settings: object) -> None:
        raise AssertionError("a device was opened")

    monkeypatch.setattr(campaign, "open_device", never)
    (tmp_path / "file").write_text("no folder")
    result = CliRunner().invoke(
        app, ["run", "swept_sine", "--rig", "samii", "--out", str(tmp_path / name)]
    )
    assert isinstance(result.exception, InputError)
    assert result.exception.exit_code == 2
    assert "--out" in str(result.exception)
    assert words in str(result.exception)
    assert "\n" not in str(result.exception)
    assert [p.name for p in tmp_path.iterdir()] == ["file"]


def test_what_the_device_learns_meanwhile_is_in_the_recording(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    device = FakeDevice()
    opened = device.open()
    opened.metadata["timing"] = "before"
    monkeypatch.setattr(campaign, "open_device", lambda rig, settings: opened)
    works = device.write

    def write(block: CommandBlock) -> None:
        opened.metadata["timing"] = "after"
        works(block)

    monkeypatch.setattr(device, "write", write)
    notes = go(tmp_path / "run.mcap").recording.metadata
    assert notes["device_timing"] == "after"
    assert notes["experiment"] == "sweep"
