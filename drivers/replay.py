"""A recording as a device: the experiment, the gate and the live pipeline run on it unchanged.

What it is told goes nowhere, and what it gives is what was recorded, so it must be told what the
recorded run told its rig: the gate holds the recorded output against the command of now, and ends
a replay of another experiment. The samples keep their distances in time and count; the run that
replays starts when it likes, and the recording is laid so that its plan begins with the new one.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from pathlib import Path
from typing import Literal

import numpy as np
from pydantic import Field

from samii_rig.devices.protocols import CommandBlock, DeviceLoop, OpenRig
from samii_rig.errors import DeviceError, InputError, RecordingError
from samii_rig.record.reader import read_events, read_recording
from samii_rig.rig.schema import Rig, Strict
from samii_rig.rig.settings import checked, wrong
from samii_rig.types import Recording, SampleBlock

NS = 1_000_000_000


class ReplaySettings(Strict):
    """Settings of the driver; an unknown one is an error.

    recording : path of an MCAP file of a run. pace : `real` time or as `fast` as possible.
    """

    recording: str = Field(min_length=1)
    pace: Literal["real", "fast"] = "fast"


class _Recorded:
    """Sensor and clock of a recording, and what all its outputs share.

    start : sequence number at which the recorded plan begins.
    """

    def __init__(self, rig: Rig, recording: Recording, start: int, *, real: bool) -> None:
        self._names = tuple(spec.name for spec in rig.actuator)
        held = [spec.deadman for spec in rig.actuator if spec.deadman is not None]
        self.deadman = min(held) if len(held) == len(rig.actuator) else None
        self.channels = recording.channels
        self._recording, self._start, self._real = recording, start, real
        self._period = NS / recording.rate_hz
        commands = recording.columns(self._names)
        moving = np.flatnonzero(np.nan_to_num(commands).any(axis=1))
        self._end = int(moving[-1]) + 1 if len(moving) else 0  # row from which all rest
        self._now = 0
        self._next = 0  # row that comes next
        self._live = False
        self._count = 0  # what is added to the recorded sequence numbers
        self._ahead = self.now() - int(recording.time[0])  # and to the recorded times, ns

    # Outputs: nothing is behind them

    def _configured(self, loop: DeviceLoop) -> None:
        if self._live:
            names = ", ".join(self._names)
            raise DeviceError(f"{names}: configured during the replay of {loop.sensor}")

    def _written(self, block: CommandBlock) -> None:
        if not self._live:
            self._live = True
            self._align(block.first)

    def zero(self) -> None:
        """On to the recorded end, where all outputs are at zero; what is left out is a gap."""
        if self._live:
            self._live = False
            if self._end > self._next:
                self._jump(self._end)

    # Sensor

    def read(self) -> SampleBlock:
        """The samples whose time has come. DeviceError after the recording's last one."""
        r = self._recording
        due = int(np.searchsorted(r.time, self.now() - self._ahead, "right"))
        rows = slice(self._next, max(due, self._next))
        if self._live and rows.start == len(r):
            raise DeviceError(f"{r.source}: the recording has ended and the run goes on")
        self._next = rows.stop
        return SampleBlock(
            self.channels,
            r.time[rows] + self._ahead,
            r.sequence[rows] + self._count,
            r.values[rows],
            r.quality[rows],
        )

    # Clock

    def now(self) -> int:
        """Nanoseconds; the machine's own at real pace."""
        return time.monotonic_ns() if self._real else self._now

    def sleep(self, seconds: float) -> None:
        """Let time pass."""
        if self._real:
            time.sleep(max(0.0, seconds))
        elif seconds > 0.0:
            self._now += round(seconds * NS)

    def _align(self, first: int) -> None:
        """Go on where the recorded plan begins when the sample `first` comes."""
        r = self._recording
        newest = int(r.sequence[max(self._next - 1, 0)]) + self._count
        wanted = self._start - (first - newest) + 1
        row = int(np.searchsorted(r.sequence, wanted))
        if wanted < int(r.sequence[0]):
            missing = int(r.sequence[0]) - wanted
            raise DeviceError(
                f"{r.source}: the recording begins {missing} samples too late before its plan for "
                "this run; expected a run with the same pace of the loop"
            )
        self._jump(row)
        self._count = first - self._start

    def _jump(self, row: int) -> None:
        """Go on with this row, one period after the newest."""
        r = self._recording
        if row < len(r):
            before = int(r.time[max(self._next - 1, 0)]) + self._ahead
            self._ahead = before + round(self._period) - int(r.time[row])
        self._next = row


