"""Experiments of several runs on a rig that a person changes in between: whoever says no, presses
Ctrl-C or loses a run ends all of it, at zero volts, with what was done before whole."""

from __future__ import annotations

import json
import signal
from importlib import resources
from pathlib import Path

import numpy as np
import pytest
from fake_device import RIG as TEXT
from fake_device import FakeDevice
from typer.testing import CliRunner

from samii_rig.cli import main
from samii_rig.cli.app import app
from samii_rig.devices import opening
from samii_rig.errors import DeviceError, GateError
from samii_rig.record.reader import read_recording
from samii_rig.rig.schema import Rig
from samii_rig.run import campaign, experiments
from samii_rig.run.plan import Plan, PlannedSegment
from samii_rig.run.setups import Conclusion, Setup
from samii_rig.signal.excitation import swept_sine

U, F = swept_sine(500.0, 2.0, 20.0, 0.6, ramp=0.1, lead_in=0.1, ring_down=0.3)


QUIET = ("--no-diagnosis",)


class Thrice:
    """Three runs; before the later ones something is to be moved, if `asks`."""

    name = "thrice"

    def __init__(self, asks: bool) -> None:
        self.asks = asks
        self.concluded = 0

    def plan(self, rig: Rig) -> Plan:
        s = PlannedSegment("burst", "burst", 1.0, "V", 0, U, np.zeros_like(U), (2.0, 20.0), F)
        return Plan("thrice", 500.0, "v", 4.0, "theta", (s,), 0)

    def setups(self, rig: Rig, rig_toml: str) -> tuple[Setup, ...]:
        say = "move it to place {}" if self.asks else ""
        return tuple(Setup(rig, rig_toml, f"{i}", say.format(i)) for i in (1, 2, 3))

    def conclude(self, rigs, outcomes, stem) -> Conclusion:
        self.concluded += 1
        return Conclusion(("all three",))


