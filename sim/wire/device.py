"""The simulated rig on a wire as a device: `driver = "simulated_node"`.

Opening it starts the rig behind its serial port in a process of its own, and opens that port with
the driver `serial_node`; closing it ends both. Everything is as at the bench, in real time.
"""

from __future__ import annotations

import json
import select
import subprocess
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Any

from pydantic import Field

from samii_rig.devices.opening import open_device
from samii_rig.devices.protocols import OpenRig
from samii_rig.diagnose.fit.rigfile import toml
from samii_rig.errors import DeviceError
from samii_rig.rig.schema import Device, Rig, Strict
from samii_rig.rig.settings import checked
from sim.wire.faults import script
from sim.wire.plant import board

STARTED_WITHIN = 120.0  # s: a machine that runs it for the first time compiles for half of that
ENDED_WITHIN = 10.0  # s, of a process that only has to see its input end


class NodeSettings(Strict):
    """Settings of the simulated node; an unknown one is an error.

    seed : of the noise and of the line's faults. noise : false makes the sensors ideal.
    faults : by name (`sim.wire.faults`), such as "reboot" or "stuck a_1 8.0".
    node : [device.settings] of the board that it stands for, a `serial_node`; without them one
        that fits the rig's sensors.
    """

    seed: Annotated[int, Field(ge=0)] = 0
    noise: bool = True
    faults: tuple[str, ...] = ()
    node: dict[str, Any] = Field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Wired(OpenRig):
    """The opened port, and the process behind it."""

    port: OpenRig
    process: subprocess.Popen[str]

    def close(self) -> None:
        """Output zero, the port closed, the rig's process ended."""
        try:
            self.port.close()
        finally:
            _end(self.process)


def check_rig(rig: Rig, settings: Mapping[str, object]) -> None:
    """InputError for a wrong setting, an unknown fault, or more outputs than a node has."""
    chosen = checked(NodeSettings, rig, {**rig.device.settings, **settings})
    driver = Device(driver="serial_node", settings=chosen.node) if chosen.node else Device()
    script(rig, board(rig.model_copy(update={"device": driver})), chosen.faults)


def open_rig(rig: Rig, settings: Mapping[str, object]) -> OpenRig:
    """The rig in its process, with its port open and the output at zero.

    InputError for a wrong setting or an unknown fault; DeviceError if the rig does not start.
    """
    check_rig(rig, settings)
    chosen = checked(NodeSettings, rig, {**rig.device.settings, **settings})
    driver = Device(driver="serial_node", settings=chosen.node) if chosen.node else Device()
    wired = rig.model_copy(update={"device": driver})
    faults = script(rig, board(wired), chosen.faults)
    with TemporaryDirectory() as folder:
        process = _started(wired, chosen, faults, Path(folder))
        try:
            hello = _hello(process)
            found = Device(driver="serial_node", settings={**chosen.node, **hello["settings"]})
            port = open_device(rig.model_copy(update={"device": found}), {})
        except BaseException:
            _end(process)
            raise
    # The same dict, as the driver adds to it what it learns during the run.
    port.metadata["simulated"] = chosen.model_dump_json(exclude_defaults=True)
    said = f"simulated {rig.name}: {port.description}"
    return Wired(port.actuator, port.sensor, port.clock, said, port.metadata, port, process)


def _started(rig: Rig, chosen: NodeSettings, faults: str, folder: Path) -> subprocess.Popen[str]:
    file, lines = folder / "rig.toml", folder / "faults.txt"
    file.write_text(toml(rig), encoding="utf-8")
    lines.write_text(faults, encoding="utf-8")
    options = ["--rig", str(file), "--script", str(lines), "--seed", str(chosen.seed)]
    if not chosen.noise:
        options.append("--ideal")
    # -P: a folder `sim` where somebody works is not this one. A session of its own: Ctrl-C is for
    # who drives it, and a board does not go away at that; it ends with its input.
    return subprocess.Popen(
        [sys.executable, "-P", "-m", "sim.wire", *options],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )


def _hello(process: subprocess.Popen[str]) -> dict[str, Any]:
    """The first line, which it prints once it has read its files."""
    assert process.stdout is not None
    ready, _, _ = select.select([process.stdout], [], [], STARTED_WITHIN)
    line = process.stdout.readline() if ready else ""
    if not line:
        why = "said nothing" if not ready else "ended before it began"
        raise DeviceError(f"the simulated rig's process {why}; python -m sim.wire shows why")
    hello: dict[str, Any] = json.loads(line)
    return hello


def _end(process: subprocess.Popen[str]) -> None:
    assert process.stdin is not None
    assert process.stdout is not None
    process.stdin.close()
    try:
        process.wait(ENDED_WITHIN)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
    process.stdout.close()
