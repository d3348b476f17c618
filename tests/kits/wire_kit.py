"""The simulated rig on a serial port, in its own process, for tests of the real driver."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from pathlib import Path

from wait_kit import WITHIN, found

from samii_rig.devices.opening import open_device
from samii_rig.devices.protocols import OpenRig
from samii_rig.rig.load import load_rig
from samii_rig.rig.schema import Device, Rig

STARTED_WITHIN = 60.0  # s, with cold caches


class Wire:
    """`python -m sim.wire`, or another `program` like it, and the rig whose driver leads to it."""

    program, driver = "sim.wire", "serial_node"

    def __init__(self, *options: str, rig: str = "samii") -> None:
        self._name = rig
        self.image = "--image" in options  # the node is the firmware's image in an emulator
        self.process = subprocess.Popen(
            [sys.executable, "-m", self.program, "--rig", rig, *options],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        self.settings = self._answer()["settings"]
        device = Device(driver=self.driver, settings=self.settings)
        self.rig: Rig = load_rig(rig)[0].model_copy(update={"device": device})

    def open(self, **settings: object) -> OpenRig:
        return open_device(self.rig, settings)

    def rest(self) -> None:
        """Rig and node as new."""
        self.tell("rest")
        assert self.history()["v"] == 0

    def tell(self, *commands: str) -> None:
        assert self.process.stdin is not None
        self.process.stdin.write("".join(f"{c}\n" for c in commands))
        self.process.stdin.flush()

    def history(self) -> dict:
        self.tell("history")
        return self._answer()

    def plug(self) -> str:
        """The port's new name."""
        self.tell("plug")
        return self._answer()["port"]

    def _answer(self) -> dict:
        assert self.process.stdout is not None
        line = self.process.stdout.readline()
        assert line, "the simulated rig has ended"
        return json.loads(line)

    def close(self) -> None:
        assert self.process.stdin is not None
        self.process.stdin.close()
        self.process.wait(WITHIN)
        assert self.process.stdout is not None
        self.process.stdout.close()

    def rig_file(self, folder: Path) -> Path:
        """The shipped rig with its driver changed, as a file."""
        text = load_rig(self._name)[1]
        head = text[: text.index("[device]")]
        tables = [
            self._table(kind) for kind in ("output", "encoder", "adc") if kind in self.settings
        ]
        one = self.settings.get("output_counts_per_unit")
        path = folder / "wired.toml"
        path.write_text(
            head + '[device]\ndriver = "serial_node"\n\n[device.settings]\n'
            f'port = "{self.settings["port"]}"\n'
            + (f"output_counts_per_unit = {one}\n\n" if one else "\n")
            + "".join(tables)
        )
        return path

    def _table(self, kind: str) -> str:
        rows = [f"[device.settings.{kind}]\n"]
        for name, w in self.settings[kind].items():
            zero = "offset" if "offset" in w else "null"
            rows.append(
                f"{name} = {{ index = {w['index']}, counts_per_unit = {w['counts_per_unit']}, "
                f"{zero} = {w[zero]} }}\n"
            )
        return "".join(rows)


def slow_deadman(folder: Path, rig: str = "samii") -> Path:
    """A shipped rig whose deadman and sensors wait 0.12 s: the machine of the tests has other
    work, and what is real-time on it gives way to the rest for 50 ms of a second. From
    0.15 s on the loop would be 0.25 s ahead of silent sensors, and end for that reason."""
    path, text = folder / "slow.toml", load_rig(rig)[1]
    text = text.replace("deadman = 0.05", "deadman = 0.12").replace("stale_after = 0.05\n", "")
    path.write_text(text.replace("[[sensor]]\n", "[[sensor]]\nstale_after = 0.12\n"))
    return path


def until(what, seconds: float = 2.0) -> float:
    """Wait until `what()` is true; the time that it took, s."""
    start = time.monotonic()
    found(what, seconds, every=0.002)
    return time.monotonic() - start
