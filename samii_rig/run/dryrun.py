"""What a plan will do to the rig, predicted from the transfer matrices before anything moves.

The whole plan is one signal, so that what an earlier burst leaves behind (a mode that rings
for a minute, an integrator's drift) is part of the prediction. The sampled closed loop

    v(z) = (u(z) + kp theta_ref(z)) / (1 + L(z)),   L = kp H_theta - sum F_i H_i,   y = H_y v

with the filters F_i of the rig's feedback loops is evaluated on the circle
z = exp((sigma + j w) T) a little outside the unit circle, and the time series is brought back
with exp(sigma t). On that circle an integrator is finite, and what a discrete Fourier transform
wraps around comes back smaller by exp(-sigma T_plan). Several outputs make one such loop of
matrices, see `samii_rig.run.closed`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from scipy import fft

from samii_rig.errors import InputError, LimitError
from samii_rig.model.sampled import filter_response
from samii_rig.model.tmm import Chain
from samii_rig.rig.schema import (
    ANGLE_SOURCES,
    MOTION_SOURCES,
    SOURCES,
    Force,
    ForceSource,
    GravityStiffness,
    Moment,
    Rig,
    flattened,
)
from samii_rig.run.closed import ClosedLoops
from samii_rig.run.dwell import ways
from samii_rig.run.expected import BandError, exciting_only, expected_errors
from samii_rig.run.margins import Margin, margins, worse_of
from samii_rig.run.outputs import columns, completed, plan_limits
from samii_rig.run.plan import Plan
from samii_rig.safety.limits import GateLimits, find_actuator
from samii_rig.types import Complex, Float

WRAP = 1e-3  # what is left of the signal after one turn of the transform
# Silence after the plan, as a part of it: catches what the finite sum of aliases, which is
# not quite causal, sends ahead of the first samples; exp(sigma t) would amplify it.
PAD = 0.05
# Aliases on each side. The hold has its zeros there, so the next ones add under 0.1 % to a
# response below a tenth of the rate.
ALIASES = 1
# Where on the real axis a chain that falls over is looked for: parts of the sample rate (rad/s
# over Hz), and points.
LOWEST_FALL, HIGHEST_FALL, FALLS = 1e-6, 10.0, 2000


@dataclass(frozen=True, slots=True)
class DryRun:
    """The prediction for a whole plan.

    duration, shortest : s, with every dwell in full and as short as it may be.
    channels, units : of `peaks` : (n_segment, n_channel), largest |value| of the command v,
    of each sensor and of the moment or force at each actuated joint, in the segment.
    margins : worst first. outputs : the actuators that are driven, the first channels.
    """

    duration: float
    shortest: float
    channels: tuple[str, ...]
    units: tuple[str, ...]
    peaks: Float
    slew: float
    margins: tuple[Margin, ...]
    bands: tuple[BandError, ...]
    outputs: tuple[str, ...] = ()

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

    A plan whose dwells may be left early is predicted several ways (see `dwell.ways`), as the
    time spent at one frequency decides what of it is left in the next. Peaks and margins are the
    worst of all, the duration and the expected errors those of every dwell in full.

    Raises LimitError if the chain or the rig's own loops would be unstable, InputError if the
    rig could never be armed, its source moves nothing, a dwell would leave a step, or the plan
    has another sample rate.
    """
    plan = completed(plan, rig)
    if plan.rate_hz != rig.rate_hz:
        where, expected = f"experiment {plan.experiment}", f"{rig.rate_hz:g}, the rig's own"
        raise InputError(where, "rate_hz", plan.rate_hz, expected)
    _refuse_falling(rig)
    full, *others = [_predict(way, rig) for way in ways(plan)]
    if not others:
        return full
    return replace(
        full,
        shortest=min(other.duration for other in others),
        peaks=np.max([full.peaks, *(other.peaks for other in others)], axis=0),
        slew=max(full.slew, *(other.slew for other in others)),
        margins=worse_of([full.margins, *(other.margins for other in others)]),
    )


