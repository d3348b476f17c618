"""The sampled rig with effects added, as a function of one vector of logarithms."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from samii_rig.diagnose.physics.causal import CausalChain
from samii_rig.diagnose.physics.effect import Effect, Key
from samii_rig.diagnose.physics.fractional import ChainLike, FractionalChain
from samii_rig.diagnose.physics.poses import turned
from samii_rig.model.sampled import sampled_response, sensors_at
from samii_rig.model.tmm import Chain
from samii_rig.rig.schema import Rig, parameters
from samii_rig.rig.schema.elements import flattened
from samii_rig.types import Complex, Float, Int

ALIAS_POINTS = 120  # frequencies at which the aliases are summed; they are smooth between
# Aliases that are computed at every frequency, as a mode in one may be sharp, and that a factor on
# a channel changes.
NEAR = (-1, 1, -2, 2)
OWN = 2  # of them, those of each model itself where that shows: modes are seldom above 1.5 rates
# Aliases beyond those, at a few frequencies, as a factor changes each otherwise: what it leaves of
# them beside its phase at the frequency itself is smooth between. `ALONE` are by themselves, then
# blocks of `BLOCKS` an octave, in which a factor grows by one ratio from order to order. Terms are
# those of the chain up to `ASKED`, behind it they fall as they did there.
FAR_POINTS, ALONE, BLOCKS, ASKED, LAST = 9, range(3, 16), 4, 64, 4096
STEEPEST = 8.0  # power of the frequency with which such a term falls, at most: nothing is left then
STEP = 1e-6  # of a logarithm, for the derivative of parameters by unknowns
FARTHEST = 6.0  # tolerances that a refit moves a nominal parameter at most


@dataclass(frozen=True, slots=True)
class Loop:
    """A proportional loop of the device, v = r - kp y of one entry, closed around the rig."""

    kp: float
    entry: int

    def part(self, H: Complex, b: Complex) -> tuple[Complex, Complex]:
        """b (n, q) and c (n,) around which a part is closed that changes H by b x:
        H + b x becomes, closed, H/(1 + L) + b' x/(1 - c x)."""
        sensitivity = 1 / (1 + self.kp * H[:, self.entry])
        back = self.kp * b[:, self.entry] * sensitivity
        return sensitivity[:, None] * (b - back[:, None] * H), -back

    def closed(self, H: Complex) -> Complex:
        """(n, q) to the reference from those to the command."""
        return np.asarray(H / (1 + self.kp * H[:, self.entry])[:, None])

    def slopes(self, H: Complex, dH: Complex) -> Complex:
        """(n, q, m) derivatives of `closed`."""
        sensitivity = 1 / (1 + self.kp * H[:, self.entry])
        back = self.kp * dH[:, self.entry, None, :] * self.closed(H)[:, :, None]
        return np.asarray(sensitivity[:, None, None] * (dH - back))

    def around(self, H: Complex, every: Complex) -> Complex:
        """(n, q, K) what the sensors show of every (n, q, K) that they would show without a loop.
        H : (n, q), closed."""
        return np.asarray(every - self.kp * H[:, :, None] * every[:, self.entry, None, :])


