"""Of one piece what a reference leaves of its lines, and what else is in them.

All of it comes from two motions: what the reference answers to the piece's input, and to an
impulse. Neither is computed twice.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from samii_rig.likelihood import nuisance, rounding
from samii_rig.likelihood.contour import Contour
from samii_rig.likelihood.pieces import Loops, Piece
from samii_rig.types import Complex, Float, Int


@dataclass(frozen=True, slots=True)
class Answers:
    """A reference on its contour.

    H : (M//2 + 1, q), or (M//2 + 1, q inputs) of several, all inputs of the first sensor first.
    loops : that H has closed. impulse : (m, q) or (m, q inputs) its answer to an impulse.
    """

    H: Complex
    exact: Contour
    loops: Loops
    inputs: int
    impulse: Float
    kept: dict[int, list[Float]] = field(default_factory=dict)

    @classmethod
    def of(cls, H: Complex, exact: Contour, loops: Loops, longest: int, inputs: int = 1) -> Answers:
        """longest : samples of any piece, input before it included."""
        return cls(H, exact, loops, inputs, exact.record(H, min(2 * longest, exact.samples)))

    def steps(self, n: int) -> list[Float]:
        """(n, q) what the sensors show of a step of each input, and of each loop's sensor."""
        if n not in self.kept:
            each = [self.H[:, j :: self.inputs] for j in range(self.inputs)]
            for kp, sensor, of in self.loops:
                sensed = -kp * each[of]
                sensed[:, sensor] += 1
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
        H, exact = answers.H, answers.exact
        y = exact.predicted(H, piece.r)[piece.history :]
        left = np.fft.rfft(piece.z - y, axis=0)
        own = [nuisance.wander(n, k, q), nuisance.hum(left, k, exact.rate_hz, n)]
        own += [nuisance.past(piece, k, answers.impulse, exact)]
        own += [nuisance.unread(piece, k, y, H, exact, answers.loops, step)]
        own += [nuisance.edges(piece, k, answers.impulse)]
        own += [nuisance.offsets(piece, k, answers.steps(len(piece.r)))]
        N = np.concatenate(own, axis=2)
        size = np.linalg.norm(N, axis=(0, 1))
        return cls(
            np.asarray(left[k] / np.sqrt(n)),
            np.asarray(N[:, :, size > 0] / size[size > 0]),
            rounding.of_piece(piece, step, y, exact.rate_hz),
        )
