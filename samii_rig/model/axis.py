"""All zeros on the imaginary axis of a characteristic function without damping, proven complete.

Without damping D is real on the imaginary axis, D(-s) = D(s), and all its zeros but those of
a motion that is unstable at rest (on the real axis) lie on the imaginary one. The argument
principle then needs one half of a contour only: on a path from j a to j b through the right
half plane the phase of D turns by exactly pi for each zero between a and b. A sign change of
D(j omega) holds an odd number of zeros; so if there are as many sign changes as the phase turned by
multiples of pi, each holds one, and none is missed. Where there are fewer, two or more zeros
lie close together; the interval is cut and counted until they part or are one with a
multiplicity.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from samii_rig.errors import SamiiRigError
from samii_rig.model.poles import START, Characteristic, phase_along
from samii_rig.types import Complex, Float, Int

PER_ROOT = 4  # samples of D(j omega) for each zero counted, first look
LOOKS = 4  # times that the samples are doubled before an interval is cut
SAME = 1e-9  # relative distance below which zeros are one with a multiplicity
WHOLE = 1e-6  # of pi, by how much a turn may miss a whole number
STRETCH = (0.0, 1e-7, 1e-5, 1e-3)  # by how much an end that meets a zero is moved outwards
WIDE = 0.5  # width of the detour through the right half plane over its height
SECTIONS = 32  # parts of an interval in one step towards its zero
LINEAR = 1e-8  # relative width of an interval in which D is linear to rounding
CUT = 0.4871  # where an interval is cut, off the middle that symmetric chains may hit


@dataclass(frozen=True, slots=True)
class AxisZeros:
    """Zeros of D at s = j omega, low < omega < high.

    omega : (n,) rad/s, increasing. multiplicity : (n,). count : zeros by the argument
    principle, equal to the sum of `multiplicity`. turn : what the phase turned by over pi,
    before rounding to `count`. low, high : rad/s, the interval that was searched.
    below : all other pairs of zeros +-s with |s| < high: natural frequencies below, motions
        without stiffness (at s = 0), unstable ones.
    """

    omega: Float
    multiplicity: Int
    count: int
    turn: float
    low: float
    high: float
    below: int


def axis_zeros(D: Characteristic, low: float, high: float) -> AxisZeros:
    """All zeros of D between j low and j high, rad/s, 0 < low < high.

    An end that lies on a zero is moved outwards by a little. SamiiRigError if count and zeros
    found do not agree, as for a D that is not analytic.
    """
    for stretch in STRETCH:
        a, b = low * (1 - stretch), high * (1 + stretch)
        turn, inside = _turn(D, a, b), _inside(D, b)
        if turn is not None and inside is not None:
            break
    else:
        raise SamiiRigError("root search: every interval tried ends on a root")
    count = _whole(turn)
    brackets, at, multiplicity = _isolate(D, a, b, count)
    omega = np.concatenate([_polish(D, brackets), at])
    order = np.argsort(omega)
    multiple = np.concatenate([np.ones(len(brackets), dtype=np.int64), multiplicity])
    if int(multiple.sum()) != count:
        raise SamiiRigError(f"root search: {count} roots counted, {int(multiple.sum())} found")
    return AxisZeros(omega[order], multiple[order], count, turn, a, b, inside - count)


def _turn(D: Characteristic, low: float, high: float) -> float | None:
    """By how many pi the phase of D turns from j low to j high through the right half plane."""
    height = high - low
    width = WIDE * height

    def path(t: Float) -> Complex:
        x = np.interp(t, [0, 1, 2, 3], [0, width, width, 0])
        return np.asarray(x + 1j * np.interp(t, [0, 1, 2, 3], [low, low, high, high]))

    turned = phase_along(D, path, np.linspace(0.0, 3.0, 3 * START + 1), height / START)
    return None if turned is None else turned / np.pi


def _inside(D: Characteristic, radius: float) -> int | None:
    """Pairs of zeros in the disc |s| < radius, from a quarter of its circle."""

    def path(t: Float) -> Complex:
        return np.asarray(radius * np.exp(0.5j * np.pi * t))

    turned = phase_along(D, path, np.linspace(0.0, 1.0, 2 * START + 1), radius / START)
    # Four quarters of the turn over 2 pi are the zeros, half of them the pairs.
    return None if turned is None else _whole(turned / np.pi)


def _whole(turn: float) -> int:
    if abs(turn - round(turn)) > WHOLE or turn < -WHOLE:
        raise SamiiRigError(
            f"root search: the phase turns by {turn:.6g} pi, no whole number of roots; "
            "the characteristic function is damped or not analytic"
        )
    return round(turn)


def _isolate(D: Characteristic, low: float, high: float, count: int) -> tuple[Float, Float, Int]:
    """(n, 2) intervals that hold one zero each; zeros of higher multiplicity and that number."""
    brackets: list[Float] = []
    at: list[float] = []
    multiplicity: list[int] = []
    stack = [(low, high, count)]
    while stack:
        a, b, n = stack.pop()
        if n == 0:
            continue
        found = _sign_changes(D, a, b, n)
        if len(found) == n:
            brackets.append(found)
        elif b - a < SAME * b:
            at.append((a + b) / 2)
            multiplicity.append(n)
        else:
            stack += _halves(D, a, b, n)
    joined = np.concatenate(brackets) if brackets else np.zeros((0, 2))
    return joined, np.array(at), np.array(multiplicity, dtype=np.int64)


def _halves(D: Characteristic, a: float, b: float, n: int) -> list[tuple[float, float, int]]:
    for cut in (CUT, CUT + 0.05, CUT - 0.07):
        middle = a + cut * (b - a)
        lower = _turn(D, a, middle)
        upper = _turn(D, middle, b)
        if lower is None or upper is None:
            continue
        if _whole(lower) + _whole(upper) == n:
            return [(a, middle, _whole(lower)), (middle, b, _whole(upper))]
    raise SamiiRigError(f"root search: {n} roots near {a:.9g} rad/s cannot be told apart")


def _sign_changes(D: Characteristic, low: float, high: float, count: int) -> Float:
    """(n, 2) intervals between samples in which D(j omega) changes its sign, n <= count."""
    found = np.zeros((0, 2))
    for look in range(LOOKS):
        # A beam's natural frequencies grow as the square of their number.
        points = PER_ROOT * (count + 1) * 2**look + 1
        omega = np.linspace(np.sqrt(low), np.sqrt(high), points) ** 2
        omega[[0, -1]] = low, high
        mantissa, _ = D(np.asarray(1j * omega))
        sign = np.sign(mantissa.real)
        sign[sign == 0] = 1.0
        i = np.flatnonzero(sign[1:] != sign[:-1])
        found = np.column_stack([omega[i], omega[i + 1]])
        if len(found) >= count:
            break
    return found


def _polish(D: Characteristic, brackets: Float) -> Float:
    """(n,) the zero in each interval, to rounding.

    All intervals are cut into SECTIONS at once: one call of D with many points costs little
    more than with one.
    """
    low, high = brackets.T
    if not low.size:
        return np.zeros(0)
    rows, share = np.arange(low.size), np.linspace(0.0, 1.0, SECTIONS + 1)
    while True:
        omega = low[:, None] + (high - low)[:, None] * share
        omega[:, -1] = high
        mantissa, log_scale = D(np.asarray(1j * omega).ravel())
        value = mantissa.real.reshape(omega.shape)
        at = np.argmax(np.sign(value) != np.sign(value[:, :1]), axis=1)
        low, high = omega[rows, at - 1], omega[rows, at]
        if np.all(high - low < LINEAR * high):
            break
    scale = log_scale.reshape(omega.shape)
    left = value[rows, at - 1]
    right = value[rows, at] * np.exp(scale[rows, at] - scale[rows, at - 1])
    return np.asarray(low + (high - low) * left / (left - right))
