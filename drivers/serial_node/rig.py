"""A rig behind a serial I/O node: volts and radians on this side, counts on the other."""

from __future__ import annotations

import contextlib
import math
import time
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from drivers.sensing import taken
from drivers.serial_node.continuity import Continuity
from drivers.serial_node.link import KEPT, Link
from drivers.serial_node.settings import Input, SerialSettings, check_node, read_settings
from drivers.serial_node.wire import (
    HALF,
    MAX_STREAM,
    Code,
    Event,
    Flag,
    Hello,
    State,
    Type,
    configure_body,
    reason_text,
    stream_body,
)
from samii_rig.devices.clock import MonotonicClock
from samii_rig.devices.protocols import CommandBlock, DeviceEvent, DeviceLoop, OpenRig
from samii_rig.errors import DeviceError, InputError
from samii_rig.rig.schema import Rig
from samii_rig.types import Channel, Flags, Int, Quality, SampleBlock

Q16 = 1 << 16
MOST32 = HALF - 1
RAILS = (-(1 << 15), (1 << 15) - 1)  # where an ADC is out of its range
TELL_EVERY = 0.25  # s between two events that count the line's faults
TRIPPED = "the node had tripped while no program was there"
REFUSALS = {
    Code.NOT_NULL: "its output is not at null",
    Code.LIMIT: "a number is beyond the node's own hard limits",
    Code.STATE: "it has tripped, or its deadman has ended the run",
    Code.CAUSE: "the cause of its trip is still there (emergency input, or an input out of range)",
}


class SerialNode:
    """Actuator and sensor of one node.

    Every frame to the node is sent inside `configure`, `write` or `zero`, so a stream cannot
    outlive the gate that calls them.
    """

    def __init__(self, rig: Rig, settings: SerialSettings, link: Link, hello: Hello) -> None:
        spec = rig.actuator[0]
        self.name, self.deadman = spec.name, spec.deadman
        self._rig, self._settings, self._link, self._hello = rig, settings, link, hello
        self._inputs = [
            (s.name in settings.encoder, (settings.encoder | settings.adc)[s.name])
            for s in (*rig.sensor, *rig.monitor)
        ]
        centring = rig.centring.sensor if rig.centring else rig.sensor[0].name
        self._angle = self._encoder(centring)
        self.channels = _channels(rig, settings, centring)
        self._layout = np.dtype(
            [
                ("v", "<i2"),
                ("u", "<i2"),
                ("theta_ref", "<i4"),
                ("flags", "u1"),
                ("encoder", "<i4", (hello.n_encoder,)),
                ("adc", "<i2", (hello.n_adc,)),
            ]
        )
        self._line = Continuity(link, hello.period_ns, settings.max_bad_frames)
        self._told: dict[str, str | int | float] = {}
        self._tell_at = 0.0
        self._arrivals: deque[tuple[int, int]] = deque(maxlen=KEPT)
        # The way back is at most the whole round.
        self.latency = (0.0, link.round_trip)

    # Actuator

    def configure(self, loop: DeviceLoop) -> None:
        """Set loop and limits; DeviceError if the node cannot or will not keep them."""
        if loop.feedback:
            raise DeviceError(
                f"{self.name}: the serial node has no filters, so it cannot run the feedback "
                f"{loop.feedback[0].name}; take [[feedback]] out of the rig file"
            )
        numbers = (loop.max_output, loop.max_rate, loop.max_angle)
        if not math.isfinite(loop.kp) or not all(x >= 0.0 for x in numbers):
            raise DeviceError(f"{self.name}: negative or missing number in {loop}")
        x, out = self._encoder(loop.sensor), self._settings.output_counts_per_unit
        kp = round(loop.kp * out / x.counts_per_unit * Q16)
        if abs(kp) > MOST32:
            raise DeviceError(f"{self.name}: kp = {loop.kp:g} is beyond what the node can count")
        jump = self._settings.max_jump
        scale = abs(x.counts_per_unit)
        most = _counts(loop.max_output * abs(out))
        if most > self._hello.max_output:
            limit = self._hello.max_output / abs(out)
            raise DeviceError(
                f"{self.name}: a limit of {loop.max_output:g} is beyond the node's own hard limit "
                f"of {limit:.4g}"
            )
        body = configure_body(
            encoder=x.index,
            adc_mask=self._watched(),
            kp_q16=kp,
            max_output=most,
            # The node's own step may be the tighter one: then it limits, and says so.
            max_step=min(
                _counts(loop.max_rate * abs(out) / self._rig.rate_hz), self._hello.max_step
            ),
            max_angle=_counts(loop.max_angle * scale),
            max_jump=min(self._hello.max_jump, _counts((jump or math.inf) * scale)),
            centre=x.offset,
        )
        self._angle = x
        code = self._link.request(Type.CONFIGURE, body)
        if code is Code.STATE:
            # Latched. Whoever configures has been told to go on by a person.
            code = self._link.request(Type.CLEAR)
            code = code or self._link.request(Type.CONFIGURE, body)
        if code:
            why = REFUSALS.get(code, code.name)
            raise DeviceError(f"{self.name}: the node refuses its limits: {why}")

    def write(self, block: CommandBlock) -> None:
        """Stream reference samples; what comes too late or while tripped, the node ignores."""
        if block.u.shape != block.theta_ref.shape or block.u.ndim != 1:
            raise DeviceError(f"{self.name}: u and theta_ref of a block differ in length")
        if not (np.isfinite(block.u).all() and np.isfinite(block.theta_ref).all()):
            raise DeviceError(f"{self.name}: a reference sample is not a finite number")
        u = np.rint(block.u * self._settings.output_counts_per_unit)
        ref = np.rint(block.theta_ref * self._angle.counts_per_unit + self._angle.offset)
        if np.abs(u).max(initial=0.0) > RAILS[1] or np.abs(ref).max(initial=0.0) > MOST32:
            raise DeviceError(f"{self.name}: a reference sample is beyond what the node can count")
        counts, angles = u.astype(np.int64).tolist(), ref.astype(np.int64).tolist()
        for i in range(0, len(counts), MAX_STREAM):
            part = slice(i, i + MAX_STREAM)
            self._link.send(Type.STREAM, stream_body(block.first + i, counts[part], angles[part]))

    def zero(self) -> None:
        """Output to null. If the port does not take that, the node's deadman does it."""
        # No silence: the port's end is what read() raises next.
        with contextlib.suppress(DeviceError):
            self._link.send(Type.ZERO)

    # Sensor

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
            self._check_supply(raw["flags"])
        out = self._settings.output_counts_per_unit
        values[:, 0], values[:, 2] = raw["u"] / out, raw["v"] / out
        x = self._angle
        values[:, 1] = (raw["theta_ref"].astype(np.int64) - x.offset) / x.counts_per_unit
        quality[(raw["flags"] & Flag.LIMITED) != 0, 2] = Quality.LIMITED
        for i, (is_encoder, x) in enumerate(self._inputs, start=3):
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
        """The line is on while the output is live, and off at null."""
        live, on = (flags & Flag.NULL) == 0, (flags & Flag.SUPPLY) != 0
        if (live != on).any():
            self._line.trouble = (
                f"{self._link.name}: the node's supply line was not on while its output was live; "
                "does its firmware have one (device.settings.supply)?"
            )

    def _encoder(self, sensor: str) -> Input:
        if sensor not in self._settings.encoder:
            raise DeviceError(f"{self.name}: no encoder {sensor!r} to close the loop on")
        return self._settings.encoder[sensor]

    def _watched(self) -> int:
        """The analogue inputs that trip the node when out of range: those with a limit."""
        return sum(
            1 << x.index for name, x in self._settings.adc.items() if any(self._rig.limits_on(name))
        )


