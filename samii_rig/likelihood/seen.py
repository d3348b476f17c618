"""Of one piece what a reference leaves of its lines, and what else is in them.

All of it comes from two motions: what the reference answers to the piece's input, and to an
impulse. Neither is computed twice.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from samii_rig.likelihood import nuisance, rounding
from samii_rig.likelihood.contour import Contour
from samii_rig.likelihood.pieces import Piece
from samii_rig.types import Complex, Float, Int


@dataclass(frozen=True, slots=True)
class Answers:
    """A reference on its contour.

    H : (M//2 + 1, q). loop : kp and sensor of the loop that H has closed. impulse : (m, q) its
    answer to an impulse of the input.
    """

    H: Complex
    exact: Contour
    loop: tuple[float, int] | None
    impulse: Float
    kept: dict[int, list[Float]] = field(default_factory=dict)

    @classmethod
    def of(
        cls, H: Complex, exact: Contour, loop: tuple[float, int] | None, longest: int
    ) -> Answers:
        """longest : samples of any piece, input before it included."""
        return cls(H, exact, loop, exact.record(H, min(2 * longest, exact.samples)))

    def steps(self, n: int) -> list[Float]:
        """(n, q) what the sensors show of a step of the input, and of the loop's sensor."""
        if n not in self.kept:
            each = [self.H]
            if self.loop is not None:
                kp, entry = self.loop
                sensed = -kp * self.H
                sensed[:, entry] += 1
                each.append(sensed)
            self.kept[n] = [self.exact.predicted(H, np.ones(n)) for H in each]
        return self.kept[n]


@dataclass(frozen=True, slots=True)
class Seen:
    """Lines of a piece.

    e : (n, q) what the reference leaves, a sample's power. N : (n, q, m) nuisances, of size 1 each.
    rounding : as `rounding.of_piece` has it.
    """

    e: Complex
    N: Complex
    rounding: tuple[Float, Float]

    @classmethod
    def of(cls, piece: Piece, k: Int, answers: Answers, step: Float) -> Seen:
        """k : (n,) numbers of the lines. step : (q,) of each sensor's converter, 0 if not known."""
        n, q = piece.z.shape
        H, exact, loop = answers.H, answers.exact, answers.loop
        y = exact.predicted(H, piece.r)[piece.history :]
        left = np.fft.rfft(piece.z - y, axis=0)
        own = [nuisance.wander(n, k, q), nuisance.hum(left, k, exact.rate_hz, n)]
        own += [nuisance.past(piece, k, answers.impulse)]
        own += [nuisance.unread(piece, k, y, H, exact, loop, step)]
        own += [nuisance.edges(piece, k, answers.impulse)]
        own += [nuisance.offsets(piece, k, answers.steps(piece.r.size))]
        N = np.concatenate(own, axis=2)
        size = np.linalg.norm(N, axis=(0, 1))
        return cls(
            np.asarray(left[k] / np.sqrt(n)),
            np.asarray(N[:, :, size > 0] / size[size > 0]),
            rounding.of_piece(piece, step, y, exact.rate_hz),
        )
