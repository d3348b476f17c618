"""The linear plant as poles: from the matrices to x' = lambda x + b u, y = sum(c x) + D u.

The poles are the eigenvalues of the finite element plant with its drive, relaxing springs and
sensor filters. What is faster than the converters can see is kept as its static part.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from samii_rig.errors import InputError
from samii_rig.types import Complex, Float, Int
from sim.concealed.assemble import Structure, assemble
from sim.concealed.parts import GRAVITY, Description, Drive, Law, SensorPath

# Poles above this multiple of the sample rate act at once. Their static part stays; what is
# lost at 50 Hz and 500 samples/s is (50/1500)^2 of it.
FASTEST = 3.0
# A pole that adds less than this part of the others' sum to any output is left out.
NEGLIGIBLE = 1e-8
CHECKED_HZ = (0.7, 7.0, 70.0)  # where the poles are held against a direct solution,
ABOUT = 150.0  # 1/s, in the band but to the right of all poles
ACCURATE = 1e-5  # and how well they must agree
DRIVE_LAWS = ("drive_friction", "flow_saturation")


@dataclass(frozen=True)
class Poles:
    """The plant as n poles. Inputs: v of each drive, the disturbing force, then one a law.
    Outputs: the sensors as they reach the converter, then two probes a law.

    pole : (n,). b : (n, n_in). c : (n_out, n), weighted so that y = Re(c x) + D u.
    D : (n_out, n_in). delay : (n_sensor,) s, of the sensors. input_delay : (n_drive,) s, of v.
    """

    pole: Complex
    b: Complex
    c: Complex
    D: Float
    delay: Float
    input_delay: Float
    rate_hz: float

    @property
    def push(self) -> int:
        """The disturbing force among the inputs."""
        return self.input_delay.size

    def response(self, frequency_hz: Float) -> Complex:
        """(n_freq, n_sensor n_drive) of each sensor to each drive: the drives side by side."""
        each = [self.sampled(frequency_hz, k) for k in range(self.push)]
        return np.stack(each, axis=2).reshape(len(each[0]), -1)

    def sampled(self, frequency_hz: Float, source: int = 0) -> Complex:
        """Response of the sampled sensors to an input held for each sample, (n_freq, n_sensor).

        For a total delay k T + r of a pole with residue R, with phi(t) = (exp(p t) - 1)/p:
        H = z^-(k+1) R (phi(T - r) + phi(T) exp(p (T - r)) z^-1/(1 - exp(p T) z^-1)).
        The samples are taken just before the input changes.
        """
        T = 1.0 / self.rate_hz
        z = np.exp(-2j * np.pi * np.asarray(frequency_hz) * T)  # one sample later
        z = np.concatenate([z, z.conj()])  # the real part, half from each side of the axis
        out = np.zeros((z.size, self.delay.size), dtype=np.complex128)
        start = float(self.input_delay[source]) if source < self.push else 0.0
        p = self.pole
        for i, own in enumerate(self.delay):
            k = math.floor((start + own) / T + 1e-9)
            rest = max(start + own - k * T, 0.0)
            first = phi(p, T - rest)
            later = phi(p, np.array(T)) * np.exp(p * (T - rest))
            R = self.c[i] * self.b[:, source]
            again = z[:, None] / (1 - np.exp(p * T) * z[:, None])
            sums = (R * first).sum() + again @ (R * later)
            out[:, i] = z ** (k + 1) * (sums + self.D[i, source])
        n = out.shape[0] // 2
        return np.asarray((out[:n] + out[n:].conj()) / 2)

    def continuous(self, s: Complex) -> Complex:
        """Transfer functions at complex s, (n, n_out, n_in), without the pure delays."""
        s = np.asarray(s, dtype=np.complex128)
        one = np.einsum("ok,ki,sk->soi", self.c, self.b, 1 / (s[:, None] - self.pole))
        two = np.einsum("ok,ki,sk->soi", self.c, self.b, 1 / (s.conj()[:, None] - self.pole))
        return np.asarray((one + two.conj()) / 2 + self.D)


def phi(p: Complex, t: float | Float) -> Complex:
    """(exp(p t) - 1)/p, t where p = 0."""
    safe = np.where(p == 0, 1.0, p)
    return np.asarray(np.where(p == 0, t, np.expm1(safe * t) / safe))


@dataclass(frozen=True)
class StateSpace:
    """x' = A x + B u, y = C x + D u; the sensors before their filters, then the probes."""

    A: Float
    B: Float
    C: Float
    D: Float


