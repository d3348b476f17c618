"""Hosts that can be killed: a process that has loaded everything and forks one for each line.

In comes JSON: {"rig", "state", "path"}; out goes "pid N", and from the host itself "ready N" once
it is in that state and "ended N CODE" when it is over. {"wait": N} is answered by "exit N CODE"
(minus the signal if one ended it).
"""

from __future__ import annotations

import json
import os
import sys
import threading
import time
from pathlib import Path

import numpy as np

from samii_rig.devices.opening import open_device
from samii_rig.rig.schema import Rig
from samii_rig.run.campaign import carry_out
from samii_rig.run.client import NOBODY, Client
from samii_rig.run.dryrun import DryRun, predict
from samii_rig.run.interrupts import Interrupts
from samii_rig.run.loop import _Run
from samii_rig.run.order import RunOrder
from samii_rig.run.pace import LoopSettings
from samii_rig.run.plan import Plan, PlannedSegment

EXIT = {"completed": 0, "stopped": 130, "tripped": 5, "failed": 6}
VOLTS, HZ = 0.5, 5.0


def say(text: str) -> None:
    os.write(1, f"{text}\n".encode())


def plan_of(rig: Rig, seconds: float, volts: float = VOLTS) -> Plan:
    """A sine at the output, without a step."""
    n = round(seconds * rig.rate_hz)
    u = volts * np.sin(2 * np.pi * HZ * np.arange(n) / rig.rate_hz)
    part = PlannedSegment("sine", "burst", volts, "V", 0, u, 0 * u, (HZ, HZ), 0 * u)
    return Plan("fault", rig.rate_hz, rig.actuator[0].name, 4.0, "theta_2", (part,), 0)


class Nowhere:
    """A sink."""

    def write(self, block: object) -> None: ...
    def event(self, time: int, name: str, payload: object) -> None: ...
    def segment(self, segment: object) -> None: ...


def rest(rig: Rig, state: str) -> int:
    """SAFE or ARMED, until a signal or a fault."""
    device = open_device(rig, {})
    job = _Run(plan_of(rig, 1.0), rig, device, Nowhere(), NOBODY, LoopSettings())
    with Interrupts() as interrupts:
        try:
            while job.newest < 0:
                time.sleep(0.004)
                job._read()
            if state == "armed":
                job.gate.arm(job.clock.now())
            say(f"ready {os.getpid()}")
            while not interrupts.reason:
                time.sleep(0.004)
                job._read()
            status = "stopped"
            job.gate.stop(interrupts.reason, job.clock.now())
        except BaseException as error:
            status = job.ended_by(error)[0]
    device.close()
    return EXIT[status]


def driven(rig: Rig, path: Path, predicted: DryRun) -> int:
    """RUNNING, recorded."""
    said = threading.Event()

    def progress(p: object) -> None:
        if not said.is_set():
            said.set()
            say(f"ready {os.getpid()}")

    plan = plan_of(rig, 30.0)
    loop = LoopSettings(report=0.02)
    order = RunOrder(rig, "", "", plan, predicted)
    outcome = carry_out(order, path, Client(progress), loop=loop)
    return EXIT[outcome.stop.status]


def main() -> None:
    predicted: DryRun | None = None
    for line in sys.stdin:
        asked = json.loads(line)
        if "wait" in asked:
            _, status = os.waitpid(asked["wait"], 0)
            say(f"exit {asked['wait']} {os.waitstatus_to_exitcode(status)}")
            continue
        rig = Rig.model_validate(asked["rig"])
        if predicted is None:
            predicted = predict(plan_of(rig, 2.0), rig)
        pid = os.fork()
        if pid:
            say(f"pid {pid}")
            continue
        code = 1
        try:
            if asked["state"] == "running":
                code = driven(rig, Path(asked["path"]), predicted)
            else:
                code = rest(rig, asked["state"])
            # One that ended before it was ready must not be waited for.
            say(f"ended {os.getpid()} {code}")
        except BaseException as error:
            code = getattr(error, "exit_code", 1)
            say(f"error {os.getpid()} {error!r}")
        finally:  # whatever signal comes now: a host never goes on as its own parent
            os._exit(code)


if __name__ == "__main__":
    main()
