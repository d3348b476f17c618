"""Whole records of one rig, and how a model predicts them.

Their likelihood (`samii_rig.likelihood`) is made about a fit.
"""

from __future__ import annotations

import math
import re
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy import special

from samii_rig.diagnose.fit.kept import Computed
from samii_rig.diagnose.fit.refit import Fitted
from samii_rig.diagnose.physics.aliases import Aliases, alias_points
from samii_rig.diagnose.physics.disturbed import Disturbed
from samii_rig.diagnose.physics.grid import Grid, grid
from samii_rig.diagnose.physics.loops import Closed, JointLoops, Loop
from samii_rig.diagnose.physics.model import Model
from samii_rig.errors import EstimateError
from samii_rig.likelihood.complete import Complete
from samii_rig.likelihood.excited import driven_to, records_of, up_to
from samii_rig.likelihood.form import Reduced
from samii_rig.likelihood.free import scatter
from samii_rig.likelihood.noise import Disturbances, Noise
from samii_rig.likelihood.nuisance import HIGHEST
from samii_rig.likelihood.pieces import Loops, Wiring, faster, joined, pieces_of, wiring
from samii_rig.likelihood.records import Records, Response
from samii_rig.likelihood.reduce import LineResiduals, reduced, residuals_by_line
from samii_rig.rig.schema import Rig
from samii_rig.signal.columns import aligned
from samii_rig.signal.groups import segments_of
from samii_rig.types import Complex, Finding, Float, Int, Recording

TEST_TURN = 10  # one line in so many is a test line
# Test lines: by turns of this part, so that of every second, fifth or tenth line, where a
# multisine has its own, one in ten is a test line too (Weyl 1916, Math. Ann. 77).
GOLDEN = (5**0.5 - 1) / 2
# Highest that counts of what a force makes. The first of what is alike both ways is the third, but
# of what friction and play showed on three narrow tests two thirds to three quarters lay above it,
# and 6 to 23 % above the seventh. More lines cost more than they tell.
HARMONIC = 7
# Lines to which harmonics may add: a quadratic form of so many takes 5 s of a core. Many records
# show a force at the lines of their excitation too.
MOST_LINES = 12000
# Of chi-square, all that a response does above the lines that are looked at: ten times as large it
# would add 10, less than what any effect must explain.
LOST = 0.1
MOST_KEPT = 20000  # lines at which disturbances are kept: 50 MB of four sensors
# Of half the rate, width over which samples between those that were recorded are told from these:
# at `HIGHEST` they are to 1e-6, after 130 samples of either side nothing is left. And how many
# widths count: 1e-12 behind them.
PASSING, FAR_OFF = 0.03, 5.0


