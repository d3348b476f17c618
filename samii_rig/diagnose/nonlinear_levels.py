"""How strongly each level drove a rig at each line, and a nonlinear force's own loop there.

A sine that sweeps has its own amplitude at every frequency; the lines of a random-phase multisine
act at once, so that what counts is the standard deviation of them all.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from samii_rig.diagnose.measured import Measured, of_level
from samii_rig.diagnose.model import STEP, Grid
from samii_rig.diagnose.nonlinear_laws import Law, Strength, starved, starved_gauss
from samii_rig.model.sampled import hold_response, sensor_response
from samii_rig.rig.schema import Rig
from samii_rig.types import Complex, Float, FrequencyResponse, Int

if TYPE_CHECKING:
    from samii_rig.diagnose.nonlinear_model import LevelModel, Quasi

SWEEPS, SETTLED = 60, 1e-9  # of the amplitude, at most; change of x at which they end
STEEPEST = 0.7  # slope of a sweep that is believed where the next one is guessed from two
FLOW_SWEEPS, FLOW_SETTLED = 10, 1e-4
LEAST = 1e-3  # of the motion without the force: friction that holds is a very stiff damper


@dataclass(frozen=True, slots=True)
class Extra:
    """What a force adds to the response beyond its describing function, computed in time.

    part : (n_level, n, q) at all lines of a grid, or (n, q) at some. p : the strength that it was
    computed at. top : the largest value of what it is driven by, where that is the input.
    """

    part: Complex
    p: float
    top: float = 0.0

    def at(self, level: Int, i: Int) -> Extra:
        """At lines i of these levels."""
        return replace(self, part=self.part[level, i])


@dataclass(frozen=True, slots=True)
class LevelGrid(Grid):
    """A grid that knows how strongly each level drove each frequency.

    hold, filter : (n,), (n, q) the parts of `factor`. driven : (n_level, n) mean square of the
    input; random : (n_level,) whether all lines were driven at once. level, power : (n,) of the
    lines themselves, in a grid that `at` made; power of all lines of a random level adds up to
    that of its input. extra : of some forces, what the response with their describing
    function lacks.
    """

    hold: Complex
    filter: Complex
    driven: Float
    random: NDArray[np.bool_]
    level: Int | None = None
    power: Float | None = None
    extra: Mapping[Quasi, Extra] = field(default_factory=dict)

    def together(self) -> Iterator[Int]:
        """The lines of each random level."""
        assert self.level is not None
        for k in np.flatnonzero(self.random):
            mine = np.flatnonzero(self.level == k)
            if mine.size:
                yield mine

    def at(self, frequency: Float, level: Int | None = None) -> LevelGrid:
        """The same on lines of these levels."""
        i = np.searchsorted(self.frequency, frequency)
        power = None
        if level is not None:
            power = self.driven[level, i]
            for k in np.flatnonzero(self.random):
                mine = np.flatnonzero(level == k)
                if mine.size:
                    edges = (frequency[mine][1:] + frequency[mine][:-1]) / 2
                    which = np.searchsorted(edges, self.frequency)
                    power[mine] = np.bincount(which, self.driven[k], mine.size)
        return LevelGrid(
            frequency, self.factor[i], self.aliases[i], self.folded[:, i], self.rate_hz,
            self.sensor, self.actuator, self.hold[i], self.filter[i], self.driven, self.random,
            level, power,
            {} if level is None else {key: e.at(level, i) for key, e in self.extra.items()},
        )  # fmt: skip


@dataclass(frozen=True, slots=True)
class RecordGrid(Grid):
    """The nodes of whole records, where a force is computed in time under every record's input.

    added : (model, x) -> (n, q) what the force adds to the records' lines. A model with a force
    predicts the nodes, and these lines behind them.
    """

    added: Callable[[LevelModel, Float], Complex] = field(kw_only=True)


def level_grid(
    rig: Rig,
    at: Grid,
    lines: Measured,
    responses: Sequence[FrequencyResponse],
) -> LevelGrid | None:
    """The grid with the input's strength by level; None where it is not known, or where more
    than one input was driven."""
    if len(set(at.actuator.tolist())) != 1:
        return None
    driven = np.zeros((len(lines.levels), at.frequency.size))
    random = np.zeros(len(lines.levels), dtype=bool)
    for k, (level, periodic) in enumerate(zip(lines.levels, lines.periodic, strict=True)):
        own = of_level(responses, level, periodic)
        if not own:
            return None
        rms = [
            np.interp(at.frequency, r.frequency, np.abs(r.input_rms[:, 0]), left=0.0, right=0.0)
            for r in own
        ]
        if not np.all(np.isfinite(rms)):
            return None
        random[k] = all(r.estimator == "periodic" for r in own)
        if random[k]:
            # The lines of a comb count once each, wherever else a line may be.
            rms = [np.where(np.isin(at.frequency, r.frequency), x, 0.0)
                   for r, x in zip(own, rms, strict=True)]  # fmt: skip
        driven[k] = np.max(rms, axis=0) ** 2
    spec = rig.actuator[int(at.actuator[0])]
    return LevelGrid(
        at.frequency, at.factor, at.aliases, at.folded, at.rate_hz, at.sensor, at.actuator,
        hold_response(at.frequency, rig.rate_hz, spec.delay),
        sensor_response(rig.sensor, at.frequency)[:, at.sensor],
        driven, random,
    )  # fmt: skip


@dataclass(frozen=True, slots=True)
class Loop:
    """The force's own loop at the lines: readings per unit command and per unit force."""

    s: Complex
    l0: Complex  # (n, m)
    l1: Complex
    at: LevelGrid

    def amplitude(self, reading: Complex) -> Float:
        """(..., n) amplitude of a sine; of a line of a multisine the standard deviation of all."""
        assert self.at.power is not None
        power = np.abs(reading) ** 2 * self.at.power
        return np.asarray(np.sqrt(self.added(power, axis=-1)))

    def added(self, power: Float, axis: int = 0) -> Float:
        """Twice a sine's mean square; a random level's lines, along `axis`, all added up."""
        out = np.moveaxis(2 * power, axis, -1)
        for mine in self.at.together():
            out[..., mine] = out[..., mine].sum(axis=-1, keepdims=True) / 2
        return np.moveaxis(out, -1, axis)

    def gain(self, law: Law, A: Float, p: Strength) -> Float:
        """(n,) N of each line's kind of excitation."""
        assert self.at.level is not None
        random = self.at.random[self.at.level]
        if not random.any():
            return law.sine(A, p)
        return np.where(random, law.gauss(A, p), law.sine(A, p))

    def parts(self, law: Law) -> tuple[Complex, Complex]:
        """l0 and l1 of what the law reads."""
        rate = self.s if law.of_speed else np.ones_like(self.s)
        return rate * self.l0[:, 0], rate * self.l1[:, 0]

    def force(self, quasi: Quasi, p: Strength, scale: float = 1.0) -> tuple[Complex, Float]:
        """(n,) e per unit command, and x; (m, n) for strengths p (m, 1)."""
        if quasi.law is None:
            return self._flow(p), np.zeros(0)
        law = quasi.law
        l0, l1 = self.parts(law)
        least = LEAST * self.amplitude(l0)

        def swept(x: Float) -> Float:
            A = np.maximum(self.amplitude(l0 / (1 - x * l1)), least)
            return quasi.sign * scale * self.gain(law, A, p)

        x = np.zeros(np.broadcast_shapes(np.shape(p), self.s.shape))
        new = swept(x)
        slope = np.zeros_like(x)
        for _ in range(SWEEPS):
            # Wegstein's method: the fixed point of the line through the last two sweeps.
            ahead = x + (new - x) / (1 - slope)
            moved = ahead - x
            still = np.abs(moved) <= SETTLED * np.abs(ahead)
            if np.all(still):
                break
            there = swept(ahead)
            change = np.divide(there - new, moved, out=np.zeros_like(x), where=~still)
            slope = np.minimum(change, STEEPEST)
            x, new = ahead, there
        return np.asarray(new * l0 / (1 - new * l1)), new

    def slopes(
        self, quasi: Quasi, p: float, scale: float, x: Float, changes: tuple[Complex, Complex]
    ) -> tuple[Complex, Complex, Complex]:
        """(n, m) derivatives of e by what changes l0 and l1 as `changes` (n, m), then (n,) by the
        logarithms of p and of the scale."""
        law = quasi.law
        assert law is not None
        assert self.at.power is not None
        l0, l1 = self.parts(law)
        rate = self.s[:, None] if law.of_speed else 1.0
        d0, d1 = (rate * c for c in changes)
        D = 1 - x * l1
        y = l0 / D
        A = np.maximum(self.amplitude(y), LEAST * self.amplitude(l0))
        sized = quasi.sign * scale
        N_A = sized * (self.gain(law, A * (1 + STEP), p) - self.gain(law, A, p)) / (A * STEP)
        N_p = sized * (self.gain(law, A, p * (1 + STEP)) - self.gain(law, A, p)) / STEP
        y_x = l0 * l1 / D**2
        weight = self.at.power / A

        def through(dy: Complex, dx: Float) -> Complex:
            """de where the reading would change by dy and x by dx, were its amplitude held."""
            direct = dy + y_x[:, None] * dx
            moved = self.added(weight[:, None] * np.real(y.conj()[:, None] * direct))
            held = 1 - N_A * self.added(weight * np.real(y.conj() * y_x))
            dx = dx + N_A[:, None] * moved / held[:, None]
            return np.asarray(dx * y[:, None] + x[:, None] * (dy + y_x[:, None] * dx))

        zero = np.zeros((self.s.size, 1))
        by_chain = through(d0 / D[:, None] + (x * l0 / D**2)[:, None] * d1, np.zeros(d0.shape))
        by_p = through(zero.astype(complex), N_p[:, None])[:, 0]
        by_scale = through(zero.astype(complex), x[:, None])[:, 0]
        return by_chain, by_p, by_scale

    def _flow(self, T_s: Strength) -> Complex:
        assert self.at.power is not None
        a = np.sqrt(2 * self.at.power)
        size = np.where(a > 0, a, 1.0)
        q = self.at.hold
        e = np.zeros(np.broadcast_shapes(np.shape(T_s), q.shape), complex)
        for i in range(FLOW_SWEEPS):
            M = self.l0[:, 0] + self.l1[:, 0] * e
            new = starved(q * a, M * a, T_s) / size
            for mine in self.at.together():
                power = self.at.power[mine]
                new[..., mine] = starved_gauss(q[mine], M[..., mine], power, T_s)
            # The first sweep is the answer of a weak force; a strong one needs damping.
            moved = np.abs(new - e)
            e = new if i == 0 else 0.5 * (e + new)
            if np.all(moved < FLOW_SETTLED * np.abs(new) + 1e-300):
                break
        return e
