"""A rig behind a serial I/O node: what it samples, and how it is opened."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from drivers.sensing import taken
from drivers.serial_node.continuity import Continuity
from drivers.serial_node.link import FRAMES_KEPT, Link
from drivers.serial_node.outputs import OneOutput, Outputs
from drivers.serial_node.settings import SerialSettings, check_node, read_settings
from drivers.serial_node.wire import Event, Flag, Hello, State, Type, reason_text
from samii_rig.devices.channels import centring_name, command_channel, reference_channels
from samii_rig.devices.clock import MonotonicClock
from samii_rig.devices.protocols import DeviceEvent, OpenRig
from samii_rig.errors import DeviceError, InputError
from samii_rig.rig.schema import Rig
from samii_rig.types import Channel, Flags, Int, Quality, SampleBlock

RAILS = (-(1 << 15), (1 << 15) - 1)  # where an ADC is out of its range
TELL_EVERY = 0.25  # s between two events that count the line's faults
TRIPPED = "the node had tripped while no program was there"


class SerialNode:
    """The sensor of one node: what its outputs and inputs were, in the rig file's units."""

    def __init__(
        self, rig: Rig, settings: SerialSettings, link: Link, hello: Hello, outputs: Outputs
    ) -> None:
        self._settings, self._link, self._hello = settings, link, hello
        self._outputs = outputs.wired
        self._inputs = [
            (s.name in settings.encoder, (settings.encoder | settings.adc)[s.name])
            for s in (*rig.sensor, *rig.monitor)
        ]
        self.channels = _channels(rig, settings)
        reported = [("v", "<i2"), ("u", "<i2"), ("theta_ref", "<i4"), ("flags", "u1")]
        self._layout = np.dtype(
            [
                ("output", reported, (len(hello.outputs),)),
                ("encoder", "<i4", (hello.n_encoder,)),
                ("adc", "<i2", (hello.n_adc,)),
            ]
        )
        self._line = Continuity(link, hello.period_ns, settings.max_bad_frames)
        self._told: dict[str, str | int | float] = {}
        self._tell_at = 0.0
        self._arrivals: deque[tuple[int, int]] = deque(maxlen=FRAMES_KEPT)
        # The way back is at most the whole round.
        self.latency = (0.0, link.round_trip)

    def read(self) -> SampleBlock:
        """All samples since the last call. DeviceError, after the last one that came, when the
        port is gone, the node has rebooted or its clock jumped, or too many frames are bad."""
        if self._line.trouble:
            raise DeviceError(self._line.trouble)
        trouble = self._link.trouble
        came = [self._link.samples.popleft() for _ in range(len(self._link.samples))]
        frames = [frame for _, frame in came]
        if not frames and trouble:
            raise DeviceError(trouble)
        starts = self._line.take(frames)
        frames = frames[: len(starts)]
        raw = np.frombuffer(b"".join(f.data for f in frames), dtype=self._layout)
        period = self._hello.period_ns
        # A frame leaves when its last sample is taken.
        self._arrivals += [
            (c * 1000 + (f.n - 1) * period, at)
            for (_, c), (at, f) in zip(starts, came[: len(starts)], strict=True)
        ]
        steps = [np.arange(f.n, dtype=np.int64) for f in frames]
        none = np.zeros(0, dtype=np.int64)
        sequence = np.concatenate([none, *(s + k for (s, _), k in zip(starts, steps, strict=True))])
        clock = np.concatenate(
            [none, *(c * 1000 + k * period for (_, c), k in zip(starts, steps, strict=True))]
        )
        values = np.empty((len(raw), len(self.channels)))
        quality = np.zeros((len(raw), len(self.channels)), dtype=np.uint8)
        if self._settings.supply:
            self._check_supply(raw["output"]["flags"][:, 0])
        k = len(self._outputs)
        for j, w in enumerate(self._outputs):
            own = raw["output"][:, w.output.index]
            values[:, 2 * j], values[:, 2 * k + j] = w.volts(own["u"]), w.volts(own["v"])
            angle = own["theta_ref"].astype(np.int64) - w.angle.offset
            values[:, 2 * j + 1] = angle / w.angle.counts_per_unit
            quality[(own["flags"] & Flag.LIMITED) != 0, 2 * k + j] = Quality.LIMITED
        for i, (is_encoder, x) in enumerate(self._inputs, start=3 * k):
            counts = raw["encoder" if is_encoder else "adc"][:, x.index].astype(np.int64)
            values[:, i] = (counts - x.offset) / x.counts_per_unit
            ends = (values[:, i] <= self.channels[i].low) | (values[:, i] >= self.channels[i].high)
            if not is_encoder:
                ends |= (counts <= RAILS[0]) | (counts >= RAILS[1])
            quality[ends, i] = Quality.CLIPPED
        return SampleBlock(self.channels, clock, sequence, values, quality)

    def arrivals(self) -> Int:
        """(n, 2) ns: node's and host's time of the frames that `read` gave since the last call."""
        return taken(self._arrivals)

    def events(self) -> list[DeviceEvent]:
        """Changes of the node's state, and the counts of the line when they changed."""
        node = [self._link.events.popleft() for _ in range(len(self._link.events))]
        told = [DeviceEvent(self._line.time_of(e), "node", _change(e)) for e in node]
        bad = self._line.bad()
        if bad != self._told and (time.monotonic() >= self._tell_at or self._line.trouble):
            self._told, self._tell_at = bad, time.monotonic() + TELL_EVERY
            told.append(DeviceEvent(self._line.clock, "line", bad))
        return told

    @property
    def counts(self) -> dict[str, str]:
        """How the line did so far, as text."""
        bad = {name: str(n) for name, n in self._line.bad().items()}
        return {
            "frames": str(self._link.decoder.frames),
            **bad,
            "node_last_reason": self._link.last_reason(),
        }

    def _check_supply(self, flags: Flags) -> None:
        """The line is on while the outputs are live, and off at null."""
        live, on = (flags & Flag.NULL) == 0, (flags & Flag.SUPPLY) != 0
        if (live != on).any():
            self._line.trouble = (
                f"{self._link.name}: the node's supply line was not on while its output was live; "
                "does its firmware have one (device.settings.supply)?"
            )