def _predict(plan: Plan, rig: Rig) -> DryRun:
    for output in plan.outputs:
        if find_actuator(rig, output.actuator, rig.name).deadman is None:
            expected = "the device's own, in s; without one it is never armed"
            raise InputError(rig.name, f"actuator[{output.actuator}].deadman", None, expected)
    driven = [o.actuator for o in plan.outputs]
    moments = tuple(m for name in driven for m in _joint_moments(rig, name))
    seen = rig.model_copy(update={"sensor": (*rig.sensor, *moments)})
    u = np.concatenate([columns(s.u) for s in plan.segments])
    theta_ref = np.concatenate([columns(s.theta_ref) for s in plan.segments])
    n = fft.next_fast_len(math.ceil(len(u) * (1 + PAD)), real=True)
    sigma = -math.log(WRAP) * plan.rate_hz / n
    omega = 2 * np.pi * plan.rate_hz * np.arange(n // 2 + 1) / n
    s = np.asarray(sigma + 1j * omega, dtype=np.complex128)
    H = _sampled(seen, driven, s)
    for j, name in enumerate(driven):
        if not np.any(np.abs(H[:, :, j]) > 0.0):
            expected = f"an end that {name} can push against; it moves nothing"
            raise InputError(rig.name, "base", rig.base, expected)
    limits = plan_limits(plan, rig)
    closed = ClosedLoops.of(plan, rig, H, np.exp(s / plan.rate_hz))
    closed.refuse_unstable(plan)
    shrink = np.exp(-sigma * np.arange(len(u)) / plan.rate_hz)[:, None]
    kp = np.array([o.kp for o in plan.outputs])
    command = closed.outputs(fft.rfft((u + kp * theta_ref) * shrink, n, axis=0))

    def in_time(spectrum: Complex) -> Float:
        x: Float = fft.irfft(spectrum, n)[: len(u)] / shrink[:, 0]
        return x

    v = {name: in_time(command[:, j]) for j, name in enumerate(driven)}
    y = {x.name: in_time((command * H[:, i]).sum(axis=1)) for i, x in enumerate(seen.sensor)}
    added = {
        loop.name: in_time((command * H[:, i]).sum(axis=1) * own[:, k])
        for one, own in zip(closed.loops, closed.filters, strict=True)
        for k, (i, loop) in enumerate(one.feedback)
    }
    return _seen(plan, rig, limits, {**v, **y}, added, omega / (2 * np.pi), H)


def _seen(
    plan: Plan,
    rig: Rig,
    limits: tuple[GateLimits, ...],
    series: dict[str, Float],
    added: dict[str, Float],
    hz: Float,
    H: Complex,
) -> DryRun:
    """What the predicted series come to. H : (n, n_sensor, k) at hz."""
    units = {
        **rig.units(),
        **{m.name: m.unit for o in plan.outputs for m in _joint_moments(rig, o.actuator)},
    }
    ends = np.cumsum([len(s.u) for s in plan.segments])
    parts = [slice(int(e) - len(s.u), int(e)) for s, e in zip(plan.segments, ends, strict=True)]
    peaks = np.array([[np.abs(x[part]).max() for x in series.values()] for part in parts])
    for name, x in series.items():
        if not np.isfinite(x).all():
            raise LimitError(f"the model gives no number for {name} of {rig.name}; nothing is sent")
    spectrum = np.abs(H[:, : len(rig.sensor)])
    near, bands, steepest = [], list[BandError](), 0.0
    for j, (output, own) in enumerate(zip(plan.outputs, limits, strict=True)):
        v, alone = series[output.actuator], plan.only(j)
        steepest = max(steepest, float(np.abs(np.diff(v, prepend=0.0)).max() * plan.rate_hz))
        near.append(margins(alone, rig, own, series, added, parts))
        exciting, its_parts = exciting_only(alone, parts)
        if exciting.segments:
            found = expected_errors(exciting, rig, v, its_parts, hz, spectrum[:, :, j])
            name = output.actuator if plan.beside else ""
            bands += [replace(band, input=name) for band in found]
    return DryRun(
        duration=plan.duration,
        shortest=plan.duration,
        channels=tuple(series),
        units=tuple(units[name] for name in series),
        peaks=peaks,
        slew=steepest,
        margins=near[0] if len(near) == 1 else worse_of(near),
        bands=tuple(bands),
        outputs=tuple(o.actuator for o in plan.outputs),
    )


def _joint_moments(rig: Rig, actuator: str) -> tuple[Moment | Force, ...]:
    """A perfect moment sensor at each source that the actuator drives: M, which an angular
    velocity source passes on; of a torque or a force what the chain towards the base carries.
    Of a source along w, and in an axial chain, the force in place of the moment."""
    out: list[Moment | Force] = []
    for before, e in zip((None, *rig.element), rig.element, strict=False):
        if not isinstance(e, SOURCES) or e.input != actuator:
            continue
        pulls = isinstance(e, MOTION_SOURCES) or (
            rig.motion == "axial" and isinstance(e, ForceSource)
        )
        name = f"{'F' if pulls else 'M'}_{e.name}"[:40]
        passes = isinstance(e, (*ANGLE_SOURCES, *MOTION_SOURCES))
        at = (e if before is None or passes else before).name
        if name in rig.units():
            continue
        if pulls:
            out.append(Force(kind="force", name=name, unit="N", after=at))
        else:
            out.append(Moment(kind="moment", name=name, unit="N m", after=at))
    return tuple(out)


def _refuse_falling(rig: Rig) -> None:
    """LimitError if the chain by itself falls over: what is predicted holds for a stable one.

    Only what stands on a joint can do that. A chain with stiffness and gravity falls without
    swinging: its pole is real, where D, which is real there, changes its sign.
    """
    stands = min(rig.pulls) < 0 or any(
        isinstance(e, GravityStiffness) and e.k.value < 0 for e in flattened(rig.element)
    )
    if not stands:
        return
    s = np.geomspace(LOWEST_FALL, HIGHEST_FALL, FALLS) * rig.rate_hz
    D, _ = Chain(rig).characteristic(s.astype(np.complex128), clear=True)
    turns = np.flatnonzero(np.diff(np.sign(D.real)))
    if turns.size:
        raise LimitError(
            f"{rig.name} falls over by itself, by e in {1 / s[turns[-1]]:.2g} s by the model; "
            "expected more stiffness than gravity takes away"
        )


def _sampled(rig: Rig, actuators: list[str], s: Complex) -> Complex:
    """Sampled response (n, n_sensor, k) from these actuators at complex s: `sampled_response`
    with few aliases, off the imaginary axis."""
    places = [[a.name for a in rig.actuator].index(name) for name in actuators]
    delays = np.array([rig.actuator[j].delay for j in places])
    chain = Chain(rig)
    total = np.zeros((len(s), len(rig.sensor), len(places)), dtype=np.complex128)
    for k in range(-ALIASES, ALIASES + 1):
        at = s + 2j * np.pi * rig.rate_hz * k
        T = 1.0 / rig.rate_hz
        hold = -np.expm1(-at * T) / (at * T)
        late = np.exp(-at[:, None] * delays)
        # A chain answers a real input: G(conj s) = conj G(s).
        upper = np.where(at.imag < 0, at.conj(), at)
        G = chain.evaluate(upper)[:, :, places]
        G = np.where((at.imag < 0)[:, None, None], G.conj(), G)
        F = np.stack([filter_response(x, at) * np.exp(-at * x.delay) for x in rig.sensor], axis=1)
        total += G * F[:, :, None] * (hold[:, None] * late)[:, None, :]
    return total


def _round_down(x: float) -> str:
    """Three digits, never more than x: a level that is typed in as printed must pass."""
    step = 10.0 ** (math.floor(math.log10(x)) - 2)
    return f"{math.floor(x / step * (1 + 1e-12)) * step:.3g}"
