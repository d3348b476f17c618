"""Wiring: units, signs and the order of channels, told from the ratio to the nominal model.

A unit is a factor that all frequencies share, a sign half a turn that they share, two swapped
channels each fit the other's model. All are mended, as they are exactly known.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from samii_rig.diagnose.physics.confusions import UNITS, nearest
from samii_rig.model.sampled import sampled_response
from samii_rig.rig.schema import SOURCES, Rig, parameters
from samii_rig.signal.several.undriven import as_measured
from samii_rig.types import Complex, Float, FrequencyResponse, Recording

LINES_LOOKED_AT = 300  # lines of a response that are looked at
UNIT_WITHIN = 1.25  # factor between a channel's gain and a unit; what a rig file may be off by
HALF_WITHIN = 1.6  # half of a channel's lines lie within this factor of their median
OPPOSITE = -0.7  # cosine of the median phase error from which a sign is wrong
SWAPPED = 0.15  # of the misfit of two channels that is left when they are exchanged
MISFIT = 0.5  # least misfit (squared logarithm a line) for which they are
MOST_MISFIT = 4.0  # of one line: what is far off in any case
FEW_LINES = 12  # below which nothing can be told from noise
# Standard deviations of an estimate from which a line says what it is to the model: noise alone is
# as large in one line of 3,000. A sensor that shows next to nothing but noise is no unit off.
SHOWN_LINE = 4.0


@dataclass(frozen=True, slots=True)
class Mend:
    """What makes columns those of the rig file. source : of each that is changed, by name, the
    column that holds it and the factor that it is multiplied by."""

    source: Mapping[str, tuple[str, float]]

    def __call__(self, run: Recording) -> Recording:
        """A recording with these columns mended; others, and columns that it lacks, stay."""
        values, quality = run.values.copy(), run.quality.copy()
        have = {c.name for c in run.channels}
        for name, (column, factor) in self.source.items():
            if {name, column} <= have:
                i, j = run.column(name), run.column(column)
                values[:, i] = factor * run.values[:, j]
                quality[:, i] = run.quality[:, j]
        return replace(run, values=values, quality=quality)


@dataclass(frozen=True, slots=True)
class Wired:
    """Responses with channels in the rig file's order, units and signs.

    remarks : what was changed, once for all that share it. units : channels whose unit was.
    mend : the same for their recordings; None where it differs from one response to another.
    """

    responses: list[FrequencyResponse]
    remarks: list[str]
    units: frozenset[str]
    mend: Mend | None


def wired(responses: Sequence[FrequencyResponse], rig: Rig) -> Wired:
    """What the ratio of each response to the rig's model tells of units, signs and order."""
    where: dict[str, list[FrequencyResponse]] = {}
    out, units, mends = [], set(), []
    for r in responses:
        mended, remarks, order, gains = _mended(r, rig)
        out.append(mended)
        units |= {c.name for c, g in zip(r.outputs, gains, strict=True) if abs(g) != 1}
        mends.append(_columns(r, order, gains))
        for text in remarks:
            where.setdefault(text, []).append(r)
    remarks = []
    for text, those in where.items():
        some = f" ({', '.join(dict.fromkeys(named(r) for r in those))})"
        remarks.append(text + ("" if len(those) == len(responses) else some))
    alike = all(m == mends[0] for m in mends)
    return Wired(out, remarks, frozenset(units), Mend(mends[0]) if mends and alike else None)


def _columns(
    r: FrequencyResponse, order: Sequence[int], gains: Float
) -> dict[str, tuple[str, float]]:
    """As of `Mend`. What all channels share is the input's."""
    names = [c.name for c in r.outputs]
    if len(names) > 1 and gains[0] != 1 and np.all(gains == gains[0]):
        out = {c.name: (c.name, 1 / float(gains[0])) for c in r.inputs}
        gains = np.ones(len(names))
    else:
        out = {}
    each = zip(names, order, gains.tolist(), strict=True)
    return out | {n: (names[k], g) for n, k, g in each if names[k] != n or g != 1}


def _mended(
    r: FrequencyResponse, rig: Rig
) -> tuple[FrequencyResponse, list[str], list[int], Float]:
    pick = np.unique(np.linspace(0, r.frequency.size - 1, LINES_LOOKED_AT).astype(int))
    names = [s.name for s in rig.sensor]
    on = [names.index(c.name) for c in r.outputs]
    acting = [a.name for a in rig.actuator]
    model = sampled_response(rig, r.frequency[pick])[:, on]
    model = as_measured(lines_of(r, pick), model, acting)
    hidden = np.abs(r.H[pick]) < SHOWN_LINE * np.sqrt(r.variance()[pick])
    H, remarks = np.where(hidden, 0.0, r.H[pick]), []
    order = list(range(len(on)))
    for a, b in _swaps(H, model):
        order[a], order[b] = order[b], order[a]
        remarks.append(
            f"{r.outputs[a].name} and {r.outputs[b].name} are swapped; taken for each other"
        )
    if remarks:
        labels = r.outputs
        r = replace(outputs_of(r, order), outputs=labels)
        H = H[:, order]
    gains, words = _gains(H, model, r, _tolerance(rig))
    return scaled(r, gains) if words else r, remarks + words, order, gains


def _ratio(H: Complex, model: Complex) -> Complex:
    """Logarithm of measurement over model (n, n_out, n_in); nan where one of them is 0."""
    good = (np.abs(H) > 0) & (np.abs(model) > 0)
    log = np.log(np.where(good, H, 1.0) / np.where(good, model, 1.0))
    return np.asarray(np.where(good, log, np.nan))


