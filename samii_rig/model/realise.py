"""A chain as a finite sum of first-order terms: poles, residues and what they leave out.

A chain has poles without end. Kept are all poles in a region of the s-plane
(`samii_rig.model.poles`), the source's own at 0 and -p, and those of the sensors' filters.
With the filters F in it, the partial fractions of the response of one sensor are

    G(s) F(s) = sum_i R_i F(p_i) / (s - p_i)  +  sum_j G(q_j) res F(q_j) / (s - q_j)  +  rest(s)

over the kept poles p_i of G and all poles q_j of F. The rest is smooth below the region's
edge. It is fitted there, relative to the response itself, by a constant (the static
compliance of the modes left out; only for a sensor without anti-alias filter) and by
relaxations 1/(s - a) at real a: one where poles of a damped beam accumulate, and some beyond the
region, where the overdamped poles lie that were left out. No term is unstable.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from samii_rig.errors import InputError
from samii_rig.model.damping import CausalChain, relaxed_beams
from samii_rig.model.poles import CLUSTER, PoleSet, Region, contour_residues, find_poles
from samii_rig.model.sampled import (
    dead_time,
    filter_poles,
    filter_residues,
    filter_response,
    immediate,
    lowpass_poles,
)
from samii_rig.model.tmm import Chain
from samii_rig.rig.schema import (
    BEAMS,
    AccelerationSource,
    AngularVelocitySource,
    AngularVelocitySource2,
    DisplacementSource,
    ForceSource,
    Rig,
    Rod,
    SensorBase,
    TorqueSource,
    VelocitySource,
    flattened,
)
from samii_rig.types import Complex, Float

BAND_OVER_RATE = 4.0  # default band of the pole search over the sample rate
STRIP = 1.0  # rad/s, half height of the strip along the real axis
HOLE = 0.02  # half width of a hole over the rate 1/tau that it stands around
RIGHT = 0.02  # right edge of the region over its top: an undamped pole must lie inside
POLE_CIRCLE = 0.4  # radius of a residue's circle over the distance to the next pole
RELAXED_BEYOND = (1.5, 4.0)  # relaxations beyond the region, over its left edge
LOSS_LOW = 2e-4  # lowest frequency at which a loss factor is kept, over the rate
ERROR_LOW = 1e-4  # lowest frequency at which the error is given, over the rate
APART = 1e-6  # smallest distance of a filter's pole from one of the chain, over its modulus
FLOOR = 1e-9  # smallest response that an error is relative to, over the largest
FIT_POINTS = 400  # frequencies of the fit of the rest
FIT_LOW = 2e-5  # lowest of them over the rate
FIT_HIGH = 1.0  # highest of them over the rate: aliases of the first zone count too


@dataclass(frozen=True, slots=True)
class Realisation:
    """A rig's continuous response, filters included, delays and hold not.

    late : (n_input,) s, the dead time of each actuator's sources: a delay as well.

    poles : (n,) complex rad/s, Im >= 0; one with Im > 0 stands for its conjugate as well.
    residues : (n, n_sensor, n_input) complex.
    direct : (n_sensor, n_input) feedthrough.
    structure : the poles of the chain among them, as searched.
    error : (n_sensor,) largest relative deviation from the transfer matrices at any frequency
        from ERROR_LOW times the rate to half the rate.
    """

    poles: Complex
    residues: Complex
    direct: Float
    structure: PoleSet
    error: Float
    late: Float

    def response(self, frequency_hz: Float) -> Complex:
        """(n_freq, n_sensor, n_input) at these frequencies."""
        return self.evaluate(np.asarray(2j * np.pi * frequency_hz, dtype=np.complex128))

    def evaluate(self, s: Complex) -> Complex:
        """(n, n_sensor, n_input) at complex s."""
        return _sum(s, self.poles, self.residues) + self.direct

    def state_space(self) -> tuple[Float, Float, Float, Float]:
        """Real modal form (A, B, C, D): a 2 x 2 block [[a, -b], [b, a]] for a pair a +- jb, a
        1 x 1 block for a real pole; each input has its own copy of the states."""
        n_out, n_in = self.direct.shape
        size = int(np.where(self.poles.imag > 0, 2, 1).sum())
        A = np.zeros((size * n_in, size * n_in))
        B = np.zeros((size * n_in, n_in))
        C = np.zeros((n_out, size * n_in))
        at = 0
        for j in range(n_in):
            for p, R in zip(self.poles, self.residues[:, :, j], strict=True):
                B[at, j] = 1.0
                if p.imag > 0:
                    A[at : at + 2, at : at + 2] = [[p.real, -p.imag], [p.imag, p.real]]
                    C[:, at], C[:, at + 1] = 2 * R.real, -2 * R.imag
                    at += 2
                else:
                    A[at, at] = p.real
                    C[:, at] = R.real
                    at += 1
        return A, B, C, self.direct


def _relaxations(region: Region) -> Complex:
    """Poles on the real axis for what lies in the region's holes and left of it, rad/s."""
    # Two in each hole: the poles gathered there lie left of where the modulus vanishes.
    holes = [x for low, high in region.holes for x in (low, (low + high) / 2)]
    return np.array([*holes, *(region.left * x for x in RELAXED_BEYOND)], dtype=np.complex128)


