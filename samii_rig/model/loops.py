"""Feedback loops closed inside the model: the device's centring and its filters.

The device forms v = u + kp (theta_ref - theta) + sum F_i(z) y_i, in short v = r - K(z) y, from
the samples y = H(z) v. With the loops closed on one actuator, and L = K H its loop gain,

    H_cl = H (I + K H)^-1,      column of that actuator:  H / (1 + L).

H(z) is the exact sampled response (`samii_rig.model.sampled`): hold, filters, delays, aliases.
The closed loop's poles are found twice, independently: as eigenvalues of the realised rig
stepped exactly from sample to sample, and by Nyquist's count on the exact response.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.linalg import block_diag, expm

from samii_rig.errors import InputError, SamiiRigError
from samii_rig.model.feedback import analogue, digital, state_space
from samii_rig.model.realise import Realisation, realise
from samii_rig.model.sampled import as_sent, sampled_response, sensor_response
from samii_rig.model.tmm import Chain
from samii_rig.rig.schema import Feedback, Rig
from samii_rig.types import Complex, Float

FIRST = 400  # frequencies of Nyquist's count before any halving
LOWEST = 1e-6  # lowest of them over the rate: an integrator's loop gain is large there
TURN = np.pi / 6  # rad, largest step of arg(1 + L) between neighbours, and of log|1 + L|
ROUNDS = 12  # of halving
DEADBEAT = 1e-6  # |z| of a pole that is only a delay
REAL = 1e-9  # rad a sample below which a pole lies on the real axis


@dataclass(frozen=True, slots=True)
class Loops:
    """The loops that are closed on one actuator of a rig.

    actuator : its index. theta, kp : index of the centring sensor and the gain; 0 for none.
    feedback : the filters, with the index of the sensor that each reads.
    """

    actuator: int
    theta: int
    kp: float
    feedback: tuple[tuple[int, Feedback], ...]

    def gain(self, H: Complex, filters: Complex) -> Complex:
        """L (n,) = kp H_theta - sum F_i H_i from H (n, n_sensor, n_actuator) and the filters'
        values (n, n_feedback)."""
        column = H[:, :, self.actuator]
        total = self.kp * column[:, self.theta]
        for k, (i, _) in enumerate(self.feedback):
            total = total - filters[:, k] * column[:, i]
        return np.asarray(total)

    def filters(self, z: Complex, rate_hz: float) -> Complex:
        """Values (n, n_feedback) of the digital filters."""
        columns = [digital(f, z, rate_hz) for _, f in self.feedback]
        return np.stack(columns, axis=1) if columns else np.zeros((z.size, 0), complex)


def loops_of(rig: Rig, actuator: str | None = None, kp: float | None = None) -> Loops:
    """The loops of a rig file on `actuator` (its first by default).

    kp : of the centring loop on that actuator; the rig file's by default.

    Raises InputError for an unknown actuator.
    """
    names = [a.name for a in rig.actuator]
    actuator = names[0] if actuator is None else actuator
    if actuator not in names:
        raise InputError(rig.name, "actuator", actuator, f"one of {', '.join(names)}")
    sensors = [s.name for s in rig.sensor]
    centring = rig.centring_of(actuator)
    own = centring.kp if centring else 0.0
    return Loops(
        names.index(actuator),
        sensors.index(centring.sensor) if centring else 0,
        own if kp is None else kp,
        tuple((sensors.index(f.sensor), f) for f in rig.feedback if f.actuator == actuator),
    )


def loop_gain(
    rig: Rig, frequency_hz: Float, loops: Loops | None = None, chain: Chain | None = None
) -> Complex:
    """L (n_freq,) of the sampled loops, cut at the actuator; the closed loop is stable as
    long as L keeps away from -1 (negative feedback)."""
    loops = loops_of(rig) if loops is None else loops
    f = np.asarray(frequency_hz, dtype=np.float64)
    H = sampled_response(as_sent(rig), f, chain)
    return loops.gain(H, loops.filters(_z(rig, f), rig.rate_hz))


def closed_response(
    rig: Rig, frequency_hz: Float, loops: Loops | None = None, chain: Chain | None = None
) -> Complex:
    """Sampled response (n_freq, n_sensor, n_actuator) from the references u to the sensors
    with the loops closed; the columns of other actuators with their own loops open."""
    loops = loops_of(rig) if loops is None else loops
    f = np.asarray(frequency_hz, dtype=np.float64)
    H = sampled_response(as_sent(rig), f, chain)
    return _close(H, loops, loops.filters(_z(rig, f), rig.rate_hz))


def continuous_closed_response(
    rig: Rig, frequency_hz: Float, loops: Loops | None = None, chain: Chain | None = None
) -> Complex:
    """(n_freq, n_sensor, n_actuator) at frequency_hz (n_freq,), as `closed_response` without
    sampling: the chain, the sensors' filters and delays, F(s), no hold."""
    loops = loops_of(rig) if loops is None else loops
    f = np.asarray(frequency_hz, dtype=np.float64)
    G = (Chain(rig) if chain is None else chain).response(f)
    G = G * sensor_response(rig.sensor, f)[:, :, None]
    s = np.asarray(2j * np.pi * f, dtype=np.complex128)
    G = G * np.exp(-np.outer(s, [a.delay for a in rig.actuator]))[:, None, :]
    columns = [analogue(x, s) for _, x in loops.feedback]
    F = np.stack(columns, axis=1) if columns else np.zeros((f.size, 0), complex)
    return _close(G, loops, F)


