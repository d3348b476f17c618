"""The inputs of a rig: converters, and the limits that they have by themselves."""

from __future__ import annotations

from typing import Self

from pydantic import model_validator

from samii_rig.rig.schema.base import Finite, Name, NonNegative, Positive, Strict
from samii_rig.rig.schema.loops import Centring


class ActuatorSpec(Strict):
    """The input of the rig: the converter that drives a source.

    The converter holds each sample until the next (zero-order hold); `delay` s pass
    between a sample's time stamp and the moment the output changes. `deadman` s after the
    last command the device itself drops its output to zero; without it the rig cannot be armed.

    held : what a recording has of this input. False: a sensor measured it, such as a hammer's force
        or a table's acceleration. It is band limited, and the rig followed it between samples, too.
        What is sent out is held whatever this says.
    centring : the loop on this output, where it is not the rig's first; that of the first is the
        rig's own [centring].
    """

    name: Name
    unit: str
    low: Finite
    high: Finite
    resolution: NonNegative = 0.0
    delay: NonNegative = 0.0
    held: bool = True
    deadman: Positive | None = None
    centring: Centring | None = None

    @model_validator(mode="after")
    def _range(self) -> Self:
        if not self.low < 0 < self.high:
            raise ValueError(f"low {self.low:g}, high {self.high:g}; expected 0 between them")
        return self
