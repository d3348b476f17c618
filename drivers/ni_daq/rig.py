"""Analogue inputs, encoders, output of a board on one sample clock; docs/reference/ni-daq.md."""

from __future__ import annotations

import contextlib
import importlib
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from drivers.ni_daq.actuators import AnalogueOutput, AnalogueOutputs
from drivers.ni_daq.board import Board
from drivers.ni_daq.output import BUFFER, describe
from drivers.ni_daq.settings import NiSettings, read_settings
from drivers.sensing import NoOutput
from samii_rig.devices.clock import MonotonicClock
from samii_rig.devices.protocols import OpenRig
from samii_rig.errors import DeviceError, InputError
from samii_rig.rig.schema import Rig

MODULES = ("constants", "types", "system", "system.watchdog")


@dataclass(frozen=True, slots=True)
class NiRig(OpenRig):
    """Ends the outputs at null, then the board's tasks."""

    parts: contextlib.ExitStack

    def close(self) -> None:
        """May be called twice."""
        self.parts.close()


def open_rig(rig: Rig, settings: Mapping[str, object]) -> OpenRig:
    """The board of the settings, sampling, its outputs at null.

    InputError for a wrong setting or where nidaqmx is not installed, DeviceError for what NI-DAQmx
    refuses.
    """
    s = read_settings(rig, settings)
    try:
        ni = importlib.import_module("nidaqmx")
        for name in MODULES:
            importlib.import_module(f"nidaqmx.{name}")
    except ImportError as error:
        expected = "the package nidaqmx: pip install 'samii-rig[nidaqmx]', and NI-DAQmx of NI"
        raise InputError(rig.name, "device.driver", "ni_daq", expected) from error
    with contextlib.ExitStack() as parts:
        try:
            output: AnalogueOutput | AnalogueOutputs | None = None
            if s.output is not None:
                kind = AnalogueOutput if len(rig.actuator) == 1 else AnalogueOutputs
                output = kind(ni, s, s.output, rig)
                parts.callback(output.close)
            tasks = _tasks(ni, s, rig, parts)
            if output is not None:
                inputs = tasks[0].in_stream
                output.acquired = lambda: int(inputs.total_samp_per_chan_acquired)
            board = Board(rig, s, tasks, output)
        except Exception as error:
            # NI's own errors, and whatever a missing library of NI makes of a call.
            line = " ".join(str(error).split())
            raise DeviceError(f"{s.board}: NI-DAQmx refuses: {line}") from error
        parts.callback(board.close)
        if output is not None:
            # Once more here, so that it is the first thing that a close does.
            parts.callback(output.zero)
        return NiRig(
            output or NoOutput("ni_daq"),
            board,
            MonotonicClock(),
            f"NI-DAQmx board {s.board}",
            {
                "device": "ni_daq",
                "clock": "device",
                "device_settings": s.model_dump_json(),
                **(describe(s.output, output.deadman) if s.output and output else {}),
            },
            parts.pop_all(),
        )


def _tasks(ni: Any, s: NiSettings, rig: Rig, parts: contextlib.ExitStack) -> list[Any]:
    """The inputs' tasks, started; the analogue one last, as its sample clock is that of all."""

    def made() -> Any:
        task = ni.Task()
        parts.callback(_end, task)
        return task

    analogue = made()
    rate = s.rate(rig)
    for w in s.output.wires(rig) if s.output else ():
        analogue.ai_channels.add_ai_voltage_chan(s.at(w.measured), min_val=w.low, max_val=w.high)
    for a in s.analogue.values():
        analogue.ai_channels.add_ai_voltage_chan(s.at(a.input), min_val=a.low, max_val=a.high)
    size = math.ceil(BUFFER * rate)
    mode = ni.constants.AcquisitionType.CONTINUOUS
    analogue.timing.cfg_samp_clk_timing(rate, sample_mode=mode, samps_per_chan=size)
    tasks = [analogue]
    for e in s.encoder.values():
        task = made()
        task.ci_channels.add_ci_ang_encoder_chan(
            s.at(e.counter),
            decoding_type=ni.constants.EncoderType.X_4,
            units=ni.constants.AngleUnits.RADIANS,
            pulses_per_rev=e.pulses_per_rev,
        )
        task.timing.cfg_samp_clk_timing(rate, source=s.clock, sample_mode=mode, samps_per_chan=size)
        tasks.append(task)
    for task in reversed(tasks):
        task.start()
    return tasks


def _end(task: Any) -> None:
    with contextlib.suppress(Exception):
        task.close()