@dataclass(frozen=True, slots=True)
class SerialRig(OpenRig):
    """Releases the port after the outputs are at null."""

    node: SerialNode
    link: Link

    def close(self) -> None:
        """Outputs to null, port free."""
        self.actuator.zero()
        self.metadata.update(self.node.counts)
        self.link.close()


def open_rig(rig: Rig, settings: Mapping[str, object]) -> OpenRig:
    """The rig behind the node at `settings["port"]`, its outputs at null.

    InputError for a wrong setting or a node that is not the rig's, DeviceError if it does not
    open; one line each, with the remedy.
    """
    chosen = read_settings(rig, settings)
    for spec in rig.actuator:
        centring, where = centring_name(rig, spec.name), "device.settings.encoder"
        if centring not in chosen.encoder:
            raise InputError(rig.name, where, sorted(chosen.encoder), f"{centring} among them")
    link = Link(chosen.port, chosen.baud)
    try:
        hello = link.identify(chosen.baud)
        link.measure(chosen.baud)
        check_node(rig, chosen, hello)
        link.send(Type.ZERO)
        if hello.state is State.TRIPPED and link.request(Type.CLEAR):
            raise DeviceError(
                f"{chosen.port}: the node has tripped and its cause is still there; release the "
                "emergency input, look at the analogue inputs"
            )
    except BaseException:
        link.close()
        raise
    outputs = Outputs(rig, chosen, link, hello)
    node = SerialNode(rig, chosen, link, hello, outputs)
    return SerialRig(
        outputs if len(rig.actuator) > 1 else OneOutput(outputs),
        node,
        MonotonicClock(),
        f"serial node {hello.serial} at {chosen.port}, firmware {hello.firmware}",
        {
            "device": "serial_node",
            "clock": "device",
            "port": chosen.port,
            "firmware": hello.firmware,
            "serial": hello.serial,
            "boot": str(hello.boot),
            "null_counts": ", ".join(str(w.own.null) for w in outputs.wired),
            "device_settings": chosen.model_dump_json(),
            **({"supply": "on only while the output is live"} if chosen.supply else {}),
            **({"tripped": TRIPPED} if hello.state is State.TRIPPED else {}),
        },
        node,
        link,
    )


def _change(event: Event) -> dict[str, str | int | float]:
    state = State(event.state).name if event.state <= max(State) else str(event.state)
    return {"state": state, "reason": reason_text(event.reason), "sample": event.sample}


def _channels(rig: Rig, settings: SerialSettings) -> tuple[Channel, ...]:
    """Columns: references, the output of each actuator, the sensors in the rig's order."""
    inputs = settings.encoder | settings.adc
    commands = (
        command_channel(spec, 1.0 / abs(o.counts_per_unit), "as put out by the node")
        for spec, o in zip(rig.actuator, settings.outputs(rig), strict=True)
    )
    sensors = (
        Channel(
            s.name,
            s.unit,
            "sensor" if s in rig.sensor else "monitor",
            s.low,
            s.high,
            1.0 / abs(inputs[s.name].counts_per_unit),
            s.calibration,
        )
        for s in (*rig.sensor, *rig.monitor)
    )
    return *reference_channels(rig), *commands, *sensors
