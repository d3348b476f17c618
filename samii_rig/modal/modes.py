"""Modes of one measured frequency response: frequency, damping, shape, each with its interval.

    found = find_modes(response, rig)
    found.modes[0].frequency_hz.interval(), found.modes[0].damping, found.modes[0].shape

Poles of the stabilisation diagram (`stabilisation`) start a maximum likelihood in output error
(`refine`), enlarged and pruned until noise explains the rest (`selection`). What is estimated are
the poles of the measured response: from a command, those of the plant that it drives, whatever loop
computes the command; from a reference, those of the closed loop. A zero-order hold, delays and
filters move no pole; they turn residues, and are divided out where the rig file gives them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import special

from samii_rig.errors import EstimateError
from samii_rig.modal.lines import Lines, lines_of
from samii_rig.modal.participation import Factored, factored
from samii_rig.modal.plscf import Coefficients
from samii_rig.modal.rational import Rational
from samii_rig.modal.selection import FALSE_ALARM, Selected, fixed, lines_under, select, widened
from samii_rig.modal.stabilisation import Diagram, diagram
from samii_rig.rig.schema import Rig
from samii_rig.signal.whitening import Fit
from samii_rig.types import Complex, Float, FrequencyResponse

HEAVY = 0.3  # damping ratio above which a pair of poles is background, not a mode
# Lines that a stepped sine has in the width of a mode at least: each is an experiment of its own,
# and a grid that steps over a resonance has not seen it.
GRID = 3.0
# Chi-square per degree of freedom above which the model misses more than the covariance might.
MISSES = 1.5
VAGUE = 0.1  # relative standard deviation of a frequency above which it is none
ZOOMED = 0.5  # lowest over highest frequency above which the polynomials' band starts at the lowest
LEVEL = 0.9  # probability of every interval


@dataclass(frozen=True, slots=True)
class Value:
    """A number with its standard deviation."""

    value: float
    sd: float

    def interval(self, level: float = LEVEL) -> tuple[float, float]:
        """Two-sided interval of this probability."""
        half = self.half(level)
        return self.value - half, self.value + half

    def half(self, level: float = LEVEL) -> float:
        """Half the width of `interval`."""
        return float(special.ndtri((1 + level) / 2)) * self.sd


@dataclass(frozen=True, slots=True)
class Mode:
    """One mode.

    frequency_hz : natural frequency |a|/(2 pi) of the pole a. damping : -Re a/|a|.
    pole : rad/s, Im > 0. shape : (n_out,) complex, 1 at `reference`, the output that knows the mode
        best. shape_covariance : (n_out, 2, 2) of real and imaginary part.
    participation : (n_in,) complex; shape times it is the residue (rad/s times output over input).
    sigma : how far the mode stands above the noise, the root of chi-square lost without it.
    chance : probability that noise makes such a mode anywhere in the band.
    orders : orders of the diagram that show it stable.
    """

    frequency_hz: Value
    damping: Value
    pole: complex
    shape: Complex
    shape_covariance: Float
    participation: Complex
    reference: int
    sigma: float
    chance: float
    orders: int

    def shape_interval(self, level: float = LEVEL) -> tuple[Float, Float]:
        """(n_out,) half widths of the intervals of the shape's real and imaginary parts."""
        sd = np.sqrt(np.diagonal(self.shape_covariance, axis1=1, axis2=2))
        half = float(special.ndtri((1 + level) / 2)) * sd
        return half[:, 0], half[:, 1]

    @property
    def complexity(self) -> float:
        """0 for a shape whose parts move in phase or against it, 1 for one that only turns."""
        whole = abs(np.sum(self.shape**2)) / np.sum(np.abs(self.shape) ** 2)
        return float(1 - whole)


