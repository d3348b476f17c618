"""Commands at the bench, on the wire-level rig: what they say, and that nothing else moves."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from typer.testing import CliRunner
from wire_kit import Wire

from samii_rig.cli.app import app
from samii_rig.errors import DeviceError, GateError, InputError
from samii_rig.rig.load import load_rig
from samii_rig.run import protections
from samii_rig.run.calibrate import (
    Wiring,
    null_volts,
    one_point,
    rewritten,
    rewritten_null,
    two_points,
    wiring,
)
from samii_rig.run.protections import own_protections
from samii_rig.safety.latch import Latch

TRIES = 4  # of a move in real time; a loaded machine may be later than a deadman allows


@pytest.fixture(scope="module")
def shared(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Wire, Path]]:
    w = Wire("--seed", "5")
    yield w, w.rig_file(tmp_path_factory.mktemp("rig"))
    w.close()


@pytest.fixture
def wire(shared: tuple[Wire, Path]) -> Wire:
    shared[0].rest()
    return shared[0]


@pytest.fixture
def rig(wire: Wire, shared: tuple[Wire, Path], tmp_path, monkeypatch) -> str:
    monkeypatch.setenv("SAMII_RIG_STATE", str(tmp_path / "state"))
    return str(shared[1])


def said(*words: str, code: int = 0) -> str:
    result = CliRunner().invoke(app, words, catch_exceptions=True)
    if result.exception and not isinstance(result.exception, SystemExit):
        raise result.exception
    assert result.exit_code == code, result.output
    return result.output


def moved(wire: Wire, rig: str, *words: str) -> dict:
    for _ in range(TRIES):
        result = CliRunner().invoke(app, [*words, "--rig", rig])
        if result.exit_code == 0:
            break
        latch = Latch("SAMII", "serial_node")
        if latch.fault:
            latch.clear("a test", "tries again")
        wire.rest()
    assert result.exit_code == 0, (result.output, result.exception)
    return json.loads(result.output) if "--json" in words else {"said": result.output}


def test_devices_names_ports_drivers_and_who_answers(rig):
    text = said("devices", "--rig", rig)
    assert "serial node SIM-0001" in text
    assert "firmware   simulated 1" in text
    assert "simulated" in text.splitlines()[0]
    found = json.loads(said("devices", "--rig", rig, "--json"))
    assert found["fault"] is None
    assert found["firmware"] == "simulated 1"


def test_devices_says_why_one_does_not_open(tmp_path, rig):
    path = tmp_path / "other.toml"
    text = Path(rig).read_text()
    path.write_text(text.replace(text[text.index('port = "') :].split("\n")[0], 'port = "/dev/no"'))
    assert "not open: /dev/no: no such port" in said("devices", "--rig", str(path))


def test_a_latched_fault_is_shown_and_cleared_by_a_person_only(wire, rig):
    Latch("SAMII", "serial_node").set("smoke")
    assert "FAULT      since" in said("devices", "--rig", rig)
    with pytest.raises(GateError, match="smoke"):
        said("jog", "--rig", rig)
    with pytest.raises(InputError, match="--name"):
        said("clear-fault", "--rig", rig, "--name", " ", "--reason", "x")
    wire.tell("emergency 1")
    wire.history()
    with pytest.raises(DeviceError, match="cause is still there"):
        said("clear-fault", "--rig", rig, "--name", "Ada", "--reason", "looked")
    wire.tell("emergency 0")
    wire.history()
    text = said("clear-fault", "--rig", rig, "--name", "Ada", "--reason", "hose replaced")
    assert "cleared by Ada: hose replaced" in text
    assert wire.history()["state"] == "IDLE"
    assert Latch("SAMII", "serial_node").fault is None


def test_a_jog_brings_the_joint_there_and_is_recorded(wire, rig, tmp_path):
    out = moved(
        wire, rig, "jog", "--to", "0.02", "--speed", "0.1", "--out", str(tmp_path), "--json"
    )
    assert out["after"] == pytest.approx(0.02, abs=out["within"])
    assert out["reached"]
    assert out["within"] == pytest.approx(0.02 * 0.02, rel=0.1)
    assert Path(out["recording"]).exists()
    assert wire.history()["v"] == 0


@pytest.mark.parametrize(
    ("words", "what"),
    [
        (("--to", "0.3"), "at most 0.28"),
        (("--speed", "1"), "at most 0.2"),
        (("--to", "nan"), "80 %"),
    ],
)
def test_a_jog_too_far_or_too_fast_is_refused(rig, words, what):
    with pytest.raises(InputError, match=what):
        said("jog", "--rig", rig, *words)


def test_doctor_finds_a_well_rig_well_and_names_what_is_not(wire, rig, tmp_path):
    wire.tell("freeze a_1 1")
    result = CliRunner().invoke(app, ["doctor", "--rig", rig, "--out", str(tmp_path), "--json"])
    checks = {c["what"]: c for c in json.loads(result.output)["checks"]}
    assert checks["device"]["verdict"] == "good"
    assert checks["theta_2"]["verdict"] == "good"
    assert checks["a_1"]["verdict"] == "look"
    assert "too quiet" in checks["a_1"]["remedy"]
    assert checks["disk"]["verdict"] in ("good", "look")


def protected(wire, rig, **answers: str) -> dict:
    """What `doctor --protections` finds, where the person does what `answers` has."""
    asked = []

    def ask(what: str) -> None:
        asked.append(what)
        for word, command in answers.items():
            if word in what:
                wire.tell(command)

    checks = {c.what: c for c in own_protections(load_rig(rig)[0], ask)}
    assert len(asked) == sum(c in checks for c in ("emergency", "cleared", "reset"))
    return checks


def test_doctor_tries_the_devices_own_protections(wire, rig):
    found = protected(wire, rig, open="emergency 1", close="emergency 0", press="reboot")
    assert {name: c.verdict for name, c in found.items()} == dict.fromkeys(
        ("deadman", "emergency", "cleared", "reset"), "good"
    ), found
    assert "after the only reference, 50 are declared" in found["deadman"].found
    assert "the emergency input" in found["emergency"].found
    history = wire.history()
    assert (history["most"], history["v"]) == (0, 0)


def test_doctor_says_which_protection_did_not_act(wire, rig, monkeypatch):
    monkeypatch.setattr(protections, "WITHIN", 0.5)
    found = protected(wire, rig)
    assert found["deadman"].verdict == "good"
    assert found["emergency"].verdict == "bad"
    assert "wire a contact" in found["emergency"].remedy
    assert found["reset"].verdict == "look"
    held = protections._output
    monkeypatch.setattr(protections, "_output", lambda r, b: (held(r, b)[0], held(r, b)[1] & False))
    assert protected(wire, rig)["deadman"].remedy == "do not connect a valve to this device"


def test_doctor_sees_the_sign_of_the_encoder(wire, rig, tmp_path):
    from samii_rig.run.doctor import _sign

    the_rig, text = load_rig(rig)
    for _ in range(TRIES):
        wire.rest()
        good = _sign(the_rig, text, tmp_path)
        if good.verdict == "good":
            break
        Latch("SAMII", "serial_node").clear("a test", "again") if Latch(
            "SAMII", "serial_node"
        ).fault else None
    assert good.verdict == "good", good
    settings = json.loads(json.dumps(the_rig.device.settings))
    settings["encoder"]["theta_2"]["counts_per_unit"] *= -1
    turned = the_rig.model_copy(
        update={"device": the_rig.device.model_copy(update={"settings": settings})}
    )
    for _ in range(TRIES):
        wire.rest()
        latch = Latch("SAMII", "serial_node")
        if latch.fault:
            latch.clear("a test", "again")
        wrong = _sign(turned, text, tmp_path)
        if "turn the sign" in wrong.remedy:
            break
    assert "turn the sign of theta_2's counts_per_unit" in wrong.remedy, wrong


def test_an_offset_is_found_and_written_into_a_copy(wire, rig, tmp_path):
    wire.tell("offset a_0 500")
    new = tmp_path / "new.toml"
    said("calibrate", "a_0", "--rig", rig, "--to", str(new), "--yes", "--seconds", "0.3")
    assert wiring(load_rig(str(new))[0], "a_0") == Wiring(640.0, 500)
    with pytest.raises(InputError, match="a new name"):
        said("calibrate", "a_0", "--rig", rig, "--to", str(new), "--yes")
    with pytest.raises(InputError, match="an input of"):
        said("calibrate", "a_9", "--rig", rig, "--to", str(tmp_path / "b.toml"), "--yes")


def test_the_null_is_found_from_the_drift(wire, rig, tmp_path):
    new = tmp_path / "null.toml"
    text = moved(
        wire, rig, "calibrate", "null", "--seconds", "0.5", "--to", str(new), "--out", str(tmp_path)
    )["said"]
    assert "null 37 -> 37 counts" in text
    assert load_rig(str(new))[0].device.settings["null"] == 37


# What the numbers are


@given(
    gain=st.floats(1.0, 1e5),
    offset=st.integers(-30000, 30000),
    x=st.floats(-10, 10),
    y=st.floats(-10, 10),
)
def test_two_known_values_give_gain_and_offset_back(gain, offset, x, y):
    if abs(x - y) < 0.1:
        return
    true, old = Wiring(gain, offset), Wiring(100.0, 7)
    read = [(true.counts(v) - old.offset) / old.counts_per_unit for v in (x, y)]
    new = two_points(old, (read[0], read[1]), (x, y))
    assert new.counts_per_unit == pytest.approx(gain, rel=1e-6)
    assert abs(new.offset - offset) <= 1


def test_one_known_value_gives_the_offset():
    assert one_point(Wiring(100.0, 7), 0.5, 0.2) == Wiring(100.0, 37)
    with pytest.raises(InputError, match="two different values"):
        two_points(Wiring(100.0, 7), (0.5, 0.5), (0.0, 1.0))


def test_a_drift_at_zero_output_gives_the_null():
    theta = 0.3 + 0.02 * np.arange(1000) / 500.0
    assert null_volts(theta, 500.0, 0.5) == pytest.approx(-0.04)


def test_only_the_numbers_of_one_line_change():
    text = (
        '[device.settings]\nport = "x"\n[device.settings.adc]\na = { index = 1, '
        "counts_per_unit = 2.0 }\nab = { index = 2, offset = -3, counts_per_unit = 4.0 }\n"
    )
    new = rewritten(text, "f", "a", Wiring(5.0, 6))
    assert "a = { index = 1, counts_per_unit = 5.0, offset = 6 }" in new
    assert "ab = { index = 2, offset = -3, counts_per_unit = 4.0 }" in new
    assert "offset = 8, counts_per_unit = 1.5 }" in rewritten(text, "f", "ab", Wiring(1.5, 8))
    with pytest.raises(InputError, match="one line b"):
        rewritten(text, "f", "b", Wiring(1.0, 0))
    assert '[device.settings]\nnull = 4\nport = "x"' in rewritten_null(text, "f", 4)
    assert "null = 5\n" in rewritten_null(rewritten_null(text, "f", 4), "f", 5)
