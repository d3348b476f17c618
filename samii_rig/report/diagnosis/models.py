"""What a diagnosis is shown against: the models before and after, and x(w) at a cause.

Of a cause in the model all but its strength is kept: scaled by t the outputs are Moebius functions
y_k = (a_k + b_k t)/(1 + g t), and a factor of a channel is y_k = b_k t. At each frequency the
measurement then gives t, and x = t times the law; t is about 1 where the law is right.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from samii_rig.diagnose.data.measured import binned, measured
from samii_rig.diagnose.fit.refit import Problem, refit
from samii_rig.diagnose.fit.rigfile import explained
from samii_rig.diagnose.physics import insert
from samii_rig.diagnose.physics.along import POSITION
from samii_rig.diagnose.physics.grid import grid
from samii_rig.diagnose.physics.model import Model
from samii_rig.diagnose.physics.points import POINTS
from samii_rig.diagnose.physics.rows import EVERY_SENSOR
from samii_rig.diagnose.result import Cause
from samii_rig.model.sampled import sampled_response
from samii_rig.report.compare import ModelCurve
from samii_rig.report.diagnosis.laws import factor_curve, jump_curve
from samii_rig.rig.schema import Rig
from samii_rig.rig.schema.elements import flattened, parameters
from samii_rig.types import Complex, Float, FrequencyResponse

STRENGTHS = (0.5, 1.0, 2.0)  # times the cause's own; three points give the Moebius function
# Divided difference over STRENGTHS: nothing is left of what is linear in t.
_CURVED = np.array([1 / 0.75, -1 / 0.5, 1 / 1.5])
# x falls with these symbols: the stronger the part, the smaller.
_INVERSE = ("torsional_compliance", "translational_compliance", "velocity_feedback")
# Parameters of elements by the symbols that a cause tells them by.
_REPORTED = {row.physics: {row.strong: row.reported} for row in POINTS if row.reported}
_KEPT = {"D"}  # parameters that say what the part is, not how strong
MOST_LINES = 1500  # at which a model is evaluated for a picture
BINS_PER_DECADE = 30
# 90 % of a real part whose complex number has standard deviation 1.
HALF = 1.645 / math.sqrt(2)
STEPS = 5  # of Gauss-Newton; the start is right but for the noise in the denominator
_TINY = 1e-300


@dataclass(frozen=True, slots=True)
class Strength:
    """x(w) at the place of a cause, as one response has it.

    frequency : (n,) Hz, middles of bins. x : (n,). sd : (n,) of the complex x. law : (n,).
    """

    level: str
    frequency: Float
    x: Complex
    sd: Float
    law: Complex

    @property
    def strength(self) -> tuple[float, float]:
        """Part of the law's size that is there over all frequencies, and half its 90 % band."""
        w = (np.abs(self.law) / self.sd) ** 2
        return float(np.sum(w * (self.x / self.law).real) / w.sum()), HALF / math.sqrt(w.sum())


def refitted_nominal(
    rig: Rig, responses: Sequence[FrequencyResponse], band_hz: tuple[float, float] | None
) -> Rig:
    """The rig with nothing added, its uncertain parameters at their best for all lines."""
    lines = measured(responses, rig, band_hz)
    at = grid(rig, lines.frequency, lines.sensor, lines.actuator)
    model = Model(rig)
    x = np.zeros(model.n)
    for _ in range(2):  # the second time with bins that suit the first's end
        shape = model.response(x, at.at(lines.frequency, lines.level))
        fitted = refit(model, Problem.of(binned(lines, shape), at), x)
        x = fitted.x
    return explained(fitted)


def curve(rig: Rig, name: str, responses: Sequence[FrequencyResponse]) -> ModelCurve:
    """The sampled rig's response over the band that was measured."""
    f = np.unique(np.concatenate([r.frequency for r in responses]))
    f = _thinned(f[(f > 0) & (f < rig.rate_hz / 2)])
    sensors = tuple(s.name for s in rig.sensor)
    inputs = tuple(a.name for a in rig.actuator)
    return ModelCurve(name, f, sampled_response(rig, f), sensors, inputs)


