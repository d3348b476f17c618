"""What a run leaves behind."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from samii_rig.types import FrequencyResponse, Recording, StopRecord


@dataclass(frozen=True, slots=True)
class Outcome:
    """What a run left behind. `trouble` says why there are no responses, "" if there are.

    interrupted : the signal that came at any time before the device was closed, perhaps after
        the run was done; no other run may follow by itself.
    """

    path: Path
    recording: Recording
    responses: tuple[FrequencyResponse, ...]
    stop: StopRecord
    trouble: str
    interrupted: str = ""

    @property
    def completed(self) -> bool:
        """It went through, and nobody asked for an end meanwhile: another run may follow."""
        return self.stop.status == "completed" and not self.interrupted