@dataclass(frozen=True, slots=True)
class JointLoops:
    """Proportional loops of a device of m inputs, v_j = r_j - kp_j y_i, closed around the rig.

    Entries (n, q m) are those of all inputs to the first sensor, then to the next. gain : (m, q)
    K with v = r - K y, so that H becomes H S with S = (I + K H)^-1.
    """

    gain: Float

    def _by_input(self, H: Complex) -> Complex:
        """(n, q, m, ...) of entries (n, q m, ...)."""
        m, q = self.gain.shape
        return H.reshape(len(H), q, m, *H.shape[2:])

    def _sensitivity(self, H: Complex) -> Complex:
        """S (n, m, m) of H (n, q, m), open."""
        return np.asarray(np.linalg.inv(np.eye(len(self.gain)) + self.gain @ H))

    def part(self, H: Complex, b: Complex) -> tuple[Complex, Complex]:
        """As of `Loop`. A part is of rank one, B = u w^T. By Sherman and Morrison H + B x becomes,
        closed, H S + (I - H S K) B S x/(1 + tr(S K B) x)."""
        G, B = self._by_input(H), self._by_input(b)
        S = self._sensitivity(G)
        BS = B @ S
        turned = BS - G @ S @ (self.gain @ BS)
        c = -np.trace(S @ (self.gain @ B), axis1=1, axis2=2)
        return np.asarray(turned.reshape(b.shape)), np.asarray(c)

    def closed(self, H: Complex) -> Complex:
        """(n, q m) to the references from those to the commands."""
        G = self._by_input(H)
        return np.asarray((G @ self._sensitivity(G)).reshape(H.shape))

    def slopes(self, H: Complex, dH: Complex) -> Complex:
        """(n, q m, k) derivatives of `closed`: (I - H S K) dH S."""
        G = self._by_input(H)
        S = self._sensitivity(G)
        own = np.moveaxis(self._by_input(dH), 3, 1) @ S[:, None]
        out = own - (G @ S)[:, None] @ (self.gain @ own)
        return np.asarray(np.moveaxis(out, 1, 3).reshape(dH.shape))

    def around(self, H: Complex, every: Complex) -> Complex:
        """As of `Loop`: (I + H K)^-1 = I - H S K."""
        return np.asarray(every - self._by_input(H) @ (self.gain @ every))


Closed = Loop | JointLoops


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
            T = _terms(rig, chain, s, known, sensor, actuator) / _held(s, rig.rate_hz)
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

    def added(self, at: Grid, own: Complex, passed: Complex) -> Complex:
        """(n, q) what a factor adds to all aliases. own : (n, q) the factor at s itself. passed :
        (..., q) at all of `self.s`."""
        own_few, first, behind = self._apart(passed)
        mean, turn = _mean(first, _over(behind, first)), _turn(own)
        left = np.sum(self.terms * (mean * _turn(own_few).conj() - 1), axis=(0, 1))
        return np.asarray(at.rest * (turn - 1) + self._between(at, left) * turn)

    def slope(
        self, at: Grid, own: Complex, passed: Complex, d_own: Complex, d_passed: Complex
    ) -> Complex:
        """(n, q) the slope of `added`. d_own, d_passed : those of the factor."""
        (own_few, first, behind), (d_own_few, *d) = self._apart(passed), self._apart(d_passed)
        ratio, d_first = _over(behind, first), _over(d[0], first)
        grows = ratio * (_over(d[1], behind) - d_first)
        mean, d_mean = _slope_of_mean(first, ratio, grows)
        d_mean += mean * d_first
        turn, back = _turn(own), _turn(own_few).conj()
        d_turn, d_back = _turned(own, d_own), _turned(own_few, d_own_few).conj()
        left = np.sum(self.terms * (mean * back - 1), axis=(0, 1))
        d_left = np.sum(self.terms * (d_mean * back + mean * d_back), axis=(0, 1))
        between = (at.rest + self._between(at, left)) * d_turn
        return np.asarray(between + self._between(at, d_left) * turn)

    def _apart(self, each: Complex) -> tuple[Complex, Complex, Complex]:
        """At these frequencies (m, q), at each block's first order (2, n, m, q), and behind it."""
        m, q = self.few.size, each.shape[-1]
        each = each.reshape(-1, m, q)
        first, behind = each[1:].reshape(2, 2, len(FAR), m, q).swapaxes(0, 1)
        return each[0], first, behind

    def _between(self, at: Grid, few: Complex) -> Complex:
        f = at.s.imag / (2 * np.pi)
        between = np.stack([np.interp(f, self.few, one) for one in few.T], axis=1)
        return np.asarray(_held(at.s, at.rate_hz) * between)


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


