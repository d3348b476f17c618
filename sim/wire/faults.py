"""Faults by name on the wire: what the rig's process is told, and when."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

from samii_rig.errors import one_of
from samii_rig.rig.schema import Rig
from samii_rig.rig.settings import wrong
from sim.faults import Fault, parsed
from sim.wire.plant import Board

ENCODER_JUMP = 0.1  # rad by which the first encoder jumps, twice what a node takes in one sample
DRIFT = 0.1  # of an input's range every second
STRAY = 0.05  # of the output's limit that the converter holds by itself
STALL = 0.3  # s for which nothing passes, six times the deadman of the shipped rigs
BAD = 2e-3  # of the bytes, dozens of frames a second; a rig file allows five
CLOCK = 3_000_000  # us by which the node's clock is set on


def _jump(_rig: Rig, board: Board, _f: Fault) -> str:
    first = next(iter(board.encoder.values()))
    return f"jump {round(ENCODER_JUMP * abs(first.counts_per_unit))}"


def _drift(rig: Rig, board: Board, f: Fault) -> str:
    ends = {c.name: max(abs(c.low), abs(c.high)) for c in (*rig.sensor, *rig.monitor)}
    end = ends[f.channel]
    if not math.isfinite(end):
        with_range = [name for name, x in ends.items() if math.isfinite(x)]
        raise wrong(rig, "faults", f"{f.name} {f.channel}", one_of(f.channel, with_range))
    wired = (board.encoder | board.adc)[f.channel]
    return f"drift {f.channel} {DRIFT * end * wired.counts_per_unit}"


def _rail(rig: Rig, board: Board, f: Fault) -> str:
    if f.channel not in board.adc:
        raise wrong(rig, "faults", f"{f.name} {f.channel}", one_of(f.channel, board.adc))
    return f"rail {board.adc[f.channel].index} 1"


def _stray(rig: Rig, board: Board, _f: Fault) -> str:
    spec = rig.actuator[0]
    return f"stray {round(STRAY * spec.high * board.output[spec.name].counts_per_unit)}"


def _always(command: str) -> Callable[[Rig, Board, Fault], str]:
    return lambda _rig, _board, _f: command


# Whether a channel follows the name, and the command of sim/wire/rig.py.
COMMANDS: dict[str, tuple[bool, Callable[[Rig, Board, Fault], str]]] = {
    "stuck": (True, lambda _rig, _board, f: f"freeze {f.channel} 1"),
    "drift": (True, _drift),
    "saturated": (True, _rail),
    "jump": (False, _jump),
    "stray": (False, _stray),
    "emergency": (False, _always("emergency 1")),
    "reboot": (False, _always("reboot")),
    "clock": (False, _always(f"clock {CLOCK}")),
    "unplug": (False, _always("unplug")),
    "stall": (False, _always(f"stall {STALL}")),
    "loss": (False, _always(f"line down loss {BAD}")),
}


def script(rig: Rig, board: Board, given: Sequence[str]) -> str:
    """Lines SECONDS COMMAND that make the faults; InputError for one that the wire has not."""
    asked = parsed(rig, given, {name: needs for name, (needs, _) in COMMANDS.items()})
    return "".join(f"{f.at} {COMMANDS[f.name][1](rig, board, f)}\n" for f in asked)