def state_space(plant: Description, structure: Structure | None = None) -> StateSpace:
    """First-order form: x = [q, q', relaxations, then phi, phi' and the filters of each drive], phi
    a source's angle."""
    s = assemble(plant) if structure is None else structure
    n, d = s.M.shape[0], np.array([s.driven[drive.element] for drive in plant.drives])
    free = np.delete(np.arange(n), d)
    nf, nz = free.size, len(s.relaxations)
    wide = [2 + len(drive.lags) + 2 * len(drive.valves) for drive in plant.drives]
    start = 2 * nf + nz + np.concatenate([[0], np.cumsum(wide)])
    size, phis = int(start[-1]), start[:-1]
    push = len(plant.drives)
    inputs = push + 1 + len(plant.laws)
    # Rows of q and q' of all coordinates, in the state.
    Q, Qd = np.zeros((n, size)), np.zeros((n, size))
    Q[free, np.arange(nf)] = 1.0
    Qd[free, nf + np.arange(nf)] = 1.0
    Q[d, phis] = Qd[d, phis + 1] = 1.0
    A, B = np.zeros((size, size)), np.zeros((size, inputs))

    force = np.zeros((n, inputs))
    force[:, push] = s.ends[plant.push][0]
    for j, law in enumerate(plant.laws):
        if law.kind not in DRIVE_LAWS:
            force[:, push + 1 + j] += _place(law, s)
    seen_by = _sources(plant, phis, A, B)
    speeds = phis + 1

    # Elastic forces, then the accelerations they leave.
    elastic = s.C @ Qd + s.K @ Q
    for i, r in enumerate(s.relaxations):
        z = 2 * nf + i
        elastic[:, z] += r.row * r.stiffness
        A[z] = r.row @ Qd
        A[z, z] -= r.rate
    pull = np.linalg.inv(s.M[np.ix_(free, free)])
    carried = s.M[np.ix_(free, d)]
    acc_x = -pull @ (elastic[free] + carried @ A[speeds])
    acc_u = pull @ (force[free] - carried @ B[speeds])
    A[:nf] = Qd[free]
    A[nf : 2 * nf], B[nf : 2 * nf] = acc_x, acc_u
    Ax, Au = np.zeros((n, size)), np.zeros((n, inputs))
    Ax[free], Au[free] = acc_x, acc_u
    Ax[d], Au[d] = A[speeds], B[speeds]

    C: list[Float] = []
    D: list[Float] = []
    for sensor in plant.sensors:
        x, u = _seen(sensor, s, Q, Ax, Au)
        C.append(x)
        D.append(u)
    for law in plant.laws:
        rows, feeds = _joint_probes(law, s, Q, Qd, inputs)
        if law.kind in DRIVE_LAWS:
            i = s.driven[law.site]
            moment = -(s.M[i] @ Ax + elastic[i]), -(s.M[i] @ Au - force[i])
            rows, feeds = _drive_probes(law, seen_by[law.site], moment)
        C += rows
        D += feeds
    return StateSpace(A, B, np.array(C), np.array(D))


@dataclass(frozen=True, slots=True)
class _Source:
    """Of a drive: the state that is its source's speed, and its command behind the filters as rows
    over x and over u."""

    at_speed: int
    command: tuple[Float, Float]


def _sources(plant: Description, phis: Int, A: Float, B: Float) -> dict[str, _Source]:
    """Put phi'' = p (K v - phi') of every drive into A and B, with its filters behind `phis`; by
    the element that it drives."""
    push = len(plant.drives)
    seen_by: dict[str, _Source] = {}
    for k, (drive, at_phi) in enumerate(zip(plant.drives, phis.tolist(), strict=True)):
        command = _command(drive, k, at_phi + 2, A, B)
        x_row, u_row = command[0], command[1].copy()
        for j, law in enumerate(plant.laws):
            if law.kind in DRIVE_LAWS and law.site == drive.element:
                u_row[push + 1 + j] += 1.0
        at_speed = at_phi + 1
        A[at_phi, at_speed] = 1.0
        A[at_speed] = drive.K * drive.p * x_row
        A[at_speed, at_speed] -= drive.p
        B[at_speed] = drive.K * drive.p * u_row
        seen_by[drive.element] = _Source(at_speed, command)
    return seen_by


