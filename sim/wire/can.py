"""`python -m sim.wire.can --rig FILE`: the simulated rig behind a serial node, with a
force/torque sensor behind an slcan adapter.

Both ports are served by one process, so that both see one rig. The sensor measures the moments of
the rig file (sensors of kind "moment"); everything else is the node's. The first line that it
prints is JSON: both ports, and the [device.settings] that belong to them. Commands are those of
sim/wire/rig.py, and

    can loss P           of a frame to the host
    can delay S          of every reply
    can bus-off 0|1      the adapter's controller has left the bus, or is back
    can silent 0|1       the sensor has no power, or has it again
    can stuck 0|1        its gauges stand still, or no longer
    can status WORD      its status word, 0 for all well
    can scale X          it delivers so much more than its calibration says
    can foreign HZ       another sender on its identifier
    can other HZ         another sender on another identifier
    can unplug | plug    the adapter's port vanishes; comes back, under another name
    can rest             all of it undone
"""

from __future__ import annotations

import sys
import time
from pathlib import Path

import numpy as np

from samii_rig.errors import InputError
from samii_rig.rig.schema import Device, Moment, Rig
from samii_rig.types import Float
from sim.settings import SimSettings
from sim.wire.can_adapter import Adapter
from sim.wire.can_sensor import Sensor
from sim.wire.program import options, run
from sim.wire.rig import WireRig

BASE = 0x20  # the sensor's base identifier
AXES = ("Fx", "Fy", "Fz", "Tx", "Ty", "Tz")
MOMENTS = ("Tz", "Ty", "Tx")  # axes in the order of the rig's moments
NO_END = 1000.0  # N m, of a sensor without an end of range
MARGIN = 2.0  # of the sensor's range over that of the rig file


class CanWireRig(WireRig):
    """The rig with two ports."""

    def __init__(
        self, rig: Rig, settings: SimSettings, link: Path | None, can_link: Path | None
    ) -> None:
        self._axes = _axes(rig)
        self._moments = [s for s in rig.sensor if s.name in self._axes]
        super().__init__(rig, settings, link)
        order = [s.name for s in rig.sensor]
        self._at = [order.index(s.name) for s in self._moments]
        noise, line = np.random.SeedSequence((settings.seed, 1)).spawn(2)
        self._noise = np.random.default_rng(noise)
        self._rms = np.array([s.noise_rms if settings.noise else 0.0 for s in self._moments])
        self._before = self._after = np.zeros(len(self._moments))
        ends = [max(abs(s.low), abs(s.high)) for s in self._moments]
        most = max((e for e in ends if np.isfinite(e)), default=NO_END)
        self.sensor = Sensor(BASE, self._loads, MARGIN * most)
        self.adapter = Adapter(self.sensor, np.random.default_rng(line), can_link)
        self.adapter.plug()

    def settings(self) -> dict[str, object]:
        """[device.settings] of the composite rig."""
        axes = {n: {"axis": axis, "sign": sign} for n, (axis, sign) in self._axes.items()}
        return {
            "main": {"driver": "serial_node", **self.board.settings(self.port)},
            "ft": {
                "driver": "force_torque",
                "sensors": list(axes),
                "interface": "slcan",
                "channel": self.adapter.port,
                "base_id": BASE,
                "axes": axes,
            },
        }

    def hello(self) -> dict[str, object]:
        """What a program needs to know to open the ports."""
        return {"port": self.port, "can": self.adapter.port, "settings": self.settings()}

    def close(self) -> None:
        """Both ports vanish."""
        super().close()
        self.adapter.unplug()

    def obey(self, line: str) -> bool:
        """Carry out one command; False for quit. InputError for what is none."""
        words = line.split()
        if words[:1] != ["can"]:
            return super().obey(line)
        a, s = self.adapter, self.sensor
        try:
            match words[1:]:
                case ["loss" | "delay" | "foreign" | "other" as name, x]:
                    setattr(a, name, float(x))
                case ["bus-off", level]:
                    a.bus_off = bool(int(level))
                case ["silent" | "stuck" as name, level]:
                    setattr(s, name, bool(int(level)))
                case ["status", word]:
                    s.status = int(word, 0)
                case ["scale", x]:
                    s.scale = float(x)
                case ["unplug"]:
                    a.unplug()
                case ["plug"]:
                    a.plug()
                    self.say(self.hello())
                case ["rest"]:
                    a.loss = a.delay = a.foreign = a.other = 0.0
                    a.bus_off = s.silent = s.stuck = False
                    s.status, s.scale = 0, 1.0
                case _:
                    raise ValueError(line)
        except ValueError as error:
            raise InputError("wire rig", "command", line, "one of those in sim/wire/can.py") from (
                error
            )
        return True

    def _wired(self, rig: Rig) -> Rig:
        """Without what the force/torque sensor measures."""
        device = rig.device
        if device.driver == "composite" and "main" in device.settings:
            main = dict(device.settings["main"])
            device = Device(driver=str(main.pop("driver", "")), settings=main)
        rest = tuple(s for s in rig.sensor if s.name not in self._axes)
        return rig.model_copy(update={"sensor": rest, "device": device})

    def _ports(self) -> list[int]:
        return [*super()._ports(), self.adapter.fd]

    def _step(self) -> None:
        super()._step()
        self._before = self._after
        self._after = np.array([self._plant.load(i) for i in self._at])

    def _transmit(self) -> None:
        super()._transmit()
        self.adapter.serve()

    def _loads(self) -> Float:
        """(6,) N and N m now, between the plant's samples."""
        part = (time.monotonic_ns() - self._due) / (self._config.period_ns * self.pace)
        between = self._before + min(max(part, 0.0), 1.0) * (self._after - self._before)
        noisy = between + self._rms * self._noise.standard_normal(len(between))
        loads = np.zeros(6)
        for s, value in zip(self._moments, noisy, strict=True):
            axis, sign = self._axes[s.name]
            loads[AXES.index(axis)] = sign * value
        return loads


def _axes(rig: Rig) -> dict[str, tuple[str, int]]:
    """Axis and sign of the sensors that are the force/torque sensor's: what the rig file states
    for such a device of a composite rig, or its moments."""
    try:
        for given in rig.device.settings.values() if rig.device.driver == "composite" else ():
            if given["driver"] == "force_torque":
                named = given["axes"].items()
                return {str(n): (str(a["axis"]), int(a.get("sign", 1))) for n, a in named}
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        where = "device.settings"
        raise InputError.saying(rig.name, where, f"not a composite rig's: {error}") from error
    moments = [s.name for s in rig.sensor if isinstance(s, Moment)]
    if not 0 < len(moments) <= len(MOMENTS):
        expected = f"1 to {len(MOMENTS)} of kind moment, for the force/torque sensor"
        raise InputError(rig.name, "sensor", len(moments), expected)
    return {name: (axis, 1) for name, axis in zip(moments, MOMENTS, strict=False)}


def main() -> int:
    """Run until standard input ends, `quit` or Ctrl-C."""
    parser = options("sim.wire.can", __doc__, "path of a rig file with moment sensors")
    parser.add_argument("--can-link", type=Path, help="one that leads to the adapter's port")
    parser.add_argument("--drift", type=float, default=0.0, help="ppm by which the node is slow")
    chosen = parser.parse_args()

    def make(rig: Rig, settings: SimSettings) -> CanWireRig:
        made = CanWireRig(rig, settings, chosen.link, chosen.can_link)
        made.pace = 1.0 + chosen.drift * 1e-6
        return made

    return run(chosen, make)


if __name__ == "__main__":
    sys.exit(main())