def realise(rig: Rig, band_hz: float | None = None, near: Complex | None = None) -> Realisation:
    """The chain of `rig` as partial fractions, all poles up to `band_hz` kept.

    band_hz : edge of the searched region, default 4 times the sample rate.
    near : (n_pole,) rad/s, poles of nearly the same chain, from which these are found in less time.
    A beam's constant loss factor is replaced by relaxations (`samii_rig.model.damping`) fitted
    from LOSS_LOW times the rate to half the rate. InputError if the chain is unstable or has
    a pole of higher order.
    """
    late, rig = dead_time(rig), immediate(rig)
    beams = relaxed_beams(rig, LOSS_LOW * rig.rate_hz, 0.5 * rig.rate_hz)
    chain = CausalChain(rig, beams) if beams else Chain(rig)
    band = BAND_OVER_RATE * rig.rate_hz if band_hz is None else band_hz
    region = search_region(rig, band)
    found = find_poles(lambda s: chain.characteristic(s, clear=True), region, near)
    if found.poles.size and found.poles.real.max() > 1e-6 * found.region.top:
        worst = found.poles[found.poles.real.argmax()]
        raise InputError(rig.name, "element", f"pole at {worst:.4g} rad/s", "a stable chain")
    poles = _with_sources(rig, found.poles)
    radius = _radii(poles, found.region)
    R, second = contour_residues(chain.evaluate, poles, radius)
    _refuse_double(rig, poles, R, second, radius)
    # On the real axis everything is real; rounding is not.
    R[poles.imag == 0] = R[poles.imag == 0].real

    f = np.geomspace(FIT_LOW, FIT_HIGH, FIT_POINTS) * rig.rate_hz
    f = np.union1d(f, _near(found.poles, f[0], f[-1]))
    s = np.asarray(2j * np.pi * f, dtype=np.complex128)
    G = chain.evaluate(s)
    relaxations = _relaxations(found.region)
    blocks: list[tuple[Complex, Complex]] = []
    direct = np.zeros((len(rig.sensor), len(rig.actuator)))
    error = np.zeros(len(rig.sensor))
    judged = (f >= ERROR_LOW * rig.rate_hz) & (f <= rig.rate_hz / 2)
    for i, given in enumerate(rig.sensor):
        sensor = _apart(given, poles)
        q, q_residues = filter_poles(sensor), filter_residues(sensor)
        q, q_residues = q[q.imag >= 0], q_residues[q.imag >= 0]
        F = filter_response(sensor, s)[:, None]
        at = np.concatenate([poles, q, relaxations])
        r = np.zeros((at.size, len(rig.actuator)), dtype=np.complex128)
        r[: poles.size] = R[:, i] * filter_response(sensor, poles)[:, None]
        if q.size:
            r[poles.size : poles.size + q.size] = chain.evaluate(q)[:, i] * q_residues[:, None]
        target = G[:, i] * F
        rest = target - _sum(s, at, r)
        size = np.abs(target)
        size = np.maximum(size, FLOOR * size.max() + 1e-300)
        for j in range(len(rig.actuator)):
            r[poles.size + q.size :, j], direct[i, j] = _fit(
                s, rest[:, j], size[:, j], relaxations, lowpass_poles(sensor).size == 0
            )
        off = np.abs(_sum(s, at, r) + direct[i] - target)
        error[i] = np.max((off / size)[judged])
        whole = np.zeros((at.size, *direct.shape), dtype=np.complex128)
        whole[:, i] = r
        blocks.append((at, whole))
    joined, residues = _collect(blocks)
    return Realisation(joined, residues, direct, found, error, late)


