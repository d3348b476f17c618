"""What a plan will do to the rig, predicted from the transfer matrices before anything moves.

The whole plan is one signal, so that what an earlier burst leaves behind (a mode that rings
for a minute, an integrator's drift) is part of the prediction. The sampled closed loop

    v(z) = (u(z) + kp theta_ref(z)) / (1 + L(z)),   L = kp H_theta - sum F_i H_i,   y = H_y v

with the filters F_i of the rig's feedback loops is evaluated on the circle
z = exp((sigma + j w) T) a little outside the unit circle, and the time series is brought back
with exp(sigma t). On that circle an integrator is finite, and what a discrete Fourier transform
wraps around comes back smaller by exp(-sigma T_plan).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from scipy import fft

from samii_rig.errors import InputError, LimitError
from samii_rig.model.feedback import reach
from samii_rig.model.loops import Loops, loops_of
from samii_rig.model.sampled import filter_response
from samii_rig.model.tmm import Chain
from samii_rig.rig.schema import AngularVelocitySource, Moment, Rig, Sensor
from samii_rig.run.expected import BandError, expected_errors
from samii_rig.run.limits import GateLimits, find_actuator, gate_limits
from samii_rig.run.protocols import Plan
from samii_rig.types import Complex, Float

WRAP = 1e-3  # what is left of the signal after one turn of the transform
# Silence after the plan, as a part of it: catches what the finite sum of aliases, which is
# not quite causal, sends ahead of the first samples; exp(sigma t) would amplify it.
PAD = 0.05
# Aliases on each side. The hold has its zeros there, so the next ones add under 0.1 % to a
# response below a tenth of the rate.
ALIASES = 1
# A closed loop without poles outside the circle does not wind around 0 at all.
MOST_WINDING = 0.5


@dataclass(frozen=True, slots=True)
class DryRun:
    """The prediction for a whole plan.

    duration, shortest : s, with every dwell in full and as short as it may be.
    channels, units : of `peaks` : (n_segment, n_channel), largest |value| of the command v,
    of each sensor and of the moment at each actuated joint, in the segment.
    margins : worst first.
    """

    duration: float
    shortest: float
    channels: tuple[str, ...]
    units: tuple[str, ...]
    peaks: Float
    slew: float
    margins: tuple[Margin, ...]
    bands: tuple[BandError, ...]

    def refuse(self) -> None:
        """LimitError if a limit would be broken; it names the largest level that would not."""
        worst = self.margins[0]
        if worst.margin >= 0.0:
            return
        scale = min(m.largest_level / m.level for m in self.margins)
        largest = scale * worst.level
        way = (
            f"largest level that would not: {_round_down(largest)} {worst.level_unit}"
            if largest > 0.0
            else "no level would not"
        )
        raise LimitError(
            f"{worst.channel} would reach {worst.predicted:.4g} {worst.unit} in {worst.segment} "
            f"(level {worst.level:g} {worst.level_unit}), over its {worst.what} of "
            f"{worst.limit:g} {worst.unit} ({worst.reason}); {way}"
        )


def predict(plan: Plan, rig: Rig) -> DryRun:
    """Peaks, margins and the FRF's expected error of a plan, from the model alone.

    A plan whose dwells may be left early is predicted twice, with each in full and with each
    as short as it may be: the less time, the more of one frequency's start is left in the next.
    Peaks and margins are the worse of the two, the duration and the expected errors those in full.

    Raises LimitError if the rig's own loops would be unstable, InputError if the rig
    could never be armed, or its source moves nothing.
    """
    full = _predict(plan, rig)
    if plan.shortest is None:
        return full
    short = _predict(plan.shortest, rig)
    worse = {(m.channel, m.what, m.reason): m for m in full.margins}
    for m in short.margins:
        known = worse.get((m.channel, m.what, m.reason))
        if known is None or m.margin < known.margin:
            worse[m.channel, m.what, m.reason] = m
    return replace(
        full,
        shortest=short.duration,
        peaks=np.maximum(full.peaks, short.peaks),
        slew=max(full.slew, short.slew),
        margins=tuple(sorted(worse.values(), key=lambda m: m.margin)),
    )


def _predict(plan: Plan, rig: Rig) -> DryRun:
    if find_actuator(rig, plan.actuator, rig.name).deadman is None:
        expected = "the device's own, in s; without one it is never armed"
        raise InputError(rig.name, f"actuator[{plan.actuator}].deadman", None, expected)
    moments = _joint_moments(rig, plan.actuator)
    seen = rig.model_copy(update={"sensor": (*rig.sensor, *moments)})
    limits = gate_limits(rig, plan.actuator, plan.kp, plan.centring_sensor)
    u = np.concatenate([s.u for s in plan.segments])
    theta_ref = np.concatenate([s.theta_ref for s in plan.segments])
    n = fft.next_fast_len(math.ceil(len(u) * (1 + PAD)), real=True)
    sigma = -math.log(WRAP) * plan.rate_hz / n
    omega = 2 * np.pi * plan.rate_hz * np.arange(n // 2 + 1) / n
    s = np.asarray(sigma + 1j * omega, dtype=np.complex128)
    H = _sampled(seen, plan.actuator, s)
    names = [s.name for s in seen.sensor]
    if not np.any(np.abs(H) > 0.0):
        expected = f"an end that {plan.actuator} can push against; it moves nothing"
        raise InputError(rig.name, "base", rig.base, expected)
    loops = _loops(rig, plan)
    filters = loops.filters(np.exp(s / plan.rate_hz), plan.rate_hz)
    sensitivity = 1.0 + loops.gain(H[:, :, None], filters)
    if plan.kp != 0.0 or loops.feedback:
        _refuse_unstable(sensitivity, plan, loops)
    shrink = np.exp(-sigma * np.arange(len(u)) / plan.rate_hz)
    drive = fft.rfft((u + plan.kp * theta_ref) * shrink, n)
    command = drive / sensitivity
    v = fft.irfft(command, n)[: len(u)] / shrink
    y = np.stack([fft.irfft(command * H[:, i], n)[: len(u)] / shrink for i in range(len(names))])
    added = {
        loop.name: fft.irfft(command * filters[:, k] * H[:, i], n)[: len(u)] / shrink
        for k, (i, loop) in enumerate(loops.feedback)
    }

    series = {plan.actuator: v, **dict(zip(names, y, strict=True))}
    units = {**rig.units(), **{m.name: m.unit for m in moments}}
    ends = np.cumsum([len(s.u) for s in plan.segments])
    parts = [slice(int(e) - len(s.u), int(e)) for s, e in zip(plan.segments, ends, strict=True)]
    peaks = np.array([[np.abs(x[part]).max() for x in series.values()] for part in parts])
    margins = [
        *_margins(plan, rig, limits, series, parts),
        *_feedback_margins(plan, rig, limits, added, parts),
    ]
    spectrum = np.abs(H[:, : len(rig.sensor)])
    return DryRun(
        duration=plan.duration,
        shortest=plan.duration,
        channels=tuple(series),
        units=tuple(units[name] for name in series),
        peaks=peaks,
        slew=float(np.abs(np.diff(v, prepend=0.0)).max() * plan.rate_hz),
        margins=tuple(sorted(margins, key=lambda m: m.margin)),
        bands=tuple(expected_errors(plan, rig, v, parts, omega / (2 * np.pi), spectrum)),
    )


def _loops(rig: Rig, plan: Plan) -> Loops:
    """The loops of a plan on its actuator, the only column that is looked at."""
    theta = [s.name for s in rig.sensor].index(plan.centring_sensor)
    return replace(loops_of(rig, plan.actuator), actuator=0, theta=theta, kp=plan.kp)


def _joint_moments(rig: Rig, actuator: str) -> tuple[Moment, ...]:
    """A perfect moment sensor behind each source that the actuator drives."""
    return tuple(
        Moment(kind="moment", name=f"M_{e.name}"[:40], unit="N m", after=e.name)
        for e in rig.element
        if isinstance(e, AngularVelocitySource) and e.input == actuator
    )


def _sampled(rig: Rig, actuator: str, s: Complex) -> Complex:
    """Sampled response (n, n_sensor) from the actuator at complex s: `sampled_response`
    with few aliases, off the imaginary axis."""
    j = [a.name for a in rig.actuator].index(actuator)
    chain = Chain(rig)
    total = np.zeros((len(s), len(rig.sensor)), dtype=np.complex128)
    for k in range(-ALIASES, ALIASES + 1):
        at = s + 2j * np.pi * rig.rate_hz * k
        T = 1.0 / rig.rate_hz
        hold = -np.expm1(-at * T) / (at * T) * np.exp(-at * rig.actuator[j].delay)
        # A chain answers a real input: G(conj s) = conj G(s).
        upper = np.where(at.imag < 0, at.conj(), at)
        G = chain.evaluate(upper)[:, :, j]
        G = np.where((at.imag < 0)[:, None], G.conj(), G)
        F = np.stack([filter_response(x, at) * np.exp(-at * x.delay) for x in rig.sensor], axis=1)
        total += G * F * hold[:, None]
    return total


def _refuse_unstable(sensitivity: Complex, plan: Plan, loops: Loops) -> None:
    """Nyquist: 1 + L has no pole outside the circle and is 1 far out, so the times it
    winds around 0 along the circle are the closed loop's poles outside."""
    turns = float(np.abs(np.diff(np.unwrap(np.angle(sensitivity))).sum()) / np.pi)
    if turns > MOST_WINDING:
        centring = f"the centring loop with kp = {plan.kp:g} on {plan.centring_sensor}"
        names = ", ".join(f"{f.name} on {f.sensor}" for _, f in loops.feedback)
        what = f"{centring} and the feedback {names}" if names else centring
        smaller = "a smaller kp or gain" if names else "a smaller kp"
        raise LimitError(f"{what} would be unstable by the model; expected {smaller}")


