"""What ends the output when this program does not: the board's watchdog timer, or a square wave
that keeps an interlock closed."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Mapping
from typing import Any

OFTEN = 5  # resets in its time, while the output rests
EDGE_WAIT = 0.02  # s that an edge may wait to be written


class Watchdog:
    """A running timer, from before any other task of the device, as NI asks.

    nulls : V, by the whole name of each output's channel, to which it puts them all.
    While the outputs rest at null the timer is reset in here; from `feed` on, which the gate's own
    calls come to, it is left to them. trouble : what ended the resets, "" if nothing did.
    """

    def __init__(self, ni: Any, device: str, nulls: Mapping[str, float], seconds: float) -> None:
        self._resting, self.trouble = True, ""
        self._seconds = seconds
        self._task = ni.system.watchdog.WatchdogTask(device, timeout=seconds)
        try:
            kind = ni.constants.WatchdogAOExpirState.VOLTAGE
            states = [
                ni.types.AOExpirationState(name, volts, kind) for name, volts in nulls.items()
            ]
            self._task.cfg_watchdog_ao_expir_states(states)
            self._task.start()
        except BaseException:
            self._task.close()
            raise
        self._ending = threading.Event()
        self._thread = threading.Thread(target=self._run, name="watchdog's resets", daemon=True)
        self._thread.start()

    def feed(self) -> None:
        """Reset the timer for a live output; what NI-DAQmx says when it has expired."""
        self._resting = False
        self._task.reset_timer()

    def rest(self, *, at_null: bool) -> None:
        """The output was put to null, or should have been: then the timer is left to expire."""
        self._resting = at_null
        self._reset()

    def close(self) -> None:
        """End the timer; the output must be at null. May be called twice."""
        if not self._ending.is_set():
            self._ending.set()
            self._thread.join()
            with contextlib.suppress(Exception):
                self._task.close()

    def _run(self) -> None:
        while not self.trouble and not self._ending.wait(self._seconds / OFTEN):
            self._reset()

    def _reset(self) -> None:
        try:
            if self._resting:
                self._task.reset_timer()
        except Exception as error:
            self.trouble = f"watchdog: {' '.join(str(error).split())}"


class SquareWave:
    """A digital output whose edges keep an interlock closed. Each is made by a call of the gate's,
    so that whatever keeps those away opens it."""

    def __init__(self, ni: Any, line: str) -> None:
        self._level = False
        self._task = ni.Task()
        try:
            self._task.do_channels.add_do_chan(line)
            self._task.write(self._level, auto_start=True, timeout=EDGE_WAIT)
        except BaseException:
            self._task.close()
            raise

    def edge(self) -> None:
        """What NI-DAQmx says when it refuses one."""
        self._level = not self._level
        self._task.write(self._level, auto_start=True, timeout=EDGE_WAIT)

    def close(self) -> None:
        """May be called twice."""
        with contextlib.suppress(Exception):
            self._task.close()