@dataclass(frozen=True, slots=True)
class ModalModel:
    """The modes of one response, by frequency.

    background : poles that are no modes, rad/s: heavily damped, or outside the band.
    unresolved : Hz of resonances that a stepped sine's grid steps over: no modes.
    fit : chi-square of the whole model; intervals are wider by `inflation` where it is refused.
    frequency : (n,) Hz. prediction : (n, n_out, n_in) of the model there, hold and filters in.
    poles, residues : (n_mode,) rad/s and (n_mode, n_out, n_in) rad/s times output over input, each
        entry by itself, of the model with poles above the band, proven or not.
    covariance : of both, of all modes together, in the order of `saved.numbers`.
    of : what the poles are those of, in words. divided : what was divided out, in words.
    closed_loop : whether a reference is the input, and a loop around the rig is in the poles.
    """

    modes: tuple[Mode, ...]
    outputs: tuple[str, ...]
    units: tuple[str, ...]
    inputs: tuple[str, ...]
    background: Complex
    unresolved: tuple[float, ...]
    poles: Complex
    residues: Complex
    covariance: Float
    fit: Fit
    inflation: float
    diagram: Diagram
    model: Rational
    frequency: Float
    prediction: Complex
    level: float
    level_unit: str
    method: str
    of: str
    divided: str
    closed_loop: bool

    def plain(self) -> dict[str, Any]:
        """Numbers and words as plain data, for machines; intervals are of 90 %."""
        return {
            "level": self.level,
            "level_unit": self.level_unit,
            "method": self.method,
            "inputs": list(self.inputs),
            "outputs": list(self.outputs),
            "units": list(self.units),
            "of": self.of,
            "divided": self.divided,
            "closed_loop": self.closed_loop,
            "low_hz": float(self.frequency[0]),
            "high_hz": float(self.frequency[-1]),
            "chi_square_per_dof": self.fit.ratio,
            "p_value": self.fit.p_value,
            "inflation": self.inflation,
            "false_alarm": FALSE_ALARM,
            "unresolved_hz": list(self.unresolved),
            "modes": [_plain(m, self.outputs) for m in self.modes],
            "poles": _pairs(self.poles),
            "residues": _pairs(self.residues),
            "covariance": self.covariance.tolist(),
        }


def find_modes(
    response: FrequencyResponse,
    rig: Rig | None = None,
    *,
    band: tuple[float, float] | None = None,
    outputs: Sequence[str] | None = None,
    pick: Sequence[float] = (),
    coefficients: Coefficients | None = None,
) -> ModalModel:
    """Modes of `response`.

    rig : gives hold, filters and delays, which are divided out. band : Hz.
    pick : Hz, poles of the diagram that a person chose; these and no others are modes then.
    coefficients : of the diagram's polynomials; by default real ones, complex ones for a band
        that spans less than an octave.

    Raises InputError for an output, band or pick that there is not; EstimateError for too few
    lines or degrees of freedom.
    """
    d = lines_of(response, rig, band, outputs)
    if coefficients is None:
        coefficients = "complex" if d.frequency[0] > ZOOMED * d.frequency[-1] else "real"
    try:
        poles = diagram(d, coefficients)
        if pick:
            wanted = poles.pick(pick)
            found = fixed(d, wanted)
            chosen = [_nearest(found.model, a / d.scale) for a in wanted]
        else:
            found = select(d, poles.candidates[np.argsort(-poles.orders, kind="stable")])
            chosen = []
    except np.linalg.LinAlgError as failure:
        raise EstimateError("no modal model fits: the response holds numbers that are none") from (
            failure
        )
    return _modal_model(d, found, poles, chosen, picked=bool(pick))


def _nearest(model: Rational, pole: complex) -> int:
    if not model.pairs.size:
        raise EstimateError("none of the picked poles is a resonance")
    return int(np.argmin(np.abs(model.pairs - pole)))