def strengths(
    cause: Cause, rig: Rig, responses: Sequence[FrequencyResponse], band_hz: tuple[float, float]
) -> tuple[Strength, ...]:
    """x(w) at a cause, by response, about `rig`, the model with all causes.

    Empty where the cause is no part at one place and no factor of a channel.
    """
    found = []
    for r in responses:
        inside = (r.frequency > max(band_hz[0], 0.0)) & (r.frequency <= band_hz[1])
        inside &= np.isfinite(r.H).all(axis=(1, 2)) & (r.frequency < rig.rate_hz / 2)
        rows = np.flatnonzero(inside)
        if not rows.size:
            continue
        rows = rows[:: -(-rows.size // MOST_LINES)]
        f = r.frequency[rows]
        law = jump_curve(cause, f)
        if law is not None:
            lines = _jump(cause, rig, r, f)
        else:
            law = factor_curve(cause, f)
            lines = None if law is None else _factor(cause, rig, r, f)
        if law is None or lines is None:
            continue
        shown, a, b, g = lines
        d = r.H[rows].reshape(rows.size, -1)[:, shown]
        C = r.covariance[rows][:, shown][:, :, shown]
        label = f"{r.level:g} {r.level_unit}" if np.isfinite(r.level) else "measured"
        found.append(_solved(label, f, law, d, C, a, b, g))
    return tuple(found)


Lines = tuple[list[int], Complex, Complex, Complex]


def _jump(cause: Cause, rig: Rig, r: FrequencyResponse, f: Float) -> Lines | None:
    """Entries of H, a, b (n, q) and g (n,) with the strength of the part that `cause` put in."""
    name = _part(cause, rig)
    if name is None:
        return None
    power = -1 if cause.physics in _INVERSE else 1
    y = np.stack([_entries(_scaled(rig, name, t**power), r, f) for t in STRENGTHS], axis=2)
    shown = [k for k in range(y.shape[1]) if np.all(np.isfinite(y[:, k]))]
    if not shown:
        return None
    y = y[:, shown]
    t = np.array(STRENGTHS)
    curved, of_ty = y @ _CURVED, (y * t) @ _CURVED
    size = np.mean(np.abs(y[:, :, 1]) ** 2, axis=0)
    above = np.sum(of_ty.conj() * curved / size, axis=1)
    below = np.sum(np.abs(of_ty) ** 2 / size, axis=1)
    g = -above / np.maximum(below, _TINY)
    n = y * (1 + g[:, None] * t[None, :])[:, None, :]
    b = (n[:, :, 2] - n[:, :, 0]) / (t[2] - t[0])
    return shown, n[:, :, 1] - b, b, g


def _factor(cause: Cause, rig: Rig, r: FrequencyResponse, f: Float) -> Lines | None:
    """The same for a factor on one sensor, or on the input."""
    y = _entries(rig, r, f)
    every = not cause.physics.startswith("sensor") or cause.site == EVERY_SENSOR
    outputs = [c.name for c in r.outputs for _ in r.inputs]
    shown = [
        k
        for k, name in enumerate(outputs)
        if (every or name == cause.site) and np.all(np.isfinite(y[:, k]))
    ]
    if not shown:
        return None
    return shown, np.zeros((f.size, len(shown)), complex), y[:, shown], np.zeros(f.size, complex)


def _entries(rig: Rig, r: FrequencyResponse, f: Float) -> Complex:
    """(n, n_out*n_in) the rig's response in the order of `r`; NaN where it has no such channel."""
    H = sampled_response(rig, f)
    sensors, inputs = [s.name for s in rig.sensor], [a.name for a in rig.actuator]
    out = np.full((f.size, len(r.outputs), len(r.inputs)), np.nan + 0j)
    for i, y in enumerate(r.outputs):
        for j, u in enumerate(r.inputs):
            if y.name in sensors and u.name in inputs:
                out[:, i, j] = H[:, sensors.index(y.name), inputs.index(u.name)]
    return out.reshape(f.size, -1)


def _solved(
    level: str, f: Float, law: Complex, d: Complex, C: Complex, a: Complex, b: Complex, g: Complex
) -> Strength:
    """One t for each narrow bin of frequency, by least squares with the noise of the entries d."""
    bins = np.floor(BINS_PER_DECADE * np.log10(f)).astype(np.int64)
    first = np.flatnonzero(np.diff(bins, prepend=bins[0] - 1))
    count = np.diff(np.append(first, f.size))

    def total(of_line: Complex) -> Complex:
        return np.asarray(np.add.reduceat(of_line, first))

    W = np.asarray(np.linalg.pinv(C, hermitian=True), np.complex128)
    # Linear in t after multiplication by the denominator; then Gauss-Newton on what was measured.
    u, v = a - d, g[:, None] * d - b
    t = total(_product(v, W, u)) / np.maximum(total(_product(v, W, v)).real, _TINY)
    s = (b - a * g[:, None]) / (1 + g)[:, None] ** 2
    at_law = np.maximum(total(_product(s, W, s)).real, _TINY)
    for _ in range(STEPS):
        on = np.repeat(t, count)
        below = (1 + g * on)[:, None]
        e = d - (a + b * on[:, None]) / below
        s = (b - a * g[:, None]) / below**2
        power = np.maximum(total(_product(s, W, s)).real, _TINY)
        t = np.asarray(t + total(_product(s, W, e)) / power)
    # A strong part moves the outputs no more: where the law says that the data cannot tell, a
    # value far from it that pretends to be well known is an accident.
    sd = np.maximum(1 / np.sqrt(power), np.abs(t) / np.sqrt(at_law))
    middle = np.exp(np.add.reduceat(np.log(f), first) / count)
    parts = [np.interp(np.log(middle), np.log(f), part) for part in (law.real, law.imag)]
    x = np.asarray(parts[0] + 1j * parts[1], np.complex128)
    return Strength(level, middle, t * x, np.abs(x) * sd, x)


def _product(a: Complex, W: Complex, b: Complex) -> Complex:
    """(n,) a^H W b of each line."""
    return np.asarray(np.einsum("ni,nij,nj->n", a.conj(), W, b))


def _part(cause: Cause, rig: Rig) -> str | None:
    """Name of the element that was put in for `cause`: the one with its values."""
    symbols = {v: k for k, v in _REPORTED.get(cause.physics, {}).items()}
    own = {k: v for k, v in cause.parameters.items() if k != POSITION}
    wanted = {symbols.get(k, k): v.value for k, v in own.items()}
    for e in rig.element:
        if not e.name.startswith(insert.PREFIX):
            continue
        has = {k: p.value for part in flattened((e,)) for k, p in parameters(part).items()}
        if wanted and all(np.isclose(has.get(k, np.nan), x, rtol=1e-6) for k, x in wanted.items()):
            return e.name
    return None


def _scaled(rig: Rig, name: str, factor: float) -> Rig:
    """The rig with every strength of one element, and of those on it, times `factor`."""

    def scaled(e: object) -> object:
        update: dict[str, object] = {
            k: p.model_copy(update={"value": p.value * factor})
            for k, p in parameters(e).items()  # type: ignore[arg-type]
            if k not in _KEPT
        }
        if getattr(e, "kind", "") == "branch":
            update["element"] = tuple(scaled(x) for x in e.element)  # type: ignore[attr-defined]
        return e.model_copy(update=update)  # type: ignore[attr-defined]

    elements = tuple(scaled(e) if e.name == name else e for e in rig.element)
    return rig.model_copy(update={"element": elements})


def _thinned(f: Float) -> Float:
    """At most about `MOST_LINES` of the frequencies, evenly on a logarithmic axis."""
    if f.size <= MOST_LINES:
        return f
    at = np.searchsorted(f, np.geomspace(f[0], f[-1], MOST_LINES))
    return np.asarray(f[np.unique(np.minimum(at, f.size - 1))])
