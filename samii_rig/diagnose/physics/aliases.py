"""Aliases of a sampled response: the nearest line by line, those beyond at a few frequencies."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from samii_rig.model.sampled import as_sent, sampled_response, sensors_at
from samii_rig.model.tmm import Chain
from samii_rig.rig.schema import Rig
from samii_rig.types import Complex, Float, Int

ALIAS_POINTS = 120  # frequencies at which the aliases are summed; they are smooth between
# Aliases that are computed at every frequency, as a mode in one may be sharp, and that a factor on
# a channel changes.
NEAR_ALIASES = (-1, 1, -2, 2)
# Aliases beyond those, at a few frequencies, as a factor changes each otherwise: what it leaves of
# them beside its phase at the frequency itself is smooth between. `ALONE` are by themselves, then
# blocks of `BLOCKS` an octave, in which a factor grows by one ratio from order to order. Terms are
# those of the chain up to `ASKED`, behind it they fall as they did there.
FAR_POINTS, ALONE, BLOCKS, ASKED, LAST = 9, range(3, 16), 4, 64, 4096
STEEPEST = 8.0  # power of the frequency with which such a term falls, at most: nothing is left then


def _blocks() -> list[tuple[int, int]]:
    """First order and number of orders, a power of two, of each block of far aliases."""
    out = [(k, 1) for k in ALONE]
    while (first := sum(out[-1])) < LAST:
        many = 1 << (first.bit_length() - 1)  # from one power of two to the next
        out += [(first + i * (many // BLOCKS), many // BLOCKS) for i in range(BLOCKS)]
    return out


FAR = tuple(_blocks())
# The blocks that are 2, 4, 8 ... orders long at least.
DOUBLED = tuple(
    slice(sum(many < 1 << i for _, many in FAR), None) for i in range(1, FAR[-1][1].bit_length())
)


class Sampled(Protocol):
    """Lines (n,) at s, of samples of a rate, whose aliases beyond the nearest sum up to `rest`."""

    @property
    def s(self) -> Complex:
        """(n,) rad/s."""
        ...

    @property
    def rate_hz(self) -> float:
        """Of the samples."""
        ...

    @property
    def rest(self) -> Complex:
        """(n, q)."""
        ...


@dataclass(frozen=True, slots=True)
class Far:
    """Aliases beyond the nearest, in blocks, at a few frequencies (m,) Hz.

    s : rad/s, these frequencies, then either way (n, m) the first order of each block, and the one
    behind it. terms : (2, n, m, q) the sum of a block, either way, without the hold's 1 - e^{-s T}.
    """

    few: Float
    s: Complex
    terms: Complex

    @classmethod
    def of(cls, rig: Rig, chain: Chain, few: Float, sensor: Int, actuator: Int) -> Far:
        """Of a chain of the rig."""
        few = np.interp(np.linspace(0, few.size - 1, FAR_POINTS), np.arange(few.size), few)
        s = np.asarray(2j * np.pi * few, np.complex128)

        def there(orders: Int) -> Complex:
            return np.asarray(s + 2j * np.pi * rig.rate_hz * orders[:, None])

        each, terms = [], []
        order, many = np.array(FAR).T
        asked = int(np.count_nonzero(order <= ASKED))
        lines = few[:, None] / rig.rate_hz
        for way in (1, -1):
            known = (way * order[:asked]).tolist()
            T = each_alias(rig, chain, s, known, sensor, actuator) / _held(s, rig.rate_hz)
            size = np.sum(np.abs(T[[asked - 1 - BLOCKS, asked - 1]]), axis=1)  # an octave apart
            with np.errstate(divide="ignore", invalid="ignore"):
                falls = np.log2(size[0] / size[1])
            falls = np.clip(np.where(np.isfinite(falls), falls, np.inf), 1.0, STEEPEST)
            # Of an order k a term is that of s/rate = 2 pi j (k + f/rate), to a power.
            first = order[:, None, None] + way * lines
            last = (first[asked - 1] / first[asked:]) ** falls * T[-1]
            terms.append(np.concatenate([T, last]) * _summed(first, many[:, None, None], falls))
            each += [there(way * order), there(way * (order + 1))]
        return cls(few, np.concatenate([s[None], *each]).ravel(), np.array(terms))

    def added(self, at: Sampled, own: Complex, passed: Complex) -> Complex:
        """(n, q) what a factor adds to all aliases. own : (n, q) the factor at s itself. passed :
        (..., q) at all of `self.s`."""
        own_few, first, behind = self._apart(passed)
        mean, turn = _mean(first, over(behind, first)), _turn(own)
        left = np.sum(self.terms * (mean * _turn(own_few).conj() - 1), axis=(0, 1))
        more = at.rest * (turn - 1) + self._between(at, left) * turn
        return np.where(_smooth(first), -at.rest, more)

    def slope(
        self, at: Sampled, own: Complex, passed: Complex, d_own: Complex, d_passed: Complex
    ) -> Complex:
        """(n, q) the slope of `added`. d_own, d_passed : those of the factor."""
        (own_few, first, behind), (d_own_few, *d) = self._apart(passed), self._apart(d_passed)
        ratio, d_first = over(behind, first), over(d[0], first)
        grows = ratio * (over(d[1], behind) - d_first)
        mean, d_mean = _slope_of_mean(first, ratio, grows)
        d_mean += mean * d_first
        turn, back = _turn(own), _turn(own_few).conj()
        d_turn, d_back = _turned(own, d_own), _turned(own_few, d_own_few).conj()
        left = np.sum(self.terms * (mean * back - 1), axis=(0, 1))
        d_left = np.sum(self.terms * (d_mean * back + mean * d_back), axis=(0, 1))
        between = (at.rest + self._between(at, left)) * d_turn
        return np.where(_smooth(first), 0.0, between + self._between(at, d_left) * turn)

    def _apart(self, each: Complex) -> tuple[Complex, Complex, Complex]:
        """At these frequencies (m, q), at each block's first order (2, n, m, q), and behind it."""
        m, q = self.few.size, each.shape[-1]
        each = each.reshape(-1, m, q)
        first, behind = each[1:].reshape(2, 2, len(FAR), m, q).swapaxes(0, 1)
        return each[0], first, behind

    def _between(self, at: Sampled, few: Complex) -> Complex:
        f = at.s.imag / (2 * np.pi)
        between = np.stack([np.interp(f, self.few, one) for one in few.T], axis=1)
        return np.asarray(_held(at.s, at.rate_hz) * between)


