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
from scipy import special
from scipy.ndimage import binary_dilation, median_filter

from samii_rig.errors import EstimateError
from samii_rig.signal.groups import Group, Piece
from samii_rig.signal.spectra import Spectrum, period, spectrum
from samii_rig.types import Complex, Float, Int

# Relative difference of two amplitude spectra that are the same but for rounding and units.
SAME_AMPLITUDE = 1e-3
# Chances that noise alone is taken for a transient: anywhere, and at a line once there is one.
FALSE_TRANSIENT, FALSE_LINE = 1e-3, 1e-3
POOLED = 101  # lines over which the noise from period to period is pooled
SKIRT = 3  # lines on either side of one at which a transient is seen
SLOWEST = 0.97  # of itself that a transient keeps from period to period, at most


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
    """The measured periods: one list of spectra a realisation, and the pieces of them all.

    before : of each realisation that has one, the period that was left out for its transient.
    """

    spectra: list[list[Spectrum]]
    pieces: list[Piece]
    before: dict[int, Spectrum]

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

    def bias(self, lines: Int) -> Complex:
        """(n, 1 + p) what the transient of the start leaves in the mean of the periods at these
        lines, as far as it stands out of the noise; else 0."""
        left = [
            transient_left(np.stack([s.Z for s in (first, *self.spectra[i])]))[lines]
            for i, first in self.before.items()
        ]
        shape = (lines.size, self.spectra[0][0].Z.shape[1])
        # A realisation that has no period to spare is not known to ring.
        return np.asarray(sum(left, np.zeros(shape, complex)) / len(self.spectra))

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
    before: dict[int, Spectrum] = {}
    out: list[Piece] = []
    for piece in group.pieces:
        used = first_used(piece.r) // p
        if used and piece.realisation not in spectra:
            first = Piece(piece.name, piece.r[:p], piece.z[:p])
            before[len(spectra)] = spectrum(first, group.rate_hz)
        for k in range(used, len(piece) // p):
            rows = slice(k * p, (k + 1) * p)
            out.append(Piece(f"{piece.name}, period {k + 1}", piece.r[rows], piece.z[rows]))
            found = spectra.setdefault(piece.realisation, [])
            found.append(spectrum(out[-1], group.rate_hz))
    if len(out) < 2:
        raise EstimateError(f"{group.pieces[0].name}: one period; method 'local' needs only one")
    return Periods(list(spectra.values()), out, before)


def transient_left(Z: Complex) -> Complex:
    """(n, 1 + p) what is left of a transient in the mean of all periods but the first.

    Z : (n_period, n, 1 + p) of successive periods, the input first. The slowest mode decays by one
    complex factor from period to period, at all lines and outputs; what all periods together say
    of it at a line shows what it leaves in their mean. 0 where nothing stands out of the noise.
    """
    d = np.diff(Z, axis=0)
    p = Z.shape[2] - 1
    # The last two periods differ by noise; a median does not see the few lines that still ring.
    noise = median_filter(np.abs(d[-1, :, 1:]) ** 2, (POOLED, 1)) / np.log(2)
    w = d[:, :, 1:] / np.sqrt(np.maximum(noise, 1e-300))
    loud = np.sum(np.abs(w[0]) ** 2, axis=1) > special.gammainccinv(p, FALSE_TRANSIENT / Z.shape[1])
    if len(d) < 2 or not loud.any():
        return np.zeros(Z.shape[1:], complex)
    before, after = w[:-1, loud], w[1:, loud]
    z = np.sum(before.conj() * after) / np.sum(np.abs(before) ** 2)
    z *= min(1.0, SLOWEST / abs(z))
    powers = z ** np.arange(len(d))
    total = np.sum(np.abs(powers) ** 2)
    known = np.sum(np.abs(np.tensordot(powers.conj(), w, 1)) ** 2, axis=1) / total
    # A mode's skirt goes down beside the lines at which it is seen.
    sure = binary_dilation(known > special.gammainccinv(p, FALSE_LINE), iterations=SKIRT)
    first = np.tensordot(powers.conj(), d, 1) / total / (z - 1)
    return np.asarray(np.where(sure[:, None], first * np.mean(powers * z), 0.0))
