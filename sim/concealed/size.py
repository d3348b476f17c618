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
    """Tolerances (n_par,) and dH (n_par, n_freq, m) by relative change of each parameter to which
    `rig` gives a tolerance, at the plant's own values.

    From (s - A) x = B u and y = C x + D u, with its adjoint; hold, filters and delays as factors.
    """
    s = np.asarray(2j * np.pi * f, np.complex128)
    structure = assemble(plant)
    system = state_space(plant, structure)
    inverse = np.linalg.inv(s[:, None, None] * np.eye(system.A.shape[0]) - system.A)
    m = len(plant.sensors)
    x = inverse @ system.B[:, 0]
    y = np.einsum("oi,fij->foj", system.C[:m], inverse)
    lag = np.exp(-s * (plant.drive.delay + 0.5 / plant.rate_hz)) * np.sinc(f / plant.rate_hz)
    filters = [filter_response(p, s) * np.exp(-s * p.delay) * lag for p in plant.sensors]
    chain = np.stack(filters, axis=1)
    tolerance, rows = [], []
    for element in rig.element:
        for symbol, parameter in parameters(element).items():
            if parameter.tolerance <= 0:
                continue
            both = [changed(plant, element.name, symbol, 1 + by) for by in (STEP, -STEP)]
            up, down = (state_space(other, assemble(other, structure)) for other in both)
            dx = x @ (up.A - down.A).T + (up.B - down.B)[:, 0]
            change = np.einsum("foj,fj->fo", y, dx) + x @ (up.C - down.C)[:m].T
            change += (up.D - down.D)[:m, 0]
            tolerance.append(parameter.tolerance)
            rows.append(change * chain / (2 * STEP))
    return np.array(tolerance), np.array(rows)


def changed(plant: Description, name: str, symbol: str, ratio: float) -> Description:
    """A copy of a plant with one parameter of the rig file's element `name` times a ratio."""
    other = copy.deepcopy(plant)
    if name == plant.drive.element:
        setattr(other.drive, symbol, getattr(other.drive, symbol) * ratio)
    else:
        other.part(name).values[symbol] *= ratio
    return other


@dataclass(frozen=True)
class Yardstick:
    """Measures responses in sigma.

    f : (n_freq,) Hz. level : (n_level, n_freq) amplitude of v at each level and line.
    white : (n_level, n_freq, m, m) rows that make an error dH of unit variance.
    tolerance, dH : of `tangent`.
    """

    f: Float
    amplitude: Float
    white: Complex
    tolerance: Float
    dH: Complex

    def __call__(self, change: Complex) -> float:
        """Sigma of a change (n_level, n_freq, m) of the response, the nominal refitted."""
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
    H = poles.sampled(f)
    kp, i = loop_gain(rig)
    S = np.abs(1 / (1 + kp * H[:, i]))
    step = np.array([s.resolution for s in rig.sensor])
    Ce = n * open_noise(poles, errors, step, f)
    repeats = max(design.bursts - 1, 1)
    each = (design.high_hz - design.low_hz) * n / rig.rate_hz / LINES
    levels = np.array(design.levels)
    V = levels[:, None] * R * S
    CH = Ce[None] / (repeats * V[:, :, None, None] ** 2)
    white = np.asarray(np.linalg.inv(np.linalg.cholesky(CH)) * math.sqrt(2 * each), np.complex128)
    return Yardstick(f, levels[:, None] * factor(f) * S, white, tolerance, dH)


def factor(f: Float) -> Float:
    """The schedule over frequency."""
    return schedule_factor(f, SCHEDULE, "logarithmic")


def loop_gain(rig: Rig) -> tuple[float, int]:
    """kp and the index of the sensor that centres."""
    if rig.centring is None:
        return 0.0, 0
    return rig.centring.kp, [s.name for s in rig.sensor].index(rig.centring.sensor)


def open_noise(poles: Poles, errors: Errors, step: Float, f: Float) -> Complex:
    """(n_freq, m, m) power of the open loop's noise, a sample: of E dY dY^H over n."""
    G = poles.sampled(f, 1)
    pushed = errors.push**2 * G[:, :, None] * G[:, None, :].conj()
    return np.asarray(pushed + np.diag(errors.white**2 + step**2 / 12))


def response_change(yard: Yardstick, true: Poles, nominal: Complex, plant: Description) -> Complex:
    """(n_level, n_freq, m) of the truth's response, its laws linearised, less the nominal's."""
    H = np.repeat(true.sampled(yard.f)[None], yard.amplitude.shape[0], axis=0)
    A = yard.amplitude
    drive = plant.drive
    if drive.deadband > 0 or drive.limit < math.inf:
        H = H * (_clip(A, drive.limit) * (1 - _clip(A, drive.deadband / 2)))[:, :, None]
    s = np.asarray(2j * np.pi * yard.f, np.complex128)
    G = true.continuous(s)
    m = true.delay.size
    for j, law in enumerate(plant.laws):
        probe = m + 2 * j
        to, own = G[:, probe, 0], G[:, probe, 2 + j]
        N = np.zeros(A.shape, complex)
        size = A * np.abs(to)
        for _ in range(SWEEPS):
            size = np.sqrt(size * np.abs(A * to / (1 - own * N)))
            N = describing(law, size, A, s)
        share = to * N / (1 - own * N)
        H = H + share[:, :, None] * G[:, :m, 2 + j] * np.exp(-s * true.input_delay)[:, None]
    return np.asarray(H - nominal)


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
