"""Modes of a rig from measured frequency responses, each number with its interval.

    modes = estimate_modes(response, rig)
    modes.modes[0].frequency_hz, modes.zeros_of("a_0")[0].frequency_hz

Several modes at once and all channels together, by a rational model with common poles in
noise units (`modal.rational`); frequencies, damping, zeros and mode shapes are functions of its
parameters and have their covariance by propagation.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import special

from samii_rig.errors import EstimateError, InputError
from samii_rig.identify.data import Data, Lines, collect
from samii_rig.modal.modes import Value
from samii_rig.modal.rational import EXTRAS, Rational, functions
from samii_rig.modal.selection import wald
from samii_rig.modal.vector_fitting import fit_rational
from samii_rig.model.sampled import given_response, sensor_response
from samii_rig.rig.schema import Rig
from samii_rig.signal.whitening import Fit, goodness
from samii_rig.types import Complex, Float, FrequencyResponse

MOST_MODES = 8  # tried when their number is not given
# Charge on chi-square for a parameter. Akaike's 2 is right for a pair of poles at a given place;
# noise makes a pair in the best of many places gain more.
PENALTY = 4.0
PATIENCE = 2  # larger models tried after the best one
HEAVY = 0.3  # damping ratio above which a pair of poles is background, not a mode
VAGUE = 0.1  # relative standard deviation of a frequency above which it is none
CHANCE = 1e-4  # probability that noise alone makes the residues of what is called a mode
NEAR_AXIS = 0.5  # |Re z|/|z| below which a zero shows in a Bode diagram


@dataclass(frozen=True, slots=True)
class Mode:
    """One mode.

    frequency_hz : natural frequency |a|/(2 pi) of the pole a. damping : -Re a/|a|.
    pole : rad/s, Im > 0. residues : (p,) complex, of the entries in the outputs' order.
    shape : (p,) residues over that of the entry with the largest, complex; for a mode
        without complex damping they are real. shape_covariance : (p, 2, 2) of real and
        imaginary part.
    reference : index of that entry.
    """

    frequency_hz: Value
    damping: Value
    pole: complex
    residues: Complex
    shape: Complex
    shape_covariance: Float
    reference: int


@dataclass(frozen=True, slots=True)
class Zero:
    """A zero of one entry; frequency |z|/(2 pi), damping -Re z/|z| (negative: right of the
    axis), as for a pole."""

    output: str
    input: str
    frequency_hz: Value
    damping: Value


@dataclass(frozen=True, slots=True)
class Modes:
    """Modes and zeros of one response, by increasing frequency.

    outputs, inputs : (p,) names of the entries. background : poles that are no modes, rad/s.
    model : the rational model. prediction : (n_freq, p) at `frequency`, hold and filters in.
    """

    modes: tuple[Mode, ...]
    zeros: tuple[Zero, ...]
    outputs: tuple[str, ...]
    inputs: tuple[str, ...]
    background: Complex
    fit: Fit
    model: Rational
    frequency: Float
    prediction: Complex

    def zeros_of(self, output: str) -> tuple[Zero, ...]:
        """The zeros of one output; InputError if it is none."""
        if output not in self.outputs:
            raise InputError("zeros", "output", output, f"one of {', '.join(self.outputs)}")
        return tuple(z for z in self.zeros if z.output == output)

    def shape_ratio(self, mode: int, top: str, bottom: str) -> Value:
        """phi(top)/phi(bottom) of a mode (0 the first): the real part, eq. 19 of paper 1.

        Both in the outputs' units, so for sensors of one kind the ratio of the mode shape.
        Raises InputError for a mode or an output that there is not.
        """
        if not 0 <= mode < len(self.modes):
            raise InputError("shape ratio", "mode", mode, f"0 to {len(self.modes) - 1}")
        for name in (top, bottom):
            if name not in self.outputs:
                raise InputError("shape ratio", "output", name, f"one of {self.outputs}")
        a, b = self.outputs.index(top), self.outputs.index(bottom)
        m = int(np.argmin(np.abs(self.model.pairs * self.model.scale - self.modes[mode].pole)))
        ratio, C = _ratio(self.model, m, a, b)
        return Value(float(ratio.real), float(np.sqrt(C[0, 0])))


def estimate_modes(
    response: FrequencyResponse,
    rig: Rig,
    *,
    n_pairs: int | None = None,
    band: tuple[float, float] | None = None,
    outputs: Sequence[str] | None = None,
) -> Modes:
    """Modes of `response`; hold, filters and delays of the rig file are divided out.

    n_pairs : pairs of poles of the rational model, those of the background included; None
        for the number with the least chi-square and `PENALTY` a parameter: a model too small
        biases its modes, one too large has poles with residues that are noise, no modes here.
    band : Hz, a part of the response with the modes of interest and some room around them.

    Raises InputError as `identify` does, or for n_pairs that the data do not allow;
    EstimateError for too few degrees of freedom.
    """
    data = collect([response], rig, band, outputs)
    d = data.lines[0]
    seen = _seen(rig, d)
    weight = np.sqrt(2 * d.factor)[:, None, None] * d.root * seen[:, None, :]
    scale = 2 * np.pi * float(np.sqrt(d.frequency[0] * d.frequency[-1]))
    s = np.asarray(2j * np.pi * d.frequency / scale, dtype=np.complex128)
    most = int((2 * d.frequency.size / d.shared[1] - EXTRAS) // 4)
    if most < 1 or (n_pairs is not None and not 1 <= n_pairs <= most):
        expected = f"1 to {most} modes for {d.frequency.size} lines" if most else "more lines"
        raise InputError("modes", "n_pairs", n_pairs, expected)
    last = min(MOST_MODES, most) if n_pairs is None else n_pairs
    best: Rational | None = None
    model: Rational | None = None
    lowest, worse = np.inf, 0
    for n in range(1, last + 1):
        model = fit_rational(s, d.H / seen, weight, scale, n, model)
        size = model.n_poles + model.coefficients.size
        criterion = model.chi2 + PENALTY * size
        if criterion < lowest or (n == n_pairs):
            best, lowest, worse = model, criterion, 0
        else:
            worse += 1
        if n_pairs is None and worse == PATIENCE:
            break
    if best is None:
        raise EstimateError("no rational model fits: the response holds numbers that are none")
    return _modes(best, data, s, seen)


def _modes(model: Rational, data: Data, s: Complex, seen: Complex) -> Modes:
    d = data.lines[0]
    prediction = model.evaluate(s) * seen
    t2 = np.sum(np.abs(d.root @ (prediction - d.H)[:, :, None]) ** 2, axis=(1, 2))
    fit = goodness(data.lines, [t2], model.n_poles + model.coefficients.size)
    order = np.argsort(np.abs(model.pairs))
    low, high = abs(s[0]), abs(s[-1])
    modes, rest = [], list(model.real * model.scale + 0j)
    for m in order:
        mode = _mode(model, int(m))
        f = mode.frequency_hz
        inside = low <= abs(model.pairs[m]) <= high
        if (
            inside
            and mode.damping.value < HEAVY
            and f.sd < VAGUE * f.value
            and _real(model, int(m))
        ):
            modes.append(mode)
        else:
            rest.append(complex(model.pairs[m] * model.scale))
    zeros = [
        zero
        for k in range(len(d.outputs))
        for zero in _zeros(model, k, d.outputs[k], d.inputs[k], (low, high))
    ]
    return Modes(
        tuple(modes),
        tuple(zeros),
        d.outputs,
        d.inputs,
        np.array(rest, dtype=np.complex128),
        fit,
        model,
        d.frequency,
        prediction,
    )


def _seen(rig: Rig, d: Lines) -> Complex:
    """(n, p) hold, filters and delays of each entry."""
    rate = d.response.rate_hz
    filters = sensor_response(rig.sensor, d.frequency)[:, d.sensor]
    holds = {i: given_response(rig.actuator[i], d.frequency, rate) for i in set(d.actuator)}
    return np.asarray(filters * np.stack([holds[i] for i in d.actuator], axis=1))


def _mode(model: Rational, m: int) -> Mode:
    a, C = model.pairs[m], model.covariance[2 * m : 2 * m + 2, 2 * m : 2 * m + 2]
    size = abs(a)
    to_f = np.array([a.real, a.imag]) / size
    to_zeta = np.array([-(a.imag**2), a.real * a.imag]) / size**3
    hertz = model.scale / (2 * np.pi)
    R = model.residues()[:, m]
    reference = int(np.argmax(np.abs(R)))
    ratios = [_ratio(model, m, k, reference) for k in range(R.size)]
    return Mode(
        Value(float(size * hertz), float(np.sqrt(to_f @ C @ to_f) * hertz)),
        Value(float(-a.real / size), float(np.sqrt(to_zeta @ C @ to_zeta))),
        complex(a * model.scale),
        np.asarray(R * model.scale),
        np.array([r for r, _ in ratios]),
        np.array([c for _, c in ratios]),
        reference,
    )


def _place(model: Rational, k: int, m: int) -> int:
    """Where the two numbers of the residue of entry k at pair m stand in the covariance."""
    return int(model.n_poles + k * model.coefficients.shape[1] + 2 * m)


def _ratio(model: Rational, m: int, a: int, b: int) -> tuple[complex, Float]:
    """Residue of entry a over that of b at pair m, and its covariance (2, 2)."""
    R = model.residues()[:, m]
    if a == b:
        return 1 + 0j, np.zeros((2, 2))
    ratio = complex(R[a] / R[b])
    at = [
        _place(model, a, m),
        _place(model, a, m) + 1,
        _place(model, b, m),
        _place(model, b, m) + 1,
    ]
    by = np.array([1, 1j, -ratio, -1j * ratio]) / R[b]
    J = np.stack([by.real, by.imag])
    return ratio, np.asarray(J @ model.covariance[np.ix_(at, at)] @ J.T)


def _real(model: Rational, m: int) -> bool:
    """Whether noise would hardly make residues as large as those of pair m."""
    return bool(special.chdtrc(2 * len(model.coefficients), wald(model, m)) < CHANCE)


def _zeros(
    model: Rational, k: int, output: str, input_: str, band: tuple[float, float]
) -> list[Zero]:
    """Zeros of entry k near the axis and in the band."""
    found = []
    for z in _numerator_roots(model, k):
        if z.imag <= 0 or not band[0] <= abs(z) <= band[1] or abs(z.real) > NEAR_AXIS * abs(z):
            continue
        here = np.array([z], dtype=np.complex128)
        step = 1e-6 * abs(z)
        around = np.array([z + step, z - step], dtype=np.complex128)
        rise = np.diff(model.evaluate(around)[::-1, k])[0] / (2 * step)
        by = np.zeros(model.covariance.shape[0], complex)
        by[: model.n_poles] = model.slopes(here)[0, k]
        first = _place(model, k, 0)
        F = functions(here, model.pairs, model.real)[0]
        by[first : first + F.size] = F
        by = -by / rise
        J = np.stack([by.real, by.imag])
        C = J @ model.covariance @ J.T
        size = abs(z)
        to_f = np.array([z.real, z.imag]) / size
        to_zeta = np.array([-(z.imag**2), z.real * z.imag]) / size**3
        hertz = model.scale / (2 * np.pi)
        found.append(
            Zero(
                output,
                input_,
                Value(float(size * hertz), float(np.sqrt(to_f @ C @ to_f) * hertz)),
                Value(float(-z.real / size), float(np.sqrt(to_zeta @ C @ to_zeta))),
            )
        )
    return sorted(found, key=lambda zero: zero.frequency_hz.value)


def _numerator_roots(model: Rational, k: int) -> Complex:
    """Roots of entry k: of its numerator, then by Newton's method on the entry itself."""
    poles = np.concatenate([model.pairs, model.pairs.conj(), model.real + 0j, [0j]])
    c, n = model.coefficients[k], 2 * model.pairs.size
    R = c[0:n:2] + 1j * c[1:n:2]
    residues = np.concatenate([R, R.conj(), c[n : n + model.real.size], [c[-EXTRAS]]])
    numerator = np.polymul([c[-1], c[-2]], np.poly(poles))
    for i in range(poles.size):
        part = residues[i] * np.poly(np.delete(poles, i))
        numerator = np.polyadd(numerator, part)
    roots = np.roots(numerator.real).astype(np.complex128)
    for i, z in enumerate(roots):
        for _ in range(3):
            step = 1e-6 * abs(z) or 1e-6
            G = model.evaluate(np.array([z, z + step, z - step], dtype=np.complex128))[:, k]
            slope = (G[1] - G[2]) / (2 * step)
            move = G[0] / slope if slope else 0j
            if abs(move) > 0.1 * abs(z):
                break
            z -= move
        roots[i] = z
    return np.asarray(roots)