def search_region(rig: Rig, band_hz: float) -> Region:
    """The region searched for a band: |Im s| and -Re s up to 2 pi band_hz, with a hole wherever
    the modulus of a beam vanishes."""
    top = 2 * np.pi * band_hz
    left = -top
    wanted: list[tuple[float, float]] = []
    relaxed = relaxed_beams(rig, LOSS_LOW * rig.rate_hz, 0.5 * rig.rate_hz)
    for e in flattened(rig.element):
        if not isinstance(e, (*BEAMS, Rod)):
            continue
        if e.name in relaxed:
            wanted += relaxed[e.name].holes()
        elif e.tau.value > 0:
            centre = -1 / e.tau.value
            wanted.append((centre * (1 + HOLE), centre * (1 - HOLE)))
    holes: list[tuple[float, float]] = []
    for low, high in sorted(wanted):
        if high < left:
            continue
        left = min(left, low)
        if holes and low <= holes[-1][1]:
            holes[-1] = (holes[-1][0], max(high, holes[-1][1]))
        else:
            holes.append((low, high))
    strip = min([STRIP, *((high - low) / 4 for low, high in holes)])
    return Region(left, RIGHT * top, top, strip, tuple(holes))


def _with_sources(rig: Rig, poles: Complex) -> Complex:
    """The chain's poles and the sources' own, each place once."""
    out = [complex(p) for p in poles]
    for own in source_poles(rig):
        if not any(abs(own - x) <= CLUSTER for x in out):
            out.append(complex(own))
    return np.array(out, dtype=np.complex128)


def source_poles(rig: Rig) -> list[complex]:
    """The poles of all sources, Im >= 0."""
    out: list[complex] = []
    for e in rig.element:
        match e:
            case AngularVelocitySource() | VelocitySource():
                out += [0j, complex(-e.p.value)]
            case AngularVelocitySource2():
                out += [0j, *_second_order(e.omega.value, e.zeta.value)]
            case DisplacementSource():
                out += _second_order(e.omega.value, e.zeta.value)
            case AccelerationSource():
                out += _second_order(*e.suspension)
            case TorqueSource() | ForceSource():
                out += [complex(-e.p.value)] if e.p else []
    return out


def _second_order(omega: float, zeta: float) -> list[complex]:
    roots = np.roots([1.0, 2 * zeta * omega, omega**2])
    return [complex(x) for x in roots if x.imag >= 0]


def _apart(sensor: SensorBase, poles: Complex) -> SensorBase:
    """The sensor, its filter's corners moved by APART if a pole lies on one: partial fractions
    need simple poles, and no corner is known so well."""
    for _ in range(4):
        q = filter_poles(sensor)
        distance = np.abs(q[:, None] - np.concatenate([poles, q]))
        distance[np.arange(q.size), poles.size + np.arange(q.size)] = np.inf
        if not np.any(distance < APART * np.abs(q)[:, None]):
            break
        changes: dict[str, object] = {
            "highpass_hz": sensor.highpass_hz * (1 + 2 * APART),
            "lag": sensor.lag * (1 + 3 * APART),
        }
        if sensor.antialias:
            corner = sensor.antialias.corner_hz * (1 + 5 * APART)
            changes["antialias"] = sensor.antialias.model_copy(update={"corner_hz": corner})
        sensor = sensor.model_copy(update=changes)
    return sensor