def _modal_model(
    d: Lines, found: Selected, poles: Diagram, chosen: Sequence[int], picked: bool
) -> ModalModel:
    model = found.model
    unresolved: list[float] = []
    if not picked:
        chosen = []
        for m in np.argsort(np.abs(model.pairs)):
            verdict = _verdict(d, found, poles, int(m))
            if verdict == "mode":
                chosen = [*chosen, int(m)]
            elif verdict == "unresolved":
                unresolved.append(float(abs(model.pairs[m]) * d.scale / (2 * np.pi)))
    chosen = sorted(set(chosen), key=lambda m: abs(model.pairs[m]))
    inflation = 1.0 if found.fit.holds else float(np.sqrt(max(found.fit.ratio, 1.0)))
    parts = factored(model, chosen, len(d.inputs))
    modes = [
        _mode(d, found, poles, m, part, inflation) for m, part in zip(chosen, parts, strict=True)
    ]
    rest = np.delete(model.pairs, chosen) if chosen else model.pairs
    units = {c.name: c.unit for c in d.response.outputs}
    n_in = len(d.inputs)
    wide, own = _wide(d, model, chosen)
    residues = wide.residues()[:, own].T * d.scale
    return ModalModel(
        modes=tuple(modes),
        outputs=d.outputs,
        units=tuple(units[name] for name in d.outputs),
        inputs=d.inputs,
        background=np.concatenate([rest, model.real]).astype(np.complex128) * d.scale,
        unresolved=tuple(unresolved),
        poles=wide.pairs[own] * d.scale,
        residues=residues.reshape(len(chosen), len(d.outputs), n_in),
        covariance=_covariance(wide, own) * (d.scale * inflation) ** 2,
        fit=found.fit,
        inflation=inflation,
        diagram=poles,
        model=model,
        frequency=d.frequency,
        prediction=(model.evaluate(d.s) * d.seen).reshape(len(d.frequency), -1, n_in),
        level=d.response.level,
        level_unit=d.response.level_unit,
        method=d.response.method,
        of=_of(d),
        divided=d.divided,
        closed_loop=_roles(d) == {"reference"},
    )


def _wide(d: Lines, model: Rational, chosen: Sequence[int]) -> tuple[Rational, list[int]]:
    """The model with poles above the band, and where its chosen pairs are; the model itself where
    they do not stay what they were, or are known to nothing."""
    try:
        wide = widened(d, model) if chosen else model
    except np.linalg.LinAlgError:  # the lines do not bear them
        wide = model
    a = model.pairs[list(chosen)]
    own = [int(np.argmin(np.abs(wide.pairs - one))) for one in a]
    moved = len(set(own)) < len(own) or np.any(np.abs(wide.pairs[own] - a) > np.abs(a.real))
    if moved or not np.all(np.diag(_covariance(wide, own)) > 0):
        return model, list(chosen)
    return wide, own


def _covariance(model: Rational, chosen: Sequence[int]) -> Float:
    """Of the poles and residues of these pairs, in units of scale: pole by pole Re, Im, then those
    of each entry's residue."""
    n, size = model.coefficients.shape
    at = [
        first + part
        for m in chosen
        for first in (2 * m, *(model.n_poles + k * size + 2 * m for k in range(n)))
        for part in (0, 1)
    ]
    C = model.covariance[np.ix_(at, at)]
    return np.asarray((C + C.T) / 2)  # its inversion leaves 2e-5 of a correlation


def _roles(d: Lines) -> set[str]:
    return {c.role for c in d.response.inputs}


