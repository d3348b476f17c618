"""The thread that takes records to the disk and syncs it, so that no caller waits for one."""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Callable

from samii_rig.errors import RecordingError
from samii_rig.record.appender import Appender

Action = Callable[[Appender], None]

SYNC_PERIOD = 0.4  # s between syncs; with the sync itself under the promised second
MAX_WAITING = 8  # actions between the caller and the disk; then the caller waits


class DiskThread:
    """Carries out actions on an appender, in order, and syncs every `SYNC_PERIOD`.

    pending : called before a periodic sync when nothing is queued; returns the action that
        appends what the caller has gathered so far, or None. It must not block.

    Once an action or a sync fails nothing more is written, and every call says why.
    """

    def __init__(self, appender: Appender, pending: Callable[[], Action | None]) -> None:
        self._appender = appender
        self._pending = pending
        self._queue: queue.Queue[Action | threading.Event | None] = queue.Queue(MAX_WAITING)
        self._failure: Exception | None = None
        self._dirty = False
        self._thread = threading.Thread(target=self._run, name="record", daemon=True)
        self._thread.start()

    def idle(self) -> bool:
        """Nothing is queued."""
        return self._queue.empty()

    def check(self) -> None:
        """RecordingError if the disk refused something earlier."""
        if self._failure is not None:
            raise RecordingError(f"recording failed: {self._failure}") from self._failure

    def put(self, action: Action) -> None:
        """Queue an action; waits while the disk is `MAX_WAITING` actions behind."""
        self.check()
        self._queue.put(action)

    def barrier(self) -> None:
        """Return when all that was queued is on the disk."""
        done = threading.Event()
        self._queue.put(done)
        done.wait()
        self.check()

    def stop(self) -> None:
        """Carry out what is queued and end the thread."""
        self._queue.put(None)
        self._thread.join()

    def _run(self) -> None:
        deadline = time.monotonic() + SYNC_PERIOD
        while True:
            action: Action | threading.Event | None = None
            try:
                action = self._queue.get(timeout=max(deadline - time.monotonic(), 0.0))
            except queue.Empty:
                pass
            else:
                if action is None:
                    return
            due = time.monotonic() >= deadline
            try:
                if callable(action):
                    self._act(action)
                if due and self._queue.empty() and (gathered := self._pending()):
                    self._act(gathered)
                if self._dirty and (due or isinstance(action, threading.Event)):
                    self._appender.sync()
                    self._dirty = False
            except Exception as error:  # handed to the caller by `check`
                self._failure = self._failure or error
                self._dirty = False
            if due:
                deadline = time.monotonic() + SYNC_PERIOD
            if isinstance(action, threading.Event):
                action.set()

    def _act(self, action: Action) -> None:
        if self._failure is None:
            self._dirty = True
            action(self._appender)
