"""Signs of life from the operator's client, over a pipe that it holds."""

from __future__ import annotations

import os
import select

READ = 4096  # bytes


class Pipe:
    """Every byte that comes is a sign of life; the end of the pipe is the end of the client.

    An instance is what `samii_rig.run.loop.run` takes as `alive`: True if a sign came since
    it was asked last. It never waits.
    """

    def __init__(self, descriptor: int) -> None:
        self._descriptor, self._ended = descriptor, False

    def __call__(self) -> bool:
        """Whether a sign came since the last call."""
        came = False
        while not self._ended and select.select([self._descriptor], [], [], 0.0)[0]:
            try:
                data = os.read(self._descriptor, READ)
            except OSError:
                data = b""
            self._ended = not data
            came = came or bool(data)
        return came