@dataclass(frozen=True)
class Whole:
    """Records, and how a model predicts them."""

    rig: Rig
    records: Records
    wired: Wiring
    left_out: tuple[tuple[str, str], ...] = ()
    of_levels: Records | None = None  # the same, every level by itself
    asked: bool = False  # whether somebody said which lines count
    own_aliases: bool = False  # whether every model folds back what is its own from above the rate
    hidden: tuple[str, ...] = ()  # as of `wiring`
    runs: tuple[Recording, ...] = field(default=(), repr=False, compare=False)  # as `aligned`
    # Of all that are made from these records: levels by themselves have the same contours.
    kept: Computed = field(default_factory=Computed, repr=False, compare=False)

    @classmethod
    def of(
        cls,
        runs: Sequence[Recording],
        rig: Rig,
        band: tuple[float, float] | None = None,
        sensors: Sequence[str] | None = None,
        findings: Sequence[Finding] = (),
        *,
        in_order: bool = False,
        hidden: Collection[str] = (),
    ) -> Whole:
        """All runs of one rig.

        sensors : those that are sound, all that were recorded if None. findings : of the samples;
        segments that they are about are left out, but not for a sensor that is left out itself.
        in_order : whether their rows hold what was sent and measured at one time, as `runs` do.
        hidden : as of `wiring`.

        Raises EstimateError where they hold nothing to compare.
        """
        if not in_order:
            runs = [run for run, _ in aligned(runs)]
        wired = wiring(runs, rig, sensors, hidden)
        (rate,) = {run.rate_hz for run in runs}
        times = faster(runs, wired)
        if times and times * rate != rig.rate_hz:
            rig = rig.model_copy(update={"rate_hz": times * rate})
        bad = [f.message for f in findings if not f.channel or f.channel in wired.sensors]
        without = _named_in(bad, (r.place(s) for r in runs for s in segments_of(r)))
        levels = pieces_of(runs, rig, wired, without, by_level=True, times=times)
        if not levels:
            raise EstimateError("no segment is sound")
        steps = {s.name: s.resolution for s in rig.sensor}
        step = tuple(steps[n] for n in wired.sensors)
        finest = {a.name: a.resolution for a in rig.actuator}
        rounding = np.array([finest[x.command] ** 2 / 12 for x in wired.inputs])
        every = round(rig.rate_hz / rate)
        all_, of_levels = (
            records_of(p, rate, band, step, rounding, every) for p in (joined(levels), levels)
        )
        rests = tuple(j for j, x in enumerate(wired.inputs) if not x.driven)
        all_, of_levels = (replace(one, undriven=rests) for one in (all_, of_levels))
        without |= _sensors_out(runs, rig, wired, findings) | _answering(all_)
        left_out, asked = tuple(without.items()), band is not None
        return cls(
            rig, all_, wired, left_out, of_levels, asked, hidden=tuple(hidden), runs=tuple(runs)
        )

    @property
    def every(self) -> int:
        """Samples of the rig for each that was recorded."""
        return self.records.every

    def thinned(self, most: int) -> Whole:
        """As of `Recorded`."""
        times = self.records.one_of * math.ceil(self.lines / most)
        return replace(self, records=replace(self.records, one_of=times)) if times > 1 else self

    def showing(self, fitted: Fitted, noise: Reduced) -> Whole:
        """As of `Recorded`."""
        return self.up_to(self.shown_to(fitted, noise))

    def shown_to(self, fitted: Fitted, noise: Reduced) -> float:
        """Hz above which nothing that a fit answers shows in noise: `LOST` of chi-square in all."""
        records, exact = self.records, self.records.exact()
        H = self.response(fitted)(exact.s)
        f, power = np.zeros(0), np.zeros(0)
        for i, piece in enumerate(records.pieces):
            lines = records.lines(piece)
            y = exact.predicted(H, piece.r)[piece.history :]
            Y = np.asarray(np.fft.rfft(y, axis=0)[lines.k] / np.sqrt(len(y)))
            of = np.full(lines.k.size, i)
            white = noise.noise.whitened(lines.frequency, of, Y[:, :, None])
            f = np.append(f, lines.frequency)
            power = np.append(power, 2 * np.sum(np.abs(white) ** 2, axis=(1, 2)))
        order = np.argsort(-f)
        above = np.cumsum(power[order]) * records.one_of
        return float(f[order[min(int(np.searchsorted(above, LOST)), f.size - 1)]])

    def up_to(self, top: float) -> Whole:
        """The same on lines up to `top` Hz, but on those that somebody asked for."""
        if self.asked:
            return self
        levels = None if self.of_levels is None else up_to(self.of_levels, top)
        return replace(self, records=up_to(self.records, top), of_levels=levels)

    def by_level(self) -> Whole:
        """The same records, the levels not summed up: for what depends on amplitude."""
        return self if self.of_levels is None else replace(self, records=self.of_levels)

    def with_harmonics(self) -> Whole:
        """The same records, with the lines at which a force shows that depends on the level: below
        what is excited, and above it up to harmonic `HARMONIC`; no others than those that were
        asked for."""
        if self.asked:
            return self
        records, most = self.records, HIGHEST * self.records.rate_hz
        times = min(float(HARMONIC), max(MOST_LINES / records.count, 1.0))
        # Below, too: what a limit or friction holds back where a rig integrates.
        bands = tuple((0.0, min(times * high, most)) for _, high in records.bands)
        driven = records.driven
        if not np.isfinite(driven):
            driven = max(records.band[1], driven_to(records.pieces, records.rate_hz))
        wide = replace(records, bands=bands, driven=driven, driven_from=records.band[0])
        return replace(self, records=wide)

    def beyond(self) -> Whole:
        """The same records on all lines of `with_harmonics`, for every explanation."""
        levels = self.by_level().with_harmonics().records
        return replace(self.with_harmonics(), of_levels=levels, asked=True)

    @property
    def sensor(self) -> Int:
        """(q,) indices into the rig's sensors."""
        names = [s.name for s in self.rig.sensor]
        return np.array([names.index(n) for n in self.wired.sensors], np.int64)

    @property
    def acting(self) -> Int:
        """(m,) indices of the inputs into the rig's actuators."""
        names = [a.name for a in self.rig.actuator]
        return np.array([names.index(x.command) for x in self.wired.inputs], np.int64)

    def metered(self, model: Model) -> list[bool]:
        """(m,) whether a model has each input as recorded by a meter."""
        return [model.metered(x.command) for x in self.wired.inputs]

    @property
    def loop(self) -> Closed | None:
        """The loops around the sensors."""
        if not self._loop:
            return None
        if len(self.wired.inputs) == 1:
            return Loop(*self._loop[0][:2])
        gain = np.zeros((len(self.wired.inputs), self.sensor.size))
        for kp, sensor, of in self._loop:
            gain[of, sensor] = kp
        return JointLoops(gain)

    @property
    def _loop(self) -> Loops:
        return self.wired.loops

    def grid(self, frequency: Float, sigma: float, fitted: Fitted) -> Grid:
        """The grid beside the imaginary axis, with the aliases of a fit."""
        acting = self.acting
        sensor = np.repeat(self.sensor, acting.size)
        actuator = np.tile(acting, self.sensor.size)
        chain, contour = fitted.model.plain(fitted.x), self.records.exact()

        def summed() -> Aliases:
            few = alias_points(contour.rate_hz / contour.samples, self.rig.rate_hz / 2)
            return Aliases.of(self.rig, chain, few, sensor, actuator)

        key = *self._of(fitted), contour.samples
        made = self.kept.aliases.get(key, (self.rig, fitted.model), summed)
        open_ = grid(self.rig, frequency, sensor, actuator, chain, sigma, made, self.own_aliases)
        return replace(open_, loop=self.loop)

    def _of(self, fitted: Fitted) -> tuple[int, int, bytes]:
        return id(self.rig), id(fitted.model), fitted.x.tobytes()

    def with_own_aliases(self) -> Whole:
        """As of `Recorded`."""
        return replace(self, own_aliases=True)

    def nodes(self, found: Reduced, fitted: Fitted) -> Grid:
        """The nodes of a likelihood."""
        return self.grid(found.frequency, found.sigma, fitted)

    def between(self, found: Reduced, fitted: Fitted) -> Grid:
        """What is between them."""
        return self.grid(found.between, found.sigma, fitted)

    @property
    def lines(self) -> int:
        """Lines of the records that take part."""
        return self.records.count

    def response(self, fitted: Fitted) -> Response:
        """Of a fit, at any s of one contour."""

        def at(s: Complex) -> Complex:
            key = *self._of(fitted), self.own_aliases, s.size, complex(s[-1])
            return self.kept.answers.get(key, (self.rig, fitted.model), lambda: computed(s))

        def computed(s: Complex) -> Complex:
            f, sigma = s.imag / (2 * np.pi), float(s.real[0])
            half = self.records.rate_hz / 2
            beyond = round(f[-1] / half) > 1
            f = np.minimum(f, self.rig.rate_hz / 2 if beyond else half)  # but for rounding
            H = fitted.model.response(fitted.x, self.grid(f, sigma, fitted))
            whole = beyond or self.every == 1
            return H if whole else self._recorded(f, H, sigma, fitted)

        return at

    def _recorded(self, f: Float, H: Complex, sigma: float, fitted: Fitted) -> Complex:
        """(n, q) from and to the samples that were recorded, of the rig's response H at f (n,).

        The input between them is that of a filter that ends within some samples. Were it that of
        no filter, H would jump at half the rate, and what rings from there before its cause would
        grow along the contour.
        """
        half = self.records.rate_hz / 2
        on = np.flatnonzero(f > half * (1 - FAR_OFF * PASSING))
        beyond = self.grid(2 * half - f[on][::-1], sigma, fitted)
        folded = fitted.model.response(fitted.x, beyond)[::-1].conj()
        passed = special.erfc((f[on] / half - 1) / PASSING)[:, None] / 2
        out = H.copy()
        out[on] = passed * H[on] + (1 - passed) * folded
        return out

    def disturbed(self, fitted: Fitted) -> Disturbances:
        """What each disturbance of a fit makes in all sensors, the loop around them closed."""
        made = Disturbed.of(fitted.model, fitted.x, self.sensor)
        lines = np.unique(
            np.concatenate([self.records.lines(p).frequency for p in self.records.pieces])
        )
        known: list[Complex] = []

        def at(f: Float) -> Complex:
            of = np.minimum(np.searchsorted(lines, f), lines.size - 1)
            if lines.size > MOST_KEPT or not np.array_equal(lines[of], f):
                return made.response(f, self.response_at(fitted, f), self.loop)
            if not known:
                known.append(made.response(lines, self.response_at(fitted, lines), self.loop))
            return known[0][of]

        return at

    def response_at(self, fitted: Fitted, f: Float) -> Complex:
        """(n, q) of a fit at real frequencies f (n,)."""
        once, which = np.unique(f, return_inverse=True)
        return np.asarray(fitted.model.response(fitted.x, self.grid(once, 0.0, fitted))[which])

    def about(self, fitted: Fitted, at: Float | None = None) -> Reduced:
        """The likelihood near a fit, on the lines that are fitted. at : Hz of its nodes."""
        response, disturbed = self.response(fitted), self.disturbed(fitted)
        return reduced(self.records, response, disturbed, self._loop, fitted_lines, at)

    def complete(self, fitted: Fitted, own_power: Float | None = None) -> Complete:
        """The same, with what no linear model explains. own_power : as of `Complete.about`."""
        disturbed = self.disturbed(fitted)
        return Complete.about(
            self.records, self.response(fitted), disturbed, self._loop, fitted_lines, own_power
        )

    def scatter(self, fitted: Fitted, noise: Reduced) -> Float:
        """(q,) as of `scatter`, of the repeats of one command: of each sensor what its noise has
        of it."""
        response = self.response(fitted)
        H = response(self.records.exact().s)
        seen = self.records.seen(H, self._loop, response)
        return scatter(self.records, H, seen, noise.noise)

    def residuals(self, fitted: Fitted, noise: Reduced, *, shown: bool = False) -> LineResiduals:
        """What a fit leaves, line by line: on the lines that are fitted, or on those shown."""
        latest = self._latest
        if not latest or latest[0][0] is not fitted or latest[0][1] is not noise.noise:
            parts = fitted_lines, _shown
            each = residuals_by_line(self.records, self.response(fitted), noise, self._loop, *parts)
            latest[:] = [(fitted, noise.noise, each)]
        return latest[0][2][shown]

    @cached_property
    def _latest(self) -> list[tuple[Fitted, Noise, list[LineResiduals]]]:
        """What the latest fit leaves: both parts of the lines are asked for."""
        return []