def _close(H: Complex, loops: Loops, filters: Complex) -> Complex:
    row = np.zeros_like(H[:, 0, :])  # K H, one row: what each input sends back
    row += loops.kp * H[:, loops.theta, :]
    for k, (i, _) in enumerate(loops.feedback):
        row -= filters[:, k, None] * H[:, i, :]
    back = row / (1.0 + row[:, loops.actuator, None])
    return np.asarray(H - H[:, :, loops.actuator, None] * back[:, None, :])


def _z(rig: Rig, f: Float) -> Complex:
    return np.asarray(np.exp(2j * np.pi * f / rig.rate_hz), dtype=np.complex128)


@dataclass(frozen=True, slots=True)
class Sampled:
    """One actuator's column of a rig as x[n+1] = A x[n] + B v[n], y[n] = C x[n].

    There is no direct term: the sensors are read just before the output changes.
    """

    A: Float
    B: Float
    C: Float
    rate_hz: float

    def response(self, frequency_hz: Float) -> Complex:
        """(n_freq, n_sensor)."""
        z = np.exp(2j * np.pi * np.asarray(frequency_hz) / self.rate_hz)
        at = z[:, None, None] * np.eye(len(self.A)) - self.A
        B = np.broadcast_to(self.B.astype(complex), (z.size, *self.B.shape))
        return np.asarray((self.C @ np.linalg.solve(at, B))[:, :, 0])


def sampled_system(rig: Rig, made: Realisation, actuator: int = 0) -> Sampled:
    """The realised rig stepped exactly over one sample, delays of any length included.

    A sensor whose delay and that of the output make tau = m T - e (0 <= e < T) reads what the
    chain, without delay, shows e after the sample m before.
    """
    A, B, C, D = made.state_space()
    size = len(A) // B.shape[1]
    own = slice(actuator * size, (actuator + 1) * size)
    A, B, C, D = A[own, own], B[own, actuator, None], C[:, own], D[:, actuator]
    T = 1.0 / rig.rate_hz
    step, push = _held(A, B, T)
    n = size + 1  # the last one holds v[n-1]
    blocks = [np.block([[step, np.zeros((size, 1))], [np.zeros((1, n))]])]
    into = [np.concatenate([push, [[1.0]]])]
    rows: list[tuple[Float, int]] = []  # a sensor's row of x, or the place of its last delay
    feed = []  # (place of the line's first state, what it takes in from x, from v)
    for i, sensor in enumerate(rig.sensor):
        tau = rig.actuator[actuator].delay + sensor.delay
        m = math.ceil(tau / T - 1e-9)
        ahead = m * T - tau
        c, d = np.zeros(n), 0.0
        if ahead > 1e-9 * T:
            carried, pushed = _held(A, B, ahead)
            c[:size], d = C[i] @ carried, float(C[i] @ pushed[:, 0] + D[i])
        else:
            c[:size], c[size] = C[i], D[i]
        if m == 0:
            rows.append((c, -1))
            continue
        feed.append((sum(len(b) for b in blocks), c, d))
        blocks.append(np.eye(m, k=-1))
        into.append(np.zeros((m, 1)))
        rows.append((c, sum(len(b) for b in blocks) - 1))
    whole, column = block_diag(*blocks), np.concatenate(into)
    for place, c, d in feed:
        whole[place, :n] = c
        column[place] = d
    out = np.zeros((len(rows), len(whole)))
    for i, (c, last) in enumerate(rows):
        if last < 0:
            out[i, :n] = c
        else:
            out[i, last] = 1.0
    return Sampled(whole, column, out, rig.rate_hz)