def _over(a: Complex, b: Complex) -> Complex:
    """a/b, 0 where b is: what is not held has no alias."""
    return np.divide(a, b, out=np.zeros_like(a), where=b != 0)


def _turn(factor: Complex) -> Complex:
    """Of a factor its phase alone: that of a delay of samples turns by radians between `few`."""
    size = np.abs(factor)
    return np.divide(factor, size, out=np.ones_like(factor), where=size > 0)


def _turned(factor: Complex, d: Complex) -> Complex:
    """The slope of `_turn`, d that of the factor."""
    return np.asarray(1j * _over(d, factor).imag * _turn(factor))


@dataclass(frozen=True, slots=True)
class Folded:
    """What of a model folds back. near : (order, n, q) of the orders `NEAR`. times : (q,) by how
    much all beyond the model's own are larger than those of the grid; None where none is its own.
    """

    near: Complex
    times: Float | None = None


def _larger(own: Complex, of_grid: Complex) -> Float:
    """(q,) how many times an entry's own aliases (order, n, q) are those of a grid, in the mean of
    the logarithm: far above its modes a rig answers as K p / (s ...) does, all aliases alike."""
    known = (own != 0) & (of_grid != 0)
    ratio = np.divide(own, of_grid, out=np.ones_like(own), where=known)
    return np.asarray(np.exp(np.mean(np.log(np.abs(ratio)), axis=(0, 1))))


@dataclass(frozen=True, slots=True)
class Grid:
    """Frequencies (n,), at s = sigma + 2 pi j f, with what does not change between models there.

    factor : (n, q) hold, filters and delays. aliases : (n, q) what the sum over aliases adds.
    folded : (order, n, q) of these the ones of `NEAR`, or none. far : of these those beyond.
    own_aliases : (`OWN`, n, q) hold, filters and delays of the first of `folded`, if every model
    has its
        own there; None where those of one chain are near enough.
    rate_hz : of the samples.
    sensor, actuator : (q,) entries. loop : closed around them, if responses are to the references.
    sigma : of all, or (n,) of each.
    """

    frequency: Float
    factor: Complex
    aliases: Complex
    folded: Complex
    rate_hz: float
    sensor: Int
    actuator: Int
    sigma: float | Float = field(default=0.0, kw_only=True)
    loop: Closed | None = field(default=None, kw_only=True)
    far: Far | None = field(default=None, kw_only=True)
    own_aliases: Complex | None = field(default=None, kw_only=True)

    @property
    def changed(self) -> slice:
        """The rows on which further effects act."""
        return slice(None)

    @property
    def s(self) -> Complex:
        """(n,) rad/s."""
        return np.asarray(self.sigma + 2j * np.pi * self.frequency, np.complex128)

    def at(self, frequency: Float, level: Int | None = None) -> Grid:
        """The same on some of the frequencies, whatever their level."""
        del level
        i = np.searchsorted(self.frequency, frequency)
        return Grid(
            frequency, self.factor[i], self.aliases[i], self.folded[:, i], self.rate_hz,
            self.sensor, self.actuator, sigma=self.sigma, loop=self.loop, far=self.far,
            own_aliases=None if self.own_aliases is None else self.own_aliases[:, i],
        )  # fmt: skip

    @property
    def rest(self) -> Complex:
        """(n, q) of the aliases those that are not in `folded`."""
        return np.asarray(self.aliases - np.sum(self.folded, axis=0))

    def without_aliases(self) -> Grid:
        """The same of the rig before it is sampled, no loop closed."""
        none = np.zeros((0, *self.factor.shape), complex)
        nothing = np.zeros_like(self.factor)
        return replace(self, aliases=nothing, folded=none, far=None, own_aliases=None, loop=None)

    def asked(self) -> Complex:
        """s at which a model's chain is asked: of the grid, and of its own aliases behind."""
        own = () if self.own_aliases is None else NEAR[:OWN]
        return np.concatenate([self.s, *(_upper(self.s, k, self.rate_hz) for k in own)])

    def by_alias(self, answers: Complex) -> list[Complex]:
        """Answers there, as rows, of the grid and of each of these aliases."""
        return np.split(answers, 1 if self.own_aliases is None else 1 + OWN)

    def response_and_folded(self, answers: Complex) -> tuple[Complex, Folded]:
        """Answers (n ..., q) there as those of the grid (n, q), and what folds back: of the chain
        itself where it was asked."""
        G, *terms = self.by_alias(answers)
        if self.own_aliases is None:
            return G, Folded(self.folded)
        each = zip(terms, NEAR, self.own_aliases, strict=False)
        own = np.stack([_lower(t, k) * f for t, k, f in each])
        times = _larger(own, self.folded[:OWN])
        return G, Folded(np.concatenate([own, times * self.folded[OWN:]]), times)

    def orders(self) -> list[Complex]:
        """s (n,) of each order of `folded`."""
        known = NEAR[: len(self.folded)]
        return [self.s + 2j * np.pi * k * self.rate_hz for k in known]


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
        near = _terms(rig, chain, s, (0, *NEAR), sensor, actuator)
        rest = sampled_response(rig, few, chain)[:, sensor, actuator] - near.sum(axis=0)
        far = Far.of(rig, chain, few, sensor, actuator)
        return cls(few, rest / _held(s, rig.rate_hz), far)

    def spread(self, s: Complex, rate_hz: float) -> Complex:
        """(n, q) at s (n,) rad/s."""
        f = s.imag / (2 * np.pi)
        between = np.stack([np.interp(f, self.few, r) for r in self.rest.T], axis=1)
        return np.asarray(_held(s, rate_hz) * between)


