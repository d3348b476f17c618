"""The end of a run: the output at zero, that it is seen to be, and what went wrong meanwhile."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Literal

import numpy as np

from samii_rig.devices.protocols import OpenRig
from samii_rig.errors import DeviceError, DiskError, RecordingError, SamiiRigError
from samii_rig.record.reader import read_recording
from samii_rig.record.writer import RunWriter
from samii_rig.safety.limits import ChannelLimit
from samii_rig.types import Float, SampleBlock, StopRecord

# s after zero within which the read-back must show it: samples on their way at that moment
# may still show the output before.
SHOWN_WITHIN = 0.1
TRIES = 3  # calls of zero() after the gate's own have failed
# Parts of the deadman's time after zero() in which the output must be, and stay, at zero: later
# than any command takes to arrive, and before the deadman itself makes it so.
OBEYED, DROPPED = 0.5, 0.9

Status = Literal["completed", "stopped", "tripped", "failed"]

# How the reason of a stop says that the output may not be at zero.
_NOT_ZEROED = "the output could not be zeroed"
_NOT_AT_ZERO = "THE OUTPUT IS NOT AT ZERO"
_NOT_SHOWN = "no sample shows"


def attempt(step: Callable[[], None]) -> str:
    """Do a step of the ending; what goes wrong as a line, "" if nothing."""
    try:
        step()
    except Exception as error:
        known = isinstance(error, SamiiRigError)
        return str(error) if known else f"{type(error).__name__}: {error}"
    return ""


def with_troubles(status: Status, reason: str, troubles: list[str]) -> tuple[Status, str]:
    """The end with what went wrong after it. Only a trip says more than `failed`."""
    for trouble in dict.fromkeys(t for t in troubles if t and t not in reason):
        status = status if status == "tripped" else "failed"
        reason = f"{reason}; then {trouble}"
    return status, reason


def finish(writer: RunWriter, stop: StopRecord) -> None:
    """Close the recording of a run that is over.

    DiskError says how the run ended, and what of it is on the disk, if the disk refuses that.
    """
    try:
        writer.close(stop)
    except RecordingError as error:
        raise DiskError("; ".join((_known(error, stop), _left(writer.partial_path)))) from error


def _known(error: RecordingError, stop: StopRecord) -> str:
    """What went wrong, and whether the output is at zero nevertheless."""
    if any(text in stop.reason for text in (_NOT_ZEROED, _NOT_AT_ZERO, _NOT_SHOWN)):
        return f"{stop.reason}; {error}"
    more = "" if str(error) in stop.reason else f" ({stop.status}: {stop.reason})"
    return f"{error}; the output is at zero{more}"


def _left(partial: Path) -> str:
    """What `samii-rig recover` will find; counted, because a disk that fails also forgets."""
    if not partial.exists():
        return "wherever it is now, samii-rig recover gives back what was flushed into it"
    try:
        samples = len(read_recording(partial, partial=True))
    except RecordingError as error:
        return f"nothing of it can be read back: {error}"
    return f"samii-rig recover {partial} gives back the {samples:,} samples that are on the disk"


class Zero:
    """The last resort for a device that does not do what zero() promises.

    trouble : why the output may not be at zero, "" if it is.
    """

    def __init__(self, device: OpenRig, *outputs: ChannelLimit) -> None:
        self._device, self._outputs = device, outputs
        names = [c.name for c in device.sensor.channels]
        self._columns = [names.index(output.channel) for output in outputs]
        # What each output's converter cannot distinguish from zero.
        self._least = np.array([output.slack / 2 for output in outputs])
        self.trouble = ""

    def force(self) -> None:
        """Zero whatever the gate's state; never raises."""
        for _ in range(TRIES):
            try:
                self._device.actuator.zero()
            except BaseException as error:
                self.trouble = f"{_NOT_ZEROED}: {type(error).__name__}: {error}"
            else:
                self.trouble = ""
                return

    def check(
        self, tick: float, keep: Callable[[SampleBlock], None], zeroed: int, *, spoke: bool
    ) -> None:
        """Read on until the output shows zero; if it does not, zero again and say so.

        zeroed : when zero() was called, ns on the device's clock. An output that is at zero only
        once the deadman has dropped it did not obey, and that is said too.
        spoke : whether the device ever gave a sample; one that did not was never driven.
        DeviceError if nothing comes back any more.
        """
        held = min(self._device.actuator.deadman or SHOWN_WITHIN, SHOWN_WITHIN) * 1e9
        window = (zeroed + round(OBEYED * held), zeroed + round(DROPPED * held))
        shown, disobeyed = self._shown(tick, keep, window)
        if not spoke:
            return
        if self._at_zero(shown):
            if not self._at_zero(disobeyed) and not self.trouble:
                text = f"{self._reads(disobeyed)} after zero(), which did nothing"
                self.trouble = f"{_NOT_AT_ZERO}: {text}; the deadman ended it"
            return
        before = self.trouble
        self.force()
        self._shown(tick, keep, (0, 0))
        if np.isnan(shown).any():
            names = " and ".join(output.channel for output in self._outputs)
            raise DeviceError(f"{_NOT_SHOWN} {names} at zero: none came any more")
        self.trouble = (
            self.trouble or before or (f"{_NOT_AT_ZERO}: {self._reads(shown)} after zero")
        )

    def _at_zero(self, v: Float) -> bool:
        """Whether every output is; v (k,), of which NaN is not."""
        return bool((v <= self._least).all())

    def _reads(self, v: Float) -> str:
        """The output that is furthest from zero; v (k,)."""
        i = int(np.argmax(v - self._least))
        return f"{self._outputs[i].channel} read {v[i]:.4g} {self._outputs[i].unit}"

    def _shown(
        self, tick: float, keep: Callable[[SampleBlock], None], window: tuple[int, int]
    ) -> tuple[Float, Float]:
        """(k,) each: the newest |v| that came back once zero had time to show, NaN if none came;
        and the largest of those samples that the device took inside the window of its time, ns."""
        clock = self._device.clock
        shown, inside = np.full(len(self._outputs), np.nan), np.zeros(len(self._outputs))
        until = clock.now() + round(SHOWN_WITHIN * 1e9)
        newest = -1
        while True:
            clock.sleep(tick)
            block = self._device.sensor.read()
            keep(block)
            v = np.abs(block.values[:, self._columns])
            there = np.isfinite(v).all(axis=1)
            if there.any():
                time = block.time[there]
                shown, newest = v[there][-1], int(time[-1])
                judged = (time >= window[0]) & (time < window[1])
                inside = np.maximum(inside, v[there][judged].max(axis=0, initial=0.0))
            over = self._at_zero(shown) and newest >= window[1]
            if over or clock.now() >= until:
                return shown, inside
