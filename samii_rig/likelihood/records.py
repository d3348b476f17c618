"""All pieces of some records on common contours, and what a response leaves of them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from samii_rig.likelihood import nuisance, spikes
from samii_rig.likelihood.algebra import by_input
from samii_rig.likelihood.contour import EXACT, SMOOTH, Contour
from samii_rig.likelihood.pieces import Loops, Piece, Samples, across
from samii_rig.likelihood.seen import Answers, Seen
from samii_rig.types import Complex, Float, Int

# In a record, of its lowest line: below, wandering is as large as what polynomials leave.
CYCLES = 5
# Lines of which one of n takes part are those whose number times this has a fraction below 1/n:
# evenly spread, and no period of a multisine, which excites every tenth line say, is missed.
SPREAD = 2**0.5
Response = Callable[[Complex], Complex]
"""(n,) s -> (n, q) of the reference model, from input to sensors; (n, q m) of m inputs, all inputs
of the first sensor first. Beyond half the rate of records that hold not every sample of the rig:
from and to all of its samples."""


@dataclass(frozen=True, slots=True)
class Lines:
    """The lines of one piece. k : (n,) of its DFT. frequency : (n,) Hz."""

    k: Int
    frequency: Float


@dataclass(frozen=True)
class Records:
    """All pieces, on common contours.

    bands : Hz, of the lines of each that take part. steps : of each sensor's converter, none where
    they are not known. least : samples for which the contours are long enough at least, so that
    those of other records are the same. driven : Hz up to which, and driven_from : from which the
    input is more than noise, so that a change of the response shows. undriven : inputs that nothing
    excites. What they did is known; a change of the response to it would fit the noise in it.
    every : samples of the rig for each that was recorded. one_of : lines of which one takes part.
    """

    pieces: tuple[Piece, ...]
    rate_hz: float
    bands: tuple[tuple[float, float], ...]
    steps: tuple[float, ...] = ()
    least: int = 0
    driven: float = np.inf
    driven_from: float = 0.0
    undriven: tuple[int, ...] = ()
    every: int = 1
    one_of: int = 1

    @property
    def changing(self) -> tuple[float, float]:
        """Hz between which a change of the response shows."""
        low, high = self.band
        return max(low, self.driven_from), min(high, self.driven)

    @property
    def band(self) -> tuple[float, float]:
        """Hz, from the lowest to the highest line."""
        return min(low for low, _ in self.bands), max(high for _, high in self.bands)

    @property
    def step(self) -> Float:
        """(q,) of each sensor's converter, 0 where it is not known."""
        return np.array(self.steps or (0.0,) * self.pieces[0].z.shape[1])

    @property
    def longest(self) -> int:
        """Samples, input before the piece included."""
        return max(self.least, *(len(p.r) for p in self.pieces))

    @property
    def count(self) -> int:
        """Lines of all pieces."""
        return sum(self.lines(piece).k.size for piece in self.pieces)

    def exact(self) -> Contour:
        """The contour of predictions."""
        return Contour.over(self.longest, self.rate_hz, EXACT)

    def fine(self) -> Contour:
        """That of all samples of the rig, where not every one was recorded."""
        return Contour.over(self.longest * self.every, self.rate_hz * self.every, EXACT)

    def smooth(self) -> Contour:
        """The contour of the nodes."""
        return Contour.over(self.longest, self.rate_hz, SMOOTH)

    def lines(self, piece: Piece) -> Lines:
        """The lines of a piece in its band."""
        n = len(piece.z)
        band = self.bands[next(i for i, p in enumerate(self.pieces) if p is piece)]
        low, high = (f * n / self.rate_hz for f in band)
        first, last = max(CYCLES, int(np.ceil(low))), min(int(high), (n - 1) // 2)
        k = np.arange(first, last + 1)
        if self.one_of > 1:
            k = k[(k * SPREAD) % 1.0 < 1 / self.one_of]
        return Lines(k, np.asarray(k * (self.rate_hz / n), np.float64))

    def residual(self, samples: Samples | Piece, k: Int, H: Complex, contour: Contour) -> Complex:
        """(n, q) lines k of what H (M//2 + 1, q) on `exact` leaves of samples, a sample's power."""
        e = _left_in_time(samples, H, contour)
        return np.asarray(np.fft.rfft(e, axis=0)[k] / np.sqrt(len(e)))

    def without_spikes(self, H: Complex) -> Records:
        """The same, without spikes that show beside what H on `exact` predicts: as `spikes`, whose
        cubic is blind to them where the motion is fast; and with those that it predicts."""
        exact = self.exact()

        def without(samples: Samples | Piece) -> Float:
            e = _left_in_time(samples, H, exact)
            z = samples.z
            if none := spikes.as_predicted(e, samples.struck, self.step):
                at, sensor, more = zip(*none, strict=True)
                z, e = z.copy(), e.copy()
                z[at, sensor] += more
                e[at, sensor] += more
            mended, found = spikes.mended(e, self.step)
            return z + (mended - e) if found else z

        def each(found: tuple[Samples, ...]) -> tuple[Samples, ...]:
            return tuple(replace(x, z=without(x), struck=()) for x in found)

        pieces = tuple(
            replace(
                p, z=without(p), struck=(), repeats=each(p.repeats), contrasts=each(p.contrasts)
            )
            for p in self.pieces
        )
        return replace(self, pieces=pieces)

    def seen(self, H: Complex, loop: Loops, response: Response) -> list[Seen]:
        """Of each piece what H on `exact`, of a response, leaves, and what else is in it."""
        rms = [np.sqrt(np.mean(by_input(p.r) ** 2, axis=1)) for p in self.pieces]
        answers = Answers.of(
            H, self.exact(), loop, self.longest, np.max(rms, axis=0), self.pieces[0].inputs
        )
        if self.every > 1 and any(p.edges for p in self.pieces):
            contour = self.fine()
            fine = contour.record(response(contour.s), self.longest * self.every)
            folded = nuisance.folding(answers.impulse, fine, self.every)
            answers = replace(answers, folded=folded)
        sent = self.every == 1
        return [Seen.of(p, self.lines(p).k, answers, self.step, as_sent=sent) for p in self.pieces]


def _left_in_time(samples: Samples | Piece, H: Complex, contour: Contour) -> Float:
    """(n, q) what H on a contour leaves of samples."""
    left = samples.z - contour.predicted(H, samples.r)[len(samples.r) - len(samples.z) :]
    return across(left, samples.lost) if isinstance(samples, Piece) else left
