"""Wait for what happens elsewhere: in another thread, process or browser."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import TypeVar

T = TypeVar("T")
WITHIN = 90.0  # s for what takes a few on a machine with nothing else to do


def found(what: Callable[[], T], within: float, every: float = 0.05, said: str = "") -> T:
    """What `what()` gives, once it is true."""
    end = time.monotonic() + within
    while not (it := what()):
        assert time.monotonic() < end, f"it did not happen: {said}"
        time.sleep(every)
    return it
