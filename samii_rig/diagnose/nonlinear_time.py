"""Confirmation in time: the rig with a nonlinear force in its loop, driven by a recorded input.

The rig's partial fractions move by exact steps, some to a sample; the force is held over each.
Dry friction takes the value within its limits that stops the motion, if there is one, so that it
sticks without smoothing. Nothing of the describing functions is used.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from samii_rig.diagnose.nonlinear_laws import CUBIC, EXCESS, FRICTION, GAP, Law
from samii_rig.diagnose.nonlinear_model import LevelModel, Quasi
from samii_rig.diagnose.refit import Fitted
from samii_rig.diagnose.rigfile import explained
from samii_rig.model.realise import Realisation, realise
from samii_rig.rig.schema import Rig
from samii_rig.types import Complex, Float, Recording

INNER = 8  # steps a sample
BETTER = 0.95  # of the linear model's error, at most, for a force to be confirmed
LONGEST = 30_000  # samples of a run that are simulated
MOST_RUNS = 6
NONE, DRY, CUBE, PLAY, LIMIT, FLOW = range(6)
_CODES: tuple[tuple[Law, int], ...] = ((FRICTION, DRY), (CUBIC, CUBE), (GAP, PLAY), (EXCESS, LIMIT))


@dataclass(frozen=True, slots=True)
class Confirmation:
    """Relative error of the outputs, rms over the recorded rms, each channel's weight the same.

    linear : of the refitted linear model; forced : with the force; runs : how many.
    """

    linear: float
    forced: float
    runs: int

    @property
    def holds(self) -> bool:
        """Whether the force makes the prediction better."""
        return self.forced < BETTER * self.linear

    def told(self) -> str:
        """In words."""
        return (
            f"simulated in time on {self.runs} recorded inputs: relative error "
            f"{self.linear:.3g} without the nonlinear force, {self.forced:.3g} with it"
        )


@njit(cache=True)
def _force(
    code: int, p: float, scale: float, y: float, other: float, free: float, g: float
) -> float:
    """The force, from the place y, the chain's moment, and the speed free that there would be."""
    if code == DRY:
        return scale * min(max(-free / (scale * g), -p), p) if g != 0.0 else 0.0
    if code == CUBE:
        return scale * p * y * y * y
    if code == PLAY:
        return scale * min(max(y, -p / 2), p / 2)
    if code == LIMIT:
        return scale * (y - min(max(y, -p), p))
    if code == FLOW:
        left = 1.0 + other / p if y >= 0.0 else 1.0 - other / p
        return float(y * (np.sqrt(max(left, 0.0)) - 1.0))
    return 0.0


@njit(cache=True)
def _run(
    poles: Complex,
    grow: Complex,
    push: Complex,
    R: Complex,
    D: Float,
    v: Float,
    late: int,
    inner: int,
    at: int,
    code: int,
    command: bool,
    p: float,
    scale: float,
    own: int,
) -> Float:
    """(n_step, n_out) outputs before each step. R : (n_pole, n_out, n_in), pairs counted twice.
    at : the output that the force is driven by; own : the input that it is fed into."""
    n_pole, n_out, n_in = R.shape
    z = np.zeros((n_pole, n_in), dtype=np.complex128)
    y = np.zeros((v.size * inner, n_out))
    # Speed at the end of a step per unit force over it.
    g = 0.0
    if code == DRY:
        for k in range(n_pole):
            g += (R[k, at, own] * (poles[k] * push[k] + 1.0)).real
    e = 0.0
    for step in range(y.shape[0]):
        n = (step - late) // inner
        u = v[n] if n >= 0 else 0.0
        free = 0.0
        for i in range(n_out):
            total = D[i, 0] * u
            if n_in > 1:
                total += D[i, own] * e
            for j in range(n_in):
                for k in range(n_pole):
                    total += (R[k, i, j] * z[k, j]).real
            y[step, i] = total
        if code == DRY:
            for j in range(n_in):
                given = u if j == 0 else 0.0
                for k in range(n_pole):
                    ahead = grow[k] * z[k, j] + push[k] * given
                    free += (R[k, at, j] * (poles[k] * ahead + given)).real
        if code != NONE:
            reads = u if command else y[step, at]
            other = y[step, n_out - 1]
            e = _force(code, p, scale, reads, other, free, g)
        for j in range(n_in):
            given = u if j == 0 else 0.0
            if j == own:
                given += e
            for k in range(n_pole):
                z[k, j] = grow[k] * z[k, j] + push[k] * given
    return y


def realised(rig: Rig, quasi: Quasi | None = None) -> Realisation:
    """The partial fractions of the rig, with the force's own input and sensors."""
    return realise(quasi.widened(rig) if quasi else rig)


