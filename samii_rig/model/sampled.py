"""The rig as the converters see it: hold, sensor filters, delays and aliases.

A digital controller does not see the chain's continuous response G(f) but that of the
sequence it reads to the sequence it writes,

    H(f) = sum over k of  hold(f_k) G(f_k) F(f_k),      f_k = f + k rate,

with the zero-order hold of the output and the filter F of each sensor. A lag is a negative
phase: the hold alone is -18 degrees at 50 Hz and 500 samples/s.

An input that a sensor measured (`held = false` of its actuator) is band limited: the rig followed
it between samples, too, so that it has neither hold nor aliases.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from samii_rig.errors import InputError
from samii_rig.model.tmm import Chain
from samii_rig.rig.schema import SOURCES, ActuatorSpec, Parameter, Rig, SensorBase
from samii_rig.types import Complex, Float

ALIAS_TOLERANCE = 1e-5  # of each response, change by the last doubling of the aliases
FIRST_ALIASES = 16  # aliases on each side to begin with
# Ratio of a doubling's sum to the last, below which the rest is extrapolated: 1/f^2 has 0.5.
SETTLED_RATIO = 0.7
BLOCK = 128  # frequencies at once, so that memory stays bounded
MAX_ALIASES = 4096  # on each side; the terms fall at least as 1/f^2 from there


def hold_response(frequency_hz: Float, rate_hz: float, delay: float = 0.0) -> Complex:
    """Zero-order hold, (n,) complex: exp(-j w T/2) sinc(f T) exp(-j w delay)."""
    f = np.asarray(frequency_hz, dtype=np.float64)
    lag = np.exp(-2j * np.pi * f * (0.5 / rate_hz + delay))
    return np.asarray(lag * np.sinc(f / rate_hz))


def hold_at(s: Complex, rate_hz: float, delay: float = 0.0) -> Complex:
    """(1 - e^{-s T})/(s T) e^{-s delay} at complex s of any shape but 0, rad/s; delay in s."""
    s = np.asarray(s, dtype=np.complex128)
    held = -np.expm1(-s / rate_hz) * rate_hz / s
    return np.asarray(held * np.exp(-s * delay) if delay else held)


def unheld_at(s: Complex, rate_hz: float) -> Complex:
    """s T/(1 - exp(-s T)), the inverse of `hold_at`, at complex s of any shape, rad/s; 0 from half
    the rate on: what was measured at the samples is smooth between them and has no images there."""
    sT = np.asarray(s, dtype=np.complex128) / rate_hz
    inside = np.abs(sT.imag) < np.pi
    below = -np.expm1(-sT)
    ratio = np.divide(sT, below, out=np.ones_like(sT), where=below != 0)
    return np.where(inside, ratio, 0.0)


def given_response(actuator: ActuatorSpec, frequency_hz: Float, rate_hz: float) -> Complex:
    """(n,) what comes of an actuator's samples at real frequencies, Hz: held, or as it was
    measured, after its delay."""
    held = hold_response(frequency_hz, rate_hz, actuator.delay)
    s = 2j * np.pi * np.asarray(frequency_hz, dtype=np.complex128)
    return held if actuator.held else held * unheld_at(s, rate_hz)


def as_sent(rig: Rig) -> Rig:
    """The rig as a converter drives it: whatever its recordings have, what is sent out is held."""
    if all(a.held for a in rig.actuator):
        return rig
    held = tuple(a.model_copy(update={"held": True}) for a in rig.actuator)
    return rig.model_copy(update={"actuator": held})


def lowpass_poles(sensor: SensorBase) -> Complex:
    """(n_pole,) rad/s, of the sensor's anti-alias Butterworth filter, then of its lag."""
    lag = np.full(1 if sensor.lag > 0 else 0, -1 / sensor.lag if sensor.lag > 0 else 0.0)
    if sensor.antialias is None:
        return lag.astype(np.complex128)
    n = sensor.antialias.order
    angle = np.pi * (2 * np.arange(n) + n + 1) / (2 * n)
    unit = np.exp(1j * angle)
    if n % 2:
        unit[n // 2] = -1.0  # the odd one is real; rounding would leave it beside the axis
    return np.append(2 * np.pi * sensor.antialias.corner_hz * unit, lag)


def filter_poles(sensor: SensorBase) -> Complex:
    """(n_pole,) rad/s, all poles of `filter_response`, the high-pass's last."""
    low = lowpass_poles(sensor)
    if sensor.highpass_hz > 0:
        return np.append(low, -2 * np.pi * sensor.highpass_hz)
    return low


def filter_response(sensor: SensorBase, s: Complex) -> Complex:
    """gain times anti-alias filter, lag and high-pass s/(s + w_hp), without the delay, at complex s
    of any shape, rad/s."""
    s = np.asarray(s, dtype=np.complex128)
    poles = filter_poles(sensor)
    low = poles[:-1] if sensor.highpass_hz > 0 else poles
    at_rest = sensor.gain * np.prod(-low)
    value = np.full_like(s, at_rest) if low.size == poles.size else at_rest * s
    if poles.size == 0:
        return value
    below = s - poles[0]
    for q in poles[1:]:
        below *= s - q
    return np.asarray(value / below)


def filter_residues(sensor: SensorBase) -> Complex:
    """(n_pole,) residues of `filter_response` at `filter_poles`, all of which are simple; rad/s
    times the gain."""
    low = lowpass_poles(sensor)
    corner = 2 * np.pi * sensor.highpass_hz
    out = [
        -q * np.prod([-other / (q - other) for k, other in enumerate(low) if k != j])
        for j, q in enumerate(low)
    ]
    if corner > 0:
        out = [r * q / (q + corner) for r, q in zip(out, low, strict=True)]
        out.append(-corner * np.prod(-low / (-corner - low)))
    return sensor.gain * np.array(out, dtype=np.complex128)


def sensor_response(sensors: Sequence[SensorBase], frequency_hz: Float) -> Complex:
    """Filters and delays of the sensors, (n_freq, n_sensor); a delay is a negative phase."""
    f = np.asarray(frequency_hz, dtype=np.float64)
    return sensors_at(sensors, np.asarray(2j * np.pi * f, dtype=np.complex128))


def sensors_at(sensors: Sequence[SensorBase], s: Complex) -> Complex:
    """(n, n_sensor) `filter_response` with the delay of each sensor, at complex s (n,), rad/s."""
    filters = _filters_at(sensors, s)
    late = {delay: np.exp(-s * delay) for delay in {x.delay for x in sensors} if delay}
    columns = [f * late[x.delay] if x.delay else f for f, x in zip(filters, sensors, strict=True)]
    return np.stack(columns, axis=1)


def _filters_at(sensors: Sequence[SensorBase], s: Complex) -> list[Complex]:
    """`filter_response` of each sensor; most sensors of a rig share one, found once."""
    found: dict[tuple[object, ...], Complex] = {}
    out = []
    for x in sensors:
        alike = (x.gain, x.antialias, x.lag, x.highpass_hz)
        if alike not in found:
            found[alike] = filter_response(x, s)
        out.append(found[alike])
    return out


def dead_time(rig: Rig) -> Float:
    """(n_input,) s by which the sources of each actuator are late.

    Raises InputError if sources of one actuator differ: that is no delay of the input.
    """
    out = []
    for actuator in rig.actuator:
        own = {
            e.tau.value for e in rig.element if isinstance(e, SOURCES) and e.input == actuator.name
        }
        if len(own) != 1:
            raise InputError(
                rig.name, f"{actuator.name}: tau", sorted(own), "one value for all its sources"
            )
        out.append(own.pop())
    return np.array(out)


def immediate(rig: Rig) -> Rig:
    """The same rig, its sources without dead time."""
    none = {"tau": Parameter(value=0.0, unit="s", source="left out")}
    elements = (e.model_copy(update=none) if isinstance(e, SOURCES) else e for e in rig.element)
    return rig.model_copy(update={"element": tuple(elements)})


def feedthrough(chain: Chain) -> Float:
    """Instantaneous response of the continuous chain, (n_sensor, n_input): G(s) as s grows
    along the positive real axis, where no wave comes back.

    Only an accelerometer rigidly on the driven side of a source has any. Found from two
    points, G(s) = D + c/s, and zero where G still falls from the one to the other.
    """
    far = np.array([1e7, 2e7], dtype=np.complex128)  # 1/s, far above every corner of a rig
    G = chain.evaluate(far).real
    D = 2 * G[1] - G[0]
    return np.asarray(np.where(np.abs(G[1]) > 0.9 * np.abs(G[0]), D, 0.0))


def sampled_response(
    rig: Rig,
    frequency_hz: Float,
    chain: Chain | None = None,
    tolerance: float = ALIAS_TOLERANCE,
) -> Complex:
    """Response of the sampled sensors to the sampled commands, by summation over aliases.

    frequency_hz : (n_freq,), above 0 and at most half the rate. tolerance : of each response,
    change by the last doubling of the aliases.
    Returns (n_freq, n_sensor, n_input) complex, rig-file order; of an actuator that is not `held`
    the response to what was measured. The sensors are read just
    before the output changes, so that a jump of the output is not in the sample taken with it.
    Uses the transfer matrices alone, not the state space of `samii_rig.model.realise`.

    Raises InputError for a frequency outside that range.
    """
    f = np.atleast_1d(np.asarray(frequency_hz, dtype=np.float64))
    if not np.all((f > 0) & (f <= rig.rate_hz / 2)):
        wrong = f[~((f > 0) & (f <= rig.rate_hz / 2))][0]
        raise InputError(rig.name, "frequency_hz", float(wrong), f"0 to {rig.rate_hz / 2:g} Hz")
    chain = Chain(rig) if chain is None else chain
    blocks = [_aliased(rig, chain, f[i : i + BLOCK], tolerance) for i in range(0, f.size, BLOCK)]
    return np.concatenate(blocks) - _half_jumps(rig, chain, f)


def _aliased(rig: Rig, chain: Chain, f: Float, tolerance: float) -> Complex:
    """Sum over as many aliases as the slowest of these frequencies needs.

    Far up, terms are smooth in k: their sum to k = K, the last one halved, is an integral but for
    the third order of 1/K (Euler and Maclaurin). What twice as many add falls by a ratio that
    settles, and the rest is a geometric series (Aitken): it is taken once two estimates agree.
    """

    def both(k: np.ndarray) -> Complex:
        return _terms(rig, chain, f, k) + _terms(rig, chain, f, -k)

    total = _terms(rig, chain, f, np.zeros(1, dtype=np.int64))
    last, end = np.zeros_like(total), np.zeros_like(total)
    estimate = np.full_like(total, np.inf)
    reached, upto = 0, FIRST_ALIASES
    while True:
        half = both(np.array([upto])) / 2
        part = end + both(np.arange(reached + 1, upto)) + half
        total += part
        ratio = np.divide(part, last, out=np.zeros_like(part), where=np.abs(part) < np.abs(last))
        rest = np.where(np.abs(ratio) < SETTLED_RATIO, part * ratio / (1 - ratio), half)
        off = np.minimum(np.abs(part), np.abs(total + rest - estimate))
        estimate, last, end = total + rest, part, half
        if upto >= MAX_ALIASES or np.all(off <= tolerance * np.abs(total)):
            return estimate
        reached, upto = upto, 2 * upto


def _terms(rig: Rig, chain: Chain, f: Float, k: np.ndarray) -> Complex:
    """Sum over the aliases k of hold G F, (n_freq, n_sensor, n_input)."""
    at = f[:, None] + k * rig.rate_hz
    # The response to a real input at -f is the conjugate of that at f.
    G = chain.response(np.abs(at).ravel())
    np.conjugate(G, out=G, where=(at < 0).ravel()[:, None, None])
    s = np.asarray(2j * np.pi * at, np.complex128)
    filters = _filters_at(rig.sensor, s)
    # Of hold and delays e^{-j w late} is a factor of f times one of k; so is the hold's sine.
    held = (np.sin(np.pi / rig.rate_hz * f)[:, None] * (1 - 2 * (k % 2))) / (
        np.pi / rig.rate_hz * at
    )
    given = [held if a.held else held * unheld_at(s, rig.rate_hz) for a in rig.actuator]
    G = G.reshape(f.size, k.size, *G.shape[1:])
    out = np.empty((f.size, *G.shape[2:]), np.complex128)
    for i, (x, F) in enumerate(zip(rig.sensor, filters, strict=True)):
        for j, actuator in enumerate(rig.actuator):
            late = 0.5 / rig.rate_hz + actuator.delay + x.delay
            turned = np.exp(-2j * np.pi * k * (late * rig.rate_hz))
            passed = G[:, :, i, j] * (F * given[j])
            out[:, i, j] = np.exp(-2j * np.pi * f * late) * (passed @ turned)
    return out


def _half_jumps(rig: Rig, chain: Chain, f: Float) -> Complex:
    """What the symmetric sum has too much where a jump falls on a sampling instant.

    A Fourier sum gives the mean of both sides of a jump; the sample is the side before it.
    """
    late = dead_time(rig)
    D = feedthrough(Chain(immediate(rig)) if late.any() else chain)
    out = np.zeros((f.size, len(rig.sensor), len(rig.actuator)), dtype=np.complex128)
    for i, sensor in enumerate(rig.sensor):
        for j, actuator in enumerate(rig.actuator):
            if not actuator.held:
                continue  # what was measured does not jump
            periods = (actuator.delay + late[j] + sensor.delay) * rig.rate_hz
            if lowpass_poles(sensor).size == 0 and abs(periods - round(periods)) < 1e-9:
                lag = np.exp(-2j * np.pi * f * round(periods) / rig.rate_hz)
                out[:, i, j] = (
                    sensor.gain * D[i, j] / 2 * lag * (1 - np.exp(-2j * np.pi * f / rig.rate_hz))
                )
    return out
