"""Even and odd distortion of a multisine, read from the lines that it does not drive.

At a line that the reference leaves silent, d = Y - H V is what the open loop adds by itself:
noise, which scatters over the periods, and distortion, which repeats with the period. The
command V is not zero there, because the centring loop feeds the distortion of its sensor back;
H V takes the linear answer to that out (Pintelon and Schoukens, System Identification, 2nd ed.,
sections 4.3.3 and 3.9). H is interpolated between the driven lines beside it; its error there
is a small part of the distortion, and makes none where there is none.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import special

from samii_rig.signal.spectra import Spectrum
from samii_rig.signal.statistics import octaves
from samii_rig.types import Complex, Finding, Float, Int

# |R|^2 of a line that counts as silent, of the strongest line's: recorded references are
# exact to 1e-16, and single precision makes 1e-14.
SILENT = 1e-12
# Detection lines whose powers are averaged for the level at one driven line.
WINDOW = 5
# Lines beside a line over which the variance that weighs it is averaged, on each side.
SMOOTH = 8
# Chance that a response of a linear rig carries any finding of distortion, all bands, outputs
# and both parities together.
FALSE_FINDINGS = 0.01
# Of the output: above this, a response that holds for one level only is worth a warning.
NOTABLE = 0.01
# Degrees of freedom of the scatter over periods, below which nothing can be tested.
LEAST_DOF = 4

MEANING = {
    "even": "something is not symmetric, such as an offset, gravity or a valve that differs "
    "between its two directions",
    "odd": "a symmetric nonlinearity such as friction, saturation, a deadband or a hardening "
    "joint; the response holds for this level alone",
}


@dataclass(frozen=True, slots=True)
class Distortion:
    """Levels (n_freq, n_out) at the driven lines, None where the lines cannot separate them."""

    even: Float | None
    odd: Float | None
    findings: tuple[Finding, ...] = ()


@dataclass(frozen=True, slots=True)
class _Residual:
    """What stands at the detection lines, for K of them.

    number (K,) harmonic numbers; frequency (K,) Hz; power (K, p) mean over realisations of
    |mean over periods of d|^2; noise (K, p) what noise alone makes of `power`; scatter
    (n, K, p) deviations of the periods from their mean; dof of `noise`, complex, a line;
    realisations.
    """

    number: Int
    frequency: Float
    power: Float
    noise: Float
    scatter: Complex
    dof: int
    realisations: int

    def at(self, lines: NDArray[np.bool_]) -> _Residual:
        return _Residual(
            self.number[lines],
            self.frequency[lines],
            self.power[lines],
            self.noise[lines],
            self.scatter[:, lines],
            self.dof,
            self.realisations,
        )


def distortion(
    spectra: Sequence[Sequence[Spectrum]], excited: Int, H: Complex, floor: Float, names: list[str]
) -> Distortion:
    """Relative distortion at the driven lines and what is to be said of it.

    Parameters
    ----------
    spectra : of each measured period, by realisation.
    excited : (n_freq,) indices of the driven lines in a spectrum.
    H : (n_freq, p) the response there.
    floor : (p,) variance of each output's rounding at a line, which periods do not show.

    Returns
    -------
    even, odd : rms at the nearest detection lines over the rms of the outputs at the driven
        lines around them, after the power that noise alone makes is taken off; 0 where
        nothing is left. Both None unless every driven line is odd, or where the periods are
        too few to know the noise.
    """
    number = excited + 1  # a spectrum leaves line 0 out
    none = Distortion(None, None)
    if np.any(number % 2 == 0) or sum(len(s) - 1 for s in spectra) < LEAST_DOF:
        return none
    first = spectra[0][0]
    inside = np.arange(excited[0], excited[-1] + 1)
    strongest = max(float(np.abs(s[0].R).max()) for s in spectra) ** 2
    loudest = np.max([np.abs(s[0].R[inside]) ** 2 for s in spectra], axis=0)
    silent = inside[loudest <= SILENT * strongest]
    if silent.size == 0:
        return none
    residual = _residual(spectra, silent, excited, H, floor)
    frequency = first.frequency[excited]
    V = [np.mean([np.abs(x.Z[excited, 0]) ** 2 for x in s], axis=0) for s in spectra]
    output = np.abs(H) ** 2 * np.mean(V, axis=0)[:, None]
    levels: dict[str, Float | None] = {}
    findings: list[Finding] = []
    parts = {
        kind: residual.at(residual.number % 2 == odd) for kind, odd in (("even", 0), ("odd", 1))
    }
    bands = octaves(frequency)
    allowed = FALSE_FINDINGS / (2 * len(bands) * len(names))
    for kind, part in parts.items():
        if part.number.size == 0:
            levels[kind] = None
            continue
        levels[kind] = _levels(part, number, output)
        for i, name in enumerate(names):
            findings += _findings(kind, part, i, name, frequency, output[:, i], bands, allowed)
    return Distortion(levels["even"], levels["odd"], tuple(findings))


def _residual(
    spectra: Sequence[Sequence[Spectrum]], silent: Int, excited: Int, H: Complex, floor: Float
) -> _Residual:
    between = np.stack([np.interp(silent, excited, h) for h in H.T], axis=1)
    d = [
        np.stack([x.Z[silent, 1:] - between * x.Z[silent, :1] for x in s]) for s in spectra
    ]  # (periods, K, p) of each realisation
    mean = [x.mean(axis=0) for x in d]
    scatter = np.concatenate([x - m for x, m in zip(d, mean, strict=True)])
    dof = sum(len(x) - 1 for x in d)
    variance = np.sum(np.abs(scatter) ** 2, axis=0) / dof
    share = float(np.mean([1 / len(x) for x in d]))
    return _Residual(
        number=silent + 1,
        frequency=spectra[0][0].frequency[silent],
        power=np.mean([np.abs(m) ** 2 for m in mean], axis=0),
        noise=share * variance + np.maximum(floor - variance, 0.0),
        scatter=scatter,
        dof=dof,
        realisations=len(d),
    )


def _levels(part: _Residual, number: Int, output: Float) -> Float:
    """(n_freq, p) at each driven line, from the nearest detection lines."""
    size = min(WINDOW, part.number.size)
    nearest = np.searchsorted(part.number, number)
    start = np.clip(nearest - size // 2, 0, part.number.size - size)
    low = np.minimum(np.searchsorted(number, part.number[start]), np.arange(number.size))
    high = np.searchsorted(number, part.number[start + size - 1])
    high = np.maximum(high, np.arange(number.size) + 1)
    extra = np.cumsum(np.pad(part.power - part.noise, ((1, 0), (0, 0))), axis=0)
    total = np.cumsum(np.pad(output, ((1, 0), (0, 0))), axis=0)
    power = np.maximum(extra[start + size] - extra[start], 0.0) / size
    around = (total[high] - total[low]) / (high - low)[:, None]
    level = np.divide(power, around, out=np.zeros_like(power), where=around > 0)
    return np.asarray(np.sqrt(level))


def _findings(
    kind: str,
    part: _Residual,
    i: int,
    name: str,
    frequency: Float,
    output: Float,
    bands: Sequence[tuple[float, float]],
    allowed: float,
) -> list[Finding]:
    """One finding for each run of neighbouring bands in which distortion stands out."""
    runs: list[tuple[float, float]] = []
    for low, high in bands:
        here = (part.frequency >= low) & (part.frequency < high)
        if not here.any() or _stands_out(part.at(here), i) >= allowed:
            continue
        if runs and runs[-1][1] == low:
            runs[-1] = (runs[-1][0], high)
        else:
            runs.append((low, high))
    out = []
    for low, high in runs:
        here = (part.frequency >= low) & (part.frequency < high)
        driven = (frequency >= low) & (frequency < high)
        power = float(np.mean(part.power[here, i] - part.noise[here, i]))
        level = np.sqrt(max(power, 0.0) / float(np.mean(output[driven])))
        text = (
            f"{kind} distortion at {low:.3g}-{min(high, frequency[-1]):.3g} Hz, "
            f"{100 * level:.2g} % of {name}: {MEANING[kind]}"
        )
        finding = Finding("distortion", "note", text, channel=name)
        out.append(replace(finding, severity="warning") if level > NOTABLE else finding)
    return out


def _stands_out(part: _Residual, i: int) -> float:
    """Chance that noise alone makes the power of output `i` at these lines."""
    dof = (part.realisations, part.dof)
    return _chance(part.power[:, i], part.noise[:, i], part.scatter[:, :, i], part.dof, dof)


def _chance(power: Float, noise: Float, scatter: Complex, nu: int, dof: tuple[int, int]) -> float:
    """Chance of as much `power` (K,) at these lines if there were `noise` (K,) alone.

    dof : complex degrees of freedom of both, a line. Both sums are weighted by the smoothed
    noise, so that no loud line decides alone. Lines that share what scatters count as fewer
    (a drift, or a transient that is not over, leaks into all of them alike, and with a phase
    that is known, so that they are one real number): 2 K real parts as (tr C)^2 / tr C^2 of
    them (Satterthwaite), C their covariance. Of S, its estimate from `scatter` (n, K) with
    nu degrees of freedom, E tr S^2 = (1 + 1/nu) tr C^2 + (tr C)^2/nu and
    E (tr S)^2 = (tr C)^2 + 2 tr C^2/nu.
    """
    weight = _smooth(noise)
    if not np.all(weight > 0):
        return 0.0 if np.any(power > 0) else 1.0
    F = float(np.sum(power / weight) / np.sum(noise / weight))
    x = scatter / np.sqrt(weight)
    x = np.concatenate([x.real, x.imag], axis=1)
    trace = float(np.sum(x**2) / nu) ** 2
    square = float(np.sum((x @ x.T) ** 2)) / nu**2
    free = nu**2 / ((nu - 1) * (nu + 2)) * (square - trace / nu)
    most = 2.0 * power.size
    parts = float(np.clip((trace - 2 * free / nu) / free, 1.0, most)) if free > 0 else most
    return float(special.fdtrc(dof[0] * parts, dof[1] * parts, F))


def _smooth(x: Float) -> Float:
    """Mean over the neighbours, over fewer of them at the ends."""
    width = min(2 * SMOOTH + 1, x.size)
    ones = np.ones(width)
    count = np.convolve(np.ones_like(x), ones, mode="same")
    return np.asarray(np.convolve(x, ones, mode="same") / count, dtype=np.float64)