def _radii(poles: Complex, region: Region) -> Float:
    """Radius of a circle around each pole with nothing else singular inside or near."""
    everything = np.concatenate([poles, poles[poles.imag > 0].conj()])
    distance = np.abs(poles[:, None] - everything[None, :])
    distance[np.arange(poles.size), np.arange(poles.size)] = np.inf
    nearest = np.min(distance, axis=1, initial=np.inf)
    for low, high in region.holes:
        x = np.clip(poles.real, low, high)
        y = np.clip(poles.imag, 0, (high - low) / 2)
        nearest = np.minimum(nearest, np.abs(poles - (x + 1j * y)))
    nearest = np.where(np.isfinite(nearest), nearest, 1.0 + np.abs(poles))
    return np.asarray(POLE_CIRCLE * nearest)


def _refuse_double(rig: Rig, poles: Complex, R: Complex, second: Complex, radius: Float) -> None:
    strength = np.max(np.abs(R) * radius[:, None, None] + 1e-300, axis=0)
    double = np.abs(second) > 1e-6 * np.max(strength) * radius[:, None, None]
    if double.any():
        where, sensor = poles[np.argwhere(double)[0][0]], rig.sensor[np.argwhere(double)[0][1]]
        tables = (e for e in rig.element if isinstance(e, AccelerationSource) and not e.omega)
        if abs(where) <= CLUSTER and (table := next(tables, None)):
            raise InputError.saying(
                rig.name, f"element[{table.name}].omega",
                "missing; expected omega and zeta where the table is simulated in time: without "
                f"a suspension what {sensor.name} reads drifts away",
            )  # fmt: skip
        raise InputError(
            rig.name, "element", f"double pole at {where:.6g} rad/s", "a chain with simple poles"
        )


def _near(poles: Complex, low: float, high: float) -> Float:
    """Frequencies beside every resonance in a band, Hz; on it a lossless one is infinite."""
    f = poles.imag / (2 * np.pi)
    width = np.maximum(np.abs(poles.real) / (2 * np.pi), 1e-4 * f)
    at = np.concatenate([f + x * width for x in (-2.0, -1.0, -0.3, 0.3, 1.0, 2.0)])
    return np.asarray(at[(at > low) & (at < high)])


def _sum(s: Complex, poles: Complex, residues: Complex) -> Complex:
    """Partial fractions with the conjugates of the poles above the real axis."""
    s = np.asarray(s, dtype=np.complex128)
    pair = poles.imag > 0
    value = np.einsum("si,i...->s...", 1 / (s[:, None] - poles), residues)
    mirror = 1 / (s[:, None] - poles[pair].conj())
    return np.asarray(value + np.einsum("si,i...->s...", mirror, residues[pair].conj()))


def _fit(
    s: Complex, rest: Complex, size: Float, at: Complex, constant: bool
) -> tuple[Float, float]:
    """Least squares of rest/size by real relaxations and, if asked, a constant."""
    columns = [-p / (s - p) for p in at]
    if constant:
        columns.append(np.ones_like(s))
    basis = np.stack(columns, axis=1) / size[:, None]
    stacked = np.concatenate([basis.real, basis.imag])
    goal = np.concatenate([(rest / size).real, (rest / size).imag])
    x = np.linalg.lstsq(stacked, goal, rcond=1e-12)[0]
    return -at.real * x[: at.size], float(x[-1]) if constant else 0.0


def _collect(blocks: list[tuple[Complex, Complex]]) -> tuple[Complex, Complex]:
    """Sum of partial fractions, poles that occur more than once joined."""
    poles = np.concatenate([p for p, _ in blocks])
    residues = np.concatenate([r for _, r in blocks])
    unique, where = np.unique(poles, return_inverse=True)
    total = np.zeros((unique.size, *residues.shape[1:]), dtype=np.complex128)
    np.add.at(total, where, residues)
    return unique, total
