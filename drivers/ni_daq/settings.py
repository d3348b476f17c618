"""Settings of a National Instruments board: its table in a rig file's [device.settings]."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated

from pydantic import Field

from samii_rig.errors import InputError
from samii_rig.rig.schema import Finite, Name, Positive, Rig, Strict
from samii_rig.rig.settings import checked, wrong


class Analogue(Strict):
    """value = (volts - offset)/volts_per_unit at an input such as ai0, of the range low to high."""

    input: str = Field(min_length=1)
    volts_per_unit: Finite
    offset: Finite = 0.0
    low: Finite = -10.0
    high: Finite = 10.0


class Encoder(Strict):
    """value = sign (angle - offset), rad, at a counter such as ctr0; four edges a pulse."""

    counter: str = Field(min_length=1)
    pulses_per_rev: Annotated[int, Field(ge=1)]
    offset: Finite = 0.0
    sign: Annotated[int, Field(ge=-1, le=1)] = 1


class Interlock(Strict):
    """What takes the valve's power away within the actuator's `deadman` of the last edge at a
    digital output such as port0/line0, and why that is known: the word of the person who writes
    it."""

    name: str = Field(min_length=1)
    line: str = Field(min_length=1)
    reason: str = Field(min_length=1)


class Wire(Strict):
    """volts = null + volts_per_unit value at an output such as ao0, of the range low to high.

    readback : the input that measures it; left out, the board's own channel _ao0_vs_aognd.
    """

    channel: str = Field(min_length=1)
    volts_per_unit: Finite = 1.0
    null: Finite = 0.0
    low: Finite = -10.0
    high: Finite = 10.0
    readback: str = ""

    @property
    def measured(self) -> str:
        """The channel of its read-back."""
        return self.readback or f"_{self.channel}_vs_aognd"


class Output(Strict):
    """The outputs, and what ends all of them when this program is dead.

    channel, volts_per_unit, null, low, high, readback : of the rig's only output, see `Wire`.
    channels : of each, by actuator name, where the rig has several.
    watchdog : name of the device (of a chassis, the chassis) whose watchdog timer puts the outputs
        to null. interlock : what does it instead. Without either no gate arms them.
    """

    channel: str = ""
    volts_per_unit: Finite = 1.0
    null: Finite = 0.0
    low: Finite = -10.0
    high: Finite = 10.0
    readback: str = ""
    channels: dict[Name, Wire] = Field(default_factory=dict)
    watchdog: str = ""
    interlock: Interlock | None = None

    def wires(self, rig: Rig) -> tuple[Wire, ...]:
        """Of each actuator, in the rig file's order; of settings that were checked."""
        if self.channels:
            return tuple(self.channels[a.name] for a in rig.actuator)
        own = Wire.model_fields
        return (Wire(**{name: getattr(self, name) for name in own}),)


class NiSettings(Strict):
    """Settings of the driver; an unknown one is an error.

    board : as NI MAX names it, Dev1. rate_hz : left out, the rig's. analogue, encoder : by the
    name of a sensor or monitor; each of the rig's has one. output : left out, it only measures.
    latency : s, the longest way of a sample to this program on a quiet machine: 1 ms inside a
    computer, 5 ms over USB. Channels are the board's, or of a module where they name it.
    """

    board: str = Field(min_length=1)
    rate_hz: Positive | None = None
    analogue: dict[Name, Analogue] = Field(default_factory=dict)
    encoder: dict[Name, Encoder] = Field(default_factory=dict)
    output: Output | None = None
    latency: Positive = 0.005

    def at(self, channel: str) -> str:
        """The whole name of a channel, or of a line such as port0/line0."""
        own = channel.startswith("port") or "/" not in channel
        return f"{self.board}/{channel}" if own else channel

    def rate(self, rig: Rig) -> float:
        """Samples per second."""
        return self.rate_hz or rig.rate_hz

    @property
    def clock(self) -> str:
        """The sample clock of all tasks."""
        return f"/{self.board}/ai/SampleClock"


def read_settings(rig: Rig, given: Mapping[str, object]) -> NiSettings:
    """The settings, checked against the rig; InputError names the first wrong one."""
    s = checked(NiSettings, rig, given, page="docs/reference/ni-daq.md")
    units = {x.name: x.unit for x in (*rig.sensor, *rig.monitor)}
    if sorted([*s.analogue, *s.encoder]) != sorted(units):
        found = sorted([*s.analogue, *s.encoder])
        raise wrong(rig, "analogue and encoder", found, f"{', '.join(units)}, each once")
    if not s.analogue and s.output is None:
        expected = "at least one: its sample clock is that of the encoders"
        raise wrong(rig, "analogue", [], expected)
    for name, a in s.analogue.items():
        if a.volts_per_unit == 0.0:
            raise wrong(rig, f"analogue.{name}.volts_per_unit", 0.0, "another number than 0")
        if not a.low < a.high:
            raise wrong(rig, f"analogue.{name}.low", a.low, f"below high, {a.high:g}")
    for name, e in s.encoder.items():
        if units[name] != "rad":
            raise wrong(rig, f"encoder.{name}", units[name], "a channel in rad")
        if e.sign == 0:
            raise wrong(rig, f"encoder.{name}.sign", 0, "1 or -1")
    if s.output is not None:
        _check_output(rig, s, s.output)
    return s


def check_rig(rig: Rig, given: Mapping[str, object]) -> None:
    """InputError for settings of a board that could not drive this rig."""
    s = read_settings(rig, given)
    if s.output is None:
        raise wrong(rig, "output", None, "the output that drives, or this board beside another")


def _check_output(rig: Rig, s: NiSettings, o: Output) -> None:
    if s.rate(rig) != rig.rate_hz:
        raise wrong(rig, "rate_hz", s.rate_hz, f"{rig.rate_hz:g}, the rig's, with an output")
    names = [a.name for a in rig.actuator]
    if not o.channels:
        if len(names) > 1:
            expected = f"{', '.join(names)}, each with its channel"
            raise wrong(rig, "output.channels", [], expected)
        if not o.channel:
            raise wrong(rig, "output.channel", "", "the name of the output, such as ao0")
    elif given := sorted(o.model_fields_set & set(Wire.model_fields)):
        expected = "left out: output.channels has it for each"
        raise wrong(rig, f"output.{given[0]}", getattr(o, given[0]), expected)
    elif sorted(o.channels) != sorted(names):
        raise wrong(rig, "output.channels", sorted(o.channels), f"{', '.join(names)}, each once")
    wires = o.wires(rig)
    for spec, w in zip(rig.actuator, wires, strict=True):
        where = f"output.channels.{spec.name}" if o.channels else "output"
        if w.volts_per_unit == 0.0:
            raise wrong(rig, f"{where}.volts_per_unit", 0.0, "another number than 0")
        if not w.low < w.null < w.high:
            between = f"between low, {w.low:g}, and high, {w.high:g}"
            raise wrong(rig, f"{where}.null", w.null, between)
        if (o.watchdog or o.interlock) and spec.deadman is None:
            expected = "the time of the watchdog or the interlock, such as 0.05"
            raise InputError(rig.name, f"actuator[{spec.name}].deadman", None, expected)
    for what, seen in (
        ("channel", [s.at(w.channel) for w in wires]),
        ("readback", [s.at(w.measured) for w in wires]),
    ):
        if len(set(seen)) < len(seen):
            raise wrong(rig, f"output.channels, {what}", seen, "one of its own for each")