class Replay(_Recorded):
    """A recording of one output as its actuator, sensor and clock."""

    def __init__(self, rig: Rig, recording: Recording, start: int, *, real: bool) -> None:
        super().__init__(rig, recording, start, real=real)
        (self.name,) = self._names

    def configure(self, loop: DeviceLoop) -> None:
        """Taken as it is: the device that was recorded kept its own. DeviceError while live."""
        self._configured(loop)

    def write(self, block: CommandBlock) -> None:
        """Goes nowhere. The first one says where the plan begins now."""
        self._written(block)


class ReplayOutputs(_Recorded):
    """A recording of several outputs as their actuators, sensor and clock."""

    def __init__(self, rig: Rig, recording: Recording, start: int, *, real: bool) -> None:
        super().__init__(rig, recording, start, real=real)
        self.names = self._names

    def configure(self, loops: tuple[DeviceLoop, ...]) -> None:
        """As of a `Replay`, of all outputs."""
        self._configured(loops[0])

    def write(self, blocks: tuple[CommandBlock, ...]) -> None:
        """As of a `Replay`, of all outputs."""
        self._written(blocks[0])


def open_rig(rig: Rig, settings: Mapping[str, object]) -> OpenRig:
    """The recording of the settings as this rig's device.

    InputError for a wrong setting or a recording that is not this rig's.
    """
    chosen = checked(
        ReplaySettings, rig, settings, expected="recording, a path, and pace, real or fast"
    )
    path = Path(chosen.recording)
    if not path.is_file():
        expected = "the path of a recording"
        raise wrong(rig, "recording", chosen.recording, expected)
    try:
        recording = read_recording(path)
        plans = [e for e in read_events(path) if e.name == "plan"]
    except RecordingError as error:
        raise InputError.saying(rig.name, "device.settings.recording", str(error)) from error
    _check(rig, recording, str(path), bool(plans))
    device: Replay | ReplayOutputs
    outputs = Replay if len(rig.actuator) == 1 else ReplayOutputs
    device = outputs(rig, recording, int(plans[0].payload["start"]), real=chosen.pace == "real")
    return OpenRig(
        device,
        device,
        device,
        f"replay of {path.name}",
        {
            "device": "replay",
            # Nothing moves, at whatever pace: no fault of it is a fault of the rig.
            "clock": "simulated",
            "replayed": str(path),
            "replayed_device": recording.metadata.get("device", ""),
            "timing": recording.metadata.get("device_timing", "{}"),
        },
    )


def _check(rig: Rig, recording: Recording, path: str, planned: bool) -> None:
    """InputError unless it is a run of this rig."""
    if not planned or not len(recording):
        raise InputError.saying(path, "", "holds no plan; expected the recording of a run")
    if recording.rate_hz != rig.rate_hz:
        raise InputError(path, "rate_hz", recording.rate_hz, f"{rig.rate_hz:g}, that of {rig.name}")
    found = {c.name: c.unit for c in recording.channels}
    for name, unit in rig.units().items():
        if found.get(name) != unit:
            expected = f"{name} in {unit}, a channel of {rig.name}"
            raise InputError(path, "channels", found.get(name, sorted(found)), expected)
