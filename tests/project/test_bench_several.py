"""Commands at the bench on a rig with two outputs behind one node."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from typer.testing import CliRunner
from wire_kit import Wire

from samii_rig.cli.app import app
from samii_rig.errors import InputError
from samii_rig.rig.load import load_rig
from samii_rig.run.calibrate import rewritten_null
from samii_rig.run.protections import own_protections
from samii_rig.safety.latch import Latch

TRIES = 4  # of a move in real time; a loaded machine may be later than a deadman allows
TABLE = """[device.settings]
port = "x"
[device.settings.output]
v_2 = { index = 0, counts_per_unit = 3276.8, null = 37 }
v_3 = { index = 1, counts_per_unit = 3276.8 }
"""


@pytest.fixture(scope="module")
def shared(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Wire, Path]]:
    w = Wire("--seed", "5", rig="samii_two_joints")
    yield w, w.rig_file(tmp_path_factory.mktemp("rig"))
    w.close()


@pytest.fixture
def wire(shared: tuple[Wire, Path]) -> Wire:
    shared[0].rest()
    return shared[0]


@pytest.fixture
def rig(shared: tuple[Wire, Path]) -> str:
    return str(shared[1])


def test_doctor_tries_the_devices_own_protections_of_both_outputs(wire, rig):
    def ask(what: str) -> None:
        for word, command in (
            ("open", "emergency 1"),
            ("close", "emergency 0"),
            ("press", "reboot"),
        ):
            if word in what:
                wire.tell(command)

    found = {c.what: c for c in own_protections(load_rig(rig)[0], ask)}
    assert {name: c.verdict for name, c in found.items()} == dict.fromkeys(
        ("deadman", "emergency", "cleared", "reset"), "good"
    ), found
    history = wire.history()
    assert (history["most"], history["v"]) == (0, 0)


@pytest.mark.parametrize(("actuator", "null"), [("v_2", 37), ("v_3", -12)])
def test_the_null_of_each_output_is_found_while_the_other_rests(
    wire, rig, tmp_path, actuator, null
):
    for i in range(TRIES):
        new = tmp_path / f"{i}.toml"
        asked = ["--rig", rig, "--seconds", "0.5", "--to", str(new), "--out", str(tmp_path)]
        result = CliRunner().invoke(app, ["calibrate", "null", "--actuator", actuator, *asked])
        if result.exit_code == 0:
            break
        wire.rest()
        latch = Latch("SAMII two joints", "serial_node")
        if latch.fault:
            latch.clear("a test", "again")
    assert f"the joint of {actuator} stands still" in result.output
    assert f"null {null} -> {null} counts" in result.output
    table = load_rig(str(new))[0].device.settings["output"]
    assert {name: o["null"] for name, o in table.items()} == {"v_2": 37, "v_3": -12}


def test_an_actuator_that_is_none_is_one_line(rig, tmp_path):
    asked = ["--rig", rig, "--to", str(tmp_path / "new.toml"), "--actuator", "v_9"]
    result = CliRunner().invoke(app, ["calibrate", "null", *asked])
    assert isinstance(result.exception, InputError)
    assert "v_2, v_3" in str(result.exception)


def test_only_the_null_of_one_output_is_written():
    assert rewritten_null(TABLE, "f", 5, "v_2") == TABLE.replace("null = 37", "null = 5")
    new = rewritten_null(TABLE, "f", -4, "v_3")
    assert new == TABLE.replace("3276.8 }", "3276.8, null = -4 }")
    with pytest.raises(InputError, match="one line v_4"):
        rewritten_null(TABLE, "f", 5, "v_4")
