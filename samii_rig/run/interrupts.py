"""Signals that ask a run to end: they only raise a flag, so that it ends in good order."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType, TracebackType

SIGNALS = tuple(
    getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)
)


class Interrupts:
    """While this context is open, SIGINT, SIGTERM and SIGHUP set `reason` instead of killing.

    A second signal, for a program that hangs in a device and never looks at the flag,
    raises KeyboardInterrupt; once `ending` is set (the output is at zero and only the
    recording is being closed) further signals are ignored. `give_up` is for work in between
    that can be left out: the next signal raises KeyboardInterrupt, the rest are ignored. Only
    Python's main thread may handle signals; in any other this does nothing.

    came : name of the first signal, also of one that was ignored: whoever would go on to
    another run must not.
    """

    def __init__(self) -> None:
        self.reason = self.came = ""
        self.ending = False
        self._optional = False
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
        if self.reason:
            raise KeyboardInterrupt(name)
        self.reason = f"{name} (Ctrl-C)" if number == signal.SIGINT else name