def _command(drive: Drive, k: int, at: int, A: Float, B: Float) -> tuple[Float, Float]:
    """The command k through its drive's filters, whose states begin at `at`: rows over x and u."""
    size, inputs = B.shape
    x_row, u_row = np.zeros(size), np.zeros(inputs)
    u_row[k] = 1.0
    for lag in drive.lags:
        A[at] = x_row / lag
        A[at, at] -= 1 / lag
        B[at] = u_row / lag
        x_row, u_row = unit(size, at), np.zeros(inputs)
        at += 1
    for omega, zeta in drive.valves:
        A[at, at + 1] = 1.0
        A[at + 1] = omega**2 * x_row
        A[at + 1, at] -= omega**2
        A[at + 1, at + 1] -= 2 * zeta * omega
        B[at + 1] = omega**2 * u_row
        x_row, u_row = unit(size, at), np.zeros(inputs)
        at += 2
    return x_row, u_row


def unit(size: int, i: int) -> Float:
    """The i-th unit vector."""
    row = np.zeros(size)
    row[i] = 1.0
    return row


def _seen(sensor: SensorPath, s: Structure, Q: Float, Ax: Float, Au: Float) -> tuple[Float, Float]:
    none = np.zeros(Au.shape[1])
    match sensor.kind:
        case "relative_angle":
            row = np.zeros(Q.shape[0])
            for name in sensor.across:
                if name in s.inside:  # with what gives within it and behind it
                    row += s.ends[name][1] - s.starts[name][1]
                    continue
                for i in s.joints.get(name, ()):
                    row[i] += 1.0
            return row @ Q, none
        case "absolute_angle":
            return s.ends[sensor.across[0]][1] @ Q, none
        case "acceleration":
            w, theta = s.lateral(sensor.across[0], sensor.position)
            return w @ Ax + sensor.tilt * GRAVITY * (theta @ Q), w @ Au
    raise InputError("plant", f"sensor.{sensor.name}", sensor.kind, "an angle or acceleration")


def _joint_probes(
    law: Law, s: Structure, Q: Float, Qd: Float, inputs: int
) -> tuple[list[Float], list[Float]]:
    row = _place(law, s)
    return [row @ Q, row @ Qd], [np.zeros(inputs), np.zeros(inputs)]


def _place(law: Law, s: Structure) -> Float:
    """(n,) row of the motion that a law acts on: the angle across a joint, or a body's
    displacement."""
    if law.ground:
        return s.ends[law.site][0]
    return unit(s.M.shape[0], s.joints[law.site][-1])


def _drive_probes(
    law: Law, source: _Source, moment: tuple[Float, Float]
) -> tuple[list[Float], list[Float]]:
    if law.kind == "flow_saturation":
        return [moment[0], source.command[0]], [moment[1], source.command[1]]
    speed, none = unit(moment[0].size, source.at_speed), np.zeros(moment[1].size)
    return [speed, speed], [none, none]


def filter_poles(sensor: SensorPath) -> Complex:
    """Poles of all filters of a sensor, rad/s; they must differ."""
    found: list[complex] = []
    if sensor.butterworth:
        order, corner = sensor.butterworth
        for k in range(order):
            angle = np.pi * (2 * k + order + 1) / (2 * order)
            found.append(2 * np.pi * corner * np.exp(1j * angle))
    found += [-1.0 / lag for lag in sensor.lags]
    found += [-2 * np.pi * hz for hz in sensor.highpasses]
    return np.array(found, dtype=np.complex128)


def filter_response(sensor: SensorPath, s: Complex) -> Complex:
    """The sensor's filters and gain at complex s, without its delay."""
    s = np.asarray(s, dtype=np.complex128)
    out = np.full(s.shape, sensor.gain, dtype=np.complex128)
    passes = len(sensor.highpasses)
    poles = filter_poles(sensor)
    for q in poles[: poles.size - passes]:
        out = out * (-q / (s - q))
    for q in poles[poles.size - passes :]:
        out = out * (s / (s - q))
    return out


def _residues(sensor: SensorPath) -> Complex:
    poles = filter_poles(sensor)
    passes = len(sensor.highpasses)
    out = np.full(poles.size, sensor.gain, dtype=np.complex128)
    for i, p in enumerate(poles):
        for j, q in enumerate(poles):
            above = p if j >= poles.size - passes else -q
            out[i] *= above if j == i else above / (p - q)
    return out