def _noise(sensor: Sensor) -> float:
    """The largest part of a reading that no level scales: offset, noise, half a step."""
    return abs(sensor.offset) + SIGMAS * sensor.noise_rms + sensor.resolution / 2


def _margins(
    plan: Plan, rig: Rig, limits: GateLimits, series: dict[str, Float], parts: list[slice]
) -> list[Margin]:
    sensors = {s.name: s for s in rig.sensor}
    rate, kp, output = plan.rate_hz, abs(plan.kp), limits.output
    out: list[Margin] = []

    def add(
        channel: str, what: str, unit: str, x: list[float], fixed: float, limit: float, reason: str
    ) -> None:
        if math.isfinite(limit):
            out.append(_worst(plan, channel, what, unit, x, fixed, limit, reason))

    authority = sum(a.loop.max for a in limits.feedback)
    slewing = [(a.slew, sensors[a.loop.sensor]) for a in limits.feedback]
    slew_noise = sum(slew * _noise(sensor) for slew, sensor in slewing)
    centring = sensors.get(plan.centring_sensor) if kp > 0 else None
    theta = series[centring.name] if centring else np.zeros(1)
    theta_noise = _noise(centring) if centring else 0.0
    bound, slew = [], []
    # The whole plan's steps, from rest and back to rest: segments are sent without a border.
    u, theta_ref = (
        np.concatenate([[0.0], *(getattr(s, name) for s in plan.segments), [0.0]])
        for name in ("u", "theta_ref")
    )
    steps = np.abs(np.diff(u)) + kp * np.abs(np.diff(theta_ref))
    turning = np.abs(np.diff(theta, prepend=0.0)) if centring else np.zeros(len(u) - 2)
    reach = math.ceil(limits.max_ahead * rate)
    for s, part in zip(plan.segments, parts, strict=True):
        # The gate judges a reference by the angle of up to `reach` samples before.
        seen = slice(max(0, part.start - reach), part.stop)
        angle = np.abs(theta[seen]) if centring else np.zeros(1)
        bound.append(float((np.abs(s.u) + kp * np.abs(s.theta_ref)).max() + kp * angle.max()))
        # The step out of a segment counts for it too: it leads back to rest after the last.
        step = steps[part.start : part.stop + 1].max()
        turn_of = sum(k * float(np.abs(series[x.name][seen]).max()) for k, x in slewing)
        slew.append(float(step + kp * turning[seen].max()) * rate + turn_of)
    fixed_bound = kp * theta_noise + authority
    add(output.channel, "limit", output.unit, bound, fixed_bound, output.max, output.reason)
    add(
        output.channel,
        "rate",
        f"{output.unit}/s",
        slew,
        2 * kp * theta_noise * rate + slew_noise,
        output.max_rate,
        output.reason,
    )
    for c in limits.sensors:
        x, fixed = series[c.channel], _noise(sensors[c.channel])
        size = [float(np.abs(x[part]).max()) for part in parts]
        add(c.channel, "limit", c.unit, size, fixed, c.max, c.reason)
        turns = np.abs(np.diff(x, prepend=0.0))
        turn = [float(turns[part].max()) * rate for part in parts]
        add(c.channel, "rate", f"{c.unit}/s", turn, 2 * fixed * rate, c.max_rate, c.reason)
    for sensor in rig.sensor:
        reason = "end of the converter's range"
        up = [float(series[sensor.name][part].max()) for part in parts]
        down = [float(-series[sensor.name][part].min()) for part in parts]
        add(sensor.name, "range", sensor.unit, up, _noise(sensor), sensor.high, reason)
        add(sensor.name, "range", sensor.unit, down, _noise(sensor), -sensor.low, reason)
    return out


