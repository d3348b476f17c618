"""The outputs of a serial I/O node: volts and radians on this side, counts on the other.

All outputs are one: one CONFIGURE has the limits of each, one STREAM the references of the same
samples. A frame that does not arrive whole changes none of them.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from drivers.serial_node.link import Link
from drivers.serial_node.settings import Input, Output, SerialSettings
from drivers.serial_node.wire import (
    HALF,
    MAX_STREAM,
    Code,
    Hello,
    Limits,
    Type,
    configure_body,
    stream_body,
)
from samii_rig.devices.channels import centring_name
from samii_rig.devices.protocols import CommandBlock, DeviceLoop
from samii_rig.errors import DeviceError
from samii_rig.rig.schema import ActuatorSpec, Rig

Q16 = 1 << 16
MOST16, MOST32 = (1 << 15) - 1, HALF - 1
REFUSALS = {
    Code.NOT_NULL: "its output is not at null",
    Code.LIMIT: "a number is beyond the node's own hard limits",
    Code.STATE: "it has tripped, or its deadman has ended the run",
    Code.CAUSE: "the cause of its trip is still there (emergency input, or an input out of range)",
}


@dataclass(slots=True)
class Wired:
    """One output of the rig. angle : the encoder in whose counts its theta_ref is."""

    spec: ActuatorSpec
    output: Output
    own: Limits
    angle: Input

    def volts(self, counts: np.ndarray) -> np.ndarray:
        """In the actuator's unit, of counts less the null."""
        return counts / self.output.counts_per_unit


class Outputs:
    """Actuators of one node, in the rig file's order.

    Every frame to the node is sent inside `configure`, `write` or `zero`, so a stream cannot
    outlive the gate that calls them. What the node has and the rig file does not is held at null.
    """

    def __init__(self, rig: Rig, settings: SerialSettings, link: Link, hello: Hello) -> None:
        self.names = tuple(a.name for a in rig.actuator)
        # That of the node, which settings.check_node has held each of these against.
        self.deadman = rig.actuator[0].deadman
        self._rig, self._settings, self._link, self._hello = rig, settings, link, hello
        self.wired = tuple(
            Wired(a, o, hello.outputs[o.index], self._encoder(a.name, centring_name(rig, a.name)))
            for a, o in zip(rig.actuator, settings.outputs(rig), strict=True)
        )

    def configure(self, loops: tuple[DeviceLoop, ...]) -> None:
        """Set loops and limits; DeviceError if the node cannot or will not keep one of them."""
        self._one_for_each(loops)
        angles = [
            self._encoder(w.spec.name, loop.sensor)
            for w, loop in zip(self.wired, loops, strict=True)
        ]
        bodies = [_held(own) for own in self._hello.outputs]
        for w, loop, x in zip(self.wired, loops, angles, strict=True):
            bodies[w.output.index] = self._limits(w, loop, x)
        for w, x in zip(self.wired, angles, strict=True):
            w.angle = x
        body = b"".join(bodies)
        code = self._link.request(Type.CONFIGURE, body)
        if code is Code.STATE:
            # Latched. Whoever configures has been told to go on by a person.
            code = self._link.request(Type.CLEAR)
            code = code or self._link.request(Type.CONFIGURE, body)
        if code:
            why = REFUSALS.get(code, code.name)
            raise DeviceError(f"{', '.join(self.names)}: the node refuses its limits: {why}")

    def write(self, blocks: tuple[CommandBlock, ...]) -> None:
        """Stream reference samples; what comes too late or while tripped, the node ignores."""
        self._one_for_each(blocks)
        for w, block in zip(self.wired, blocks, strict=True):
            _check(w.spec.name, block)
        if len({(b.first, len(b)) for b in blocks}) != 1:
            raise DeviceError(f"{', '.join(self.names)}: references of different samples")
        n, k = len(blocks[0]), len(self._hello.outputs)
        u, ref = np.zeros((n, k), dtype=np.int64), np.zeros((n, k), dtype=np.int64)
        for w, block in zip(self.wired, blocks, strict=True):
            u[:, w.output.index], ref[:, w.output.index] = _counted(w, block)
        part = MAX_STREAM // k
        for i in range(0, n, part):
            own = slice(i, i + part)
            pairs = u[own].ravel().tolist(), ref[own].ravel().tolist()
            body = stream_body(blocks[0].first + i, *pairs, k)
            self._link.send(Type.STREAM, body)

    def zero(self) -> None:
        """Outputs to null. If the port does not take that, the node's deadman does it."""
        # No silence: the port's end is what read() raises next.
        with contextlib.suppress(DeviceError):
            self._link.send(Type.ZERO)

    def _one_for_each(self, given: Sequence[object]) -> None:
        if len(given) != len(self.names):
            raise DeviceError(
                f"{', '.join(self.names)}: {len(given)} given, one for each is needed"
            )

    def _limits(self, w: Wired, loop: DeviceLoop, x: Input) -> bytes:
        """Of CONFIGURE, of one output; DeviceError if the node cannot keep them."""
        name, out = w.spec.name, w.output.counts_per_unit
        if loop.feedback:
            raise DeviceError(
                f"{name}: the serial node has no filters, so it cannot run the feedback "
                f"{loop.feedback[0].name}; take [[feedback]] out of the rig file"
            )
        numbers = (loop.max_output, loop.max_rate, loop.max_angle)
        if not math.isfinite(loop.kp) or not all(x >= 0.0 for x in numbers):
            raise DeviceError(f"{name}: negative or missing number in {loop}")
        kp = round(loop.kp * out / x.counts_per_unit * Q16)
        if abs(kp) > MOST32:
            raise DeviceError(f"{name}: kp = {loop.kp:g} is beyond what the node can count")
        scale = abs(x.counts_per_unit)
        most = _counts(loop.max_output * abs(out))
        if most > w.own.max_output:
            limit = w.own.max_output / abs(out)
            raise DeviceError(
                f"{name}: a limit of {loop.max_output:g} is beyond the node's own hard limit "
                f"of {limit:.4g}"
            )
        return configure_body(
            encoder=x.index,
            adc_mask=self._watched(),
            kp_q16=kp,
            max_output=most,
            # The node's own step may be the tighter one: then it limits, and says so.
            max_step=min(_counts(loop.max_rate * abs(out) / self._rig.rate_hz), w.own.max_step),
            max_angle=_counts(loop.max_angle * scale),
            max_jump=min(w.own.max_jump, _counts((w.output.max_jump or math.inf) * scale)),
            centre=x.offset,
        )

    def _encoder(self, name: str, sensor: str) -> Input:
        if sensor not in self._settings.encoder:
            raise DeviceError(f"{name}: no encoder {sensor!r} to close the loop on")
        return self._settings.encoder[sensor]

    def _watched(self) -> int:
        """The analogue inputs that trip the node when out of range: those with a limit."""
        return sum(
            1 << x.index for name, x in self._settings.adc.items() if any(self._rig.limits_on(name))
        )


