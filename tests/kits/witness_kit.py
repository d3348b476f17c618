"""How late the machine was while a test ran in real time, measured beside the test.

A thread of the kernel passes on the bytes of a pseudo-terminal. It has the priority of any program,
whatever priority the two ends have. With 14 programs on two cores a byte in a hundred takes 9 ms
and one in a thousand over 80, where one through a socket takes 0.1 at most. A device that waits for
50 ms is then right to end the run, and a test that fails says nothing about it.

This sends a byte every few milliseconds through a pseudo-terminal of its own, in a process of its
own, so that a test that keeps its process busy is not taken for a machine that is late.
"""

from __future__ import annotations

import contextlib
import os
import select
import subprocess
import sys
import time

EVERY = 0.004  # s between two bytes
PRIORITY = 3  # above the node's, which is above its host's
LATE = 0.015  # s; a deadman of 50 ms has two of a host's ticks and a way there and back in it


class Witness:
    """The process that measures; `late()` is the worst since it was asked before, s."""

    def __init__(self) -> None:
        self.process = subprocess.Popen(
            [sys.executable, "-S", __file__], stdin=subprocess.PIPE, stdout=subprocess.PIPE
        )
        self.late()

    def late(self) -> float:
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        self.process.stdin.write(b"\n")
        self.process.stdin.flush()
        return float(self.process.stdout.readline())

    def close(self) -> None:
        self.process.communicate(b"")


def measure() -> None:
    """Send, receive, note the longest that one took or came too late; until the input ends."""
    import tty

    with contextlib.suppress(PermissionError, AttributeError):  # AttributeError: macOS
        os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(PRIORITY))
    far, near = os.openpty()
    tty.setraw(near)
    worst, due = 0.0, time.monotonic()
    while True:
        asked, _, _ = select.select([0], [], [], max(0.0, due - time.monotonic()))
        if asked:
            if not os.read(0, 64):
                return
            os.write(1, f"{worst}\n".encode())
            worst = 0.0
        if time.monotonic() >= due:
            os.write(far, b"x")
            os.read(near, 1)
            worst = max(worst, time.monotonic() - due)
            due = time.monotonic() + EVERY


if __name__ == "__main__":
    measure()
