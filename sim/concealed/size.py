"""How large an effect is in the noise of its own runs, in sigma, before it is made.

Sigma is the root of the least chi-square of the refitted nominal model against the noise-free
truth. Here the refit is linear (a Jacobian of the plant itself, priors as the rig file's
tolerances) and laws are linearised by describing functions: good enough to draw effects evenly
from 1 to 1000 sigma. The score takes sizes from the noise-free responses that a truth holds.
"""

from __future__ import annotations

import copy
import math
from dataclasses import dataclass

import numpy as np

from samii_rig.rig.schema import Rig
from samii_rig.rig.schema.elements import parameters
from samii_rig.signal.excitation import schedule_factor
from samii_rig.types import Complex, Float
from sim.concealed.assemble import assemble
from sim.concealed.measure import Errors
from sim.concealed.modes import Poles, filter_response, state_space
from sim.concealed.parts import Description, Law
from sim.concealed.runs import SCHEDULE, Design, burst

LINES = 150  # frequencies that stand for all estimated ones
# Relative step of the Jacobian, to both sides. The matrices' change acts on motions that are not
# re-solved for it: nodes moved along a stiff beam of another length bend it by the step, and that
# energy, the step squared times what one short element resists, is far more than the slope. It
# cancels between both sides; the cubic rest wants a small step, rounding a larger one.
STEP = 3e-5
SWEEPS = 30  # fixed-point sweeps for an amplitude that depends on itself


def tangent(plant: Description, rig: Rig, f: Float) -> tuple[Float, Complex]:
    """Tolerances (n_par,) and dH (n_par, n_freq, q) by relative change of each parameter to which
    `rig` gives a tolerance, at the plant's own values.

    From (s - A) x = B u and y = C x + D u, with its adjoint; hold, filters and delays as factors.
    q = m d: for each sensor the drives side by side.
    """
    s = np.asarray(2j * np.pi * f, np.complex128)
    structure = assemble(plant)
    system = state_space(plant, structure)
    inverse = np.linalg.inv(s[:, None, None] * np.eye(system.A.shape[0]) - system.A)
    m, d = len(plant.sensors), len(plant.drives)
    x = inverse @ system.B[:, :d]
    y = np.einsum("oi,fij->foj", system.C[:m], inverse)
    hold = np.sinc(f / plant.rate_hz)
    late = np.array([drive.delay + 0.5 / plant.rate_hz for drive in plant.drives])
    lag = np.exp(-s[:, None] * late) * hold[:, None]
    filters = [filter_response(p, s) * np.exp(-s * p.delay) for p in plant.sensors]
    chain = np.stack(filters, axis=1)[:, :, None] * lag[:, None, :]
    tolerance, rows = [], []
    for element in rig.element:
        for symbol, parameter in parameters(element).items():
            if parameter.tolerance <= 0:
                continue
            both = [changed(plant, element.name, symbol, 1 + by) for by in (STEP, -STEP)]
            up, down = (state_space(other, assemble(other, structure)) for other in both)
            dx = (up.A - down.A) @ x + (up.B - down.B)[:, :d]
            change = y @ dx + (up.C - down.C)[:m] @ x + (up.D - down.D)[:m, :d]
            tolerance.append(parameter.tolerance)
            rows.append((change * chain / (2 * STEP)).reshape(f.size, -1))
    return np.array(tolerance), np.array(rows)


def changed(plant: Description, name: str, symbol: str, ratio: float) -> Description:
    """A copy of a plant with one parameter of the rig file's element `name` times a ratio."""
    other = copy.deepcopy(plant)
    other.set_value(name, symbol, other.value(name, symbol) * ratio)
    return other


