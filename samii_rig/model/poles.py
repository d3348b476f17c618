"""All poles of a chain in a region of the s-plane, found so that none can be missed.

The poles of a chain are the zeros of its characteristic function D(s) (paper 1, eq. 17: the
boundary conditions leave a 2 x 2 determinant), which is analytic wherever no beam's complex
modulus vanishes. By the argument principle the number of zeros inside a contour is the number
of turns of D(s) around the origin as s runs along it. A box that holds zeros is cut until
each piece holds one, which Muller's method then polishes; it counts only if it lies in its
own box. So the number of poles returned equals the number counted around the whole region, or
the search fails loudly.

The number of turns is taken from samples of D. It is right if the phase moves by less than
half a turn between neighbours. Phases alone cannot tell (two zeros close to one interval turn
it by nothing), so log D is followed in two ways: every interval is halved until the phase steps
by less than an eighth of a turn and the complex change of log D agrees with the integral of
D'/D over it, modulus and phase.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import brentq

from samii_rig.errors import SamiiRigError
from samii_rig.types import Complex, Float, Int

Characteristic = Callable[[Complex], tuple[Complex, Float]]
"""D at each s as (mantissa, log_scale), D = mantissa exp(log_scale)."""

PHASE_STEP = np.pi / 4  # rad, largest step of arg D between neighbouring samples
AGREEMENT = 0.2  # largest deviation of a step of log D from the integral of D'/D
NUDGE = 1e-3  # width of the difference that gives D' over the interval
START = 8  # samples on each side of a box before any halving
MAX_HALVINGS = 28  # a side halved this often passes through a zero
CUTS = (0.5, 0.47, 0.54, 0.41, 0.61, 0.35)  # where to cut a box if the middle meets a zero
CLUSTER = 1e-5  # rad/s, zeros closer than this are one with a multiplicity
MULLER_STEPS = 60
NEWTON_STEPS = 12
# Of a place: of the difference for a step, and of a step that is none.
STEP_WIDTH, SETTLED = 1e-7, 1e-10


@dataclass(frozen=True, slots=True)
class Region:
    """The part of the s-plane that is searched: left <= Re s <= right, |Im s| <= top, rad/s.

    holes : squares left out, each given by the interval (low, high) of the real axis that
        it is centred on; poles accumulate there without end, at the zeros of a beam's
        modulus (s = -1/tau).
    strip : rad/s, half height of the strip along the real axis that is searched by itself.
    """

    left: float
    right: float
    top: float
    strip: float
    holes: tuple[tuple[float, float], ...] = ()

    def contains(self, s: Complex) -> np.ndarray[tuple[int, ...], np.dtype[np.bool_]]:
        """(n,) whether each s (n,), rad/s, lies in the region."""
        inside = (s.real >= self.left) & (s.real <= self.right) & (np.abs(s.imag) <= self.top)
        for low, high in self.holes:
            half = (high - low) / 2
            inside &= ~((s.real > low) & (s.real < high) & (np.abs(s.imag) < half))
        return np.asarray(inside)


@dataclass(frozen=True, slots=True)
class PoleSet:
    """Every pole in `region`.

    poles : (n,) complex, rad/s, Im >= 0, by increasing modulus; one with Im > 0 stands for
        its conjugate as well.
    multiplicity : (n,) how many zeros of D each is.
    count : zeros inside the region by the argument principle, conjugates included; equals
        what `poles` and `multiplicity` add up to.
    """

    poles: Complex
    multiplicity: Int
    region: Region
    count: int


@dataclass(frozen=True, slots=True)
class _Box:
    left: float
    right: float
    low: float
    high: float

    @property
    def symmetric(self) -> bool:
        return self.low == -self.high

    @property
    def centre(self) -> complex:
        return complex((self.left + self.right) / 2, (self.low + self.high) / 2)

    @property
    def size(self) -> float:
        return max(self.right - self.left, self.high - self.low)

    @property
    def corners(self) -> list[complex]:
        """Counter-clockwise, the first again at the end."""
        x = [self.left, self.right, self.right, self.left, self.left]
        y = [self.low, self.low, self.high, self.high, self.low]
        return [complex(a, b) for a, b in zip(x, y, strict=True)]

    def holds(self, s: complex) -> bool:
        return self.left <= s.real <= self.right and self.low <= s.imag <= self.high


def find_poles(D: Characteristic, region: Region, near: Complex | None = None) -> PoleSet:
    """All zeros of D in the region; D must be real on the real axis and analytic in it.

    near : (n,) places, Im >= 0, that zeros may be close to: a short way to them where it leads
    to all that were counted.
    Edges that run through a zero are moved outwards by a little; the region returned is the
    one searched. SamiiRigError if a count and what was found do not agree.
    """
    for stretch in (1.0, 1.013, 1.029, 1.051):
        searched = Region(
            region.left * stretch,
            region.right * stretch,
            region.top * stretch,
            region.strip * stretch,
            region.holes,
        )
        boxes = _pieces(searched)
        counts = _turns(D, boxes)
        if None not in counts:
            break
    else:
        raise SamiiRigError("pole search: every contour tried runs through a pole")
    polished = np.zeros(0, complex) if near is None else _newton(D, near)
    counted = [(box, n) for box, n in zip(boxes, counts, strict=True) if n is not None]
    total = sum(n if box.symmetric else 2 * n for box, n in counted)
    found = _isolate(D, counted, polished)
    found.sort(key=lambda item: (abs(item[0]), item[0].imag))
    poles = np.array([p for p, _ in found], dtype=complex)
    multiplicity = np.array([m for _, m in found], dtype=np.int64)
    if int(np.where(poles.imag > 0, 2, 1) @ multiplicity) != total:
        raise SamiiRigError(
            f"pole search: {total} poles counted, {len(found)} places found; "
            "the characteristic function is not analytic in the region"
        )
    return PoleSet(poles, multiplicity, searched, total)


def _pieces(region: Region) -> list[_Box]:
    """Boxes that make up the upper half of the region and the strip along the real axis.

    Over each hole stands one box; over each interval between holes a symmetric one and one
    on top of it.
    """
    boxes = []
    edge = region.left
    for low, high in [*sorted(region.holes), (region.right, region.right)]:
        if low > edge:
            boxes.append(_Box(edge, low, -region.strip, region.strip))
            boxes.append(_Box(edge, low, region.strip, region.top))
        if high > low:
            boxes.append(_Box(low, high, (high - low) / 2, region.top))
        edge = high
    return boxes


def _turns(D: Characteristic, boxes: Sequence[_Box]) -> list[int | None]:
    """Zeros inside each box; None if one lies on its boundary, as far as can be seen."""
    # The last corner twice, as t = 4 is where it begins and nothing follows.
    corners = np.array([[*box.corners, box.corners[-1]] for box in boxes])

    def boundary(which: Int, t: Float) -> Complex:
        k = t.astype(np.int64)
        begin = corners[which, k]
        return np.asarray(begin + (corners[which, k + 1] - begin) * (t - k))

    spacing = np.array([box.size / START for box in boxes])
    turned = phases_along(D, boundary, np.linspace(0.0, 4.0, 4 * START + 1), spacing)
    return [None if x is None else round(x / (2 * np.pi)) for x in turned]


def phase_along(
    D: Characteristic, path: Callable[[Float], Complex], t: Float, spacing: float
) -> float | None:
    """rad, `phases_along` of one path s = path(t), t (n,) increasing."""
    (turned,) = phases_along(D, lambda _, t: path(t), t, np.array([spacing]))
    return turned


def phases_along(
    D: Characteristic, path: Callable[[Int, Float], Complex], t: Float, spacing: Float
) -> list[float | None]:
    """By how much arg D turns as s = path(which, t) runs over the increasing t (n,), rad.

    spacing : (n_path,) rad/s, of the order of the distance between neighbouring points of each.
    Intervals are halved until phase and modulus agree with the derivative of log D; None if that
    never happens, as the path runs through a zero. All paths go together, since a call of D costs
    as much for one point as for fifty.
    """
    count = spacing.size
    which, t = np.repeat(np.arange(count), t.size), np.tile(t, count)
    s = path(which, t)
    slope, mantissa, log_scale = _log_derivative(D, s, NUDGE * spacing[which])
    blocked = np.zeros(count, dtype=bool)
    blocked[which[mantissa == 0]] = True
    open_ = (which[1:] == which[:-1]) & ~blocked[which[1:]]
    for halving in range(MAX_HALVINGS):
        at = np.flatnonzero(open_)
        if not at.size:
            break
        middle, own = (t[at] + t[at + 1]) / 2, which[at]
        new = path(own, middle)
        g, value, scale = _log_derivative(D, new, NUDGE * spacing[own] / 2**halving)
        if np.any(value == 0):
            blocked[own[value == 0]] = True
            on = ~blocked[own]
            at, middle, own, new = at[on], middle[on], own[on], new[on]
            g, value, scale = g[on], value[on], scale[on]
        first = np.log(value / mantissa[at]) + scale - log_scale[at]
        second = np.log(mantissa[at + 1] / value) + log_scale[at + 1] - scale
        off = np.maximum(
            np.abs(first - (slope[at] + g) * (new - s[at]) / 2),
            np.abs(second - (slope[at + 1] + g) * (s[at + 1] - new) / 2),
        )
        step = np.maximum(np.abs(first.imag), np.abs(second.imag))
        still = (step > PHASE_STEP) | (off > AGREEMENT)
        t, s = np.insert(t, at + 1, middle), np.insert(s, at + 1, new)
        which = np.insert(which, at + 1, own)
        slope, mantissa = np.insert(slope, at + 1, g), np.insert(mantissa, at + 1, value)
        log_scale = np.insert(log_scale, at + 1, scale)
        open_ = np.zeros(len(t) - 1, dtype=bool)
        left = at + np.arange(at.size)
        open_[left] = still
        open_[left + 1] = still
    blocked[which[:-1][open_]] = True
    inner = np.flatnonzero((which[1:] == which[:-1]) & ~blocked[which[1:]])
    turns = np.angle(mantissa[inner + 1] / mantissa[inner])
    turned = np.bincount(which[inner], turns, count)
    return [None if b else float(x) for b, x in zip(blocked, turned, strict=True)]


def _log_derivative(
    D: Characteristic, s: Complex, h: float | Float
) -> tuple[Complex, Complex, Float]:
    """D'/D by a central difference of width h, and D as mantissa and scale."""
    mantissa, log_scale = D(np.concatenate([s, s + h, s - h]))
    n = s.size
    here = np.where(mantissa[:n] == 0, 1.0, mantissa[:n])  # a zero is seen by who asked
    up = mantissa[n : 2 * n] / here * np.exp(np.clip(log_scale[n : 2 * n] - log_scale[:n], -9, 9))
    down = mantissa[2 * n :] / here * np.exp(np.clip(log_scale[2 * n :] - log_scale[:n], -9, 9))
    return (up - down) / (2 * h), mantissa[:n], log_scale[:n]