def _held(A: Float, B: Float, t: float) -> tuple[Float, Float]:
    """State after t and what a held unit input adds in that time."""
    n = len(A)
    M = np.zeros((n + 1, n + 1))
    M[:n, :n], M[:n, n:] = A * t, B * t
    E = expm(M)
    return E[:n, :n], E[:n, n:]


@dataclass(frozen=True, slots=True)
class Poles:
    """Poles of a closed loop.

    z : (n,) all of them. s : (m,) rad/s with Im >= 0, by modulus, delays left out; one above
    the real axis stands for its conjugate as well.
    """

    z: Complex
    s: Complex

    @property
    def outside(self) -> int:
        """How many do not decay: |z| at least 1."""
        return int(np.sum(np.abs(self.z) >= 1.0))

    @property
    def damping(self) -> Float:
        """(m,) -Re s/|s|."""
        return np.asarray(-self.s.real / np.abs(self.s))

    def oscillating(self, below: float) -> Complex:
        """The pairs of modulus below `below`, rad/s."""
        return self.s[(self.s.imag > 0) & (np.abs(self.s) < below)]


def closed_poles(system: Sampled, loops: Loops) -> Poles:
    """Eigenvalues of the sampled rig with its loops closed, and of its filters with it."""
    A, B, C = system.A, system.B, system.C
    K = -loops.kp * C[loops.theta]
    forward, back, own = [], [], []
    for i, loop in loops.feedback:
        a, b, c, d = state_space(loop, system.rate_hz)
        K = K + d[0, 0] * C[i]
        forward.append(B @ c)
        back.append(b @ C[i : i + 1])
        own.append(a)
    whole = A + B @ K[None, :]
    if own:
        whole = np.block(
            [[whole, np.concatenate(forward, axis=1)], [np.concatenate(back), block_diag(*own)]]
        )
    z = np.linalg.eigvals(whole).astype(np.complex128)
    real = z[np.abs(z) > DEADBEAT]
    real = real[np.angle(real) >= -REAL]
    s = np.log(real) * system.rate_hz
    s = np.where(np.abs(np.angle(real)) <= REAL, s.real, s)
    return Poles(z, np.asarray(s[np.argsort(np.abs(s))], dtype=np.complex128))


def closed_loop_poles(rig: Rig, loops: Loops | None = None, band_hz: float | None = None) -> Poles:
    """The same from a rig file. band_hz : of the realisation, see `realise`."""
    loops = loops_of(rig) if loops is None else loops
    return closed_poles(sampled_system(rig, realise(rig, band_hz), loops.actuator), loops)


def unstable_count(rig: Rig, loops: Loops | None = None) -> int:
    """Closed-loop poles outside the unit circle by Nyquist's count on the exact response.

    L itself has none there (the filters are stable, the chain is) but perhaps the source's
    integrator at z = 1, which is passed outside. 1 + L is 1 far out, so each turn of 1 + L
    around 0, as z runs along the circle, is a pole of the closed loop.

    Raises SamiiRigError if the count is no whole number.
    """
    loops = loops_of(rig) if loops is None else loops
    chain = Chain(rig)

    def difference(f: Float) -> Complex:
        return 1.0 + loop_gain(rig, f, loops, chain)

    half = rig.rate_hz / 2
    f = np.geomspace(LOWEST * rig.rate_hz, half * (1 - 1e-9), FIRST)
    f, D = refined(difference, f)
    turns = float(-np.unwrap(np.angle(D))[-1] / np.pi)
    if abs(turns - round(turns)) > 0.1:
        raise SamiiRigError(f"Nyquist's count came to {turns:.3g} turns, which is no whole number")
    return round(turns)


def refined(function: Callable[[Float], Complex], f: Float) -> tuple[Float, Complex]:
    """Frequencies (m,) and the function's values there, (m,): increasing f (n,), Hz, with intervals
    halved until its logarithm moves by less than `TURN` in each."""
    value = function(f)
    for _ in range(ROUNDS):
        step = np.log(value[1:] / value[:-1])
        wide = np.flatnonzero(np.maximum(np.abs(step.real), np.abs(step.imag)) > TURN)
        if wide.size == 0:
            break
        middle = np.sqrt(f[wide] * f[wide + 1])
        f = np.insert(f, wide + 1, middle)
        value = np.insert(value, wide + 1, function(middle))
    return f, value