@dataclass(frozen=True, slots=True)
class SerialRig(OpenRig):
    """Releases the port after the output is at null."""

    node: SerialNode
    link: Link

    def close(self) -> None:
        """Output to null, port free."""
        self.actuator.zero()
        self.metadata.update(self.node.counts)
        self.link.close()


def open_rig(rig: Rig, settings: Mapping[str, object]) -> OpenRig:
    """The rig behind the node at `settings["port"]`, its output at null.

    InputError for a wrong setting or a node that is not the rig's, DeviceError if it does not
    open; one line each, with the remedy.
    """
    chosen = read_settings(rig, settings)
    centring = rig.centring.sensor if rig.centring else rig.sensor[0].name
    if centring not in chosen.encoder:
        raise InputError(
            rig.name, "device.settings.encoder", sorted(chosen.encoder), f"{centring} among them"
        )
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
    node = SerialNode(rig, chosen, link, hello)
    return SerialRig(
        node,
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
            "null_counts": str(hello.null),
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


def _counts(x: float) -> int:
    """Rounded down, so that a limit stays one; at most what 32 bits hold."""
    return math.floor(min(x, MOST32) + 1e-9)


def _channels(rig: Rig, settings: SerialSettings, centring: str) -> tuple[Channel, ...]:
    """Columns: u, theta_ref, v under the actuator's name, the sensors in the rig's order."""
    spec, unit = rig.actuator[0], rig.units()[centring]
    inputs = settings.encoder | settings.adc
    step = 1.0 / abs(settings.output_counts_per_unit)
    return (
        Channel("u", spec.unit, "reference", description="reference of the excitation"),
        Channel("theta_ref", unit, "reference", description=f"reference of {centring}"),
        Channel(
            spec.name, spec.unit, "command", spec.low, spec.high, step, "as put out by the node"
        ),
        *(
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
        ),
    )