@dataclass(frozen=True)
class Yardstick:
    """Measures responses in sigma.

    f : (n_freq,) Hz. amplitude : (n_level, n_freq, d) of v at each level and line, of each drive
    where it is the one that is driven. white : (n_level, n_freq, q, q) rows that make an error dH
    of unit variance; q = m d, for each sensor the drives side by side.
    tolerance, dH : of `tangent`.
    """

    f: Float
    amplitude: Float
    white: Complex
    tolerance: Float
    dH: Complex

    def __call__(self, change: Complex) -> float:
        """Sigma of a change (n_level, n_freq, q) of the response, the nominal refitted."""
        r = np.einsum("lfab,lfb->lfa", self.white, change).ravel()
        J = np.einsum("lfab,pfb->lfap", self.white, self.dH).reshape(r.size, -1)
        J = np.concatenate([J.real, J.imag]) * self.tolerance
        y = np.concatenate([r.real, r.imag])
        normal = J.T @ J + np.eye(J.shape[1])
        best = np.linalg.solve(normal, J.T @ y)
        return math.sqrt(max(float(y @ y - (J.T @ y) @ best), 0.0))


def lines_of(design: Design) -> Float:
    """Frequencies that stand for the estimated ones: those are evenly spaced."""
    return np.linspace(design.low_hz, design.high_hz, LINES)


def yardstick(
    rig: Rig, design: Design, plant: Description, poles: Poles, errors: Errors
) -> Yardstick:
    """From the noise that the runs will have: sensors and disturbance, over settled repeats.

    rig : the nominal one, whose tolerances count. plant, poles : it at the drawn values.
    """
    f = lines_of(design)
    tolerance, dH = tangent(plant, rig, f)
    wave = burst(design, rig.rate_hz)
    n = wave.size
    at = np.fft.rfftfreq(n, 1 / rig.rate_hz)
    R = np.interp(f, at, np.abs(np.fft.rfft(wave)))
    back = returned(rig, poles, f)
    step = np.array([s.resolution for s in rig.sensor])
    Ce = n * in_turn(open_noise(poles, errors, step, f), back)
    repeats = max(design.bursts - 1, 1)
    each = (design.high_hz - design.low_hz) * n / rig.rate_hz / LINES
    levels = np.array(design.levels)
    V = levels[:, None] * R
    CH = Ce[None] / (repeats * V[:, :, None, None] ** 2)
    white = np.asarray(np.linalg.inv(np.linalg.cholesky(CH)) * math.sqrt(2 * each), np.complex128)
    S = np.abs(np.diagonal(np.linalg.inv(back), axis1=1, axis2=2))
    return Yardstick(f, levels[:, None, None] * factor(f)[:, None] * S, white, tolerance, dH)


def factor(f: Float) -> Float:
    """The schedule over frequency."""
    return schedule_factor(f, SCHEDULE, "logarithmic")


def returned(rig: Rig, poles: Poles, f: Float) -> Complex:
    """(n_freq, d, d) return difference 1 + F H of the loops, so that v = (1 + F H)^-1 u."""
    names, loops = [s.name for s in rig.sensor], [rig.centring_of(a.name) for a in rig.actuator]
    F = np.zeros((len(loops), len(names)))
    for row, loop in zip(F, loops, strict=True):
        if loop is not None:
            row[names.index(loop.sensor)] = loop.kp
    H = poles.response(f).reshape(f.size, len(names), len(loops))
    return np.asarray(np.eye(len(loops)) + F @ H)


def in_turn(noise: Complex, back: Complex) -> Complex:
    """(n_freq, q, q) power of the noise of a response from inputs in turn with reference 1.

    dH = E V^-1 with V = (1 + F H)^-1. noise : (n_freq, m, m), of the open loop in each experiment.
    back : 1 + F H. q = m d, for each sensor the drives side by side.
    """
    own = np.einsum("fej,fek->fjk", back, back.conj())
    both = np.einsum("fab,fjk->fajbk", noise, own)
    q = noise.shape[1] * back.shape[1]
    return np.asarray(both.reshape(len(noise), q, q))


