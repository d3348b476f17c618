"""How far the recorded commands move a rig where forces may act: the linear motion there.

It is common to all forces at a place. On a line beside the imaginary axis one product gives the
motion from rest to the record's last sample, at the lowest rate that holds the band and the
third harmonics of it (`samii_rig.likelihood.contour`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy import fft

from samii_rig.diagnose.fit.records import Whole
from samii_rig.diagnose.forces.model import augmented
from samii_rig.diagnose.forces.place import Place
from samii_rig.diagnose.forces.problem import as_driven, mean_command
from samii_rig.diagnose.physics.effect import Key
from samii_rig.diagnose.physics.model import Model
from samii_rig.errors import SamiiRigError
from samii_rig.likelihood.algebra import by_input
from samii_rig.likelihood.inputs import meter_noise
from samii_rig.likelihood.pieces import Command, Piece
from samii_rig.model.sampled import dead_time, hold_at, sensors_at
from samii_rig.types import Complex, Float, Int

OVER = 4.0  # rate over the highest line: third harmonics fold beside the band, not into it
# Of the samples, of a command that rests: one that swings passes 0 in a hundredth of them.
RESTS = 0.05
# Of the contour: 0.7 % wraps around, what is cut above the rate grows 12 times.
CONTOUR_DAMPING = 5.0
ALIKE = 1e-6  # relative, by which what is the same differs by rounding


@dataclass(frozen=True)
class Span:
    """One piece on its contour, at a low rate.

    n : samples of the record at the low rate, of `samples`. v : (M//2 + 1, m) damped spectra of the
    commands, from the record's first sample on (what is before it wraps around).
    decay : (M,) of the contour. alive : (M,) whether the instant is in the record or in the input
    before it.
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
    def of(
        cls, piece: Piece, commands: Sequence[Command], rate_hz: float, highest_hz: float
    ) -> Span:
        """Of a piece whose lines end at `highest_hz`. commands : what drove it, of every record."""
        n, history = len(piece.z), piece.history
        needed = min(max(int(OVER * highest_hz * n / rate_hz), 16), n)
        low = int(fft.next_fast_len(needed, real=True))  # more than n where that is quicker
        turns = 2 if history == 0 else 4
        M, m = turns * n, turns * low
        sigma = CONTOUR_DAMPING * rate_hz / M
        v, times = mean_command(commands)
        f = np.arange(m // 2 + 1) * (rate_hz / M)
        s = np.asarray(sigma + 2j * np.pi * f, np.complex128)
        at = np.arange(m) * (n / low) + history
        at = np.where(at >= M, at - M, at)
        decay = np.exp(-sigma / rate_hz * at)
        alive = (at < len(v)).astype(float)
        made = cls(low, n, s, np.zeros(0, complex), decay, alive, times, history, rate_hz)
        return replace(made, v=made.spectrum(v.reshape(len(v), -1)))

    def spectrum(self, x: Float) -> Complex:
        """(M//2 + 1, ...) damped, of x (history + n, ...) at the record's rate."""
        M = round(self.decay.size * self.samples / self.n)
        sigma = float(self.s[0].real)
        own = (-1,) + (1,) * (x.ndim - 1)
        decay = np.exp(-sigma / self.rate_hz * np.arange(len(x))).reshape(own)
        damped = fft.rfft(x * decay, M, axis=0)[: self.s.size]
        if len(damped) < self.s.size:
            damped = np.pad(damped, [(0, self.s.size - len(damped))] + [(0, 0)] * (x.ndim - 1))
        # Instants run from the record's first sample; the input before it stands at the end.
        turn = np.exp(1j * self.s.imag * (self.history / self.rate_hz)).reshape(own)
        return np.asarray(damped * turn * (self.decay.size / M))

    def motion(self, H: Complex) -> Float:
        """(M,) of H (M//2 + 1, m) under the commands."""
        moved = np.sum(H * self.v, axis=1)
        return np.asarray(fft.irfft(moved, self.decay.size) / self.decay * self.alive)

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

    @property
    def before(self) -> int:
        """Instants of the input before the record, which stand at the end."""
        return int(np.count_nonzero(self.alive[self.decay.size // 2 :]))

    def sampled(self, E: Complex, T: Complex) -> Float:
        """(samples, q) what `lines` are those of, by itself and at the record's rate."""
        M = round(self.decay.size * self.samples / self.n)
        y = fft.irfft(T * E[:, None], M, axis=0)[: self.samples] * (M / self.decay.size)
        sigma = float(self.s[0].real)
        at = self.history + np.arange(self.samples)
        return np.asarray(y * np.exp(sigma / self.rate_hz * at)[:, None])


@dataclass(frozen=True)
class Ports:
    """One place: (M//2 + 1, m) of each piece what drives a force there, per command; the
    recorded lines per unit force, the loop's answer in them; and (M//2 + 1,) `back`, what a unit
    force moves what drives it under the commands as recorded. y1 : (n,) its size, of all lines in
    the band."""

    reading: list[Complex]
    sensors: list[Complex]
    back: list[Complex]
    y1: Float


@dataclass
class TransferPaths:
    """The linear motion of a rig under all commands. driven : of each piece, as of `as_driven`."""

    whole: Whole
    model: Model
    x: Float
    driven: list[list[Command]] = field(default_factory=list)
    spans: list[Span] = field(default_factory=list)
    _ports: dict[tuple[Place, bool], Ports | None] = field(default_factory=dict)
    _motion: dict[tuple[Place, bool], list[Float]] = field(default_factory=dict)
    _commands: dict[int, list[Float]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        records = self.whole.records
        metered = self.whole.metered(self.model)
        self.driven = [as_driven(piece, metered) for piece in records.pieces]
        self.spans = [
            Span.of(piece, commands, records.rate_hz, band[1])
            for piece, commands, band in zip(
                records.pieces, self.driven, records.bands, strict=True
            )
        ]

    def largest(self, place: Place) -> float:
        """Amplitude of the command that a force is on."""
        return max(float(np.max(np.abs(v))) for v in self._recorded(place))

    def meter_noise(self, place: Place, step: float) -> float:
        """Standard deviation of the noise that a meter has put on that command, 0 where it was
        recorded as it was sent: then its noise drives the rig. step : of the command's converter.
        """
        on, pieces = self.column(place), self.whole.records.pieces
        if left := max(c.meter[on].on_samples for p in pieces for c in p.commands):
            return left
        if not any(self.whole.metered(self.model)):
            return 0.0
        return max(meter_noise(v, step) for v in self._recorded(place))

    def rests(self, place: Place, width: float) -> bool:
        """Whether the command that a force is on stays within a width about 0 in any piece."""
        return any(float(np.mean(np.abs(v) < width)) > RESTS for v in self._recorded(place))

    def _recorded(self, place: Place) -> list[Float]:
        """Of each piece the command that a force is on, as its first record has it."""
        on = self.column(place)
        return [by_input(commands[0].v)[on] for commands in self.driven]

    def column(self, place: Place) -> int:
        """Which input a force is on; the first where it has one of its own."""
        if place.own_input:
            return 0
        return self.whole.wired.column(place.command(self.model.built))

    def scale(self, key: Key) -> float:
        """A parameter of the rig."""
        return {**self.model.nominal, **self.model.values(self.x)}[key]

    def commands(self, place: Place) -> list[Float]:
        """(M,) of each piece the command that a force is on, as it is held, after the dead time;
        the first one where it is on none."""
        on = self.column(place)
        if on not in self._commands:
            late = dead_time(self.whole.rig)
            each = (self._held(s.s, late) for s in self.spans)
            only = np.arange(self.whole.acting.size) == on
            self._commands[on] = [
                s.motion(only * held) for s, held in zip(self.spans, each, strict=True)
            ]
        return self._commands[on]

    def _held(self, s: Complex, late: Float | float = 0.0) -> Complex:
        """(n, m) the hold of each command, with what effects on the input do to it."""
        rig, names = self.whole.rig, [x.command for x in self.whole.wired.inputs]
        more = np.broadcast_to(late, len(rig.actuator))
        each = [hold_at(s, rig.rate_hz, rig.actuator[a].delay + more[a]) for a in self.whole.acting]
        out = np.stack(each, axis=1)
        for factor, theta, _ in self.model.passing(self.x):
            if factor.kind == "input" and factor.channel in names:
                out[:, names.index(factor.channel)] *= factor.value(s, theta)[0]
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

    def alike(self, a: Place, b: Place) -> bool:
        """Whether a force at either place does the same, with no law of the speed."""
        one, other = self.ports(a, of_speed=False), self.ports(b, of_speed=False)
        if one is None or other is None or one.y1.shape != other.y1.shape:
            return False
        pairs = [(one.y1, other.y1), *zip(one.sensors[0].T, other.sensors[0].T, strict=True)]
        norm = np.linalg.norm
        return all(bool(norm(x - y) <= ALIKE * norm(y)) for x, y in pairs)

    def _made(self, place: Place, *, of_speed: bool) -> Ports | None:
        rig, records = self.model.built, self.whole.records
        of_command = place.kind == "command"
        if of_command:
            chain = self.model.chain.with_values(self.model.values(self.x))
        else:
            values = self.model.values(self.x)
            own = [k for e in self.model.effects if e.fractional for k in e.fractional.keys]
            chain = self.model.chain_of(augmented(self.model, self.x, place))
            chain = chain.with_values({k: values[k] for k in own})
        n, on, acting, loop = len(rig.sensor), self.whole.sensor, self.whole.acting, self.whole.loop
        at = place.acts_on(rig)

        def of(s: Complex) -> tuple[Complex, Complex, Complex]:
            """Reading, lines and what a unit force moves there, on one contour."""
            G = chain.evaluate(s)
            hold = self._held(s)
            seen = sensors_at(rig.sensor, s)[:, on]
            H = G[:, on[:, None], acting] * seen[:, :, None] * hold[:, None]
            by_force = H[:, :, self.column(place)] if of_command else G[:, on, at] * seen
            if loop is not None:
                closed = loop.closed(H.reshape(len(H), -1))
                by_force = loop.around(closed, by_force[:, :, None])[:, :, 0]
            if of_command:
                return np.zeros(0, complex), by_force, np.zeros(0, complex)
            rate = s if of_speed else np.ones_like(s)
            return rate[:, None] * G[:, n, acting] * hold, by_force, rate * G[:, n, at]

        # Most pieces are as long as others, on the same contour.
        found: dict[tuple[int, complex], tuple[Complex, Complex, Complex]] = {}
        reading, sensors, back, y1 = [], [], [], []
        for span, band in zip(self.spans, records.bands, strict=True):
            s = span.s
            key = s.size, complex(s[-1])
            if key not in found:
                found[key] = of(s)
            read, seen, moves = found[key]
            sensors.append(seen)
            if not of_command:
                reading.append(read)
                back.append(moves)
                inside = (s.imag >= 2 * np.pi * band[0]) & (s.imag <= 2 * np.pi * band[1])
                y1.append(np.abs(moves[inside]))
        if of_command:
            return Ports([], sensors, [], np.zeros(0))
        moved = np.concatenate(y1)
        drives = max(float(np.max(np.abs(r))) for r in reading) > 0
        useful = drives and bool(np.all(moved > 0) and np.all(np.isfinite(moved)))
        return Ports(reading, sensors, back, moved) if useful else None