def _held(s: Complex, rate_hz: float) -> Complex:
    return np.asarray(-np.expm1(-s / rate_hz)[:, None])


def _terms(
    rig: Rig, chain: Chain, s: Complex, orders: Sequence[int], sensor: Int, actuator: Int
) -> Complex:
    """(order, n, q) aliases of a chain at s (n,), all asked for at once."""
    upper = np.concatenate([_upper(s, k, rig.rate_hz) for k in orders])
    G = chain.evaluate(upper)[:, sensor, actuator].reshape(len(orders), s.size, -1)
    each = np.stack([_lower(term, k) for term, k in zip(G, orders, strict=True)])
    each *= _around(rig, s, orders, sensor, actuator)
    return each


def _upper(s: Complex, k: int, rate_hz: float) -> Complex:
    """Where to ask for alias k: what answers a real input at s* with the conjugate of what it
    answers at s is asked above the real axis alone."""
    there = s + 2j * np.pi * k * rate_hz
    return np.asarray(there if k >= 0 else there.conj())


def _lower(term: Complex, k: int) -> Complex:
    """What was asked there, of alias k."""
    return np.asarray(term if k >= 0 else term.conj())


def _around(rig: Rig, s: Complex, orders: Sequence[int], sensor: Int, actuator: Int) -> Complex:
    """(order, n, q) hold, filters and delays at the aliases of s (n,)."""
    every = s + 2j * np.pi * rig.rate_hz * np.array(orders)[:, None]
    # Of the hold, 1 - e^{-s T} is the same for all aliases.
    held = _held(s, rig.rate_hz)[:, 0] * rig.rate_hz / every
    late = {d: np.exp(-every * d) * held for d in {a.delay for a in rig.actuator} if d}
    hold = np.stack([late.get(a.delay, held) for a in rig.actuator], axis=2)
    seen = sensors_at(rig.sensor, every.ravel()).reshape(*every.shape, -1)
    return np.asarray(seen[:, :, sensor] * hold[:, :, actuator])