def poles_of(plant: Description) -> Poles:
    """The plant, sensor filters included, as poles.

    ArithmeticError if the eigenvectors do not span the state (two poles that coincide).
    """
    system = state_space(plant)
    # Of the inverse about a point between the slow poles: eigenvalues are as accurate as the
    # largest, which should be the slow ones.
    shifted = np.linalg.inv(system.A - ABOUT * np.eye(system.A.shape[0]))
    inverse, X = np.linalg.eig(shifted)
    pole = np.asarray(ABOUT + 1 / inverse, np.complex128)
    b = np.linalg.solve(X, system.B.astype(np.complex128))
    c = system.C @ X
    for hz in CHECKED_HZ:
        s = 2j * np.pi * hz
        direct = system.C @ np.linalg.solve(s * np.eye(pole.size) - system.A, system.B)
        wrong = np.abs((c / (s - pole)) @ b - direct)
        if not np.all(wrong <= ACCURATE * np.abs(direct).max(axis=1, keepdims=True)):
            raise ArithmeticError("the poles of the concealed plant cannot be told apart")
    upper = pole.imag >= 0
    pole, b, c = pole[upper], b[upper], c[:, upper] * np.where(pole[upper].imag > 0, 2.0, 1.0)
    return _filtered(plant, pole, b, c, system.D)


def _filtered(plant: Description, pole: Complex, b: Complex, c: Complex, D: Float) -> Poles:
    """Put the sensors' filters behind the poles: both kinds of poles side by side."""
    m = len(plant.sensors)
    out_c, out_D = [c[m:]], D.copy()
    poles, inputs, rows = [pole], [b], []
    c = c.copy()
    for i, sensor in enumerate(plant.sensors):
        mu = filter_poles(sensor)
        if mu.size:
            upper = mu.imag >= -1e-9 * np.abs(mu)
            r = _residues(sensor)[upper] * np.where(mu.imag > 1e-9 * np.abs(mu), 2.0, 1.0)[upper]
            mu = mu[upper]
            G = _at(pole, b, c[i], mu) + D[i]
            poles.append(mu)
            inputs.append(G)
            rows.append((i, r))
        c[i] = c[i] * filter_response(sensor, pole)
        lowpass = sensor.butterworth is not None or bool(sensor.lags)
        out_D[i] = 0.0 if lowpass else sensor.gain * D[i]
    total = sum(p.size for p in poles)
    wide = np.zeros((c.shape[0], total), dtype=np.complex128)
    wide[:, : pole.size] = np.concatenate([c[:m], *out_c])
    at = pole.size
    for i, r in rows:
        wide[i, at : at + r.size] = r
        at += r.size
    every, into = np.concatenate(poles), np.concatenate(inputs)
    slow, static = _split(every, into, wide, FASTEST * 2 * np.pi * plant.rate_hz)
    return Poles(
        every[slow],
        into[slow],
        wide[:, slow],
        out_D + static,
        np.array([s.delay for s in plant.sensors]),
        np.array([d.delay for d in plant.drives]),
        plant.rate_hz,
    )


def _at(pole: Complex, b: Complex, c: Complex, s: Complex) -> Complex:
    """(n_s, n_in) sum of c b/(s - p) over the poles and their conjugates; c counts both."""
    near = (c / (s[:, None] - pole)) @ b
    far = (c.conj() / (s[:, None] - pole.conj())) @ b.conj()
    return np.asarray((near + far) / 2)


def _split(
    pole: Complex, b: Complex, c: Complex, fastest: float
) -> tuple[np.ndarray[tuple[int], np.dtype[np.bool_]], Float]:
    """Which poles to keep, and the static response of the others."""
    size = np.abs(c)[:, :, None] * np.abs(b)[None] / np.maximum(np.abs(pole), 1.0)[None, :, None]
    total = np.maximum(size.sum(axis=1, keepdims=True), 1e-300)
    matters = (size / total).max(axis=(0, 2)) > NEGLIGIBLE
    slow = (np.abs(pole) < fastest) & matters
    gone = ~slow & (np.abs(pole) > 1e-3)
    static = (c[:, gone] @ (-b[gone] / pole[gone, None])).real
    return slow, static
