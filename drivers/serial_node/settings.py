"""Settings of a serial I/O node: [device.settings] of a rig file, held against rig and node."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated

from pydantic import Field

from drivers.serial_node.wire import OVERHEAD, Hello
from samii_rig.errors import InputError
from samii_rig.rig.schema import Finite, Name, NonNegative, Positive, Rig, Strict
from samii_rig.rig.settings import checked, wrong
from samii_rig.safety.limits import MAX_AHEAD

SYMBOL_BITS = 10  # a byte on an asynchronous line: start, 8 data, stop
RATE_ERROR = 1e-6  # relative difference of node's and rig's sample rate that is none


class Input(Strict):
    """One input of the node: value = (counts - offset)/counts_per_unit, in the sensor's unit.

    A negative `counts_per_unit` turns the sign.
    """

    index: Annotated[int, Field(ge=0)]
    counts_per_unit: Finite
    offset: Annotated[int, Field(ge=-(1 << 31), lt=1 << 31)] = 0


class SerialSettings(Strict):
    """Settings of the driver; an unknown one is an error.

    port : of the operating system, such as /dev/ttyACM0 or COM3. baud : of a true serial line.
    encoder, adc : by sensor name; every sensor and monitor of the rig is in one of them.
    output_counts_per_unit : of the actuator. null : the converter's counts at which the valve
        stands still; the node holds it, this only has to be the same.
    supply : the node's supply line switches pump or dump valve: on only while the output is live.
    max_jump : largest change of the centring sensor in one sample, in its unit; beyond it the
        node trips. Left out: the node's own.
    max_bad_frames : frames in one second that may be lost, damaged or doubled.
    """

    port: str = Field(min_length=1)
    baud: Annotated[int, Field(ge=9600, le=12_000_000)] = 921_600
    encoder: dict[Name, Input] = Field(default_factory=dict)
    adc: dict[Name, Input] = Field(default_factory=dict)
    output_counts_per_unit: Finite
    null: Annotated[int, Field(ge=-32768, le=32767)] | None = None
    supply: bool = False
    max_jump: Positive | None = None
    max_bad_frames: NonNegative = 5


def read_settings(rig: Rig, given: Mapping[str, object]) -> SerialSettings:
    """The settings, checked against the rig; InputError names the first wrong one."""
    s = checked(SerialSettings, rig, given, page="docs/serial-node.md")
    if len(rig.actuator) != 1:
        raise InputError(rig.name, "actuator", len(rig.actuator), "one; the node has one output")
    names = {x.name: x for x in (*rig.sensor, *rig.monitor)}
    for table, inputs in (("encoder", s.encoder), ("adc", s.adc)):
        for name, x in inputs.items():
            if name not in names:
                raise wrong(rig, table, name, f"one of {', '.join(sorted(names))}")
            if x.counts_per_unit == 0.0:
                raise wrong(rig, f"{table}.{name}.counts_per_unit", 0.0, "another number than 0")
        seen = [x.index for x in inputs.values()]
        if len(set(seen)) < len(seen):
            raise wrong(rig, table, seen, "an index of its own for each")
    for name in names:
        if (name in s.encoder) == (name in s.adc):
            raise wrong(rig, "encoder and adc", name, "this sensor in one of them, and in one only")
    if s.output_counts_per_unit == 0.0:
        raise wrong(rig, "output_counts_per_unit", 0.0, "another number than 0")
    return s


def check_node(rig: Rig, s: SerialSettings, hello: Hello) -> None:
    """InputError unless the node that answered is the one that rig file and settings describe."""
    spec, node = rig.actuator[0], f"node {hello.serial or '?'} at {s.port}"
    rate = 1e9 / hello.period_ns
    if abs(rate / rig.rate_hz - 1.0) > RATE_ERROR:
        raise InputError(rig.name, "rate_hz", rig.rate_hz, f"{rate:g}, the rate of {node}")
    if spec.deadman is None or round(spec.deadman * 1e3) != hello.deadman_ms:
        expected = f"{hello.deadman_ms / 1e3:g}, the deadman of {node}"
        raise InputError(rig.name, f"actuator[{spec.name}].deadman", spec.deadman, expected)
    for table, inputs, n in (("encoder", s.encoder, hello.n_encoder), ("adc", s.adc, hello.n_adc)):
        for name, x in inputs.items():
            if x.index >= n:
                expected = f"below {n}, what {node} has"
                raise wrong(rig, f"{table}.{name}.index", x.index, expected)
    if s.null is not None and s.null != hello.null:
        raise wrong(rig, "null", s.null, f"{hello.null}, the null that {node} holds")
    ahead = round(MAX_AHEAD * rig.rate_hz)
    if ahead > hello.queue:
        most = hello.queue / MAX_AHEAD
        raise InputError(rig.name, "rate_hz", rig.rate_hz, f"at most {most:g}: the queue of {node}")
    sample = 9 + 4 * hello.n_encoder + 2 * hello.n_adc
    needed = SYMBOL_BITS * rate * (sample + (OVERHEAD + 4) / hello.batch)
    if needed > s.baud:
        raise wrong(rig, "baud", s.baud, f"at least {needed:.0f} for what {node} sends")