def alias_points(low_hz: float, high_hz: float, most: int = ALIAS_POINTS) -> Float:
    """(m,) Hz at which aliases are summed, `most` of them at most."""
    few = np.geomspace(low_hz, high_hz, min(ALIAS_POINTS, most))
    few[-1] = high_hz
    return few


def grid(
    rig: Rig,
    frequency: Float,
    sensor: Int,
    actuator: Int,
    chain: Chain | None = None,
    sigma: float = 0.0,
    aliases: Aliases | None = None,
    own_aliases: bool = False,
) -> Grid:
    """The grid of a rig at sorted frequencies, Hz, without a loop. chain : whose aliases these are,
    if they are not the rig's own. sigma : 1/s, how far beside the imaginary axis. aliases : those
    of the chain, where they are known from before. own_aliases : whether every model folds back
    what is its own."""
    f = np.unique(frequency)
    chain = Chain(rig) if chain is None else chain
    if aliases is None:
        aliases = Aliases.of(rig, chain, alias_points(f[f > 0][0], f[-1], f.size), sensor, actuator)
    s = np.asarray(sigma + 2j * np.pi * f, np.complex128)
    folded = _terms(rig, chain, s, NEAR, sensor, actuator)
    every = aliases.spread(s, rig.rate_hz) + folded.sum(axis=0)
    orders = (0, *NEAR[:OWN]) if own_aliases else (0,)
    factor, *own = _around(rig, s, orders, sensor, actuator)
    return Grid(
        f, factor, every, folded, rig.rate_hz, sensor, actuator,
        sigma=sigma, far=aliases.far,
        own_aliases=np.stack(own) if own_aliases else None,
    )  # fmt: skip


@dataclass(frozen=True, slots=True)
class _Passed:
    """What factors on channels do to the response at several orders of s.

    F : (order, n, q) their product. parts : of each unknown, its place in x, the entries that
    it acts on and the slope of the product's logarithm there (order, n, 1).
    """

    F: Complex
    parts: Sequence[tuple[int, Int, Complex]]

    def slopes(self) -> Iterator[tuple[int, Int, Complex]]:
        """Of each unknown the slope of F itself."""
        return ((j, on, self.F[:, :, on] * slope) for j, on, slope in self.parts)


def _through(
    at: Grid, folded: Folded, near: _Passed | None, beyond: _Passed | None
) -> tuple[Complex, Complex]:
    """(n, q) hold, filters and delays of a grid and its aliases, each times its factors. folded :
    of the model."""
    if near is None and folded.times is None:
        return at.factor, at.aliases
    rest, each, factor = at.rest, folded.near, at.factor
    if near is not None:
        each, factor = each * near.F[1:], np.asarray(factor * near.F[0])
        if beyond is not None and at.far is not None:
            rest = rest + at.far.added(at, near.F[0], beyond.F[0])
    if folded.times is not None:
        rest = folded.times * rest
    return factor, np.asarray(rest + np.sum(each, axis=0))


