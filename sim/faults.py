"""Faults of the simulated rig by name: "stuck a_1", "nan theta_2 8.5", "reboot".

A fault is one text: its name, the sensor or monitor where it needs one, and the second at which it
comes, after the device was opened (on the wire: after the node began); AT without it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from samii_rig.errors import one_of
from samii_rig.rig.schema import Rig
from samii_rig.rig.settings import wrong

AT = 5.0  # s, into the first sweep of every shipped experiment
GAP = 0.1  # s of samples that do not arrive: twice the deadman of the shipped rigs


@dataclass(frozen=True, slots=True)
class Fault:
    """One fault as asked for. channel : "" for one of the whole rig. at : s."""

    name: str
    channel: str
    at: float


def parsed(rig: Rig, given: Sequence[str], known: Mapping[str, bool]) -> tuple[Fault, ...]:
    """The faults that the texts name; `known` says of each name whether a channel follows it.

    InputError names the text that is wrong, and what would be right.
    """
    return tuple(_parsed(rig, text, known) for text in given)


def _parsed(rig: Rig, text: str, known: Mapping[str, bool]) -> Fault:
    name, *rest = text.split() or [""]
    if name not in known:
        raise wrong(rig, "faults", text, one_of(name, sorted(known)))
    channel = ""
    if known[name]:
        channels = [c.name for c in (*rig.sensor, *rig.monitor)]
        channel = rest.pop(0) if rest else ""
        if channel not in channels:
            expected = f"{name!r}, then {one_of(channel, channels)}"
            raise wrong(rig, "faults", text, expected)
    try:
        at = float(rest[0]) if rest else AT
        if len(rest) > 1 or not 0.0 <= at < np.inf:
            raise ValueError(text)
    except ValueError:
        end = " CHANNEL" if known[name] else ""
        expected = f"'{name}{end}' or '{name}{end} SECONDS', 0 or later"
        raise wrong(rig, "faults", text, expected) from None
    return Fault(name, channel, at)


def _lost(rig: Rig, fault: Fault) -> dict[str, Any]:
    first = round(fault.at * rig.rate_hz)
    return {"drop": tuple(range(first, first + round(GAP * rig.rate_hz)))}


# Of the rig in this process: whether a sensor follows, and the settings that make it.
IN_PROCESS: dict[str, tuple[bool, Callable[[Rig, Fault], dict[str, Any]]]] = {
    "stuck": (True, lambda _, f: {"stuck": {f.channel: f.at}}),
    "nan": (True, lambda _, f: {"nan": {f.channel: f.at}}),
    "lost": (False, _lost),
}


def settings(rig: Rig, given: Sequence[str]) -> list[dict[str, Any]]:
    """Settings of the simulated rig that make the faults, one after another; InputError for a
    fault that it has not, or a channel that is no sensor."""
    sensors = {s.name for s in rig.sensor}
    asked = parsed(rig, given, {name: needs for name, (needs, _) in IN_PROCESS.items()})
    for f in asked:
        if f.channel and f.channel not in sensors:
            raise wrong(rig, "faults", f"{f.name} {f.channel}", one_of(f.channel, sorted(sensors)))
    return [IN_PROCESS[f.name][1](rig, f) for f in asked]
