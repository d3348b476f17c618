"""Recordings across short gaps, and what an input was in the samples that one has lost.

The samples beside a gap are taken for an autoregressive process; what it most likely did between
them, and how far off that may be, is one linear system (Janssen, Veldhuis and Vries 1986, IEEE
Trans. ASSP 34(2)). A sweep of any rate is such a process of few coefficients.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, replace

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from samii_rig.types import Float, Int, Recording

ORDER = 32  # coefficients: of a band that is a tenth of the rate wide it takes half of them
FITTED_BESIDE = 16 * ORDER  # samples to either side of which they are fitted
RIDGE = 1e-12  # of the power of what is fitted: a sine alone needs two coefficients

# s of lost samples that a piece goes on across, their motion a nuisance: one for each half period
# of the band, so that across a longer gap hardly less is unknown than where a piece begins.
LONGEST_GAP = 1.0
MOST_GAPS = 16  # in a segment, across which pieces go on: of many the nuisances outgrow the lines


@dataclass(frozen=True, slots=True)
class Bridged:
    """A recording (n samples) without its short gaps.

    lost : (gaps, 2) the first sample of each and the one behind its last. breaks : samples at which
    something longer ends, and the first.
    """

    recording: Recording
    lost: Int
    breaks: Int

    @classmethod
    def of(
        cls, recording: Recording, known: NDArray[np.bool_], driving: Collection[str]
    ) -> Bridged:
        """known : (rows,) whether a row counts; one does. driving : the columns of which inputs are
        made, as `bridged` has them; the others go straight from side to side."""
        rows = np.flatnonzero(known)
        sequence = recording.sequence[rows]
        steps = np.diff(sequence)
        short = (steps > 1) & (steps <= LONGEST_GAP * recording.rate_hz)
        at = np.cumsum(np.concatenate([[0], np.where(short, steps, 1)]))
        breaks = np.concatenate([[0], at[1:][(steps != 1) & ~short]])
        lost = np.stack([at[:-1][short] + 1, at[1:][short]], axis=1)
        if rows.size == len(recording) and not len(lost):
            return cls(recording, lost, breaks)
        n = int(at[-1]) + 1
        quality = np.zeros((n, len(recording.channels)), recording.quality.dtype)
        quality[at] = recording.quality[rows]
        values = np.stack(
            [np.interp(np.arange(n), at, column) for column in recording.values[rows].T], axis=1
        )
        if len(lost) <= MOST_GAPS * max(len(recording.segments), 1):
            for i, channel in enumerate(recording.channels):
                if channel.name in driving:
                    bridge(values[:, i], lost)
        when = np.interp(np.arange(n), at, recording.time[rows])
        which = np.interp(np.arange(n), at, sequence)
        filled = replace(
            recording, time=np.rint(when).astype(np.int64), values=values, quality=quality,
            sequence=np.rint(which).astype(np.int64),
        )  # fmt: skip
        return cls(filled, lost, breaks)

    @property
    def gaps(self) -> NDArray[np.bool_]:
        """(n,) which samples are lost."""
        out = np.zeros(len(self.recording), np.bool_)
        for first, behind in self.lost:
            out[first:behind] = True
        return out

    def between(self, start: int, stop: int) -> tuple[int, int]:
        """Where samples numbered from `start` to before `stop` begin and end; neither is lost."""
        a, b = (int(i) for i in np.searchsorted(self.recording.sequence, [start, stop]))
        for first, behind in self.lost.tolist():
            a = behind if first <= a < behind else a
            b = first if first < b <= behind else b
        return a, max(a, b)


def bridge(x: Float, lost: Int) -> Float:
    """Put what x (n,) most likely was into samples that are lost (gaps, 2); (gaps,) how far off
    that may be, rms."""
    off = np.zeros(len(lost))
    for i, (first, behind) in enumerate(lost.tolist()):
        x[first:behind], sd = bridged(x, first, behind)
        off[i] = np.sqrt(np.mean(sd**2))
    return off


def bridged(x: Float, first: int, behind: int) -> tuple[Float, Float]:
    """(g,) the most likely values of x (n,) from sample `first` to before `behind`, and the
    standard deviation of each. Straight from side to side, and as far off as x is large, where
    too few samples are beside the gap."""
    low, high = max(first - FITTED_BESIDE, 0), min(behind + FITTED_BESIDE, len(x))
    before, after = x[low:first], x[behind:high]
    rows = [sliding_window_view(one, ORDER + 1) for one in (before, after) if len(one) > ORDER]
    if not rows or sum(len(one) for one in rows) < 2 * ORDER:
        ends = np.interp(np.arange(first, behind), [first - 1, behind], [x[first - 1], x[behind]])
        return ends, np.full(behind - first, np.std(x))
    A = np.concatenate(rows)
    past, now = A[:, :-1], A[:, -1]
    square = past.T @ past
    power = np.trace(square) / ORDER
    if power == 0:
        return np.zeros(behind - first), np.zeros(behind - first)
    b = np.linalg.solve(square + RIDGE * power * np.eye(ORDER), past.T @ now)
    variance = float(np.mean((now - past @ b) ** 2))
    taps = np.append(-b, 1.0)  # over samples in their order: what is left is white
    start = max(first - ORDER, 0)
    values, sd = _between(x[start : behind + ORDER], first - start, behind - first, taps)
    return values, np.sqrt(variance) * sd


def _between(x: Float, first: int, g: int, taps: Float) -> tuple[Float, Float]:
    """As `bridged`, of samples x (n,) about a gap of g samples from `first` on, where `taps` leave
    white noise of power 1."""
    rows = len(x) - len(taps) + 1
    B = np.zeros((rows, len(x)))
    for i in range(rows):
        B[i, i : i + len(taps)] = taps
    inside = np.arange(first, first + g)
    known = np.delete(np.arange(len(x)), inside)
    own = B[:, inside]
    square = own.T @ own
    root = np.linalg.cholesky(square + RIDGE * np.trace(square) / g * np.eye(g))
    goal = -own.T @ (B[:, known] @ x[known])
    inverse = np.linalg.inv(root)
    values = inverse.T @ (inverse @ goal)
    return values, np.sqrt(np.sum(inverse**2, axis=0))
