"""Zero on a rig that declares a supply: the valve at null, then its supply off, on the wire."""

from __future__ import annotations

import time
from collections.abc import Iterator

import numpy as np
import pytest
from faults_kit import STATES, held, null_of
from wire_kit import Wire, slow_deadman, until

from samii_rig.run.session import listen
from samii_rig.safety.judgement import State

STRAY = "stray 500"  # counts: 0.15 V, which turn the joint at 0.076 rad/s


@pytest.fixture(scope="module", params=[True, False], ids=["supply", "none"])
def wire(request, tmp_path_factory) -> Iterator[Wire]:
    file = slow_deadman(tmp_path_factory.mktemp("rig"))
    w = Wire("--seed", "7", *(["--supply"] if request.param else []), rig=str(file))
    yield w
    w.close()


def way(host, seconds: float) -> float:
    """rad by which the joint turns in this time."""
    angles = []
    for _ in range(2):
        angles.append(np.mean(listen(host.device, 0.04).values[:, 3]))
        time.sleep(seconds)
    return float(abs(angles[1] - angles[0]))


@pytest.mark.parametrize("state", ["armed", "running"])
def test_a_converter_that_puts_out_a_voltage_by_itself_moves_nothing_without_supply(wire, state):
    supplied = wire.settings.get("supply", False)
    with held(wire, state) as host:
        wire.tell(STRAY)
        host.on(3.0)
        assert host.gate_state is State.FAULT
        assert "away from what was commanded" in host.fault
        # The null takes the line's time and a sample; what the converter adds no program ends.
        until(lambda: wire.history()["v"] == 500, 3.0)
        time.sleep(0.5)
        turned = way(host, 0.5)
        assert turned < 0.004 if supplied else turned > 0.02
        assert host.device.metadata.get("supply", "") == (
            "on only while the output is live" if supplied else ""
        )


def test_it_is_off_until_a_reference_is_there(wire):
    supplied = wire.settings.get("supply", False)
    if not supplied:
        pytest.skip("a rig without a declared supply")
    with held(wire, "safe") as host:
        wire.tell(STRAY)
        assert way(host, 0.5) < 0.004


@pytest.mark.parametrize("state", STATES)
def test_a_supply_line_that_does_not_follow_is_a_fault_once_it_is_needed(wire, state):
    supplied = wire.settings.get("supply", False)
    with held(wire, state) as host:
        wire.tell("supply 0")
        host.on(0.5)
        if supplied and state == "running":
            assert "the node's supply line was not on while its output was live" in host.fault
            assert host.gate_state is State.FAULT
            assert null_of(wire)["state"] == "IDLE"
        else:
            assert host.ended is None, host.ended
