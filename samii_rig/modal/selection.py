"""How many poles: what the noise cannot explain is kept, what it can is not.

A pair of poles is kept if chi-square rises by more without it than noise would let it rise
anywhere in the band: the likelihood ratio of a pair at an unknown place. Places are counted. A grid
in frequency and damping that no resonance falls between has `places` points, so by Bonferroni

    P(noise makes one mode or more in a data set) <= places P(F_{2p+2, m} > gain/(2p+2)),

2 p residues and the 2 numbers of the pole itself; F, not chi-square, because the covariance is
estimated: m counts the degrees of freedom of the lines that the resonance reaches. Where chi-square
refuses even the largest model, what it leaves is taken for noise and gains are judged by it.

Start: the poles that the stabilisation diagram shows. Then pairs are added where most is left,
and taken out again when they prove nothing.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import special

from samii_rig.errors import EstimateError
from samii_rig.modal.lines import Lines
from samii_rig.modal.rational import EXTRAS, Rational
from samii_rig.modal.refine import refine, score
from samii_rig.signal.whitening import Fit
from samii_rig.types import Complex, Float

FALSE_ALARM = 1e-3  # probability that noise alone makes a mode in one data set
MOST_PAIRS = 24  # of poles, background included
COARSE = 500  # lines that a model grows on first
TRIED = 3  # places where a new pair is begun, of those where most is left
DAMPINGS = (0.003, 0.01, 0.03, 0.1, 0.3)  # of the grid of places, each a third of the next
STEP = 1.0  # of the grid, over a resonance's half width: neighbours share most of their lines
NARROW = 1.0  # lines under a resonance at least: there is nothing to see between lines
BACKGROUND = 0.3  # damping ratio of a new pair beyond the band
BEYOND = 1.5  # its frequency over the highest
LOOKED_AT = 8  # places that Rao's test is made at, of those where most is left
WORTH = 1.5  # of the mean that noise alone gives at one place: less at a start is not followed


@dataclass(frozen=True, slots=True)
class Selected:
    """The model that was chosen.

    gain : (n_pair,) by how much chi-square rises when a pair is taken out, by Wald's test.
    chance : (n_pair,) probability that noise alone gains as much anywhere in the band.
    fit : chi-square of the model. places : how many the band has.
    """

    model: Rational
    gain: Float
    chance: Float
    fit: Fit
    places: int


def select(d: Lines, start: Complex) -> Selected:
    """The smallest model that noise does not refuse to enlarge.

    start : poles, rad/s, Im > 0, from the stabilisation diagram, the surest first: where there
        are more than the lines can bear, the last are left out.
    """
    grid = places(d)
    return judged(d, _pruned(d, _grown(d, start[: _most(d)], grid), grid), grid)


def fixed(d: Lines, start: Complex) -> Selected:
    """The model with all of `start` (rad/s) and what else the data ask for.

    Raises EstimateError for more poles than the lines can bear.
    """
    if start.size > _most(d):
        raise EstimateError(f"{len(d.frequency)} lines cannot bear {start.size} modes")
    grid = places(d)
    return judged(d, _grown(d, start, grid), grid)


def _grown(d: Lines, start: Complex, grid: Complex) -> Rational:
    """From the start, as many pairs more as prove something; on a part of the lines first."""
    coarse = d.thinned(COARSE)
    pairs, real = start / d.scale, np.zeros(0)
    if pairs.size < _most(d):
        pairs = np.append(pairs, _beyond(d))
    for lines in (coarse, d) if coarse is not d else (d,):
        model: Rational | None = refine(lines.s, lines.G, lines.W, d.scale, pairs, real)
        while model is not None and model.pairs.size < _most(lines):
            pairs, real = model.pairs, model.real
            model = _enlarged(lines, model, grid)
        if model is not None:
            pairs, real = model.pairs, model.real
    return refine(d.s, d.G, d.W, d.scale, pairs, real)


def judged(d: Lines, model: Rational, grid: Complex) -> Selected:
    """The model with each pair's gain and the probability that it is chance."""
    fit = d.fit(model.evaluate(d.s), model.n_poles + model.coefficients.size)
    gains = np.array([wald(model, m) for m in range(model.pairs.size)])
    count = np.array([lines_that_count(d, a) for a in model.pairs])
    return Selected(model, gains, _chance(d, gains, count, fit, grid.size), fit,
                    grid.size)  # fmt: skip


def widened(d: Lines, model: Rational) -> Rational:
    """The model with poles above the band, proven or not.

    Where none is proven, what lies there leaves no more than noise of any line; but a residue is
    known better than a line, takes what is left, and is off by more than its covariance says.
    """
    top = abs(d.s[-1])
    above = np.any(np.abs(model.pairs) > top) or np.any(np.abs(model.real) > top)
    if above or model.pairs.size >= _most(d):
        return model
    return refine(d.s, d.G, d.W, d.scale, np.append(model.pairs, _beyond(d)), model.real)


def places(d: Lines) -> Complex:
    """Poles that no resonance in the band falls between, each over `NARROW` lines at least."""
    low, high = abs(d.s[0]), abs(d.s[-1])
    found = []
    for zeta in DAMPINGS:
        count = max(2, int(np.ceil(np.log(high / low) / (STEP * zeta))))
        w = np.geomspace(low, high, count)
        found.append(w * (-zeta + 1j * np.sqrt(1 - zeta**2)))
    pole = np.concatenate(found)
    under = np.array([lines_under(d, a) for a in pole])
    return np.asarray(pole[under >= NARROW])