def _newton(D: Characteristic, s: Complex) -> Complex:
    """(m,) zeros of D, all apart, that Newton's steps from s lead to; those that settle.

    One that is real but for rounding is: taken for one of a pair it would stand for two.
    """
    real = s.imag == 0
    settled = np.zeros(s.size, dtype=bool)
    for _ in range(NEWTON_STEPS):
        size = np.maximum(np.abs(s), 1.0)
        slope, mantissa, _ = _log_derivative(D, s, STEP_WIDTH * size)
        step = np.where(mantissa == 0, 0.0, 1 / np.where(slope == 0, 1 / size, slope))
        step *= np.minimum(1.0, size / np.maximum(np.abs(step), size))
        s = s - np.where(real, step.real, step)
        settled = np.abs(step) <= SETTLED * size
        if settled.all():  # what is left is less than rounding: a step squares it
            break
    out: list[complex] = []
    for root in np.where(np.abs(s.imag) <= CLUSTER, s.real, s)[settled].tolist():
        if all(abs(root - x) > CLUSTER for x in out):
            out.append(root)
    return np.array(out, dtype=complex)


def _known(polished: Complex, box: _Box, n: int) -> list[tuple[complex, int]]:
    """The n zeros in a box, if these are all there and simple; else nothing."""
    inside = [x for x in polished.tolist() if box.holds(x) and x.imag >= 0]
    held = sum(2 if box.symmetric and x.imag > 0 else 1 for x in inside)
    return [(x, 1) for x in inside] if held == n else []


