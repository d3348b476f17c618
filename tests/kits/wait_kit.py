"""Wait for what happens elsewhere: in another thread, process or browser."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import TypeVar

from samii_rig.rig.schema import Rig

T = TypeVar("T")
WITHIN = 90.0  # s for what takes a few on a machine with nothing else to do


def found(what: Callable[[], T], within: float, every: float | None = None, said: str = "") -> T:
    """What `what()` gives, once it is true.

    every : s, for what must be asked so often: a reader whose buffer fills. What takes long is else
    asked for less often, as to answer takes time from it.
    """
    began = time.monotonic()
    while not (it := what()):
        waited = time.monotonic() - began
        assert waited < within, f"it did not happen: {said}"
        time.sleep(min(max(0.05, 0.02 * waited), 0.25) if every is None else every)
    return it


def patient(rig: Rig, seconds: float) -> Rig:
    """The rig with sensors that may be silent for so long, for a machine that is loaded."""
    own = tuple(s.model_copy(update={"stale_after": seconds}) for s in rig.sensor)
    return rig.model_copy(update={"sensor": own})
