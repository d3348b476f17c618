"""Which pieces are trusted, and which method the data call for."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Literal

import numpy as np

from samii_rig.errors import EstimateError, RepeatsDifferError
from samii_rig.signal import checks
from samii_rig.signal.groups import Group, Piece, Selection
from samii_rig.signal.rest import Ringing, ringing
from samii_rig.signal.spectra import burst_spectra, excited, period, spectrum
from samii_rig.types import Complex

Method = Literal["auto", "burst", "periodic", "local", "h1", "h2", "hv"]

# Standard deviations of a mean beyond which it has moved; bursts in a row of which the first may
# be left out for that.
MOVED, ROW_TO_SETTLE = 10.0, 4


def drop_stuck(group: Group, *, chosen: bool) -> None:
    """Leave out outputs that never changed in any piece.

    Raises EstimateError if the input never moves, or if such an output was `chosen` or is the last.
    """
    still = [
        i
        for i in range(len(group.selection.outputs))
        if all(np.ptp(p.z[:, i + 1]) == 0 for p in group.pieces)
    ]
    if np.all([np.ptp(p.z[:, 0]) == 0 for p in group.pieces]):
        raise EstimateError(
            f"{group.pieces[0].name}: the input {group.selection.input.name} never moves"
        )
    if not still:
        return
    names = [group.selection.outputs[i].name for i in still]
    if chosen or len(still) == len(group.selection.outputs):
        raise EstimateError(
            f"{group.pieces[0].name}: {', '.join(names)} never changed while the input moved"
        )
    keep = [i for i in range(len(group.selection.outputs)) if i not in still]
    outputs = tuple(group.selection.outputs[i] for i in keep)
    group.selection = Selection(group.selection.input, outputs)
    columns = [0, *(i + 1 for i in keep)]
    group.pieces = [replace(p, z=p.z[:, columns]) for p in group.pieces]


def _lines(pieces: Sequence[Piece], rate_hz: float) -> Complex:
    """(n, lines, channels) of bursts, the lines that are excited."""
    spectra, _ = burst_spectra(pieces, rate_hz)
    lines = excited(spectra, None)
    return np.stack([s.Z[lines] for s in spectra])


def drop_foreign(group: Group) -> None:
    """Exclude repeats that do not repeat.

    Raises RepeatsDifferError if there are only two of them, as neither can be trusted.
    """
    if len(group.pieces) < 2 or not group.equal_length:
        return
    # Bursts on the way from rest differ from those that start in a tail, for no fault of theirs.
    ring = _ringing(group) if _in_a_row(group) else None
    skip = (_settling(group, ring) or 1) if ring else 0
    pieces = group.pieces[skip:]
    names = [p.name for p in pieces]
    foreign = checks.foreign_repeats(_lines(pieces, group.rate_hz), names, group.selection.names)
    if foreign and len(pieces) == 2:
        raise RepeatsDifferError(
            f"{foreign[min(foreign)].message}; a third repeat would tell which is wrong, or "
            "estimate each by itself"
        )
    rest = [i for i in range(len(pieces)) if i not in foreign]
    knocked = checks.knocks(
        [pieces[i].z for i in rest],
        [names[i] for i in rest],
        group.selection.names,
        group.rate_hz,
    )
    foreign |= {rest[i]: finding for i, finding in knocked.items()}
    group.findings += foreign.values()
    group.pieces = [
        replace(p, follows=p.follows and i - 1 not in foreign)
        for i, p in enumerate(group.pieces, start=-skip)
        if i not in foreign
    ]


def choose(
    group: Group, method: Method
) -> tuple[Literal["burst", "settled", "periodic", "local"], str]:
    """The method for a group, and why; EstimateError when the one asked for cannot be."""
    n = len(group.pieces)
    if method == "local":
        return "local", "asked for"
    if method in ("burst", "periodic"):
        whole = method == "burst" and n < 2
        if whole or not group.equal_length:
            raise EstimateError(
                f"{group.pieces[0].name}: method {method!r} needs two or more repeats of equal "
                f"length, there are {n} pieces; method 'local' needs only one"
            )
        return method, "asked for"
    if group.kind == "periodic" and group.equal_length:
        p = period(group.pieces[0].r)
        if sum(len(x) // p for x in group.pieces) >= 2:
            return "periodic", f"whole periods of {p / group.rate_hz:g} s: no leakage"
    if n == 1:
        return "local", "there is one sweep: leakage and noise are told apart by local models"
    if not group.equal_length:
        return "local", "the repeats differ in length or miss samples: local models join them"
    if ring := _ringing(group):
        group.unsettled = _settling(group, ring)
        if group.unsettled:
            return "settled", (
                f"the bursts do not end at rest, but each runs into the next: all but the first "
                f"{group.unsettled} of {n} are whole periods of one motion, without leakage"
            )
        group.findings.append(ring.finding)
        return "local", "the bursts do not end at rest: transients are removed by local models"
    if _in_a_row(group) and n >= ROW_TO_SETTLE and _moves(group):
        group.unsettled = 1
        return "settled", (
            f"the level moves from burst to burst: all but the first of {n} are whole periods of "
            "one motion, from which a slow drift is taken out"
        )
    return "burst", f"{n} bursts from rest to rest with one reference: no leakage"


def _moves(group: Group) -> bool:
    """Whether the mean of a channel differs from burst to burst by more than white noise does."""
    pieces = group.pieces
    sd = np.std(pieces[-1].z - pieces[-2].z, axis=0)
    steps = np.abs(np.diff([p.z.mean(axis=0) for p in pieces], axis=0))
    return bool(np.any(steps > MOVED * sd / np.sqrt(len(pieces[0]))))


def _settling(group: Group, ring: Ringing) -> int:
    """How many of bursts that run into each other to leave out, until the motion is settled.

    0 where that is not what they are: not in a row, or too few to leave two after the motion
    has settled.
    """
    left = len(group.pieces) - ring.settled_after
    return ring.settled_after if _in_a_row(group) and left >= 2 else 0


def _in_a_row(group: Group) -> bool:
    """Whether these are three bursts or more, each of which started where one ended."""
    row = group.kind == "burst" and group.equal_length and len(group.pieces) > 2
    return row and all(p.follows for p in group.pieces[1:])


def at_rest(group: Group) -> bool:
    """Whether all pieces are whole bursts that start and end at rest."""
    if group.kind != "burst":
        return False
    known = {f.kind for f in group.findings}
    return "leakage" not in known and _ringing(group) is None


def _ringing(group: Group) -> Ringing | None:
    spectra = [spectrum(p, group.rate_hz) for p in group.pieces]
    longest = max(spectra, key=lambda s: s.n)
    highest = longest.frequency[excited(spectra, None)[-1]] / group.rate_hz
    channels = (group.selection.input, *group.selection.outputs)
    return ringing(group.pieces, channels, float(highest))