def _isolate(
    D: Characteristic, boxes: list[tuple[_Box, int]], polished: Complex
) -> list[tuple[complex, int]]:
    """The zeros in boxes that hold so many each, each with its multiplicity; Im >= 0 only.
    polished : some that are known, which are all in many a part of them."""
    found: list[tuple[complex, int]] = []
    while boxes:
        crowded = []
        for here, count in boxes:
            if count < 0:
                raise SamiiRigError(
                    f"pole search: negative count around {here.centre:.6g} rad/s; "
                    "the characteristic function has a pole there"
                )
            if count == 0:
                continue
            if known := _known(polished, here, count):
                found += known
                continue
            if count == 1:
                root = _polish(D, here)
                if root is not None:
                    found.append((root, 1))
                    continue
            if here.size < CLUSTER:
                found.append((here.centre, count))
                continue
            crowded.append((here, count))
        boxes = _cut(D, crowded)
    return found


def _cut(D: Characteristic, boxes: list[tuple[_Box, int]]) -> list[tuple[_Box, int]]:
    """Parts of boxes that hold so many zeros each, and how many each part holds."""
    out: list[tuple[_Box, int]] = []
    cuts = iter(CUTS)
    while boxes:
        cut = next(cuts, None)
        if cut is None:
            at = boxes[0][0].centre
            raise SamiiRigError(
                f"pole search: {boxes[0][1]} poles around {at:.6g} rad/s cannot be told apart"
            )
        parts = [_parts(box, cut) for box, _ in boxes]
        counts = iter(_turns(D, [half for halves, _ in parts for half in halves]))
        left = []
        for (box, count), (halves, weights) in zip(boxes, parts, strict=True):
            each = [next(counts) for _ in halves]
            known = [c for c in each if c is not None]
            whole = len(known) == len(each)
            if whole and sum(w * c for w, c in zip(weights, known, strict=True)) == count:
                out += zip(halves, known, strict=True)
            else:
                left.append((box, count))
        boxes = left
    return out


