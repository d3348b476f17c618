"""The thread that takes records to the disk and syncs it, so that no caller waits for one."""

from __future__ import annotations

import errno
import queue
import threading
import time
from collections.abc import Callable
from pathlib import Path

from samii_rig.errors import DiskError
from samii_rig.record.appender import Appender

Action = Callable[[Appender], None]

SYNC_PERIOD = 0.4  # s between syncs; with the sync itself under the promised second
MAX_WAITING = 8  # actions between the caller and the disk; then the caller waits
# s that a caller waits for the disk, or for the thread, before it is taken for dead. Disks that
# spin up and file servers that start again answer within it.
ANSWERS_WITHIN = 60.0
POLL = 0.0005  # s between two looks of one who waits; a sync takes some ms


class _Mark:
    """Queued behind actions; `done` once they are on the disk."""

    done = False


class DiskThread:
    """Carries out actions on an appender, in order, and syncs every `SYNC_PERIOD`.

    pending : called before a periodic sync when nothing is queued; returns the action that
        appends what the caller has gathered so far, or None. It must not block.
    name : of the file; a sync fails if nothing is there any more, as nobody would find what is
        recorded from then on.

    Once an action or a sync fails nothing more is written, and every call says why. Nobody waits
    for ever, whatever ends the thread: a caller looks again and again, and holds no lock that an
    exception between two lines of it could leave locked.
    """

    def __init__(
        self, appender: Appender, pending: Callable[[], Action | None], name: Path
    ) -> None:
        self._appender = appender
        self._name = name
        self._pending = pending
        self._queue: queue.SimpleQueue[Action | _Mark | None] = queue.SimpleQueue()
        self._failure: BaseException | None = None
        self._dirty = False
        self._thread = threading.Thread(target=self._run, name="record", daemon=True)
        self._thread.start()

    def idle(self) -> bool:
        """Nothing is queued."""
        return self._queue.empty()

    def check(self) -> None:
        """DiskError if the disk refused something earlier."""
        if self._failure is not None:
            failure = self._failure
            reason = getattr(failure, "strerror", None) or str(failure) or type(failure).__name__
            raise DiskError(f"{self._name} cannot be written: {reason}") from failure

    def put(self, action: Action) -> None:
        """Queue an action; waits while the disk is `MAX_WAITING` actions behind."""
        self._wait(lambda: self._queue.qsize() < MAX_WAITING)
        self.check()
        self._queue.put(action)

    def barrier(self) -> None:
        """Return when all that was queued is on the disk."""
        mark = _Mark()
        self._queue.put(mark)
        self._wait(lambda: mark.done)
        self.check()

    def stop(self) -> bool:
        """Carry out what is queued and end the thread; whether it has ended."""
        self._queue.put(None)
        self._thread.join(ANSWERS_WITHIN)
        return not self._thread.is_alive()

    def _wait(self, over: Callable[[], bool]) -> None:
        give_up = time.monotonic() + ANSWERS_WITHIN
        while not over():
            if not self._thread.is_alive():
                self.check()
                raise DiskError(f"{self._name} cannot be written: its thread has ended")
            if time.monotonic() > give_up:
                late = f"the disk did not answer in {ANSWERS_WITHIN:g} s"
                raise DiskError(f"{self._name} cannot be written: {late}")
            time.sleep(POLL)

    def _run(self) -> None:
        try:
            self._serve()
        except BaseException as error:  # handed to the caller by `check`
            self._failure = self._failure or error

    def _serve(self) -> None:
        deadline = time.monotonic() + SYNC_PERIOD
        while True:
            action: Action | _Mark | None = None
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
                if self._dirty and (due or isinstance(action, _Mark)):
                    self._sync()
            except Exception as error:
                self._failure = self._failure or error
                self._dirty = False
            if due:
                deadline = time.monotonic() + SYNC_PERIOD
            if isinstance(action, _Mark):
                action.done = True

    def _act(self, action: Action) -> None:
        if self._failure is None:
            self._dirty = True
            action(self._appender)

    def _sync(self) -> None:
        self._appender.sync()
        if not self._name.exists():
            raise FileNotFoundError(errno.ENOENT, "it was moved or removed meanwhile")
        self._dirty = False