def _answering(records: Records) -> dict[str, str]:
    """Of pieces whose command answers noise above a frequency, why they are not used there."""
    each: dict[str, float] = {}
    for p in records.pieces:
        each[p.name] = min(each.get(p.name, np.inf), p.follows)
    why = "above {:.3g} Hz its command is what a loop makes of the sensor's noise"
    return {name: why.format(hz) for name, hz in each.items() if np.isfinite(hz)}


def _sensors_out(
    runs: Sequence[Recording], rig: Rig, wired: Wiring, findings: Sequence[Finding]
) -> dict[str, str]:
    """Of each sensor that all runs have and none of which is used, why."""
    common = set.intersection(*({c.name for c in run.channels} for run in runs))
    out = {}
    for name in (s.name for s in rig.sensor if s.name in common - set(wired.sensors)):
        said = (f.message for f in findings if name in (f.channel or "").split(", "))
        out[name] = next(said, "not sound in all of them")
    return out


def _named_in(messages: Sequence[str], places: Iterable[str]) -> dict[str, str]:
    """The first message that names each of the places, of those that any names."""
    out = {}
    for place in places:
        whole = re.compile(rf"(?<![\w.]){re.escape(place)}(?![\w.])")
        why = next((m for m in messages if whole.search(m)), None)
        if why is not None:
            out[place] = why
    return out


def fitted_lines(k: Int) -> NDArray[np.bool_]:
    """Which lines k (n,) are fitted; the others show what was gained."""
    return ~_shown(k)


def _shown(k: Int) -> NDArray[np.bool_]:
    return np.asarray((k * GOLDEN) % 1.0 < 1 / TEST_TURN)