class OneOutput:
    """The actuator of a rig that drives one output."""

    def __init__(self, outputs: Outputs) -> None:
        self._outputs = outputs
        (self.name,) = outputs.names
        self.deadman = outputs.deadman

    def configure(self, loop: DeviceLoop) -> None:
        """Set loop and limits; DeviceError if the node cannot or will not keep them."""
        self._outputs.configure((loop,))

    def write(self, block: CommandBlock) -> None:
        """Stream reference samples; what comes too late or while tripped, the node ignores."""
        self._outputs.write((block,))

    def zero(self) -> None:
        """Output to null. If the port does not take that, the node's deadman does it."""
        self._outputs.zero()


def _held(own: Limits) -> bytes:
    """Of CONFIGURE, of an output that the rig file does not have: at null, whatever comes."""
    return configure_body(
        encoder=0,
        adc_mask=0,
        kp_q16=0,
        max_output=0,
        max_step=0,
        max_angle=MOST32,
        max_jump=own.max_jump,
        centre=0,
    )


def _check(name: str, block: CommandBlock) -> None:
    """DeviceError for a reference that is none."""
    if block.u.shape != block.theta_ref.shape or block.u.ndim != 1:
        raise DeviceError(f"{name}: u and theta_ref of a block differ in length")
    if not (np.isfinite(block.u).all() and np.isfinite(block.theta_ref).all()):
        raise DeviceError(f"{name}: a reference sample is not a finite number")


def _counted(w: Wired, block: CommandBlock) -> tuple[np.ndarray, np.ndarray]:
    """u and theta_ref in counts; DeviceError for what the wire cannot carry."""
    u = np.rint(block.u * w.output.counts_per_unit)
    ref = np.rint(block.theta_ref * w.angle.counts_per_unit + w.angle.offset)
    if np.abs(u).max(initial=0.0) > MOST16 or np.abs(ref).max(initial=0.0) > MOST32:
        raise DeviceError(f"{w.spec.name}: a reference sample is beyond what the node can count")
    return u.astype(np.int64), ref.astype(np.int64)


def _counts(x: float) -> int:
    """Rounded down, so that a limit stays one; at most what 32 bits hold."""
    return math.floor(min(x, MOST32) + 1e-9)