def lines_that_count(d: Lines, pole: complex) -> float:
    """Effective number of lines that determine the residue of a pair: (sum |f|^2)^2/sum |f|^4 of
    f = 1/(s - pole)."""
    f2 = 1 / np.abs(d.s - pole) ** 2
    return float(np.sum(f2) ** 2 / np.sum(f2**2))


def lines_under(d: Lines, pole: complex) -> float:
    """Lines within the half-power width of a resonance (pole over the scale)."""
    w = d.s.imag
    a, b = np.searchsorted(w, [abs(pole) + pole.real, abs(pole) - pole.real])
    return float(b - a)


def wald(model: Rational, m: int) -> float:
    """By how much chi-square rises without pair m, to second order: residues in their sigma."""
    p, f = model.coefficients.shape
    at = (model.n_poles + f * np.arange(p)[:, None] + np.array([2 * m, 2 * m + 1])).ravel()
    c = model.coefficients[:, 2 * m : 2 * m + 2].ravel()
    C = model.covariance[np.ix_(at, at)]
    size = np.sqrt(np.diag(C))
    return float(c / size @ np.linalg.solve(C / np.outer(size, size), c / size))


def _most(d: Lines) -> int:
    """Pairs of poles that the lines allow: half as many parameters as independent numbers."""
    return min(MOST_PAIRS, int((d.independent - EXTRAS) // 4))


def _chance(d: Lines, gain: Float, lines: Float, fit: Fit, count: int) -> Float:
    """Probability that noise gains as much at one of `count` places or more, see above.

    lines : that count at each.
    """
    k = 2 * d.p + 2
    nu = float(np.median(d.dof))
    groups = np.maximum(lines / d.shared[0], 1.0)
    m = 2 * np.minimum(groups * (nu - d.p), 1e9)
    noise = 1.0 if fit.holds else max(fit.ratio, 1.0)
    return np.minimum(count * special.fdtrc(k, m, np.maximum(gain, 0.0) / noise / k), 1.0)


def _pruned(d: Lines, model: Rational, grid: Complex) -> Rational:
    """Without the pairs that prove nothing, the weakest first."""
    while model.pairs.size:
        state = judged(d, model, grid)
        weakest = int(np.argmin(state.gain))
        if state.chance[weakest] < FALSE_ALARM:
            break
        pairs = np.delete(model.pairs, weakest)
        without = refine(d.s, d.G, d.W, d.scale, pairs, model.real)
        # Wald's test chose which; what decides is the likelihood ratio.
        if _proven(d, without, model, model.pairs[weakest], grid):
            break
        model = without
    return model


def _enlarged(d: Lines, model: Rational, grid: Complex) -> Rational | None:
    """The model with one pair more, None if noise may be all that one would explain."""
    for a in _candidates(d, model, grid):
        trial = refine(d.s, d.G, d.W, d.scale, np.append(model.pairs, a), model.real)
        if _proven(d, model, trial, a, grid):
            return trial
    return None


def _proven(d: Lines, small: Rational, large: Rational, pole: complex, grid: Complex) -> bool:
    """Whether noise would hardly make the larger model, which has one pair more, so much better."""
    fit = d.fit(large.evaluate(d.s), large.n_poles + large.coefficients.size)
    under = lines_that_count(d, pole)
    gain = np.array([small.chi2 - large.chi2])
    return bool(_chance(d, gain, np.array([under]), fit, grid.size)[0] < FALSE_ALARM)


def _beyond(d: Lines) -> complex:
    """A pair above the band: what a constant and a slope cannot stand for."""
    return complex(BEYOND * abs(d.s[-1]) * (-BACKGROUND + 1j * np.sqrt(1 - BACKGROUND**2)))


def _candidates(d: Lines, model: Rational, grid: Complex) -> list[complex]:
    """Places where one more pair would explain most of what is left, best first.

    First by the gain of a residue with all else held, then of the best by Rao's test.
    """
    v = np.einsum("kij,kj->ki", d.W, d.G - model.evaluate(d.s))
    p = d.p
    flat = d.W.reshape(-1, p * p)
    gains = np.empty(grid.size)
    for first in range(0, gains.size, 256):  # so that memory stays bounded
        a = grid[first : first + 256]
        F = 1 / (d.s[:, None] - a[None, :])
        b = F.conj().T @ v
        M = ((np.abs(F) ** 2).T @ flat).reshape(-1, p, p)
        x = np.linalg.solve(M, b[:, :, None])[:, :, 0]
        gains[first : first + 256] = np.sum(b.conj() * x, axis=1).real
    chosen: list[complex] = []
    for k in np.argsort(-gains):
        place = complex(grid[k])
        if all(abs(place - b) > max(-place.real, -b.real) for b in chosen):
            chosen.append(place)
        if len(chosen) == LOOKED_AT:
            break
    chosen.append(_beyond(d))
    ranked = [(score(model, d.s, d.G, d.W, a), a) for a in chosen]
    ranked.sort(key=lambda both: -both[0])
    return [a for gain, a in ranked[:TRIED] if gain > WORTH * 2 * d.p]
