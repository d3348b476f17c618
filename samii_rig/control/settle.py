"""How a rig comes to rest after a step: settle time and damping from a recording, beside what
the model of its closed loop says."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

from samii_rig.errors import EstimateError
from samii_rig.model.feedback import state_space
from samii_rig.model.loops import Loops, Poles, Sampled, closed_poles, loops_of, sampled_system
from samii_rig.model.realise import realise
from samii_rig.rig.load import parse
from samii_rig.rig.schema import Acceleration, Rig
from samii_rig.types import Complex, Float, Recording

BAND = 0.05  # of the peak: settled once the signal stays inside
NOISES = 3.0  # rms of the signal at rest: below so much of it, nothing can be said
SEEN = 1e-3  # of the peak: a pole whose share falls below it at once is left out of a decay
# Poles up to this multiple of the split between modes 1 and 2 are in the decay's model.
REACH = 3.0


@dataclass(frozen=True, slots=True)
class Decay:
    """Least damped pole below the split between modes 1 and 2, as the decay shows it.

    hz, damping : |s|/2 pi and -Re s/|s|. sd : standard deviation of the damping.
    """

    hz: float
    damping: float
    sd: float


@dataclass(frozen=True, slots=True)
class Settling:
    """What the steps of one recording show of one sensor.

    time, response, predicted : (n,) s from the step, mean of all steps (those down with the
        sign turned), and the same by the model; sensor unit.
    steps : how many. measured_s, predicted_s : s until it stays within BAND of its peak.
    decay : measured, or None where nothing oscillates; expected : the model's (hz, damping).
    """

    source: str
    sensor: str
    unit: str
    feedback: tuple[str, ...]
    time: Float
    response: Float
    predicted: Float
    steps: int
    measured_s: float
    predicted_s: float
    decay: Decay | None
    expected: tuple[float, float]


def settling(recording: Recording, sensor: str) -> Settling:
    """Settle time and damping from the steps of a recording, with its own rig's model.

    EstimateError if it carries no rig, no steps of its reference or no such sensor, or if it
    was not at rest when a step came.
    """
    where = recording.source or "recording"
    if not recording.rig_toml:
        raise EstimateError(f"{where} carries no rig file; expected one that samii-rig ran")
    rig = parse(Rig, recording.rig_toml, f"{where}: its rig file")
    known = [s.name for s in rig.sensor if isinstance(s, Acceleration)]
    if sensor not in known or sensor not in recording.names("sensor"):
        raise EstimateError(
            f"{where} has no accelerometer {sensor}; expected one of {', '.join(known)} "
            "(an angle does not come back to where it was)"
        )
    loops = loops_of(rig)
    reference, edges = _steps(recording, rig, loops, where)
    n = min(b - a for a, b in zip(edges, [*edges[1:], len(reference)], strict=True))
    y = recording.values_of(sensor)
    sizes = np.array([reference[e] - reference[e - 1] for e in edges])
    rows = np.array([y[e : e + n] * np.sign(size) for e, size in zip(edges, sizes, strict=True)])
    mean = np.nanmean(rows, axis=0)
    made = realise(rig)
    system = sampled_system(rig, made, loops.actuator)
    drive = np.full(n, np.mean(np.abs(sizes)))
    column = [s.name for s in rig.sensor].index(sensor)
    predicted = simulate(system, loops, drive)[:, column]
    poles = closed_poles(system, loops)
    pairs = made.structure.poles[made.structure.poles.imag > 0]
    split = float(np.sqrt(np.abs(pairs[0] * pairs[1]))) if pairs.size > 1 else math.inf
    noise = rig.sensor[column].noise_rms / math.sqrt(len(edges))
    if np.max(np.abs(mean)) * BAND < NOISES * noise:
        raise EstimateError(
            f"{where}: the steps move {sensor} by {np.max(np.abs(mean)):.3g} "
            f"{rig.sensor[column].unit}, too little over its noise; expected larger steps"
        )
    time = np.arange(n) / rig.rate_hz
    low = poles.oscillating(split)
    least = low[np.argmin(-low.real / np.abs(low))] if low.size else None
    return Settling(
        where,
        sensor,
        rig.sensor[column].unit,
        tuple(f.name for _, f in loops.feedback),
        time,
        mean,
        predicted,
        len(edges),
        settle_time(time, mean),
        settle_time(time, predicted),
        None if least is None else _measured(time, mean, poles, least, split),
        (math.nan, 1.0)
        if least is None
        else (float(abs(least) / (2 * np.pi)), float(-least.real / abs(least))),
    )


def settle_time(time: Float, y: Float) -> float:
    """Time after which |y| stays within BAND of its largest value; inf if it does not in the
    record."""
    beyond = np.flatnonzero(np.abs(y) > BAND * np.max(np.abs(y)))
    last = int(beyond[-1])
    return float(time[last + 1]) if last + 1 < time.size else math.inf


def simulate(system: Sampled, loops: Loops, reference: Float) -> Float:
    """Sensors (n, n_sensor) from rest with the loops closed, for the reference (n,), which is
    u + kp theta_ref. No output is clipped."""
    filters = [(i, *state_space(f, system.rate_hz)) for i, f in loops.feedback]
    states = [np.zeros((len(a), 1)) for _, a, *_ in filters]
    x = np.zeros((len(system.A), 1))
    out = np.empty((reference.size, len(system.C)))
    for k, r in enumerate(reference):
        y = system.C @ x
        out[k] = y[:, 0]
        v = r - loops.kp * y[loops.theta, 0]
        for j, (i, a, b, c, d) in enumerate(filters):
            v += (c @ states[j] + d * y[i])[0, 0]
            states[j] = a @ states[j] + b * y[i]
        x = system.A @ x + system.B * v
    return out


def _steps(recording: Recording, rig: Rig, loops: Loops, where: str) -> tuple[Float, list[int]]:
    """u + kp theta_ref, and the samples at which it steps."""
    total = np.zeros(len(recording))
    for name in recording.names("reference"):
        column = recording.column(name)
        own = recording.channels[column].unit == rig.actuator[loops.actuator].unit
        total += recording.values[:, column] * (1.0 if own else loops.kp)
    jumps = np.abs(np.diff(total))
    edges = np.flatnonzero(jumps > 0) + 1
    level = jumps.max(initial=0.0)
    if edges.size == 0 or np.any(jumps[edges - 1] < 0.5 * level):
        raise EstimateError(f"{where}: the reference does not step; expected a step experiment")
    return total, [int(e) for e in edges]


def _measured(time: Float, y: Float, poles: Poles, pair: complex, split: float) -> Decay:
    """`pair` fitted to the decay, all other slow poles of the closed loop as they are: two
    free pairs side by side, both well damped, would take each other's place."""
    near = poles.s[np.abs(poles.s) < REACH * split]
    begin = int(np.searchsorted(time, _faded(poles.s, near)))
    t, y = time[begin:] - time[begin], y[begin:]
    held = _basis(t, near[near != pair])

    def rest(x: Float) -> Float:
        s = np.array([-np.exp(x[0]) + 1j * np.exp(x[1])])
        basis = np.concatenate([_basis(t, s), held], axis=1)
        return np.asarray(y - basis @ np.linalg.lstsq(basis, y, rcond=None)[0])

    found = least_squares(rest, np.log([-pair.real, pair.imag]))
    variance = 2 * found.cost / (t.size - 4 - held.shape[1])
    J = np.asarray(found.jac, dtype=np.float64)
    covariance = np.linalg.pinv(J.T @ J) * variance
    decay, turning = np.exp(found.x)
    size = float(np.hypot(decay, turning))
    damping = float(decay) / size
    # damping = 1/sqrt(1 + (turning/decay)^2) depends on the difference of both logarithms.
    slope = damping * (1 - damping**2) * np.array([1.0, -1.0])
    return Decay(size / (2 * np.pi), damping, math.sqrt(float(slope @ covariance @ slope)))


def _faded(every: Complex, kept: Complex) -> float:
    """Time until the poles that are not kept have fallen by SEEN."""
    slowest = min((-p.real for p in every if p not in kept), default=math.inf)
    return -math.log(SEEN) / slowest


def _basis(t: Float, s: Complex) -> Float:
    """What each pole, and its conjugate, can add to a decay: one column or two."""
    columns = [np.exp(p.real * t) * np.cos(p.imag * t) for p in s]
    columns += [np.exp(p.real * t) * np.sin(p.imag * t) for p in s if p.imag > 0]
    return np.stack(columns, axis=1) if columns else np.zeros((t.size, 0))
