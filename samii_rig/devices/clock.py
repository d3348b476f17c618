"""The host's own clock, for rigs that move in real time."""

from __future__ import annotations

import time


class MonotonicClock:
    """A `Clock` on the operating system's monotonic time."""

    def now(self) -> int:
        """Nanoseconds since some fixed moment; never jumps."""
        return time.monotonic_ns()

    def sleep(self, seconds: float) -> None:
        """Return when `seconds` have passed; at once if that is not above 0."""
        if seconds > 0.0:
            time.sleep(seconds)
