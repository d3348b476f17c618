"""Gate and loop as a state machine, a few hundred ways; `benchmarks/gate_machine.py` takes more."""

from __future__ import annotations

import subprocess
import sys

from gate_machine import GateAndLoop, GateAndPair
from hypothesis import settings

GateAndLoop.TestCase.settings = settings(max_examples=120, stateful_step_count=25, derandomize=True)
TestGateAndLoop = GateAndLoop.TestCase
GateAndPair.TestCase.settings = settings(max_examples=150, stateful_step_count=25, derandomize=True)
TestGateAndPair = GateAndPair.TestCase

GATE = ("gate", "judgement", "lane", "latest", "readback")
FOREIGN = (
    "signal",
    "record",
    "identify",
    "diagnose",
    "control",
    "report",
    "papers",
    "prove",
    "run",
)


def test_the_gate_depends_on_no_experiment_estimator_or_service():
    names = ", ".join(f"samii_rig.safety.{name}" for name in GATE)
    loaded = subprocess.run(
        [sys.executable, "-c", f"import {names}, sys; print(*sys.modules, sep='\\n')"],
        capture_output=True,
        text=True,
        check=True,
    ).stdout.splitlines()
    assert "samii_rig.safety.gate" in loaded
    foreign = [f"samii_rig.{room}" for room in FOREIGN]
    foreign += ["experiments", "drivers", "sim"]
    assert not [m for m in loaded if any(m == f or m.startswith(f"{f}.") for f in foreign)]