class Bench:
    """All devices that were opened, one a run, and what the command said."""

    def __init__(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        self.path = tmp_path
        self.patch = monkeypatch
        self.devices: list[FakeDevice] = []
        self.closed: list[FakeDevice] = []
        self.spoil: dict[int, object] = {}
        self.rig = tmp_path / "rig.toml"
        self.rig.write_text(TEXT + '\n[device]\ndriver = "bench"\n')
        self.experiment = tmp_path / "thrice.toml"
        shipped = resources.files("experiments") / "data" / "step.toml"
        self.experiment.write_text(shipped.read_text())  # what is run in its place is `Thrice`
        # The fake has no entry point, so nobody can be asked what it could run.
        monkeypatch.setattr(opening, "check_device", lambda rig: None)
        monkeypatch.setattr(campaign, "open_device", self.open)

    def open(self, rig, settings):
        # No device may be open while a person is asked or another one runs.
        assert len(self.closed) == len(self.devices)
        i = len(self.devices) + 1
        if self.spoil.get(i) == "closed":
            raise DeviceError("the port is not there")
        device = FakeDevice(self.spoil.get(i))
        self.devices.append(device)
        bench = self

        from samii_rig.devices.protocols import OpenRig

        class Closing(OpenRig):
            def close(self) -> None:
                super().close()
                bench.closed.append(device)

        return Closing(device, device, device, "fake", {"clock": "simulated"})

    def go(self, answers: str = "", *, asks: bool = True, options: tuple[str, ...] = QUIET):
        self.kind = Thrice(asks)
        self.patch.setattr(experiments, "load_experiment", lambda name, rig: (self.kind, ""))
        out = str(self.path / "t.mcap")
        command = [
            "run",
            str(self.experiment),
            "--rig",
            str(self.rig),
            "--out",
            out,
            "--no-report",
        ]
        result = CliRunner().invoke(app, [*command, *options], input=answers)
        for device in self.devices:
            assert device in self.closed
            assert not device.live
            device.sleep(1.0)
            assert device.rows[-1][1] == 0.0
        given = (self.rig, self.experiment)
        left = sorted(p.name for p in self.path.iterdir() if p not in given)
        for name in left:
            assert name.endswith(".mcap"), "half a file was left"
        return result, left

    def status(self, name: str) -> str:
        stop = read_recording(self.path / name).stop
        assert stop is not None
        return stop.status


@pytest.fixture
def bench(tmp_path, monkeypatch):
    return Bench(tmp_path, monkeypatch)


def test_all_runs_are_done_one_device_after_the_other(bench):
    result, left = bench.go("y\ny\ny\n")
    assert result.exit_code == 0, result.output
    assert left == ["t_1.mcap", "t_2.mcap", "t_3.mcap"]
    assert {bench.status(name) for name in left} == {"completed"}
    assert len(bench.devices) == 3
    assert bench.kind.concluded == 1
    assert result.output.count("Done?") == 3


@pytest.mark.parametrize("answer", ["n\n", "\n", ""])
@pytest.mark.parametrize("before", [0, 1, 2])
def test_whoever_says_no_ends_it_and_nothing_more_is_opened(bench, answer, before):
    """No, nothing, and the end of the input are all no."""
    result, left = bench.go("y\n" * before + answer)
    assert result.exit_code != 0
    assert len(bench.devices) == before
    assert left == [f"t_{i + 1}.mcap" for i in range(before)]
    assert all(bench.status(name) == "completed" for name in left)
    assert bench.kind.concluded == 0


def test_ctrl_c_at_the_question_ends_with_130(bench, monkeypatch):
    def interrupted(*args, **how):
        assert len(bench.closed) == len(bench.devices) == 1
        raise KeyboardInterrupt

    import typer

    asked = typer.confirm
    monkeypatch.setattr(
        typer, "confirm", lambda *a, **k: asked(*a, **k) if not bench.devices else interrupted()
    )
    result, left = bench.go("y\n")
    assert result.exit_code != 0
    assert left == ["t_1.mcap"]
    monkeypatch.setattr(
        "sys.argv", ["samii-rig", "run", str(bench.experiment), "--rig", str(bench.rig)]
    )
    monkeypatch.chdir(bench.path)
    with pytest.raises(SystemExit) as end:
        main()
    assert end.value.code == 130
    assert len(bench.devices) == 1


def signals(at, number=signal.SIGINT):
    def spoil(block):
        if len(block) and block.sequence[0] <= at <= block.sequence[-1]:
            signal.raise_signal(number)
        return block

    return spoil


def test_ctrl_c_in_the_second_run_stops_it_and_asks_for_no_third(bench):
    bench.spoil[2] = signals(400)
    result, left = bench.go("y\ny\ny\n")
    assert result.exit_code == 130
    assert left == ["t_1.mcap", "t_2.mcap"]
    assert [bench.status(name) for name in left] == ["completed", "stopped"]
    assert result.output.count("Done?") == 2
    assert bench.kind.concluded == 0


@pytest.mark.parametrize("asks", [True, False])
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_ctrl_c_while_a_run_is_estimated_starts_no_other(bench, monkeypatch, asks, number):
    """The run itself was done; what the person wants is that nothing moves any more."""

    def waits(recordings):
        signal.raise_signal(number)

    monkeypatch.setattr(campaign, "estimate", waits)
    result, left = bench.go("y\ny\ny\n", asks=asks, options=(*QUIET, "--json"))
    assert result.exit_code == 130, result.output
    assert left == ["t_1.mcap"]
    assert bench.status("t_1.mcap") == "completed"
    assert len(bench.devices) == 1
    said = json.loads(result.stdout[result.stdout.index("{") :])
    assert said["status"] == "stopped"
    assert bench.kind.concluded == 0


def test_a_signal_while_the_recording_is_closed_is_not_lost(bench, monkeypatch):
    """It disturbs nothing, and the next run does not start."""
    closing = campaign.RunWriter.close

    def close(self, *args):
        signal.raise_signal(signal.SIGINT)
        closing(self, *args)

    monkeypatch.setattr(campaign.RunWriter, "close", close)
    result, left = bench.go(asks=False)
    assert result.exit_code == 130, result.output
    assert left == ["t_1.mcap"]
    assert bench.status("t_1.mcap") == "completed"


def trips(block):
    if len(block) and block.sequence[-1] > 400:
        block.values[:, 1] = 0.5
    return block


def breaks(block):
    if len(block) and block.sequence[-1] > 400:
        raise DeviceError("cable out")
    return block


@pytest.mark.parametrize(
    ("spoil", "status", "code"), [(trips, "tripped", 5), (breaks, "failed", 6)]
)
def test_a_second_run_that_does_not_go_through_is_the_last(bench, spoil, status, code):
    bench.spoil[2] = spoil
    result, left = bench.go("y\ny\ny\n")
    assert result.exit_code == code, result.output
    assert left == ["t_1.mcap", "t_2.mcap"]
    assert [bench.status(name) for name in left] == ["completed", status]
    assert bench.kind.concluded == 0


def test_a_second_run_whose_device_does_not_open_leaves_the_first_whole(bench):
    bench.spoil[2] = "closed"
    result, left = bench.go("y\ny\ny\n")
    assert isinstance(result.exception, DeviceError)
    assert result.exception.exit_code == 6
    assert left == ["t_1.mcap"]
    assert bench.status("t_1.mcap") == "completed"


def test_a_second_run_that_the_gate_refuses_leaves_a_recording_that_says_so(bench):
    opened = bench.open

    def lame(rig, settings):
        device = opened(rig, settings)
        if len(bench.devices) == 2:
            bench.devices[-1].channels = FakeDevice.channels[:1]
        return device

    bench.patch.setattr(campaign, "open_device", lame)
    result, left = bench.go("y\ny\ny\n")
    assert isinstance(result.exception, GateError)
    assert left == ["t_1.mcap", "t_2.mcap"]
    assert [bench.status(name) for name in left] == ["completed", "failed"]