def _feedback_margins(
    plan: Plan, rig: Rig, limits: GateLimits, added: dict[str, Float], parts: list[slice]
) -> list[Margin]:
    """Whether each feedback loop stays inside its `max`."""
    out = []
    for a in limits.feedback:
        loop = a.loop
        sensor = next(s for s in rig.sensor if s.name == loop.sensor)
        bounds = reach(loop, plan.rate_hz)
        steady = bounds.peak * (abs(sensor.offset) + sensor.resolution / 2)
        fixed = steady + SIGMAS * sensor.noise_rms * bounds.rms
        size = [float(np.abs(added[loop.name][part]).max()) for part in parts]
        reason = "the device clips this loop there"
        out.append(
            _worst(plan, loop.name, "max", limits.output.unit, size, fixed, loop.max, reason)
        )
    return out


def _worst(
    plan: Plan,
    channel: str,
    what: str,
    unit: str,
    x: list[float],
    fixed: float,
    limit: float,
    reason: str,
) -> Margin:
    i = int(np.argmax(x))
    s = plan.segments[i]
    room = max(0.0, limit - fixed)
    largest = s.level * room / x[i] if x[i] > 0 else math.inf
    return Margin(
        channel, what, unit, x[i] + fixed, limit, reason, s.name, s.level, s.unit, largest
    )


def _round_down(x: float) -> str:
    """Three digits, never more than x: a level that is typed in as printed must pass."""
    step = 10.0 ** (math.floor(math.log10(x)) - 2)
    return f"{math.floor(x / step * (1 + 1e-12)) * step:.3g}"
