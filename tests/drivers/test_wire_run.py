"""A whole run over the wire, in real time: the same response as of the rig in this process."""

from pathlib import Path

import numpy as np
import pytest
from board_kit import NODES, options
from experiment_kit import SHORT
from wire_kit import Wire, slow_deadman

from samii_rig.rig.load import load_rig
from samii_rig.rig.schema import Device, Rig
from samii_rig.run.campaign import Outcome, carry_out
from samii_rig.run.dryrun import predict
from samii_rig.run.order import RunOrder
from samii_rig.run.plan import Plan


def done(rig: Rig, plan: Plan, path: Path, settings: dict[str, object]) -> Outcome:
    return carry_out(RunOrder(rig, "", "", plan, predict(plan, rig), settings), path)


@pytest.mark.parametrize("node", NODES)
def test_the_response_over_the_wire_is_that_of_the_rig_in_this_process(tmp_path, node):
    file = slow_deadman(tmp_path)
    rig = load_rig(str(file))[0]
    plan = SHORT.plan(rig)
    wire = Wire("--seed", "3", *options(node), rig=str(file))
    try:
        wire.rest()
        wired = done(wire.rig, plan, tmp_path / "wire.mcap", {})
        state = wire.history()
    finally:
        wire.close()
    assert wired.stop.status == "completed", wired.stop.reason
    assert wired.stop.missing_samples == 0
    assert (state["state"], state["v"]) == ("IDLE", 0)
    assert wired.recording.metadata["device_device"] == "serial_node"

    plain = rig.model_copy(update={"device": Device()})
    inside = done(plain, plan, tmp_path / "inside.mcap", {"seed": 4})
    (a,), (b,) = wired.responses, inside.responses
    assert np.array_equal(a.frequency, b.frequency)
    # In units of the standard deviation of the difference, squared. Over 780 pairs of runs of one
    # rig the median of these 40 values lay between 0.16 and 0.87; a gain 1 % off makes it 80.
    apart = np.abs(a.H - b.H) ** 2 / (a.variance() + b.variance())
    assert 0.05 < np.median(apart) < 1.5
    assert np.mean(apart < 16.0) > 0.9
