"""What keeps the host in time while a rig runs: priority, short turns, small collections.

A loaded machine lets an ordinary thread wait for tens of milliseconds, and a deadman does not
wait. Where the priority is refused the run goes on without it: the device still ends at zero, only
sooner than it needed to.
"""

from __future__ import annotations

import gc
import os
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager

PRIORITY = 1  # the lowest of the real-time ones is above all ordinary programs
TURN = 5e-4  # s that a thread may keep others from Python; 5 ms by default, a tick of the loop


@contextmanager
def prioritised() -> Iterator[bool]:
    """Real-time priority for every thread of this process until the end; whether it was granted.

    Every one, the recorder's too: Python runs one thread at a time, and one that is put aside
    while it is its turn would hold up all others. New threads inherit it.
    """
    granted = False not in [_set(n, realtime=True) for n in _threads()]
    turn = sys.getswitchinterval()
    sys.setswitchinterval(TURN)
    # What is there already will not become garbage; going through it takes tens of ms.
    gc.freeze()
    try:
        yield granted
    finally:
        gc.unfreeze()
        sys.setswitchinterval(turn)
        for thread in _threads():
            _set(thread, realtime=False)


def _threads() -> list[int]:
    return [t.native_id for t in threading.enumerate() if t.native_id is not None]


def _set(thread: int, *, realtime: bool) -> bool:
    if not hasattr(os, "SCHED_RR"):
        return False
    policy, priority = (os.SCHED_RR, PRIORITY) if realtime else (os.SCHED_OTHER, 0)
    try:
        os.sched_setscheduler(thread, policy, os.sched_param(priority))
    except OSError:
        return False  # not allowed, or the thread has ended
    return True
