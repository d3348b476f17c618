"""Of one piece what a reference leaves of its lines, and what else is in them.

All of it comes from two motions: what the reference answers to the piece's input, and to an
impulse. Neither is computed twice.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from samii_rig.likelihood import nuisance
from samii_rig.likelihood.contour import Contour
from samii_rig.likelihood.past import Past, likely
from samii_rig.likelihood.pieces import Loops, Piece, across
from samii_rig.likelihood.rounding import Rounding
from samii_rig.types import Complex, Float, Int


@dataclass(frozen=True, slots=True)
class Answers:
    """A reference on its contour.

    H : (M//2 + 1, q), or (M//2 + 1, q inputs) of several, all inputs of the first sensor first.
    loops : that H has closed. impulse : (m, q) or (m, q inputs) its answer to an impulse.
    strength : (inputs,) rms of what is known to act. folded : as of `nuisance.folding`, none where
    no edge needs it. What pieces of one length have in common is kept: most are repeats and levels
    of one excitation.
    """

    H: Complex
    exact: Contour
    loops: Loops
    inputs: int
    impulse: Float
    strength: Float
    kept: dict[tuple[int, int, int, int], tuple[Past, Complex, Complex]] = field(
        default_factory=dict
    )
    folded: tuple[Float, ...] = ()

    @classmethod
    def of(
        cls,
        H: Complex,
        exact: Contour,
        loops: Loops,
        longest: int,
        strength: Float,
        inputs: int = 1,
    ) -> Answers:
        """longest : samples of any piece, input before it included."""
        impulse = exact.record(H, min(2 * longest, exact.samples))
        return cls(H, exact, loops, inputs, impulse, strength)

    def alike(self, piece: Piece, k: Int) -> tuple[Past, Complex, Complex]:
        """Of neighbouring lines k of a piece, whatever its input: its past, how sensors wander, and
        what the offsets of inputs and loops' sensors make, of size 1."""
        n, q = piece.z.shape
        key = n, piece.history, int(k[0]), k.size
        if key not in self.kept:
            past = Past.of_piece(piece, k, self.impulse, self.exact, self.strength)
            steps = nuisance.offsets(piece, k, self._steps(len(piece.r)))
            self.kept[key] = past, nuisance.wander(n, k, q), _of_size_one(steps)
        return self.kept[key]

    def _steps(self, n: int) -> list[Float]:
        """(n, q) what the sensors show of a step of each input, and of each loop's sensor."""
        each = [self.H[:, j :: self.inputs] for j in range(self.inputs)]
        for kp, sensor, of in self.loops:
            sensed = -kp * each[of]
            sensed[:, sensor] += 1
            each.append(sensed)
        return [self.exact.predicted(H, np.ones(n)) for H in each]


@dataclass(frozen=True, slots=True)
class Seen:
    """Lines of a piece.

    e : (n, q) what the reference leaves, a sample's power. N : (n, q, m) nuisances, of size 1 each;
    the first are the past's. beside : those that are no past: an offset that acts from the first
    sample on rings as that does. prior : (m,) 1 of the last, of standard normal amplitudes instead;
    0 of those whose size nobody knows.
    rounding : of the converters. left : (n_samples, q) in time what the reference
    leaves.
    """

    e: Complex
    N: Complex
    prior: Float
    past: Past
    beside: slice
    rounding: Rounding
    left: Float

    @classmethod
    def of(
        cls, piece: Piece, k: Int, answers: Answers, step: Float, *, as_sent: bool = True
    ) -> Seen:
        """k : (n,) numbers of the lines. step : (q,) of each sensor's converter, 0 if not known.
        as_sent : whether the commands are those that the loops sent, all of them."""
        n = len(piece.z)
        H, exact = answers.H, answers.exact
        y = exact.predicted(H, piece.r)[piece.history :]
        left_in_time = across(piece.z - y, piece.lost)
        left = np.fft.rfft(left_in_time, axis=0)
        past, wander, steps = answers.alike(piece, k)
        own = [wander, nuisance.hum(left, k, exact.rate_hz, n)]
        if np.any(step > 0):  # what a converter reads is the whole motion
            y = y + _before(past, left[k], wander, answers.impulse, piece)
        sent = as_sent and not any(m.shown for told in piece.commands for m in told.meter)
        closed = {sensor for _, sensor, _ in answers.loops} if sent else ()
        rounding = Rounding.of_piece(piece, k, step, y, exact.rate_hz, closed)
        own += [nuisance.unread(piece, k, rounding.factors, H, exact, answers.loops)]
        own += [nuisance.edges(piece, k, answers.impulse, answers.folded)]
        own += [nuisance.lost(piece, k, answers.impulse)]
        beside = _of_size_one(np.concatenate(own, axis=2))
        first = past.shapes.shape[2]
        metered = nuisance.metered(piece, k, answers.impulse) / np.sqrt(n)
        N = np.concatenate([past.shapes, beside, steps, metered], axis=2)
        return cls(
            np.asarray(left[k] / np.sqrt(n)),
            N,
            np.repeat([0.0, 1.0], [N.shape[2] - metered.shape[2], metered.shape[2]]),
            past,
            slice(first, first + beside.shape[2]),
            rounding,
            left_in_time,
        )


def _before(past: Past, e: Complex, wander: Complex, impulse: Float, piece: Piece) -> Float:
    """(n, q) motion from before a piece that lines e (n_lines, q) show, each sensor's median
    taken for noise."""
    power = np.median(np.abs(e) ** 2, axis=0)
    W = np.diag(1 / np.where(power > 0, power, 1.0))
    found = likely(past.likely, e, wander, np.broadcast_to(W, (len(e), *W.shape)))
    if found is None:
        return np.zeros(piece.z.shape)
    return past.motion(piece, found, impulse)


def _of_size_one(shapes: Complex) -> Complex:
    """Shapes (n, q, m) that are any, each of size 1."""
    flat = shapes.reshape(-1, shapes.shape[2])
    size = np.sqrt(np.einsum("ij,ij->j", flat.real, flat.real)
                   + np.einsum("ij,ij->j", flat.imag, flat.imag))  # fmt: skip
    some = size > 0
    return np.asarray((shapes if some.all() else shapes[:, :, some]) / size[some])
