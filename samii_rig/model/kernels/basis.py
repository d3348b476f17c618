"""The two columns of a sweep: where they begin, and the changes of basis that keep them apart.

Rows and form of the columns: see `sweep`.
"""

from __future__ import annotations

from samii_rig.model.kernels.lanes import LANES, TINY, conj, get, norm2, part, put, scaled
from samii_rig.model.kernels.registers import (
    CLAMPED,
    EXCHANGE,
    FLAG,
    FREE_END,
    GUIDED,
    HUGE,
    SCALE,
    THETA2,
    X_ROWS,
    B,
    X,
)
from samii_rig.types import Float

# Rows of columns 1 and 2, of X and of B.
_PAIRS = ((X, X + 8), (X + 2, THETA2), (X + 4, X + 10), (X + 6, X + 12), (B, B + 2), (B + 4, B + 6))


@part
def boundary(W: Float, kind: int) -> None:
    """The two columns of an end: w = theta = 0 clamped, w = M = 0 pinned, M = V = 0 free,
    theta = V = 0 guided."""
    # The sign makes det[column 1, column 2] that of (w, theta) in this order.
    one = X + 4 if kind in (CLAMPED, GUIDED) else X + 2
    two, value = (X + 8, -1.0) if kind in (FREE_END, GUIDED) else (X + 12, 1.0)
    for i in range(X_ROWS * LANES):
        W[X * LANES + i] = 0.0
    for i in range(LANES):
        W[one * LANES + i] = 1.0
    for i in range(LANES):
        W[two * LANES + i] = value


@part
def needs_exchange(a: complex, b: complex) -> bool:
    """Should the columns be exchanged or scaled, for pivots a and b of columns 1 and 2?"""
    size = norm2(a)
    return (norm2(b) > EXCHANGE * size) | (size > HUGE) | (size < 1.0 / HUGE)


@part
def exchange(W: Float, a: int, b: int, scaling: bool) -> None:
    """Make the column with the larger of the pivots in rows a and b column 1, of size 1.

    Columns (1, 2) become (2, -1), which keeps the determinant. Sets FLAG and SCALE.
    Lane by lane and with branches, as few need it.
    """
    for i in range(LANES):
        x, y = get(W, a, i), get(W, b, i)
        flag = norm2(y) > EXCHANGE * norm2(x)
        pivot = y if flag else x
        size = abs(pivot.real) + abs(pivot.imag)
        scale = 1.0 / size if scaling and size > 0 else 1.0
        W[FLAG * LANES + i] = 1.0 if flag else 0.0
        W[SCALE * LANES + i] = scale
        for one, other in _PAIRS:
            x, y = get(W, one, i), get(W, other, i)
            if flag:
                x, y = y, -x
            put(W, one, i, scaled(x, scale))
            put(W, other, i, y)


@part
def restore(W: Float) -> None:
    """Restore theta2 = 0 behind a beam and complete its B."""
    awkward = 0
    for i in range(LANES):
        awkward += needs_exchange(get(W, X + 2, i), get(W, THETA2, i))
    if awkward > 0:
        exchange(W, X + 2, THETA2, True)
    else:
        for i in range(LANES):
            W[SCALE * LANES + i] = 1.0
    for i in range(LANES):
        t = get(W, X + 2, i)
        rho = get(W, THETA2, i) * scaled(conj(t), 1.0 / (norm2(t) + TINY))
        put(W, X + 8, i, get(W, X + 8, i) - rho * get(W, X, i))
        put(W, X + 10, i, get(W, X + 10, i) - rho * get(W, X + 4, i))
        put(W, X + 12, i, get(W, X + 12, i) - rho * get(W, X + 6, i))
        put(W, B + 2, i, get(W, B + 2, i) - rho * get(W, B, i))
        put(W, B + 6, i, get(W, B + 6, i) - rho * get(W, B + 4, i))
