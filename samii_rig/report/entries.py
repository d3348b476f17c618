"""One output over one input, at every level that shows both: a level may lack a sensor that was
unsound there."""

from __future__ import annotations

from collections.abc import Sequence

from samii_rig.types import Channel, FrequencyResponse

Entry = tuple[str, str]  # names of output and input


def entries(responses: Sequence[FrequencyResponse]) -> list[Entry]:
    """Every entry that a response has, outputs first, as they come."""
    outputs = dict.fromkeys(c.name for r in responses for c in r.outputs)
    inputs = dict.fromkeys(c.name for r in responses for c in r.inputs)
    return [(y, u) for y in outputs for u in inputs if showing(responses, (y, u))]


def showing(responses: Sequence[FrequencyResponse], entry: Entry) -> list[FrequencyResponse]:
    """The responses that have an entry."""
    return [r for r in responses if has(r, entry)]


def has(r: FrequencyResponse, entry: Entry) -> bool:
    """Whether a response has an entry."""
    y, u = entry
    return any(c.name == y for c in r.outputs) and any(c.name == u for c in r.inputs)


def indices(r: FrequencyResponse, entry: Entry) -> tuple[int, int]:
    """Of output and input in `r.H`."""
    y, u = entry
    return [c.name for c in r.outputs].index(y), [c.name for c in r.inputs].index(u)


def channels(r: FrequencyResponse, entry: Entry) -> tuple[Channel, Channel]:
    """Output and input, with their units."""
    i, j = indices(r, entry)
    return r.outputs[i], r.inputs[j]
