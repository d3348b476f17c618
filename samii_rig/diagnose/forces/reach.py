"""How far the recorded commands move a rig where forces may act: the linear motion there.

It is common to all forces at a place. On a line beside the imaginary axis one product gives the
motion from rest to the record's last sample, at the lowest rate that holds the band and the
third harmonics of it (`samii_rig.likelihood.contour`).
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from scipy import fft

from samii_rig.diagnose.fit.records import Whole
from samii_rig.diagnose.forces.place import Place
from samii_rig.diagnose.forces.problem import mean_command
from samii_rig.diagnose.physics.effect import Key
from samii_rig.diagnose.physics.model import Model
from samii_rig.errors import SamiiRigError
from samii_rig.likelihood.pieces import Piece
from samii_rig.model.sampled import dead_time, hold_at, sensors_at
from samii_rig.types import Complex, Float, Int

OVER = 4.0  # rate over the highest line: third harmonics fold beside the band, not into it
DAMPING = 5.0  # of the contour: 0.7 % wraps around, what is cut above the rate grows 12 times


@dataclass(frozen=True)
class Span:
    """One piece on its contour, at a low rate.

    n : samples of the record at the low rate, of `samples`. v : damped spectrum of the command,
    from the record's first sample on (what is before it wraps around). decay : (M,) of the contour.
    alive : (M,) whether the instant is in the record or in the input before it.
    """

    n: int
    samples: int
    s: Complex
    v: Complex
    decay: Float
    alive: Float
    times: float
    history: int
    rate_hz: float

    @classmethod
    def of(cls, piece: Piece, rate_hz: float, highest_hz: float) -> Span:
        """Of a piece whose lines end at `highest_hz`."""
        n, history = len(piece.z), piece.history
        low = int(fft.next_fast_len(max(int(OVER * highest_hz * n / rate_hz), 16), real=True))
        low = min(low, n)
        turns = 2 if history == 0 else 4
        M, m = turns * n, turns * low
        sigma = DAMPING * rate_hz / M
        v, times = mean_command(piece)
        f = np.arange(m // 2 + 1) * (rate_hz / M)
        s = np.asarray(sigma + 2j * np.pi * f, np.complex128)
        at = np.arange(m) * (n / low) + history
        at = np.where(at >= M, at - M, at)
        decay = np.exp(-sigma / rate_hz * at)
        alive = (at < v.size).astype(float)
        made = cls(low, n, s, np.zeros(0, complex), decay, alive, times, history, rate_hz)
        return replace(made, v=made.spectrum(v))

    def spectrum(self, x: Float) -> Complex:
        """(M//2 + 1,) damped, of x (history + n,) at the record's rate."""
        M = round(self.decay.size * self.samples / self.n)
        sigma = float(self.s[0].real)
        damped = fft.rfft(x * np.exp(-sigma / self.rate_hz * np.arange(x.size)), M)[: self.s.size]
        # Instants run from the record's first sample; the input before it stands at the end.
        turn = np.exp(1j * self.s.imag * (self.history / self.rate_hz))
        return np.asarray(damped * turn * (self.decay.size / M))

    def motion(self, H: Complex) -> Float:
        """(M,) of H (M//2 + 1,) under the command."""
        return np.asarray(fft.irfft(H * self.v, self.decay.size) / self.decay * self.alive)

    def damped(self, force: Float) -> Complex:
        """(M//2 + 1,) damped spectrum of a force (M,) at the low rate."""
        return np.asarray(fft.rfft(force * self.alive * self.decay))

    def lines(self, E: Complex, T: Complex, k: Int) -> Complex:
        """(n_line, q) what a force of spectrum E adds to lines k, by T (M//2 + 1, q), of a sample's
        power."""
        y = fft.irfft(T * E[:, None], self.decay.size, axis=0)[: self.n]
        y *= (self.times / self.decay[: self.n])[:, None]
        Z = fft.rfft(y, axis=0)[k]
        return np.asarray(Z * (np.sqrt(self.samples) / self.n))


@dataclass(frozen=True)
class Ports:
    """One place: (M//2 + 1, ...) of each piece what drives a force there, per command; and the
    recorded lines per unit force, the loop's answer in them. y1 : (n,) of all lines in the band,
    how much a unit force moves what drives it."""

    reading: list[Complex]
    sensors: list[Complex]
    y1: Float


@dataclass
class Reach:
    """The linear motion of a rig under all commands."""

    whole: Whole
    model: Model
    x: Float
    actuator: int
    spans: list[Span] = field(default_factory=list)
    _ports: dict[tuple[Place, bool], Ports | None] = field(default_factory=dict)
    _motion: dict[tuple[Place, bool], list[Float]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        records = self.whole.records
        self.spans = [
            Span.of(piece, records.rate_hz, band[1])
            for piece, band in zip(records.pieces, records.bands, strict=True)
        ]

    @property
    def largest(self) -> float:
        """Amplitude of the command."""
        pieces = self.whole.records.pieces
        return max(float(np.max(np.abs(c.v))) for p in pieces for c in p.commands[:1])

    def scale(self, key: Key | None) -> float:
        """The rig's parameter that multiplies a force, 1 of none."""
        return 1.0 if key is None else {**self.model.nominal, **self.model.values(self.x)}[key]

    @cached_property
    def commands(self) -> list[Float]:
        """(M,) of each piece the command as it is held, after the dead time."""
        rig = self.whole.rig
        delay = rig.actuator[self.actuator].delay + float(dead_time(rig)[self.actuator])
        return [s.motion(hold_at(s.s, rig.rate_hz, delay) * self._given(s.s)) for s in self.spans]

    def _given(self, s: Complex) -> Complex:
        """(n,) what effects on the input do to the command."""
        out = np.ones(s.size, np.complex128)
        for effect, theta in zip(self.model.effects, self.model.parts(self.x), strict=True):
            if effect.factor is not None and effect.factor.kind == "input":
                out *= effect.factor.value(s, theta)[0]
        return out

    def motion(self, place: Place, *, of_speed: bool) -> list[Float]:
        """(M,) of each piece what drives a force at a place; none where nothing moves there."""
        key = place, of_speed
        if key not in self._motion:
            found = self.ports(place, of_speed=of_speed)
            moves = [] if found is None else zip(self.spans, found.reading, strict=True)
            self._motion[key] = [span.motion(H) for span, H in moves]
        return self._motion[key]

    def ports(self, place: Place, *, of_speed: bool) -> Ports | None:
        """The responses of a place; None where nothing moves, or a force cannot act."""
        key = place, of_speed
        if key not in self._ports:
            try:
                self._ports[key] = self._made(place, of_speed=of_speed)
            except SamiiRigError:
                self._ports[key] = None
        return self._ports[key]

    def _made(self, place: Place, *, of_speed: bool) -> Ports | None:
        rig, records = self.model.built, self.whole.records
        told = place.kind == "command"
        chain = self.model.chain_of(rig if told else place.widened(rig))
        chain = chain.with_values(self.model.values(self.x))
        n, on, wired = len(rig.sensor), self.whole.sensor, self.whole.wired
        reading, sensors, y1 = [], [], []
        for span, band in zip(self.spans, records.bands, strict=True):
            s = span.s
            G = chain.evaluate(s)
            hold = hold_at(s, rig.rate_hz, rig.actuator[self.actuator].delay) * self._given(s)
            seen = sensors_at(rig.sensor, s)[:, on]
            H = G[:, on, self.actuator] * seen * hold[:, None]
            own = len(rig.actuator) if place.own_input else self.actuator
            by_force = H if told else G[:, on, own] * seen
            for kp, c, _ in wired.loops:
                by_force = by_force - H * (kp * by_force[:, c] / (1 + kp * H[:, c]))[:, None]
            sensors.append(by_force)
            if told:
                continue
            rate = s if of_speed else np.ones_like(s)
            reading.append(rate * G[:, n, self.actuator] * hold)
            inside = (s.imag >= 2 * np.pi * band[0]) & (s.imag <= 2 * np.pi * band[1])
            y1.append(np.abs(rate * G[:, n, -1])[inside])
        if told:
            return Ports([], sensors, np.zeros(0))
        moved = np.concatenate(y1)
        drives = max(float(np.max(np.abs(r))) for r in reading) > 0
        useful = drives and bool(np.all(moved > 0) and np.all(np.isfinite(moved)))
        return Ports(reading, sensors, moved) if useful else None