@dataclass(frozen=True, slots=True)
class Aliases:
    """What a chain's aliases beyond the nearest add at a few frequencies (m,) Hz.

    rest : (m, q) without the hold's 1 - e^{-s T}, which all aliases have: that is smooth between
    the frequencies, and hardly changes from the imaginary axis to a line beside it. far : the same,
    each by itself.
    """

    few: Float
    rest: Complex
    far: Far

    @classmethod
    def of(cls, rig: Rig, chain: Chain, few: Float, sensor: Int, actuator: Int) -> Aliases:
        """Of a chain of the rig."""
        s = np.asarray(2j * np.pi * few, np.complex128)
        near = each_alias(rig, chain, s, (0, *NEAR_ALIASES), sensor, actuator)
        # Of held inputs, as `near` is: what was measured is made of that by a factor.
        every = sampled_response(as_sent(rig), few, chain)[:, sensor, actuator]
        rest = every - near.sum(axis=0)
        far = Far.of(rig, chain, few, sensor, actuator)
        return cls(few, rest / _held(s, rig.rate_hz), far)

    def spread(self, s: Complex, rate_hz: float) -> Complex:
        """(n, q) at s (n,) rad/s."""
        f = s.imag / (2 * np.pi)
        between = np.stack([np.interp(f, self.few, r) for r in self.rest.T], axis=1)
        return np.asarray(_held(s, rate_hz) * between)


def alias_points(low_hz: float, high_hz: float, most: int = ALIAS_POINTS) -> Float:
    """(m,) Hz at which aliases are summed, `most` of them at most."""
    few = np.geomspace(low_hz, high_hz, min(ALIAS_POINTS, most))
    few[-1] = high_hz
    return few


def _summed(first: Float, many: Int, falls: Float) -> Float:
    """(n, m, q) what a block is of its first term, where these fall as the order (n, m, 1) to a
    power: Euler and Maclaurin's sum from middle to middle."""

    def integral(u: Float) -> Float:
        steep = np.maximum(falls, 1 + 1e-9) - 1  # at 1 itself it is a logarithm
        return np.asarray(-((u / first) ** -steep) * first / steep)

    def slope(u: Float) -> Float:
        return np.asarray(-falls * (u / first) ** (-falls - 1) / first)

    low, high = first - 0.5, first - 0.5 + many
    whole = integral(high) - integral(low) - (slope(high) - slope(low)) / 24
    return np.where(many == 1, 1.0, whole)


