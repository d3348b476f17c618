"""What moved the rig before the first input of a piece that is known.

The motion that is left of it is a sum of answers to impulses at samples before the piece, of
amplitudes a that nobody knows. With H = S + d these are answers of S and of d:

    P(H) a = P(S) a + P(d) a.

The first is a nuisance. The second grows with time where d shifts a mode, and is as large as the
motion itself. It is known as far as a is, from what the reference leaves of the piece: an input
before the piece, to which a change d of the response answers as to all others. (Variable
projection with Kaufman's slope: Golub and Pereyra 2003, Inverse Problems 19.)
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from samii_rig.likelihood.algebra import SAME, as_real, directions
from samii_rig.likelihood.contour import Contour
from samii_rig.likelihood.pieces import Piece
from samii_rig.types import Complex, Float, Int

# Samples before a piece at which an unknown input may have acted: three to an octave, so that
# what is left of the motion of every mode is a sum of their answers. Behind inputs that are known
# only what rings longest is left, of few modes: one to an octave.
AN_OCTAVE, BEHIND = 3.0, 1.0
# Of a contour, how far the answer to an impulse is known: what rings before its cause, as filters
# are known to half the rate only, stands at its end and grows to there.
AS_FAR = 0.6
BEGINS = 256  # samples that are looked at first
NEW = 1e-5  # of the largest, a direction in which past inputs still differ
# Of chi-square, motion from before a piece whose change shows: 10 noise units, of which a tenth
# makes one.
PAST_SHOWN = 100.0
OVER_ROUNDING = 100.0  # over rounding alone, what a response on the contour is off; a mode's 35


@dataclass(frozen=True, slots=True)
class Past:
    """shapes : (n_lines, q, m) of motion from before the first input that is known, of size 1.

    lags : (p,) samples before it, of impulses of the inputs `of` (p,), a rig of `inputs` has.
    likely : (n_lines, q, m) the same, independent and of sd 1 beforehand, if what acted before was
    as strong as what is known. impulses : (p, m) that make them. start : (w, q, m) what they move
    at the piece's first samples.
    """

    shapes: Complex
    lags: Int
    of: Int
    inputs: int
    likely: Complex
    impulses: Float
    start: Float

    @classmethod
    def of_piece(
        cls, piece: Piece, k: Int, impulse: Float, contour: Contour, strength: Float
    ) -> Past:
        """k : (n,) numbers of the lines. impulse : (m, q) answer to an impulse of the input;
        (m, q inputs) of several; from a response on the contour, so that rounding in it grows with
        time. strength : (inputs,) rms of what is known."""
        known = piece.history + len(piece.z)
        longest = min(len(piece.z), int(AS_FAR * contour.samples) - known)
        dense = BEHIND if piece.history else AN_OCTAVE
        lags = np.unique(np.rint(2 ** np.arange(0, np.log2(longest), 1 / dense)).astype(np.int64))
        each = [impulse[:, j :: piece.inputs] for j in range(piece.inputs)]
        largest = [np.max(np.abs(one[: contour.samples // 2]), axis=0) for one in each]
        spectra, at = [], []
        for lag in lags:
            off = OVER_ROUNDING / NEW * contour.rounding(int(lag) + known)
            for j, (one, most) in enumerate(zip(each, largest, strict=True)):
                y = one[lag + piece.history : lag + known]
                # Of what has died out rounding alone would be left, in directions that nothing
                # moves.
                if lag == 1 or _moves(y, off * most):
                    spectra.append(np.fft.rfft(y, axis=0)[k])
                    at.append((int(lag), j))
        lag, of = np.array(at).T
        answers = np.stack(spectra, axis=2)
        size, turn = _independent(answers)
        shapes = np.asarray(answers @ (turn.T / size[:, None]))
        # As if one had acted from each to the next, all of one sign.
        sd = strength[of] * np.maximum(lag * (2 ** (1 / dense) - 1), 1.0)
        first = lag + piece.history + np.arange(_period(piece, k))[:, None]
        start = np.stack([each[j][first[:, i]] for i, j in enumerate(of)], axis=2)
        root, values, own = np.linalg.svd(turn * (size * sd), full_matrices=False)
        return cls(
            shapes / np.linalg.norm(shapes, axis=(0, 1)),
            lag,
            of,
            piece.inputs,
            np.asarray(shapes @ (root * values)),
            sd[:, None] * own.T,
            np.asarray(start @ (sd[:, None] * own.T)),
        )

    def motion(self, piece: Piece, amplitudes: Float, impulse: Float) -> Float:
        """(n, q) what is left of it in a piece. impulse : as of `of_piece`."""
        out = np.zeros(piece.z.shape)
        for lag, j, a in zip(self.lags, self.of, self.impulses @ amplitudes, strict=True):
            first = int(lag) + piece.history
            out += a * impulse[first : first + len(out), j :: self.inputs]
        return out

    def begins(self, left: Float, amplitudes: Float) -> bool:
        """Whether a piece begins with motion of such amplitudes (m,). left : (n, q) what a
        reference leaves of the piece, in time.

        Nothing rings more than at its start. A mismatch that is taken for it does not show there.
        """
        size = np.sqrt(np.mean(left**2, axis=0))
        own = left[: len(self.start)] / np.where(size > 0, size, 1.0)
        explained = self.start @ amplitudes / np.where(size > 0, size, 1.0)
        both = np.stack([own, own - explained])
        both -= np.mean(both, axis=1, keepdims=True)  # of a sensor's offset nobody knows
        without, beside = np.sum(both**2, axis=(1, 2))
        return bool(beside < without)

    def before(self, piece: Piece, amplitudes: Float) -> Piece:
        """The piece with impulses of such amplitudes (m,) before it."""
        most = int(self.lags.max())
        r = np.zeros((most, self.inputs))
        np.add.at(r, (most - self.lags, self.of), self.impulses @ amplitudes)
        r = r[:, 0] if piece.r.ndim == 1 else r
        return replace(piece, r=np.concatenate([r, piece.r]), history=most + piece.history)


def _moves(y: Float, least: Float) -> bool:
    """Whether any of y (n, q) is more than `least` (q,): what does so mostly begins with that."""
    return bool(np.any(np.abs(y[:BEGINS]) > least) or np.any(np.abs(y[BEGINS:]) > least))


def _period(piece: Piece, k: Int) -> int:
    """Samples of a period in the middle of lines k (n,)."""
    return int(np.clip(len(piece.z) / math.sqrt(k[0] * k[-1]), 2, len(piece.z)))


def likely(shapes: Complex, e: Complex, N: Complex, W: Complex) -> Float | None:
    """(m,) amplitudes of shapes (n, q, m), of sd 1 beforehand, that lines e (n, q) show beside
    nuisances N (n, q, p); None where they show none. W : (n, q, q) twice the inverse of the noise.
    """
    every = np.concatenate([shapes, N], axis=2)
    flat = as_real(every.reshape(-1, every.shape[2]))
    square = flat.T @ as_real((W @ every).reshape(-1, every.shape[2]))
    head = flat.T @ as_real((W @ e[:, :, None]).ravel())
    return shown(square, head, shapes.shape[2])


def shown(square: Float, head: Float, m: int) -> Float | None:
    """(m,) as `likely`, from the products of all columns with each other (m + p, m + p) and with
    the lines (m + p,)."""
    values, turn = directions(square[m:, m:])
    kept = values > SAME * np.max(values, initial=0.0)
    others = turn[:, kept] / np.sqrt(values[kept])
    across = square[:m, m:] @ others
    own = square[:m, :m] - across @ across.T
    pull = head[:m] - across @ (others.T @ head[m:])
    found = np.linalg.solve(own + np.eye(m), pull)
    return np.asarray(found) if float(found @ pull) > PAST_SHOWN else None


def _independent(shapes: Complex) -> tuple[Float, Float]:
    """Sizes (p,) of shapes (n, q, p) and, in units of these, the directions (m, p) in which they
    really differ."""
    n, q, p = shapes.shape
    scale = np.linalg.norm(shapes, axis=(0, 2))
    flat = (shapes / scale[:, None]).reshape(n * q, p)
    rows = np.concatenate([flat.real, flat.imag])
    size = np.linalg.norm(rows, axis=0)
    _, values, turn = np.linalg.svd(np.linalg.qr(rows / size, mode="r"), full_matrices=False)
    return size, np.asarray(turn[values > NEW * values[0]])