def _verdict(d: Lines, found: Selected, poles: Diagram, m: int) -> str:
    """Whether pair m is a `mode`, `unresolved` by the lines, or `background`."""
    a = found.model.pairs[m]
    size = abs(a)
    inside = abs(d.s[0]) <= size <= abs(d.s[-1])
    if not inside or not 0 < -a.real < HEAVY * size or found.chance[m] >= FALSE_ALARM:
        return "background"
    if d.response.estimator == "stepped" and lines_under(d, a) < GRID:
        return "unresolved"
    C = found.model.covariance[2 * m : 2 * m + 2, 2 * m : 2 * m + 2]
    by = np.array([a.real, a.imag]) / size
    if not np.sqrt(by @ C @ by) < VAGUE * size:
        return "background"
    # What a model that misses leaves is no noise: it may look like a pole, but hardly like one
    # that stays where it is at every order.
    if found.fit.ratio > MISSES and _orders(poles, found.model, m, d.scale) == 0:
        return "background"
    return "mode"


def _orders(poles: Diagram, model: Rational, m: int, scale: float) -> int:
    """Orders of the diagram that show pair m stable.

    A chain of the diagram belongs to the pair of the model that lies nearest, if that is in the
    width of either's resonance: linearised least squares overstates the damping of what is noisy.
    """
    pairs = model.pairs * scale
    best = 0
    for chain, orders in zip(poles.candidates, poles.orders, strict=True):
        width = max(-pairs[m].real, -chain.real)
        near = int(np.argmin(np.abs(pairs - chain))) == m
        if near and abs(abs(chain) - abs(pairs[m])) <= width:
            best = max(best, int(orders))
    return best


def _mode(
    d: Lines, found: Selected, poles: Diagram, m: int, part: Factored, inflation: float
) -> Mode:
    a, C = part.pole, part.pole_covariance * inflation**2
    size = abs(a)
    to_f = np.array([a.real, a.imag]) / size
    to_zeta = np.array([-(a.imag**2), a.real * a.imag]) / size**3
    hertz = d.scale / (2 * np.pi)
    return Mode(
        frequency_hz=Value(float(size * hertz), float(np.sqrt(to_f @ C @ to_f) * hertz)),
        damping=Value(float(-a.real / size), float(np.sqrt(to_zeta @ C @ to_zeta))),
        pole=complex(a * d.scale),
        shape=part.shape,
        shape_covariance=part.shape_covariance * inflation**2,
        participation=part.participation * d.scale,
        reference=part.reference,
        sigma=float(np.sqrt(found.gain[m]) / inflation),
        chance=float(found.chance[m]),
        orders=_orders(poles, found.model, m, d.scale),
    )


def _of(d: Lines) -> str:
    """What the poles are those of."""
    roles = _roles(d)
    named = f"{', '.join(d.outputs)} over {', '.join(d.inputs)}"
    if roles == {"reference"}:
        return f"poles of {named}: of the closed loop, as the reference drives it"
    if roles == {"command"}:
        loops = ", ".join(c.name for c in d.response.followers)
        closed = f", the loop of {loops} closed" if loops else ""
        return f"poles of {named}: of what the command drives, whatever loop computes it{closed}"
    return f"poles of {named}: of what lies between them"


def _pairs(values: Complex) -> list[Any]:
    """Real and imaginary part of each, as plain data."""
    return list(np.stack([values.real, values.imag], axis=-1).tolist())


def _plain(m: Mode, outputs: Sequence[str]) -> dict[str, Any]:
    low, high = m.frequency_hz.interval()
    least, most = m.damping.interval()
    real, imag = m.shape_interval()
    return {
        "frequency_hz": m.frequency_hz.value,
        "frequency_hz_90": [low, high],
        "damping": m.damping.value,
        "damping_90": [least, most],
        "pole": [m.pole.real, m.pole.imag],
        "sigma": m.sigma,
        "chance": m.chance,
        "orders": m.orders,
        "reference": outputs[m.reference],
        "shape": {
            name: {
                "real": float(m.shape[k].real),
                "imag": float(m.shape[k].imag),
                "real_half_90": float(real[k]),
                "imag_half_90": float(imag[k]),
            }
            for k, name in enumerate(outputs)
        },
        "participation": [[float(x.real), float(x.imag)] for x in m.participation],
        "complexity": m.complexity,
    }
