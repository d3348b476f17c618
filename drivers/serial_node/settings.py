"""Settings of a serial I/O node: [device.settings] of a rig file, held against rig and node."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated

from pydantic import Field

from drivers.serial_node.wire import MOST_OUTPUTS, OVERHEAD, Hello
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


class Output(Strict):
    """One output of the node: counts = value counts_per_unit, counted from its null.

    null : the converter's counts at which the valve stands still; the node holds it, this only has
    to be the same. max_jump : largest change of the centring sensor in one sample, in its unit;
    beyond it the node trips. Left out: the node's own.
    """

    index: Annotated[int, Field(ge=0)]
    counts_per_unit: Finite
    null: Annotated[int, Field(ge=-32768, le=32767)] | None = None
    max_jump: Positive | None = None


class SerialSettings(Strict):
    """Settings of the driver; an unknown one is an error.

    port : of the operating system, such as /dev/ttyACM0 or COM3. baud : of a true serial line.
    encoder, adc : by sensor name; every sensor and monitor of the rig is in one of them.
    output : by actuator name, where the rig has several. output_counts_per_unit, null, max_jump :
        of the only one, output 0 of the node; see `Output`.
    supply : the node's supply line switches pump or dump valve: on only while the output is live.
    max_bad_frames : frames in one second that may be lost, damaged or doubled.
    """

    port: str = Field(min_length=1)
    baud: Annotated[int, Field(ge=9600, le=12_000_000)] = 921_600
    encoder: dict[Name, Input] = Field(default_factory=dict)
    adc: dict[Name, Input] = Field(default_factory=dict)
    output: dict[Name, Output] = Field(default_factory=dict)
    output_counts_per_unit: Finite | None = None
    null: Annotated[int, Field(ge=-32768, le=32767)] | None = None
    supply: bool = False
    max_jump: Positive | None = None
    max_bad_frames: NonNegative = 5

    def outputs(self, rig: Rig) -> tuple[Output, ...]:
        """Of each actuator, in the rig file's order; of settings that were checked."""
        if self.output:
            return tuple(self.output[a.name] for a in rig.actuator)
        counts = self.output_counts_per_unit or 0.0
        return (Output(index=0, counts_per_unit=counts, null=self.null, max_jump=self.max_jump),)


def read_settings(rig: Rig, given: Mapping[str, object]) -> SerialSettings:
    """The settings, checked against the rig; InputError names the first wrong one."""
    s = checked(SerialSettings, rig, given, page="docs/reference/serial-node.md")
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
    _check_outputs(rig, s)
    return s


def _check_outputs(rig: Rig, s: SerialSettings) -> None:
    names = [a.name for a in rig.actuator]
    held = [a.deadman for a in rig.actuator]
    if len(set(held)) > 1:
        raise InputError(rig.name, "actuator.deadman", held, "one for all: the node has one")
    if len(names) > MOST_OUTPUTS:
        expected = f"at most {MOST_OUTPUTS}, whose limits fit a frame of a serial node"
        raise InputError(rig.name, "actuator", len(names), expected)
    if not s.output:
        if len(names) > 1:
            expected = f"{', '.join(names)}, each with its index and counts_per_unit"
            raise wrong(rig, "output", [], expected)
        if not s.output_counts_per_unit:
            expected = "another number than 0: the counts for one unit of the output"
            raise wrong(rig, "output_counts_per_unit", s.output_counts_per_unit, expected)
        return
    for field in ("output_counts_per_unit", "null", "max_jump"):
        if getattr(s, field) is not None:
            expected = "left out: the table output has it for each"
            raise wrong(rig, field, getattr(s, field), expected)
    if sorted(s.output) != sorted(names):
        raise wrong(rig, "output", sorted(s.output), f"{', '.join(names)}, each once")
    for name, o in s.output.items():
        if o.counts_per_unit == 0.0:
            raise wrong(rig, f"output.{name}.counts_per_unit", 0.0, "another number than 0")
    seen = [o.index for o in s.output.values()]
    if len(set(seen)) < len(seen):
        raise wrong(rig, "output", seen, "an index of its own for each")


def check_node(rig: Rig, s: SerialSettings, hello: Hello) -> None:
    """InputError unless the node that answered is the one that rig file and settings describe."""
    node = f"node {hello.serial or '?'} at {s.port}"
    rate = 1e9 / hello.period_ns
    if abs(rate / rig.rate_hz - 1.0) > RATE_ERROR:
        raise InputError(rig.name, "rate_hz", rig.rate_hz, f"{rate:g}, the rate of {node}")
    for spec in rig.actuator:
        if spec.deadman is None or round(spec.deadman * 1e3) != hello.deadman_ms:
            expected = f"{hello.deadman_ms / 1e3:g}, the deadman of {node}"
            raise InputError(rig.name, f"actuator[{spec.name}].deadman", spec.deadman, expected)
    _check_indices(rig, s, hello, node)
    ahead = round(MAX_AHEAD * rig.rate_hz)
    if ahead > hello.queue:
        most = hello.queue / MAX_AHEAD
        raise InputError(rig.name, "rate_hz", rig.rate_hz, f"at most {most:g}: the queue of {node}")
    needed = SYMBOL_BITS * rate * (hello.sample_bytes + (OVERHEAD + 4) / hello.batch)
    if needed > s.baud:
        raise wrong(rig, "baud", s.baud, f"at least {needed:.0f} for what {node} sends")


def _check_indices(rig: Rig, s: SerialSettings, hello: Hello, node: str) -> None:
    """Inputs and outputs that the node has, and the nulls that it holds."""
    for table, inputs, n in (("encoder", s.encoder, hello.n_encoder), ("adc", s.adc, hello.n_adc)):
        for name, x in inputs.items():
            if x.index >= n:
                expected = f"below {n}, what {node} has"
                raise wrong(rig, f"{table}.{name}.index", x.index, expected)
    for spec, o in zip(rig.actuator, s.outputs(rig), strict=True):
        where = f"output.{spec.name}." if s.output else ""
        if o.index >= len(hello.outputs):
            raise wrong(
                rig, f"{where}index", o.index, f"below {len(hello.outputs)}, what {node} has"
            )
        null = hello.outputs[o.index].null
        if o.null is not None and o.null != null:
            raise wrong(rig, f"{where}null", o.null, f"{null}, the null that {node} holds")