def misfit(H: Complex, model: Complex) -> float:
    """Mean squared logarithm of measurement over model, of one line `MOST_MISFIT` at most; infinite
    where no line shows any."""
    log = np.abs(_ratio(H, model)) ** 2
    known = np.minimum(log[np.isfinite(log)], MOST_MISFIT)
    return float(np.mean(known)) if known.size else math.inf


def _swaps(H: Complex, model: Complex) -> list[tuple[int, int]]:
    """Pairs of outputs that each fit the other's model, the clearest first, none twice."""
    found = []
    for a, b in combinations(range(H.shape[1]), 2):
        before = (misfit(H[:, [a]], model[:, [a]]), misfit(H[:, [b]], model[:, [b]]))
        after = (misfit(H[:, [b]], model[:, [a]]), misfit(H[:, [a]], model[:, [b]]))
        if min(before) > MISFIT and max(after) < SWAPPED * min(before):
            found.append((sum(after), a, b))
    out: list[tuple[int, int]] = []
    for _, a, b in sorted(found):
        if not {a, b} & {x for pair in out for x in pair}:
            out.append((a, b))
    return out


def _tolerance(rig: Rig) -> float:
    """By what part the gain of a source may be off, by its tolerance."""
    sources = [e for e in rig.element if isinstance(e, SOURCES)]
    return max((parameters(e)["K"].tolerance for e in sources), default=0.0)


def _gains(
    H: Complex, model: Complex, r: FrequencyResponse, tolerance: float
) -> tuple[Float, list[str]]:
    """Factors (n_out,) that bring every output to the rig file's unit and sign, and words."""
    log = _ratio(H, model)
    n = log.shape[1]
    unit = [_unit(log[:, k], tolerance) for k in range(n)]
    turned = [_opposite(log[:, k]) for k in range(n)]
    gains, words = np.ones(n), []
    inputs = ", ".join(c.name for c in r.inputs)
    every = n > 1 and unit[0] != 1.0 and all(u == unit[0] for u in unit)
    if every:
        words.append(f"every channel is {unit[0]:.4g} times what the rig file says: {inputs} "
                     f"is not in the unit of the rig file; taken in it")  # fmt: skip
    if n > 1 and all(turned):
        words.append(f"every channel has the wrong sign: {inputs} is turned round; turned back")
    for k in range(n):
        name = r.outputs[k].name
        if unit[k] != 1.0 and not every:
            words.append(f"{name} is {unit[k]:.4g} times what the rig file says: "
                         f"{nearest(unit[k])[0].name}; divided by it")  # fmt: skip
        if turned[k] and not (n > 1 and all(turned)):
            words.append(f"{name} has the wrong sign; turned round")
        gains[k] = (-1.0 if turned[k] else 1.0) / unit[k]
    return gains, words


def _unit(log: Complex, tolerance: float) -> float:
    """The factor between units that all lines of an output share; 1 for none, or where two are as
    near as a drive's gain may be off: these are distinguished by the fit."""
    size = log.real[np.isfinite(log)]
    if size.size < FEW_LINES:
        return 1.0
    low, middle, high = np.quantile(size, [0.25, 0.5, 0.75])
    if high - low > 2 * math.log(HALF_WITHIN):
        return 1.0
    _, best = nearest(math.exp(float(middle)))
    within = math.log(UNIT_WITHIN) + 2 * tolerance
    others = [f for u in UNITS for f in (u.factor, 1 / u.factor, 1.0) if f != best]
    if any(abs(float(middle) - math.log(f)) < within for f in others):
        return 1.0
    return best if abs(float(middle) - math.log(best)) < math.log(UNIT_WITHIN) else 1.0


def _opposite(log: Complex) -> bool:
    """Whether an output is half a turn off at nearly all frequencies."""
    phase = log.imag[np.isfinite(log)]
    if phase.size < FEW_LINES:
        return False
    turn = np.cos(phase)
    return float(np.median(turn)) < OPPOSITE and float(np.quantile(turn, 0.75)) < OPPOSITE / 2


def lines_of(r: FrequencyResponse, keep: np.ndarray) -> FrequencyResponse:
    """Some lines of a response."""
    return replace(
        r,
        frequency=r.frequency[keep],
        H=r.H[keep],
        covariance=r.covariance[keep],
        dof=r.dof[keep],
        coherence=r.coherence[keep],
        input_rms=r.input_rms[keep],
        even=None if r.even is None else r.even[keep],
        odd=None if r.odd is None else r.odd[keep],
        noise=None if r.noise is None else r.noise[keep],
        distortion=None if r.distortion is None else r.distortion[keep],
        follow=None if r.follow is None else r.follow[keep],
    )


def outputs_of(r: FrequencyResponse, keep: Sequence[int]) -> FrequencyResponse:
    """Some outputs of a response, in the order asked for."""
    i, n_in = np.asarray(keep), len(r.inputs)
    entries = (i[:, None] * n_in + np.arange(n_in)).ravel()
    return replace(
        r,
        H=r.H[:, i],
        covariance=r.covariance[:, entries[:, None], entries],
        coherence=r.coherence[:, i],
        outputs=tuple(r.outputs[k] for k in i),
        even=None if r.even is None else r.even[:, i],
        odd=None if r.odd is None else r.odd[:, i],
        noise=None if r.noise is None else r.noise[:, i],
        distortion=None if r.distortion is None else r.distortion[:, i],
    )


def scaled(r: FrequencyResponse, gains: Float) -> FrequencyResponse:
    """Every output (n_out,) multiplied by a real gain."""
    g = np.repeat(gains, len(r.inputs))
    return replace(r, H=r.H * gains[:, None], covariance=r.covariance * (g[:, None] * g[None, :]))


def named(r: FrequencyResponse) -> str:
    """The level of a response, in words."""
    return f"at {r.level:g} {r.level_unit}" if math.isfinite(r.level) else "in the recording"