def simulate(
    rig: Rig,
    v: Float,
    quasi: Quasi | None = None,
    strength: float = 0.0,
    inner: int = INNER,
    made: Realisation | None = None,
) -> Float:
    """(n, n_sensor) the sensors at each sample of a command v (n,) from rest, without noise.

    rig : one actuator. strength : the force's unknown, in its unit. made : what `realised` gave.
    Raises InputError as `samii_rig.model.realise` does.
    """
    made = realised(rig, quasi) if made is None else made
    h = 1 / (rig.rate_hz * inner)
    poles = made.poles
    grow = np.exp(poles * h)
    still = np.abs(poles) * h < 1e-12
    push = np.where(still, h, (grow - 1) / np.where(still, 1.0, poles))
    R = made.residues * np.where(poles.imag > 0, 2.0, 1.0)[:, None, None]
    late = round((rig.actuator[0].delay + float(made.late[0])) / h)
    code, sign = NONE, 0.0
    if quasi is not None:
        sign = quasi.sign
        code = next((c for law, c in _CODES if law is quasi.law), FLOW)
        if quasi.scale is not None:
            name, symbol = quasi.scale
            part = next(e for e in rig.element if e.name == name)
            sign *= float(getattr(part, symbol).value)
        if code == DRY:
            sign = 1.0  # the value that stops the motion has the right sign by itself
    y = _run(
        poles, grow, push, np.ascontiguousarray(R), made.direct,
        np.ascontiguousarray(v, np.float64), late, inner, len(rig.sensor),
        code, quasi is not None and quasi.kind in ("command", "flow"),
        strength, sign, 1 if quasi is not None and quasi.own_input else 0,
    )  # fmt: skip
    out = np.empty((v.size, len(rig.sensor)))
    for i, sensor in enumerate(rig.sensor):
        at = np.arange(v.size) * inner - round(sensor.delay / h)
        out[:, i] = np.where(at >= 0, y[np.maximum(at, 0), i], 0.0)
    return out


def error(
    rig: Rig,
    run: Recording,
    quasi: Quasi | None = None,
    strength: float = 0.0,
    band: tuple[float, float] | None = None,
    made: Realisation | None = None,
) -> float:
    """Relative error of the simulated sensors on a recorded command, rms over the channels; nan
    where nothing was recorded.

    Offset and drift are taken off what differs: a source that turns integrates every offset of
    its drive. band : Hz, outside of which nothing counts.
    """
    n = min(len(run), LONGEST)
    v = run.values[:n, run.column(rig.actuator[0].name)]
    v = np.where(np.isfinite(v), v, 0.0)
    y = simulate(rig, v, quasi, strength, made=made)
    parts = []
    for i, sensor in enumerate(rig.sensor):
        if sensor.name not in run.names("sensor"):
            continue
        d = run.values[:n, run.column(sensor.name)]
        known = np.isfinite(d)
        if not known.any():
            continue
        line = np.stack([np.ones(n), np.linspace(-1, 1, n)], axis=1)[known]
        d = d[known] - np.mean(d[known])
        e = y[known, i] - d
        e = e - line @ np.linalg.lstsq(line, e, rcond=None)[0]
        power = _power(d, known, rig.rate_hz, band)
        if power > 0:
            parts.append(_power(e, known, rig.rate_hz, band) / power)
    return float(np.sqrt(np.mean(parts))) if parts else float("nan")


def _power(
    x: Float, known: NDArray[np.bool_], rate_hz: float, band: tuple[float, float] | None
) -> float:
    """Sum of squares of the known samples, of their part in a band where there is one."""
    if band is None:
        return float(x @ x)
    whole = np.zeros(known.size)
    whole[known] = x
    X = np.fft.rfft(whole)
    f = np.fft.rfftfreq(known.size, 1 / rate_hz)
    return float(np.sum(np.abs(X[(f >= band[0]) & (f <= band[1])]) ** 2))


def pieces(runs: Sequence[Recording]) -> list[Recording]:
    """One burst of each level, the last, as that began at rest; whole runs without segments."""
    out: dict[tuple[float, str] | int, Recording] = {}
    for i, run in enumerate(runs):
        if not run.segments:
            out[i] = run
        for segment in run.segments:
            if segment.kind != "periodic":
                out[segment.level, segment.unit] = run.cut(segment)
    return list(out.values())[-MOST_RUNS:]


def confirm(
    linear: Fitted,
    forced: Fitted,
    runs: Sequence[Recording],
    band: tuple[float, float] | None = None,
) -> Confirmation:
    """Both models on runs that were recorded, the refitted linear one without the force."""
    model = forced.model
    assert isinstance(model, LevelModel)
    strength = float(np.exp(forced.x[model.unknown]))
    with_force, without = explained(forced), explained(linear)
    plain, wide = realised(without), realised(with_force, model.quasi)
    a = [error(without, run, band=band, made=plain) for run in runs]
    b = [error(with_force, run, model.quasi, strength, band, wide) for run in runs]
    return Confirmation(
        float(np.sqrt(np.nanmean(np.square(a)))),
        float(np.sqrt(np.nanmean(np.square(b)))),
        len(runs),
    )