class Model:
    """A rig, the effects added to it, and its uncertain nominal parameters.

    The vector x is log(value/nominal) of the nominal parameters `keys`, then the logarithm of
    each effect's unknowns. prior : (n_x,) standard deviations, inf for unknowns, whose
    bounds are `lower` and `upper`.
    """

    def __init__(self, rig: Rig, effects: Sequence[Effect] = ()) -> None:
        self.rig, self.effects = rig, tuple(effects)
        built = rig
        for effect in effects:
            built = effect.build(built)
        self.built = built
        self.chain = self.chain_of(built)
        known = {(e.name, s): p for e in flattened(rig.element) for s, p in parameters(e).items()}
        have = set(self.chain.parameters)
        self.keys: tuple[Key, ...] = tuple(
            k for k, p in known.items() if p.tolerance > 0 and p.value != 0 and k in have
        )
        self.nominal = {k: p.value for k, p in known.items()}
        self._start = np.array([self.nominal[k] for k in self.keys])
        unknowns = [u for e in effects for u in e.unknowns]
        n = len(self.keys)
        self.n_nominal, self.n = n, n + len(unknowns)
        self.prior = np.full(self.n, math.inf)
        self.prior[:n] = [known[k].tolerance for k in self.keys]
        self.lower = np.concatenate(
            [-FARTHEST * self.prior[:n], [math.log(u.low) for u in unknowns]]
        )
        self.upper = np.concatenate(
            [FARTHEST * self.prior[:n], [math.log(u.high) for u in unknowns]]
        )

    def having(self, effects: Sequence[Effect]) -> Model:
        """The same rig with other effects; nominal parameters keep their place in x."""
        return Model(self.rig, effects)

    def under(self, change: Callable[[Rig], Rig]) -> Model:
        """The same effects in a rig that was changed."""
        rig = change(self.rig)
        return Model(rig, [turned(e, self.rig, rig) for e in self.effects])

    def chain_of(self, rig: Rig) -> ChainLike:
        """The chain of a rig, as the effects have it."""
        chain: ChainLike = Chain(rig)
        causal = dict(e.causal for e in self.effects if e.causal is not None)
        if causal:
            pieces = [p for e in self.effects if e.site in causal for p in e.pieces]
            middle = next(iter(causal.values()))
            chain = CausalChain(chain.plain, (*causal, *pieces), middle)
        for joint in (e.fractional for e in self.effects if e.fractional is not None):
            chain = FractionalChain(chain, joint)
        return chain

    def parts(self, x: Float) -> list[Float]:
        """The values of each effect's unknowns."""
        out, at = [], self.n_nominal
        for effect in self.effects:
            out.append(np.exp(x[at : at + len(effect.unknowns)]))
            at += len(effect.unknowns)
        return out

    def own(self, i: int) -> range:
        """Where the unknowns of effect i stand in x."""
        first = self.n_nominal + sum(len(e.unknowns) for e in self.effects[:i])
        return range(first, first + len(self.effects[i].unknowns))

    def values(self, x: Float) -> dict[Key, float]:
        """The chain's parameters that differ from the built rig's."""
        moved = dict(
            zip(self.keys, (self._start * np.exp(x[: self.n_nominal])).tolist(), strict=True)
        )
        all_values = {**self.nominal, **moved}
        pairs = zip(self.effects, self.parts(x), strict=True)
        for effect, theta in sorted(pairs, key=lambda pair: bool(pair[0].pieces)):
            change = effect.parameters(theta, all_values)
            all_values.update(change)
            moved.update(change)
        return moved

    def plain(self, x: Float) -> Chain:
        """The chain at x, a loss factor the same at all frequencies, no fractional damper."""
        return self.chain.with_values(self.values(x)).plain

    def response(self, x: Float, at: Grid) -> Complex:
        """(n, q) at the grid's frequencies."""
        chain = self.chain.with_values(self.values(x))
        G, folded = at.response_and_folded(chain.evaluate(at.asked())[:, at.sensor, at.actuator])
        factor, aliases = _through(at, folded, *self._passed(x, at))
        H = np.asarray(G * factor + aliases)
        return H if at.loop is None else at.loop.closed(H)

    def gradient(self, x: Float, at: Grid) -> tuple[Complex, Complex]:
        """The same, and its derivatives (n, q, n_x)."""
        values = self.values(x)
        keys = tuple(values)
        chain = self.chain.with_values(values)
        every, slopes = chain.gradient_at(at.asked(), keys)
        G, folded = at.response_and_folded(every[:, at.sensor, at.actuator])
        near, beyond = self._passed(x, at)
        factor, aliases = _through(at, folded, near, beyond)
        own, *folds = at.by_alias(slopes[:, at.sensor, at.actuator])
        dG = own * factor[:, :, None]
        far, larger = aliases, np.zeros(dG.shape[1:])
        for i, (k, d) in enumerate(zip(NEAR, folds, strict=False)):
            assert at.own_aliases is not None
            by, d, alias = at.own_aliases[i], _lower(d, k), folded.near[i]
            part = _over(by, alias) / (OWN * len(alias))
            larger += np.matmul(part.T[:, None, :], d.swapaxes(0, 1))[:, 0].real
            if near is not None:
                by, alias = by * near.F[1 + i], alias * near.F[1 + i]
            dG += d * by[:, :, None]
            far = far - alias
        if folds:
            dG += far[:, :, None] * larger  # the slope of `Folded.times`
        dH = np.zeros((*G.shape, self.n), complex)
        n = self.n_nominal
        dH[:, :, :n] = dG[:, :, :n] * np.array([values[k] for k in self.keys])
        read = self._reading()
        if read:
            map_ = np.zeros((len(keys), len(read)))
            for i, j in enumerate(read):
                ahead = x.copy()
                ahead[j] += STEP
                there = self.values(ahead)
                map_[:, i] = [(there[k] - values[k]) / STEP for k in keys]
            dH[:, :, read] = dG @ map_
        if near is not None:
            terms = np.concatenate([(G * at.factor)[None], folded.near])
            for j, on, slope in near.slopes():
                dH[:, on, j] += np.sum(terms[:, :, on] * slope, axis=0)
        if near is not None and beyond is not None and at.far is not None:
            for (j, on, d_own), (_, _, d_passed) in zip(
                near.slopes(), beyond.slopes(), strict=True
            ):
                own, passed = np.zeros_like(near.F[0]), np.zeros_like(beyond.F[0])
                own[:, on], passed[:, on] = d_own[0], d_passed[0]
                slope = at.far.slope(at, near.F[0], beyond.F[0], own, passed)
                dH[:, :, j] += slope if folded.times is None else folded.times * slope
        H = G * factor + aliases
        return (H, dH) if at.loop is None else (at.loop.closed(H), at.loop.slopes(H, dH))

    def _reading(self) -> list[int]:
        """Entries of x that reach the chain's parameters through an effect."""
        touched = {k for e in self.effects for k in e.touches}
        return [i for i, k in enumerate(self.keys) if k in touched] + list(
            range(self.n_nominal, self.n)
        )

    def _passed(self, x: Float, at: Grid) -> tuple[_Passed | None, _Passed | None]:
        """What the factors on channels do at the grid's own s and to the aliases of `folded`, and
        to those of `far`; None where there is no factor, or no such aliases."""
        if not any(e.factor is not None for e in self.effects):
            return None, None
        near = self._passed_at(x, at, np.stack([at.s, *at.orders()]))
        return near, None if at.far is None else self._passed_at(x, at, at.far.s[None])

    def _passed_at(self, x: Float, at: Grid, s: Complex) -> _Passed:
        """s : (order, n)."""
        total = np.ones((*s.shape, at.sensor.size), complex)
        parts = []
        first = self.n_nominal
        for effect, theta in zip(self.effects, self.parts(x), strict=True):
            if effect.factor is not None:
                F, dF = effect.factor.value(s.ravel(), theta)
                on = self.entries(effect, at)
                total[:, :, on] *= F.reshape(*s.shape, 1)
                parts += [
                    (first + j, on, (d * theta[j] / F).reshape(*s.shape, 1))
                    for j, d in enumerate(dF)
                ]
            first += len(effect.unknowns)
        return _Passed(total, parts)

    def entries(self, effect: Effect, at: Grid) -> Int:
        """Entries of the grid that an effect's factor is on."""
        assert effect.factor is not None
        if effect.factor.kind == "input":
            names = [a.name for a in self.rig.actuator]
            return np.flatnonzero(at.actuator == names.index(effect.factor.channel))
        names = [s.name for s in self.rig.sensor]
        return np.flatnonzero(at.sensor == names.index(effect.factor.channel))
