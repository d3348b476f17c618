"""The end of a run: the output at zero, that it is seen to be, and what went wrong meanwhile."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Literal

import numpy as np

from samii_rig.errors import DeviceError, SamiiRigError
from samii_rig.run.limits import ChannelLimit
from samii_rig.run.protocols import OpenRig
from samii_rig.types import SampleBlock

# s after zero within which the read-back must show it: samples on their way at that moment
# may still show the output before.
SHOWN_WITHIN = 0.1
TRIES = 3  # calls of zero() after the gate's own have failed

Status = Literal["completed", "stopped", "tripped", "failed"]


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


class Zero:
    """The last resort for a device that does not do what zero() promises.

    trouble : why the output may not be at zero, "" if it is.
    """

    def __init__(self, device: OpenRig, output: ChannelLimit) -> None:
        self._device, self._output = device, output
        self._column = [c.name for c in device.sensor.channels].index(output.channel)
        self.trouble = ""

    def force(self) -> None:
        """Zero whatever the gate's state; never raises."""
        for _ in range(TRIES):
            try:
                self._device.actuator.zero()
            except BaseException as error:
                self.trouble = f"the output could not be zeroed: {type(error).__name__}: {error}"
            else:
                self.trouble = ""
                return

    def check(self, tick: float, keep: Callable[[SampleBlock], None], *, spoke: bool) -> None:
        """Read on until the output shows zero; if it does not, zero again and say so.

        spoke : whether the device ever gave a sample; one that did not was never driven.
        DeviceError if nothing comes back any more.
        """
        shown = self._shown(tick, keep)
        if abs(shown) <= self._least or not spoke:
            return
        before = self.trouble
        self.force()
        self._shown(tick, keep)
        name, unit = self._output.channel, self._output.unit
        if math.isnan(shown):
            raise DeviceError(f"no sample shows {name} at zero: none came any more")
        self.trouble = (
            self.trouble
            or before
            or (f"THE OUTPUT IS NOT AT ZERO: {name} read {shown:.4g} {unit} after zero")
        )

    @property
    def _least(self) -> float:
        """What the output's converter cannot tell from zero."""
        return self._output.slack / 2

    def _shown(self, tick: float, keep: Callable[[SampleBlock], None]) -> float:
        """The newest output that came back once zero had time to show; NaN if none came."""
        clock, shown = self._device.clock, math.nan
        until = clock.now() + round(SHOWN_WITHIN * 1e9)
        while True:
            clock.sleep(tick)
            block = self._device.sensor.read()
            keep(block)
            v = block.values[:, self._column]
            v = v[np.isfinite(v)]
            shown = float(v[-1]) if len(v) else shown
            if abs(shown) <= self._least or clock.now() >= until:
                return shown
