"""Faults by name: what each is in this process and on the wire, and what is no fault.

Plan: a text becomes the settings or the command that it names, at its second; every name is on the
page; the rig on the wire as a device ends its process.
"""

from __future__ import annotations

import re

import numpy as np
import pytest
from conftest import ROOT

from samii_rig.devices.opening import open_device
from samii_rig.errors import InputError
from samii_rig.rig.load import load_rig
from samii_rig.rig.schema import Device
from sim import faults
from sim.settings import read_settings
from sim.wire import faults as wire
from sim.wire.device import Wired, open_rig
from sim.wire.plant import board

RIG = load_rig("samii")[0]
PAGE = (ROOT / "docs" / "guide" / "ci.md").read_text(encoding="utf-8")


def test_a_fault_adds_to_the_settings_that_are_there():
    s = read_settings(
        RIG, {"stuck": {"a_0": 1.0}, "drop": [7], "faults": ["stuck a_1 2.5", "nan a_2", "lost 1"]}
    )
    assert s.stuck == {"a_0": 1.0, "a_1": 2.5}
    assert s.nan == {"a_2": faults.AT}
    assert s.drop == (7, *range(500, 550))


def test_samples_that_are_lost_do_not_arrive():
    device = open_device(RIG, {"faults": ["lost 0.1"], "seed": 1})
    device.clock.sleep(0.5)
    assert np.array_equal(device.sensor.read().sequence, np.r_[:50, 100:250])


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "one of lost, nan, stuck"),
        ("stick a_1", "did you mean stuck"),
        ("stuck", r"'stuck', then one of theta_2, a_0"),
        ("stuck a_9", "did you mean a_"),
        ("stuck a_1 soon", "'stuck CHANNEL SECONDS', 0 or later"),
        ("stuck a_1 -1", "0 or later"),
        ("stuck a_1 nan", "0 or later"),
        ("lost 1 2", "'lost' or 'lost SECONDS'"),
    ],
)
def test_what_is_no_fault_is_said_with_what_would_be_one(text, said):
    with pytest.raises(InputError, match=rf"device\.settings\.faults is {text!r}.*{said}"):
        read_settings(RIG, {"faults": [text]})


def test_on_the_wire_they_are_commands_in_counts():
    b = board(RIG)
    given = ["jump 1", "drift a_0 2", "saturated a_1", "stray", "unplug 3", "stuck theta_2"]
    assert wire.script(RIG, b, given).splitlines() == [
        f"1.0 jump {round(0.1 * b.encoder['theta_2'].counts_per_unit)}",
        f"2.0 drift a_0 {0.1 * 50.0 * b.adc['a_0'].counts_per_unit}",
        f"5.0 rail {b.adc['a_1'].index} 1",
        f"5.0 stray {round(0.05 * 10.0 * b.output['v_2'].counts_per_unit)}",
        "3.0 unplug",
        "5.0 freeze theta_2 1",
    ]
    with pytest.raises(InputError, match=r"saturated theta_2.*one of a_0, a_1, a_2"):
        wire.script(RIG, b, ["saturated theta_2"])
    with pytest.raises(InputError, match="'nan a_0'; expected one of clock"):
        wire.script(RIG, b, ["nan a_0"])


def test_every_name_is_on_the_page_with_where_it_works():
    rows = re.findall(r"^\| (`.*`) \| (both|in process|wire) \|", PAGE, re.M)
    told = {
        (name.split()[0], bool(" CHANNEL" in name), where)
        for names, where in rows
        for name in re.findall(r"`([^`]*)`", names)
    }
    both = faults.IN_PROCESS.keys() & wire.COMMANDS.keys()
    known = {(n, x[0], "in process") for n, x in faults.IN_PROCESS.items() if n not in both}
    known |= {(n, x[0], "wire") for n, x in wire.COMMANDS.items() if n not in both}
    assert told == known | {(n, wire.COMMANDS[n][0], "both") for n in both}


@pytest.mark.real_time
def test_the_rig_on_the_wire_is_a_device_that_ends_its_process():
    given = {"seed": 3, "node": board(RIG).settings("/dev/none")}
    wired = open_rig(RIG.model_copy(update={"device": Device(settings=given)}), {})
    try:
        assert isinstance(wired, Wired)
        assert wired.process.poll() is None
        assert wired.metadata["device"] == "serial_node"
        assert wired.metadata["port"] != "/dev/none"
        assert wired.description.startswith("simulated SAMII: serial node")
    finally:
        wired.close()
    assert wired.process.returncode == 0


def test_a_rig_that_does_not_start_is_a_device_error_or_names_the_setting():
    with pytest.raises(InputError, match=r"settings\.sed is 1; .*did you mean seed"):
        open_rig(RIG, {"sed": 1})
    with pytest.raises(InputError, match="not a serial node's"):
        open_rig(RIG, {"node": {"port": "x"}})
