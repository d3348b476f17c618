"""The client of the operator, who ordered a run and follows it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from threading import Event

from samii_rig.run.progress import Progress


@dataclass(frozen=True, slots=True)
class Client:
    """What a run has from the operator's client, and gives to it.

    progress : gets how far the run is, as often as `LoopSettings.report` says.
    stop : when set, the run ends in good order (status `stopped`), as it does on Ctrl-C.
    alive : asked each tick whether the client gave a sign of life since.
    """

    progress: Callable[[Progress], None] | None = None
    stop: Event | None = None
    alive: Callable[[], bool] | None = None


NOBODY = Client()
