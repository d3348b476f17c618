"""An encoder that drifts, on the wire, in each state: FAULT within the limit of the rig file."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from faults_kit import PATIENCE, held, null_of
from gate_agreement_kit import ONE, TWO
from wire_kit import Wire, slow_deadman

from samii_rig.errors import GateError
from samii_rig.safety.judgement import State

# Which agreement, counts a second that theta_2 drifts, samples until it is as far away: 0.02 rad at
# 0.031 rad/s, and 0.03 rad at 0.15 rad/s, of which 2 s are remembered.
CASES = {"pot_2": (TWO, 800, 326), "v_2": (ONE, 4000, 103)}


@pytest.fixture(scope="module", params=CASES)
def case(request, tmp_path_factory) -> Iterator[tuple[Wire, str, int, int]]:
    agreement, counts, samples = CASES[request.param]
    path = slow_deadman(tmp_path_factory.mktemp("rig"))
    path.write_text(path.read_text() + agreement)
    w = Wire("--seed", "7", rig=str(path))
    yield w, request.param, counts, samples
    w.close()


@pytest.mark.parametrize("state", ["armed", "running"])
def test_an_encoder_that_drifts_ends_at_null_and_is_latched(case, state):
    wire, other, counts, samples = case
    with held(wire, state) as host:
        wire.tell(f"drift theta_2 {counts}")
        host.on(3.0)
        assert host.ended, "it was not seen"
        assert host.gate_state is State.FAULT
        assert f"theta_2 and {other} are " in host.fault
        assert "one of them drifts" in host.fault
        h = null_of(wire)
        if state == "running":
            assert h["live"] - h["told"] <= 1.3 * samples + PATIENCE
        else:
            assert h["most"] == 0


def test_in_safe_no_gate_is_armed_on_it(case):
    wire, other, counts, _ = case
    with held(wire, "safe") as host:
        wire.tell(f"drift theta_2 {counts}")
        host.on(1.0)
        with pytest.raises(GateError, match=f"theta_2 and {other} are "):
            host.job.gate.arm(host.job.clock.now())
        assert host.gate_state is State.SAFE
        assert wire.history()["state"] == "IDLE"


def test_a_joint_that_is_driven_agrees(case):
    with held(case[0], "running") as host:
        host.on(2.0)
        assert host.ended is None, host.ended
