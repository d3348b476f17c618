"""Who drives the rig: the driver of its device, and the service."""

from __future__ import annotations

from typing import Any, Literal

from pydantic import Field

from samii_rig.rig.schema.base import Strict


class Device(Strict):
    """Which driver opens the rig (an entry point of `samii_rig.devices`) and its settings."""

    driver: str = "simulated"
    settings: dict[str, Any] = Field(default_factory=dict)

    @property
    def simulated(self) -> bool:
        """Nothing moves: the rig is computed in this process, and hurts nobody."""
        return self.driver == "simulated"


class Service(Strict):
    """What `samii-rig serve` does with this rig.

    when_lost : whether a run goes on or stops when the service is gone (killed, crashed) while
        it drives; a service that is started again finds it, either way.
    """

    when_lost: Literal["go_on", "stop"] = "go_on"