def _mean(first: Complex, ratio: Complex) -> Complex:
    """(2, n, m, q) of a factor over each block, of its value at the first order and by how much it
    is larger at each next: 1 + r + ... + r^{2 k - 1} = (1 + r^k) (1 + r + ... + r^{k - 1})."""
    out, power = first.copy(), ratio.copy()
    for on in DOUBLED:
        r = power[:, on]
        out[:, on] *= 0.5 + 0.5 * r
        r *= r
    return out


def _slope_of_mean(first: Complex, ratio: Complex, d_ratio: Complex) -> tuple[Complex, Complex]:
    """(2, n, m, q) the same, and its slope by the ratio."""
    out, power = first.copy(), ratio.copy()
    d_out, d_power = np.zeros_like(out), d_ratio.copy()
    for on in DOUBLED:
        r, d = power[:, on], d_power[:, on]
        d_out[:, on] *= 0.5 + 0.5 * r
        d_out[:, on] += 0.5 * out[:, on] * d
        out[:, on] *= 0.5 + 0.5 * r
        d *= 2 * r
        r *= r
    return out, d_out


def over(a: Complex, b: Complex) -> Complex:
    """a/b, 0 where b is: what is not held has no alias."""
    return np.divide(a, b, out=np.zeros_like(a), where=b != 0)


def _smooth(first: Complex) -> NDArray[np.bool_]:
    """(q,) whether nothing folds back, as of an input that is smooth between its samples: no jump
    of it either, which `rest` has half of."""
    return np.asarray(np.all(first == 0, axis=(0, 1, 2)))


def _turn(factor: Complex) -> Complex:
    """Of a factor its phase alone: that of a delay of samples turns by radians between `few`."""
    size = np.abs(factor)
    return np.divide(factor, size, out=np.ones_like(factor), where=size > 0)


def _turned(factor: Complex, d: Complex) -> Complex:
    """The slope of `_turn`, d that of the factor."""
    return np.asarray(1j * over(d, factor).imag * _turn(factor))


def _held(s: Complex, rate_hz: float) -> Complex:
    return np.asarray(-np.expm1(-s / rate_hz)[:, None])


def each_alias(
    rig: Rig, chain: Chain, s: Complex, orders: Sequence[int], sensor: Int, actuator: Int
) -> Complex:
    """(order, n, q) aliases of a chain at s (n,), all asked for at once."""
    asked = np.concatenate([upper(s, k, rig.rate_hz) for k in orders])
    G = chain.evaluate(asked)[:, sensor, actuator].reshape(len(orders), s.size, -1)
    each = np.stack([lower(term, k) for term, k in zip(G, orders, strict=True)])
    each *= around(rig, s, orders, sensor, actuator)
    return each


def upper(s: Complex, k: int, rate_hz: float) -> Complex:
    """Where to ask for alias k: what answers a real input at s* with the conjugate of what it
    answers at s is asked above the real axis alone."""
    there = s + 2j * np.pi * k * rate_hz
    return np.asarray(there if k >= 0 else there.conj())


def lower(term: Complex, k: int) -> Complex:
    """What was asked there, of alias k."""
    return np.asarray(term if k >= 0 else term.conj())


def around(rig: Rig, s: Complex, orders: Sequence[int], sensor: Int, actuator: Int) -> Complex:
    """(order, n, q) hold, filters and delays at the aliases of s (n,)."""
    every = s + 2j * np.pi * rig.rate_hz * np.array(orders)[:, None]
    # Of the hold, 1 - e^{-s T} is the same for all aliases.
    held = _held(s, rig.rate_hz)[:, 0] * rig.rate_hz / every
    late = {d: np.exp(-every * d) * held for d in {a.delay for a in rig.actuator} if d}
    hold = np.stack([late.get(a.delay, held) for a in rig.actuator], axis=2)
    seen = sensors_at(rig.sensor, every.ravel()).reshape(*every.shape, -1)
    return np.asarray(seen[:, :, sensor] * hold[:, :, actuator])
