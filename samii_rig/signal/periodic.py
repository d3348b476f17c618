"""Periodic references: which samples are measured, and which groups are one multisine.

Realisations of a multisine have one amplitude spectrum and phases of their own, and are
measurements of one best linear approximation. Over the periods of one realisation only the
noise scatters, since what is not linear repeats with it. Over realisations both scatter: what
is not linear then looks like noise, normal and independent from line to line (Pintelon and
Schoukens, 2nd ed., section 3.4). So with several realisations each counts as one measurement,
the mean of its periods.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from samii_rig.errors import EstimateError
from samii_rig.signal.groups import Group, Piece
from samii_rig.signal.spectra import Spectrum, period, spectrum
from samii_rig.types import Float

# Relative difference of two amplitude spectra that are the same but for rounding and units.
SAME_AMPLITUDE = 1e-3


def first_used(r: Float) -> int:
    """Samples at the start of a periodic reference that carry the transient and are left out:
    the first of three or more periods."""
    p = period(r)
    return p if r.size // p > 2 else 0


def joined(groups: Sequence[Group]) -> list[Group]:
    """Groups that are realisations of one multisine as one group, its pieces numbered."""
    bundles: list[list[Group]] = []
    for group in groups:
        for bundle in bundles:
            if _realisations(bundle[0], group):
                bundle.append(group)
                break
        else:
            bundles.append([group])
    return [_join(bundle) if len(bundle) > 1 else bundle[0] for bundle in bundles]


def _join(bundle: list[Group]) -> Group:
    first = bundle[0]
    numbered = [replace(p, realisation=i) for i, g in enumerate(bundle) for p in g.pieces]
    sources = list(dict.fromkeys(s for g in bundle for s in g.sources))
    findings = list(dict.fromkeys(f for g in bundle for f in g.findings))
    return replace(first, pieces=numbered, sources=sources, findings=findings)


def _realisations(a: Group, b: Group) -> bool:
    pair = (a, b)
    if any(g.kind != "periodic" or not g.equal_length for g in pair):
        return False
    if (a.unit, a.rate_hz, a.through) != (b.unit, b.rate_hz, b.through):
        return False
    if a.selection != b.selection or len(a.pieces[0]) != len(b.pieces[0]):
        return False
    if not np.isclose(a.level, b.level, rtol=1e-6, equal_nan=True):
        return False
    # The last period: the first may start from rest.
    last = [g.pieces[0].r[-period(g.pieces[0].r) :] for g in pair]
    if last[0].size != last[1].size:
        return False
    size = [np.abs(np.fft.rfft(r)) for r in last]
    return bool(np.abs(size[0] - size[1]).max() <= SAME_AMPLITUDE * size[0].max())


@dataclass(frozen=True, slots=True)
class Periods:
    """The measured periods: one list of spectra a realisation, and the pieces of them all."""

    spectra: list[list[Spectrum]]
    pieces: list[Piece]

    @property
    def independent(self) -> list[Spectrum]:
        """What counts as one measurement each: the periods of one realisation, or the mean
        of each of several."""
        if len(self.spectra) == 1:
            return self.spectra[0]
        return [
            replace(
                s[0],
                R=np.mean([x.R for x in s], axis=0),
                Z=np.mean([x.Z for x in s], axis=0),
            )
            for s in self.spectra
        ]

    @property
    def over(self) -> str:
        """What the covariance is taken over, in words."""
        return "repeats" if len(self.spectra) == 1 else "realisations"

    @property
    def why(self) -> str:
        """What the covariance contains, in words; "" for a single realisation."""
        n = len(self.spectra)
        if n == 1:
            return ""
        return (
            f"{n} realisations of {len(self.pieces) / n:.3g} periods, whose scatter holds the "
            "noise and what is not linear"
        )


def periods(group: Group) -> Periods:
    """Every measured period of a group; EstimateError if there is only one."""
    p = period(group.pieces[0].r)
    spectra: dict[int, list[Spectrum]] = {}
    out: list[Piece] = []
    for piece in group.pieces:
        for k in range(first_used(piece.r) // p, len(piece) // p):
            rows = slice(k * p, (k + 1) * p)
            out.append(Piece(f"{piece.name}, period {k + 1}", piece.r[rows], piece.z[rows]))
            found = spectra.setdefault(piece.realisation, [])
            found.append(spectrum(out[-1], group.rate_hz))
    if len(out) < 2:
        raise EstimateError(f"{group.pieces[0].name}: one period; method 'local' needs only one")
    return Periods(list(spectra.values()), out)