def open_noise(poles: Poles, errors: Errors, step: Float, f: Float) -> Complex:
    """(n_freq, m, m) power of the open loop's noise, a sample: of E dY dY^H over n."""
    G = poles.sampled(f, poles.push)
    pushed = errors.push**2 * G[:, :, None] * G[:, None, :].conj()
    return np.asarray(pushed + np.diag(errors.white**2 + step**2 / 12))


def response_change(yard: Yardstick, true: Poles, nominal: Complex, plant: Description) -> Complex:
    """(n_level, n_freq, q) of the truth's response, its laws linearised, less the nominal's."""
    m, d, levels = true.delay.size, true.push, len(yard.amplitude)
    H = np.repeat(true.response(yard.f)[None], levels, axis=0).reshape(levels, yard.f.size, m, d)
    s = np.asarray(2j * np.pi * yard.f, np.complex128)
    G = true.continuous(s)
    for k, drive in enumerate(plant.drives):
        A = yard.amplitude[:, :, k]
        if drive.deadband > 0 or drive.limit < math.inf:
            cut = _clip(A, drive.limit) * (1 - _clip(A, drive.deadband / 2))
            H[..., k] *= cut[:, :, None]
        late = np.exp(-s * true.input_delay[k])[:, None]
        for j, law in enumerate(plant.laws):
            probe, force = m + 2 * j, d + 1 + j
            to, own = G[:, probe, k], G[:, probe, force]
            N = np.zeros(A.shape, complex)
            size = A * np.abs(to)
            for _ in range(SWEEPS):
                size = np.sqrt(size * np.abs(A * to / (1 - own * N)))
                N = describing(law, size, A, s)
            share = to * N / (1 - own * N)
            H[..., k] += share[:, :, None] * G[:, :m, force] * late
    return np.asarray(H.reshape(levels, yard.f.size, m * d) - nominal)


def describing(law: Law, a: Float, v: Float, s: Complex) -> Complex:
    """Complex gain from the first probe, of amplitude a, to the law's force.

    v : amplitude of the command. s : (n_freq,) 1/s.
    """
    q = law.values
    a = np.maximum(a, 1e-30)
    match law.kind:
        case "coulomb":
            return np.asarray(-1j * 4 * q[0] / (np.pi * a))
        case "drive_friction":
            return np.asarray(-4 * q[0] / (np.pi * a) + 0j)
        case "cubic":
            return np.asarray(-0.75 * q[0] * a**2 + 0j)
        case "backlash":
            return np.asarray(q[1] * _clip(a, q[0] / 2) + 0j)
        case "drift":
            return np.asarray(np.full(a.shape, -0.7 * q[0] * q[1], complex))
        case "slip":
            pairs = zip(q[::2], q[1::2], strict=True)
            return np.asarray(-sum(k * _slip(a * k / T) for k, T in pairs))
        case "drag":
            return np.asarray(-8 / (3 * np.pi) * q[0] * a * np.abs(s) * s)
        case "one_sided":
            return np.asarray(np.full(a.shape, -q[0] / 2, complex))
        case "stop":
            beyond = 1 - _clip(a, q[1])
            return np.asarray(-q[0] * (q[2] + q[3]) / 2 * beyond + 0j)
        case "flow_saturation":
            return np.asarray(0.42 * v / q[0] + 0j)
    raise ValueError(law.kind)


def _clip(a: Float, limit: float) -> Float:
    """Describing function of clipping at +-limit, 1 below it."""
    if limit <= 0:
        return np.zeros_like(a)
    r = np.minimum(limit / np.maximum(a, 1e-30), 1.0)
    return np.asarray(2 / np.pi * (np.arcsin(r) + r * np.sqrt(1 - r**2)))


def _slip(a: Float) -> Complex:
    """Describing function of a unit spring that slips at unit force."""
    a = np.maximum(a, 1.0)
    beta = np.arccos(np.clip(1 - 2 / a, -1, 1))
    real = (beta - 0.5 * np.sin(2 * beta)) / np.pi
    return np.asarray(real + 1j * 4 / np.pi * (a - 1) / a**2)
