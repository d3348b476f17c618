"""How much of an effect a refit of the rig file's nominal parameters leaves, in sigma.

    sigma^2 = min over d of | W (y_with - y_without(nominal exp(d))) |^2 + | d/tolerance |^2

W whitens by the true noise (`noise.Whitener`), y are whole records without noise, from rest and
to where they end. Each record's constant offsets, and its mains line where it hums, are free.
The minimum is found by Gauss-Newton with derivatives by differences of exact simulations.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.fft import irfft, next_fast_len, rfft

from samii_rig.types import Complex, Float
from sim.assumed_modes.parts import Setup
from sim.assumed_modes.plant import UnphysicalError, plant
from sim.assumed_modes.sampled import closed, discrete, impulse, timeline

STEP = 1e-5  # of a parameter, for a difference; rounding is 1e-12, curvature 1e-5
ROUNDS = 12  # of Gauss-Newton
FURTHEST = 3.0  # nepers by which a refit may move a parameter
ENOUGH = 0.01  # of sigma^2, by which a round must lower it to be followed by another
# Of sigma^2, by which a whole step may miss what the derivatives foretold and still be the last:
# 1 % of sigma, at a fifth of the time where an effect leaves the linear range of no parameter.
FORETOLD = 0.02
# Levenberg's and Marquardt's, relative to the diagonal, until one lowers the cost.
DAMPINGS = (0.0, 1e-4, 1e-3, 1e-2, 1e-1, 1.0, 10.0)
COOLER = 10**0.5  # times less power of the noise from one refit to the next; 10 misses some
INSIDE = 0.9  # of the way to where an unknown ends
# Records with an effect: of each waveform and each of its levels the samples (n, n_y).
Records = Sequence[Sequence[Float]]


@dataclass(frozen=True, slots=True)
class Waveform:
    """References r (n, n_in) at unit level from rest, with the levels and repeats that it has."""

    r: Float
    levels: tuple[float, ...]
    repeats: int


@dataclass(frozen=True, slots=True)
class Bench:
    """What does not depend on the parameters: loops, waveforms, whitening.

    rate_hz : of the loops; every : loop samples a recorded one. feedback : (n_in, n_y), as of
    `closed`. response : (n, n_y, n_y) of the whitener, at the record's rate, as long as the
    longest waveform. hum_hz : 0 for none.
    """

    rate_hz: float
    every: int
    feedback: Float
    waveforms: tuple[Waveform, ...]
    response: Float
    hum_hz: float = 0.0
    _spectra: dict[int, Complex] = field(default_factory=dict)

    def linear(self, setup: Setup) -> list[Float]:
        """Samples (n, n_y) of each waveform at unit level, setup's laws at rest.

        UnphysicalError for a setup that no rig can be, or a loop that runs away.
        """
        made = plant(setup)
        loop = closed(discrete(made, timeline(setup, made, self.rate_hz)), self.feedback)
        longest = max(len(w.r) for w in self.waveforms)
        # y[k] = C s[k]; s[k+1] takes in r[k], so the response begins one sample late.
        h = np.zeros((longest, len(loop.C), loop.b.shape[1]))
        h[1:] = impulse(loop.A, loop.b, loop.C, longest - 1)
        if not np.all(np.isfinite(h)):
            raise UnphysicalError("the loop runs away")
        return [convolved(h[: len(w.r)], w.r)[:: self.every] for w in self.waveforms]

    def white(self, y: Float) -> Float:
        """W y: (n, n_y) whitened."""
        n = len(y)
        if n not in self._spectra:
            size = next_fast_len(2 * n, real=True)
            self._spectra[n] = rfft(self.response[:n], size, axis=0)
        return _applied(self._spectra[n], y)


def convolved(h: Float, x: Float) -> Float:
    """(n, n_out) the first n samples of h (n, n_out, n_in) on x (n, n_in)."""
    return _applied(rfft(h, next_fast_len(2 * len(x), real=True), axis=0), x)


def _applied(spectrum: Complex, x: Float) -> Float:
    n, size = len(x), next_fast_len(2 * len(x), real=True)
    product = np.einsum("kij,kj->ki", spectrum, rfft(x, size, axis=0))
    return np.asarray(irfft(product, size, axis=0)[:n])


@dataclass(frozen=True, slots=True)
class Left:
    """What a refit leaves: sigma, the part of it in the data alone (the rest is what the moves
    cost by their tolerances), and how far it moved each unknown, in its tolerances."""

    sigma: float
    data: float
    moved: Float


def _left(cost: float, moved: Float) -> Left:
    """From sigma^2; rounding may leave a little below 0."""
    data = cost - float(moved @ moved)
    return Left(float(np.sqrt(max(cost, 0.0))), float(np.sqrt(max(data, 0.0))), moved)


@dataclass(frozen=True, slots=True)
class Slopes:
    """Whitened derivatives of a waveform's record: rows (n_unknown, n n_y), and their products
    gram (n_unknown, n_unknown)."""

    rows: Float
    gram: Float

    @classmethod
    def of(cls, rows: Float) -> Slopes:
        """With their products."""
        return cls(rows, rows @ rows.T)


class Refit:
    """Refits unknowns (nominal parameters, and others if wanted) to records without noise.

    build : from the unknowns' offsets in tolerances (n,) to a setup without laws. step (n,) : of a
    difference; reach (n,) : the furthest that an offset may go. known : a refit of the first of
    these unknowns, where the others do nothing at 0.
    """

    def __init__(
        self,
        bench: Bench,
        build: Callable[[Float], Setup],
        step: Float,
        reach: Float,
        known: Refit | None = None,
    ) -> None:
        self.bench, self.build, self.step, self.reach, self.n = bench, build, step, reach, len(step)
        if known is None:
            lengths = [len(range(0, len(w.r), bench.every)) for w in bench.waveforms]
            self._nuisance = [self._free(n) for n in lengths]
            self.y, self.J = self._derivatives(np.zeros(self.n))
        else:
            self._nuisance, self.y = known._nuisance, known.y
            more = self._columns(np.zeros(self.n), self.y, range(known.n, self.n))
            both = zip(known.J, more, strict=True)
            self.J = [Slopes.of(np.vstack([a.rows, b.rows])) for a, b in both]

    def _free(self, n: int) -> Float:
        """Orthonormal basis (n n_y, m) of a record's offsets and mains lines, whitened."""
        n_y = self.bench.response.shape[1]
        t = np.arange(n) * self.bench.every / self.bench.rate_hz
        columns = [np.ones(n)]
        if self.bench.hum_hz:
            w = 2 * np.pi * self.bench.hum_hz
            columns += [np.sin(w * t), np.cos(w * t)]
        each = [self.bench.white(np.outer(x, e)).ravel() for x in columns for e in np.eye(n_y)]
        return np.asarray(np.linalg.qr(np.array(each).T)[0])

    def _derivatives(self, at: Float) -> tuple[list[Float], list[Slopes]]:
        """Samples at unit level, and whitened derivatives, a waveform each."""
        y0 = self.bench.linear(self.build(at))
        return y0, self._columns(at, y0, range(self.n))

    def _columns(self, at: Float, y0: Sequence[Float], which: range) -> list[Slopes]:
        columns: list[list[Float]] = [[] for _ in y0]
        for i in which:
            moved = at.copy()
            moved[i] += self.step[i]
            y1 = self.bench.linear(self.build(moved))
            for column, a, b in zip(columns, y0, y1, strict=True):
                column.append(self.bench.white((b - a) / self.step[i]).ravel())
        out = []
        for column, Q in zip(columns, self._nuisance, strict=True):
            rows = np.array(column)
            out.append(Slopes.of(rows - (rows @ Q) @ Q.T))
        return out

    def raw(self, records: Records) -> float:
        """sigma before any refit."""
        return float(np.sqrt(self._cost(records, self.y)))

    def tangent(self, records: Records) -> Left:
        """What a refit leaves by the derivatives at the start: exact for a very small effect."""
        N, g, total = self._normal(records, self.y, self.J)
        moved: Float = np.linalg.solve(N + np.eye(self.n), g).astype(np.float64)
        return _left(total - float(g @ moved), moved)

    def between(self, records: Records, before: Sequence[Float]) -> float:
        """Sigma of what differs from `before`, samples at unit level, where the unknowns are held
        by records of both; by the derivatives at the start."""
        N, g, total = self._normal(records, before, self.J)
        less = float(g @ np.linalg.solve(2 * N + np.eye(self.n), g))
        return float(np.sqrt(max(total - less, 0.0)))

    def cooled(self, records: Records) -> Left:
        """What a refit leaves, the noise first taken for so large that the nominal parameters as
        they are leave no more, then for less and less. A mode that moves by more than its width
        leads a refit in the least noise into valleys far from the tolerances."""
        steps = np.ceil(np.log(max(self.raw(records) ** 2, 1.0)) / np.log(COOLER))
        at = np.zeros(self.n)
        for k in range(int(steps), 0, -1):
            at = self.left(records, at, COOLER**k).moved
        return self.left(records, at)

    def left(self, records: Records, start: Float | None = None, times: float = 1.0) -> Left:
        """What a refit leaves, by Gauss-Newton from `start`, in noise of `times` the power.

        Derivatives are kept as long as they lower the cost as they foretell.
        """
        at = np.zeros(self.n) if start is None else np.clip(start, -self.reach, self.reach)
        y = self.bench.linear(self.build(at))
        fresh = not np.any(at)
        J = self.J
        cost = self._cost(records, y) / times + float(at @ at)
        for _ in range(ROUNDS):
            N, g = (x / times for x in self._normal(records, y, J)[:2])
            hoped = gained = 0.0
            for damping in DAMPINGS:
                G = N + np.eye(self.n)
                raised = G + damping * np.diag(np.diag(G))
                step: Float = np.linalg.solve(raised, g - at).astype(np.float64)
                there = at + step * self._room(at, step)
                try:
                    y1 = self.bench.linear(self.build(there))
                except UnphysicalError:
                    continue
                new = self._cost(records, y1) / times + float(there @ there)
                if new < cost:
                    whole = damping == 0.0 and bool(np.all(there == at + step))
                    step = there - at
                    hoped = float(step @ (2 * (g - at) - G @ step))
                    gained, cost, at, y = cost - new, new, there, y1
                    break
            else:
                whole = False
            if fresh and gained < ENOUGH * cost:
                break
            if whole and abs(gained - hoped) < FORETOLD * cost:
                break
            fresh = gained < 0.5 * hoped or gained < ENOUGH * cost
            if fresh:
                y, J = self._derivatives(at)
        return _left(cost, at)

    def _room(self, at: Float, step: Float) -> float:
        """The part of a step that keeps all unknowns within their reach."""
        ahead = np.where(step > 0, self.reach - at, self.reach + at)
        with np.errstate(divide="ignore"):
            return float(min(1.0, INSIDE * np.min(ahead / np.abs(step))))

    def _normal(
        self,
        records: Records,
        y: Sequence[Float],
        J: Sequence[Slopes],
    ) -> tuple[Float, Float, float]:
        N, g, total = np.zeros((self.n, self.n)), np.zeros(self.n), 0.0
        for w, rows, y0, own, Q in zip(
            self.bench.waveforms, records, y, J, self._nuisance, strict=True
        ):
            for level, row in zip(w.levels, rows, strict=True):
                x = self.bench.white(row - level * y0).ravel()
                x -= Q @ (Q.T @ x)
                N += w.repeats * level**2 * own.gram
                g += w.repeats * level * (own.rows @ x)
                total += w.repeats * float(x @ x)
        return N, g, total

    def _cost(self, records: Records, y: Sequence[Float]) -> float:
        total = 0.0
        with np.errstate(over="ignore", invalid="ignore"):  # a loop that is about to run away
            for w, rows, y0, Q in zip(
                self.bench.waveforms, records, y, self._nuisance, strict=True
            ):
                for level, row in zip(w.levels, rows, strict=True):
                    x = self.bench.white(row - level * y0).ravel()
                    total += w.repeats * float(x @ x - np.sum((Q.T @ x) ** 2))
        return total
