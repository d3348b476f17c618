"""Signals that ask a run to end: they only raise a flag, so that it ends in good order."""

from __future__ import annotations

import os
import signal
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType, TracebackType

SIGNALS = tuple(
    getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)
)

GATE = "samii_rig.safety.gate"  # by name: a command line that only shows its help does not load it
# s; what an ending takes at most until its output is at zero, and less than a person's patience.
PAUSE = 0.5


# s after which a signal is looked at again that came in a function that the compiler calls back:
# an exception there would be printed and forgotten, and the press with it.
AGAIN = 0.05
_CALLED_BACK = ("_raw_object_cache_notify", "_raw_object_cache_getbuffer")


def one_press_counts() -> None:
    """From now on SIGINT raises KeyboardInterrupt, but not again within `PAUSE`: an impatient
    second press would break what the first one has begun to put in order."""
    deaf_until = 0.0

    def handle(number: int, frame: FrameType | None) -> None:
        nonlocal deaf_until
        now = time.monotonic()
        if now < deaf_until:
            return
        if _called_back(frame):
            again = threading.Timer(AGAIN, os.kill, (os.getpid(), number))
            again.daemon = True
            again.start()
            return
        deaf_until = now + PAUSE
        raise KeyboardInterrupt

    signal.signal(signal.SIGINT, handle)


def _called_back(frame: FrameType | None) -> bool:
    """Whether llvmlite, which compiles for numba, has called Python back."""
    while frame is not None:
        if frame.f_code.co_name in _CALLED_BACK:
            return True
        frame = frame.f_back
    return False


class Hung(BaseException):
    """The actuator kept the gate waiting, and a person has asked again to end that.

    No Exception: a driver that tries once more on an error of its own must not take this for one.
    """


class Interrupts:
    """While this context is open, SIGINT, SIGTERM and SIGHUP set `reason` instead of killing.

    A program that works has looked at the flag, and ended, long before `PAUSE` is over, so that
    nothing is raised where a command is judged and sent. A signal after that is for one that hangs
    in a device: it raises KeyboardInterrupt, or `Hung` in the gate, whose actuator is then what
    hangs. Not again within `PAUSE`: of a key that is held down one press counts, or no line of the
    ending would ever be reached. Once `ending` is set (the output is at
    zero and only the recording is being closed) further signals are ignored. `give_up` is for
    work in between that can be left out: the next signal raises KeyboardInterrupt, the rest are
    ignored. Only Python's main thread may handle signals; in any other this does nothing.

    came : name of the first signal, also of one that was ignored: whoever would go on to
    another run must not.
    """

    def __init__(self) -> None:
        self.reason = self.came = ""
        self.ending = False
        self._optional = False
        self._deaf_until = 0.0
        self._before: dict[int, object] = {}

    def __enter__(self) -> Interrupts:
        if threading.current_thread() is threading.main_thread():
            for number in SIGNALS:
                self._before[number] = signal.signal(number, self._handle)
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        for number, handler in self._before.items():
            # None: the handler was not set from Python, and cannot be put back from it.
            if callable(handler) or isinstance(handler, int):
                signal.signal(number, handler)

    @contextmanager
    def give_up(self) -> Iterator[None]:
        """While this is open one signal raises KeyboardInterrupt; `ending` afterwards."""
        self._optional, self.ending = True, False
        try:
            yield
        finally:
            self._optional, self.ending = False, True

    def _handle(self, number: int, frame: FrameType | None) -> None:
        name = signal.Signals(number).name
        self.came = self.came or name
        if self.ending:
            return
        if self._optional:
            self.ending = True
            raise KeyboardInterrupt(name)
        now = time.monotonic()
        if self.reason and now < self._deaf_until:
            return
        self._deaf_until = now + PAUSE
        if not self.reason:
            self.reason = f"{name} (Ctrl-C)" if number == signal.SIGINT else name
        elif _in_gate(frame):
            raise Hung(f"the actuator did not return; {name} came again after {PAUSE:g} s")
        else:
            raise KeyboardInterrupt(name)


def _in_gate(frame: FrameType | None) -> bool:
    """Whether the gate is at work, or waits for its actuator."""
    while frame is not None:
        if frame.f_globals.get("__name__") == GATE:
            return True
        frame = frame.f_back
    return False
