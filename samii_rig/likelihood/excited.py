"""Which lines of records anything drives, and up to where that is known."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy import ndimage, signal

from samii_rig.errors import EstimateError
from samii_rig.likelihood.algebra import by_input
from samii_rig.likelihood.nuisance import HIGHEST
from samii_rig.likelihood.outside import OCTAVE_PARTS
from samii_rig.likelihood.pieces import Piece
from samii_rig.likelihood.records import CYCLES, Records
from samii_rig.types import Float

# Of the largest, an input's energy in a third of an octave that excites: steps through frequencies,
# of as many periods each, and steps of the input have that over 2.5 decades.
EXCITED = 0.003
# The same, from which on an input moves a rig by more than its noise: a thousandth in amplitude. A
# square wave does so far above its band.
DRIVES = 1e-6
METER = 9.0  # times a converter's rounding or a meter's noise, power of an input that is more
TAPER = 0.05  # of a record: half of it at the end counts less where its spectrum is what drives
FROM_REST = 2  # times a record's length, of which every other line is that of its repetition
# Where not every sample was recorded: of an input's power what may fold back, 1 % of its amplitude;
# of the rate, from where that is judged, and up to where it is taken for none; lines as one.
FOLDS, EDGE, UNFOLDED, TOGETHER = 1e-4, 0.47, 0.3, 16


def records_of(
    pieces: Sequence[Piece],
    rate_hz: float,
    band: tuple[float, float] | None,
    step: tuple[float, ...],
    rounding: Float,
    every: int,
) -> Records:
    """Those that anything drives. rounding : (m,) of each input's converter, its power. every : as
    of `Records`."""
    several = rounding.size > 1  # a rig's only input is never at rest
    bands_of = excited(pieces, rate_hz, rounding if several else None)
    if every > 1:
        tops = [_unfolded(p, rate_hz) for p in pieces]
        bands_of = [
            (b[0], min(b[1], top)) if b and b[0] < top else None
            for b, top in zip(bands_of, tops, strict=True)
        ]
    driven = [(p, b) for p, b in zip(pieces, bands_of, strict=True) if b]
    if not driven:
        raise EstimateError("nothing drives the rig for five cycles of any line")
    each = [(p, _followed(p, band or b, rate_hz)) for p, b in driven]
    driven = [(p, b) for p, b in each if b]
    if not driven:
        raise EstimateError("in this band the command is only what a loop makes of noise")
    bands = tuple(b for _, b in driven)
    some = tuple(p for p, _ in driven)
    driven_hz = min(_above_meter(some, rate_hz), max(p.follows for p in some))
    return Records(some, rate_hz, bands, step, driven=driven_hz, every=every)


def _followed(
    piece: Piece, band: tuple[float, float], rate_hz: float
) -> tuple[float, float] | None:
    """The band up to where a command follows what moves it from outside; None where that is none of
    five lines."""
    low, high = band
    if piece.follows >= high:
        return band
    wide = piece.follows - low > CYCLES * rate_hz / len(piece.z)
    return (low, piece.follows) if wide else None


def _above_meter(pieces: Sequence[Piece], rate_hz: float) -> float:
    """Hz up to which an input has more than a meter's noise, where one was on any: beyond, a change
    of the response would be that of a rig that does not follow its meter. inf where none was."""
    each = [[noise.on_lines for noise in c.meter] for p in pieces for c in p.commands]
    meter = np.max(each, axis=0)
    if not np.any(meter):
        return np.inf
    return driven_to(pieces, rate_hz, np.asarray(meter**2))


def driven_to(pieces: Sequence[Piece], rate_hz: float, noise: Float | None = None) -> float:
    """Hz up to which an input moves a rig by more than its noise; inf where none does. noise : as
    of `excited`.

    A record that begins at once drives all modes: of a command the spectrum from rest on counts,
    not that of its repetition. Its end, cut, leaks as well, and drives nothing that is seen.
    """
    ending = []
    for p in pieces:
        window = signal.windows.tukey(len(p.r), TAPER)
        window[: len(window) // 2] = 1.0
        ending.append(replace(p, r=np.asarray((window * p.r.T).T)))
    reached = excited(ending, rate_hz, noise, part=DRIVES, padded=FROM_REST)
    return max((band[1] for band in reached if band), default=np.inf)


def excited(
    pieces: Sequence[Piece],
    rate_hz: float,
    noise: Float | None = None,
    part: float = EXCITED,
    padded: int = 1,
) -> list[tuple[float, float] | None]:
    """Hz, of each piece the band in which an input has more than a small part of its largest
    energy in any; None for one that nothing drives: what is left of a sweep behind a gap.

    noise : (m,) power of each input that is none; one that never has more is at rest. padded :
    times the record's length, with rest behind it, of which the spectrum is.
    """
    each = [[_energy(r, rate_hz, padded) for r in by_input(p.r)] for p in pieces]
    most = np.max([[np.max(power) for _, power, _ in inputs] for inputs in each], axis=0)
    still = np.zeros(most.size) if noise is None else METER * noise
    out: list[tuple[float, float] | None] = []
    for piece, inputs in zip(pieces, each, strict=True):
        edges = inputs[0][0]
        over = [
            (energy > part * top) & (energy > floor * lines)
            for (_, energy, lines), top, floor in zip(inputs, most, still, strict=True)
        ]
        on = np.flatnonzero(np.any(over, axis=0))
        if not on.size:
            out.append(None)
            continue
        line = rate_hz / len(piece.z)
        low, high = max(edges[on[0]], CYCLES * line), min(edges[on[-1] + 1], HIGHEST * rate_hz)
        out.append((float(low), float(high)) if high - low > CYCLES * line else None)
    return out


def _unfolded(piece: Piece, rate_hz: float) -> float:
    """Hz up to which an input has more than what folds back from above half the rate may be: as
    much as it has just below. An edge that was found counts by itself."""
    if any(at < len(piece.r) - 1 for at, _ in piece.edges):
        return rate_hz / 2
    tops = []
    for r in by_input(piece.r):
        power = ndimage.uniform_filter1d(np.abs(np.fft.rfft(r)) ** 2, TOGETHER, mode="nearest")
        f = np.arange(power.size) * (rate_hz / r.size)
        edge = np.mean(power[f > EDGE * rate_hz])
        more = np.flatnonzero(power * FOLDS > edge)
        tops.append(f[more[-1]] if more.size else 0.0)
    return max(float(max(tops)), UNFOLDED * rate_hz)


def _energy(r: Float, rate_hz: float, padded: int) -> tuple[Float, Float, Float]:
    """Hz of the edges (m + 1,) of parts of an octave, an input's energy (m,) in each, and how many
    lines it has. padded : as of `excited`."""
    power = np.abs(np.fft.rfft(r, padded * r.size)) ** 2 / r.size
    f = np.arange(power.size) * (rate_hz / (padded * r.size))
    # The offset's line, and the one that it leaks to, are no excitation.
    first = 2 * padded
    part = np.floor(OCTAVE_PARTS * np.log2(f[first:] / f[first])).astype(np.int64)
    edges = f[first] * 2 ** (np.arange(part[-1] + 2) / OCTAVE_PARTS)
    energy = np.asarray(np.bincount(part, power[first:]), np.float64)
    return np.asarray(edges), energy, np.asarray(np.bincount(part), np.float64)


def within(records: Records, band: tuple[float, float]) -> Records:
    """Records on the lines within a band alone.

    Raises EstimateError where one has none there.
    """
    low, high = band
    own = tuple((max(a, low), min(b, high)) for a, b in records.bands)
    if any(a >= b for a, b in own):
        raise EstimateError("the two states were not excited at the same frequencies")
    return replace(records, bands=own)


def up_to(records: Records, top: float) -> Records:
    """Records on the lines up to `top` Hz; of a piece that begins above, its lowest few."""
    least = [CYCLES * records.rate_hz / len(p.z) for p in records.pieces]
    each = zip(records.bands, least, strict=True)
    bands = tuple((low, min(high, max(top, low + few))) for (low, high), few in each)
    return replace(records, bands=bands)