def _parts(box: _Box, cut: float) -> tuple[list[_Box], list[int]]:
    """Two halves of a box; of a symmetric one that is tall, its core and its upper part."""
    width, height = box.right - box.left, box.high - box.low
    if width >= height:
        x = box.left + cut * width
        return [_Box(box.left, x, box.low, box.high), _Box(x, box.right, box.low, box.high)], [1, 1]
    if box.symmetric:
        y = cut * box.high
        return [_Box(box.left, box.right, -y, y), _Box(box.left, box.right, y, box.high)], [1, 2]
    y = box.low + cut * height
    return [
        _Box(box.left, box.right, box.low, y),
        _Box(box.left, box.right, y, box.high),
    ], [1, 1]


def _polish(D: Characteristic, box: _Box) -> complex | None:
    """The single zero in a box, to rounding; None if the iteration leaves the box.

    A single zero in a box that is symmetric about the real axis is real, and D, real there,
    changes its sign.
    """
    log_ref = float(D(np.array([box.centre]))[1][0])

    def value(s: complex) -> complex:
        mantissa, log_scale = D(np.array([s], dtype=np.complex128))
        return complex(mantissa[0] * np.exp(np.clip(log_scale[0] - log_ref, -600.0, 600.0)))

    if box.symmetric:
        eps = float(np.finfo(float).eps)
        root = brentq(
            lambda x: value(complex(x)).real,
            box.left,
            box.right,
            xtol=eps * box.size,
            rtol=4 * eps,
            maxiter=200,
        )
        return complex(root)
    reach = 0.25 * min(box.right - box.left, box.high - box.low)
    x = [box.centre - reach, box.centre + reach, box.centre]
    f = [value(s) for s in x]
    small = 1e-6 * max(abs(v) for v in f)
    for _ in range(MULLER_STEPS):
        step = _muller_step(x, f)
        new = x[2] + step
        if not box.holds(new):
            return None
        x, f = [x[1], x[2], new], [f[1], f[2], value(new)]
        # Rounding in D may keep the last digits moving for ever.
        if abs(step) <= 1e-12 * abs(new) and abs(f[2]) <= small:
            return new
    return None


def _muller_step(x: list[complex], f: list[complex]) -> complex:
    """From x[2] to the nearest zero of the parabola through three points; 0 at a zero."""
    h1, h2 = x[1] - x[0], x[2] - x[1]
    if f[2] == 0 or h1 == 0 or h2 == 0 or h1 + h2 == 0:
        return 0j
    d1, d2 = (f[1] - f[0]) / h1, (f[2] - f[1]) / h2
    a = (d2 - d1) / (h2 + h1)
    b = a * h2 + d2
    root = complex(np.sqrt(b * b - 4 * a * f[2] + 0j))
    bottom = b + root if abs(b + root) > abs(b - root) else b - root
    return -2 * f[2] / bottom if bottom != 0 else 0j


def contour_residues(
    evaluate: Callable[[Complex], Complex], centre: Complex, radius: Float, points: int = 32
) -> tuple[Complex, Complex]:
    """Residue and next Laurent coefficient of a transfer matrix around each centre.

    evaluate : s (n,) -> (n, n_out, n_in). centre, radius : (n_poles,), each circle with
    nothing singular inside but what it is drawn around, and nothing near its outside: the
    trapezoidal sum converges as (radius/distance)^points.
    Returns c_-1 and c_-2, each (n_poles, n_out, n_in): c_-k = 1/(2 pi j) times the integral of
    G(s) (s - centre)^(k - 1).
    """
    turn = np.exp(2j * np.pi * (np.arange(points) + 0.5) / points)
    offset = radius[:, None] * turn
    G = evaluate((centre[:, None] + offset).ravel())
    G = G.reshape(len(centre), points, *G.shape[1:])
    first = np.einsum("pk,pk...->p...", offset, G) / points
    second = np.einsum("pk,pk...->p...", offset**2, G) / points
    return first, second
