"""Intervals and tests from a covariance that was itself estimated.

With nu complex degrees of freedom the estimate C of the covariance of a circular complex
error dH follows a complex Wishart distribution (Goodman, Ann. Math. Stat. 34, 1963), hence

    |dH|^2 / C            ~  F(2, 2 nu)                              one entry,
    Re(dH) / sqrt(C/2)    ~  t(2 nu)                                 one component,
    T^2 = dH^H C^-1 dH    ~  nu p/(nu - p + 1) F(2p, 2(nu - p + 1))  p entries (Hotelling).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from scipy import special

from samii_rig.errors import EstimateError
from samii_rig.types import Complex, Finding, Float, FrequencyResponse

# |H|^2/C above which the error of |H| is the Gaussian one along the radius: the curvature
# shifts it by 0.07 of its standard deviation there.
RICE_LIMIT = 25.0
BISECTIONS = 24  # leave 1e-6 of the interval's width
NODES = 16  # equally probable values of the true variance, given the estimated one
CERTAIN = 1e9  # degrees of freedom beyond which the noise is known


@dataclass(frozen=True, slots=True)
class Interval:
    """Two-sided interval; `low` and `high` have the shape of the response's `H`."""

    low: Float
    high: Float


def real_interval(response: FrequencyResponse, level: float = 0.9) -> Interval:
    """Interval of Re H, (n_freq, n_out, n_in), each entry and frequency by itself."""
    return _around(response.H.real, _component(response, level))


def imag_interval(response: FrequencyResponse, level: float = 0.9) -> Interval:
    """Interval of Im H, (n_freq, n_out, n_in), each entry and frequency by itself."""
    return _around(response.H.imag, _component(response, level))


def magnitude_interval(response: FrequencyResponse, level: float = 0.9) -> Interval:
    """Interval of |H| in the response's unit, (n_freq, n_out, n_in).

    Where the response stands well above its noise the error along the radius is Student's.
    Below, the limits are the values of |H| that put the observed one on the tails of its
    distribution: Rice's, averaged over the true variance given the estimated one. That is
    Student's again for a strong response and F(2, 2 nu) for none; the lower limit is 0 where
    no response at all would do.
    """
    variance, nu = response.variance(), _spread(response.entry_dof, response.H)
    size = np.abs(response.H)
    half = _component(response, level)
    low, high = np.maximum(size - half, 0.0), size + half
    snr = np.divide(size**2, variance, out=np.full(size.shape, np.inf), where=variance > 0)
    weak = snr < RICE_LIMIT
    if np.any(weak):
        tail = (1 - level) / 2
        sigma = np.sqrt(variance[weak])
        observed = np.sqrt(snr[weak])
        low[weak] = sigma * _rice_limit(observed, nu[weak], 1 - tail)
        high[weak] = sigma * _rice_limit(observed, nu[weak], tail)
    return Interval(low, high)


def decibel_interval(response: FrequencyResponse, level: float = 0.9) -> Interval:
    """Interval of 20 log10 |H| in dB; `low` is -inf where the response may be zero."""
    interval = magnitude_interval(response, level)
    with np.errstate(divide="ignore"):
        return Interval(20 * np.log10(interval.low), 20 * np.log10(interval.high))


def phase(response: FrequencyResponse) -> Float:
    """Phase of H in degrees, (n_freq, n_out, n_in), unwrapped along frequency.

    Only lines that are known to better than 45 degrees take part in the unwrapping; the
    others are put next to their neighbours, so that noise cannot add whole turns.
    """
    angle: Float = np.angle(response.H)
    half = phase_half_width(response)
    out = np.empty_like(angle)
    grid = response.frequency
    for i in np.ndindex(angle.shape[1:]):
        known = half[(slice(None), *i)] < 45.0
        column = angle[(slice(None), *i)]
        if np.count_nonzero(known) < 2:
            out[(slice(None), *i)] = column
            continue
        smooth = np.interp(grid, grid[known], np.unwrap(column[known]))
        out[(slice(None), *i)] = column + 2 * np.pi * np.round((smooth - column) / (2 * np.pi))
    return np.degrees(out)


def phase_half_width(response: FrequencyResponse, level: float = 0.9) -> Float:
    """(n_freq, n_out) half width of the phase interval in degrees, 180 where it is not known.

    Fieller's argument: at the true phase phi the component Im(H exp(-j phi)) has zero mean
    and variance C/2, so sin(half) = t sqrt(C/2)/|H|. That leaves out the opposite phase, so
    nothing is said where H = 0 is not refused at the same level (its F test).
    """
    half = _component(response, level)
    size = np.abs(response.H)
    zero = np.asarray(special.fdtri(2, 2 * response.entry_dof, (1 + level) / 2), float)
    known = size**2 > zero[:, None, None] * response.variance()
    ratio = np.divide(half, size, out=np.ones(size.shape), where=size > 0)
    return np.where(known & (ratio < 1), np.degrees(np.arcsin(np.minimum(ratio, 1.0))), 180.0)


def phase_interval(response: FrequencyResponse, level: float = 0.9) -> Interval:
    """Interval of the unwrapped phase in degrees; 360 wide where it is not known."""
    return _around(phase(response), phase_half_width(response, level))


def hotelling(error: Complex, covariance: Complex) -> Float:
    """(n_freq,) T^2 = e^H C^-1 e; `error` (n_freq, p), `covariance` (n_freq, p, p).

    Raises EstimateError for a singular covariance.
    """
    scale = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2).real)
    scale = np.where(scale > 0, scale, 1.0)
    unit = error / scale
    matrix = covariance / (scale[:, :, None] * scale[:, None, :])
    try:
        solved = np.linalg.solve(matrix, unit[:, :, None])[:, :, 0]
    except np.linalg.LinAlgError as failure:
        raise EstimateError(
            "the noise covariance is singular: two outputs carry the same noise; "
            "leave one of them out"
        ) from failure
    return np.asarray(np.einsum("fp,fp->f", unit.conj(), solved).real, float)


def hotelling_distribution(p: int, dof: Float) -> tuple[Float, Float, Float]:
    """(scale, dfn, dfd) with T^2/scale ~ F(dfn, dfd); EstimateError where dof < p."""
    dof = np.asarray(dof, float)
    if np.any(dof < p):
        raise EstimateError(
            f"{float(dof.min()):.3g} degrees of freedom do not give a covariance of {p} outputs; "
            "more repeats or fewer outputs would"
        )
    rest = dof - p + 1
    return dof * p / rest, np.full(dof.shape, 2.0 * p), 2.0 * rest


def hotelling_p(t2: Float, p: int, dof: Float) -> Float:
    """Probability of a T^2 at least this large, of p entries with `dof` degrees of freedom, when
    the hypothesis holds; shape of `t2` and `dof`."""
    scale, dfn, dfd = hotelling_distribution(p, dof)
    return np.asarray(special.fdtrc(dfn, dfd, np.maximum(t2, 0.0) / scale), float)


def hotelling_mean(p: int, dof: Float) -> Float:
    """Mean of T^2: nu p/(nu - p) with nu = `dof` of any shape, infinite for nu <= p."""
    dof = np.asarray(dof, float)
    return np.where(dof > p, dof * p / np.where(dof > p, dof - p, 1.0), np.inf)


def model_distance(response: FrequencyResponse, model: Complex) -> tuple[Float, Float]:
    """T^2 of `model` (n_freq, n_out, n_in) against the response, and its p-value, per line."""
    p = response.H.shape[1] * response.H.shape[2]
    error = (response.H - model).reshape(-1, p)
    t2 = hotelling(error, response.covariance)
    return t2, hotelling_p(t2, p, response.dof)


@dataclass(frozen=True, slots=True)
class Difference:
    """Whether two responses, or a response and a model, are one: per band, in units of noise.

    ratio : mean of T^2 over its mean under equality; 1 when they agree.
    p_value : approximate probability of such a ratio when they agree.
    change : median of |H_a - H_b|/|H_a| over the band and the outputs.
    """

    low_hz: float
    high_hz: float
    ratio: float
    p_value: float
    change: float


def difference(
    a: FrequencyResponse,
    b: FrequencyResponse,
    bands: Sequence[tuple[float, float]],
) -> tuple[Difference, ...]:
    """Compare two responses (levels, days, repeats) on the lines they share, band by band.

    The covariance of the difference is C_a + C_b with the Welch-Satterthwaite degrees of
    freedom. Bands that hold no common line are left out.
    """
    ia, ib = _common_lines(a, b)
    p = a.H.shape[1] * a.H.shape[2]
    f = a.frequency[ia]
    error = (a.H[ia] - b.H[ib]).reshape(-1, p)
    nu = _sum_dof([a.covariance[ia], b.covariance[ib]], [a.dof[ia], b.dof[ib]])
    t2 = hotelling(error, a.covariance[ia] + b.covariance[ib])
    share = max(_lines_shared(a), _lines_shared(b))
    change = np.abs(error) / np.abs(a.H[ia]).reshape(-1, p)
    local = "local" in (a.estimator, b.estimator)
    return _by_band(f, t2, p, nu, change, bands, share, correlated=local)


def model_difference(
    response: FrequencyResponse,
    model: Complex,
    output: int,
    input: int,
    bands: Sequence[tuple[float, float]],
) -> tuple[Difference, ...]:
    """Hold a model (n_freq, n_out, n_in) against one entry of a response, band by band.

    Lines at which the model is NaN are left out, and bands that hold no other.
    """
    error = response.H[:, output, input] - model[:, output, input]
    known = np.isfinite(error)
    f, nu = response.frequency[known], response.entry_dof[known]
    # A line known for certain is compared as one known to a millionth.
    least = (1e-6 * np.abs(response.H[known, output, input])) ** 2 + np.finfo(float).tiny
    t2 = np.abs(error[known]) ** 2 / np.maximum(response.variance()[known, output, input], least)
    change = (np.abs(error) / np.abs(response.H[:, output, input]))[known, None]
    share = _lines_shared(response)
    return _by_band(f, t2, 1, nu, change, bands, share, correlated=response.estimator == "local")


def _by_band(
    f: Float,
    t2: Float,
    p: int,
    nu: Float,
    change: Float,
    bands: Sequence[tuple[float, float]],
    share: float,
    *,
    correlated: bool,
) -> tuple[Difference, ...]:
    """Mean of T^2 in each band, held against what equality would give.

    T^2 of neighbouring lines share one pooled covariance: with n lines in n_w windows their
    mean is approximately F with 2 p n and 2 p (nu - p + 1) n_w degrees of freedom, which is
    exact for one line of one output. Lines of a local method share their data too
    (`correlated`): there n = n_w.
    """
    out = []
    nu = np.minimum(nu, CERTAIN)
    usable = nu > p + 1  # below, T^2 has no mean to compare with
    for low, high in bands:
        inside = (f >= low) & (f < high) & usable
        n = int(np.count_nonzero(inside))
        if n == 0:
            continue
        ratio = float(np.mean(t2[inside] / hotelling_mean(p, nu[inside])))
        windows = max(1.0, n / share)
        independent = windows if correlated else float(n)
        rest = 2 * p * float(np.mean(nu[inside]) - p + 1) * windows
        p_value = float(special.fdtrc(2 * p * independent, rest, ratio * rest / (rest - 2)))
        out.append(Difference(low, high, ratio, p_value, float(np.median(change[inside]))))
    return tuple(out)


def octaves(frequency: Float) -> tuple[tuple[float, float], ...]:
    """(lowest, highest) of the octave bands, Hz, that cover the positive of the increasing
    frequencies (n,), Hz."""
    positive = frequency[frequency > 0]
    edges = [float(positive[0])]
    while edges[-1] <= positive[-1]:
        edges.append(edges[-1] * 2)
    return tuple(pairwise(edges))


def combine(responses: Sequence[FrequencyResponse]) -> FrequencyResponse:
    """One response from several, weighted by their precision: only when asked for.

    Nothing calls this by itself: amplitude levels are never pooled silently. Each line is
    weighted by the inverse of the mean relative variance over the outputs; `level` is NaN
    when the levels differ. Raises EstimateError when channels or frequencies differ.
    """
    first = responses[0]
    for other in responses[1:]:
        same = [c.name for c in first.outputs] == [c.name for c in other.outputs]
        if not same or not np.array_equal(first.frequency, other.frequency):
            raise EstimateError("responses to combine differ in outputs or in frequencies")
    size = np.mean([np.abs(r.H) ** 2 for r in responses], axis=0)
    relative = np.stack([np.mean(r.variance() / size, axis=(1, 2)) for r in responses])
    weight = 1 / relative
    weight /= weight.sum(axis=0)
    H = sum(w[:, None, None] * r.H for w, r in zip(weight, responses, strict=True))
    parts = [(w**2)[:, None, None] * r.covariance for w, r in zip(weight, responses, strict=True)]
    levels = {r.level for r in responses}
    finding = Finding("dof", "note", f"{len(responses)} responses combined on request")
    return replace(
        first,
        H=np.asarray(H),
        covariance=np.sum(parts, axis=0),
        dof=_sum_dof(parts, [r.dof for r in responses]),
        coherence=np.mean([r.coherence for r in responses], axis=0),
        level=first.level if len(levels) == 1 else float("nan"),
        input_rms=np.mean([r.input_rms for r in responses], axis=0),
        n_averages=sum(r.n_averages for r in responses),
        why=f"{len(responses)} responses combined on request: {first.why}",
        findings=(*(f for r in responses for f in r.findings), finding),
        sources=tuple(dict.fromkeys(s for r in responses for s in r.sources)),
    )


def _around(centre: Float, half: Float) -> Interval:
    return Interval(centre - half, centre + half)


def _spread(dof: Float, H: Complex) -> Float:
    return np.broadcast_to(dof[:, None, None], H.shape)


def _component(response: FrequencyResponse, level: float) -> Float:
    """t quantile times the standard deviation of one real component."""
    t = np.asarray(special.stdtrit(2 * response.entry_dof, (1 + level) / 2), float)
    return np.asarray(t[:, None, None] * np.sqrt(response.variance() / 2), float)


def _rice_limit(observed: Float, nu: Float, probability: float) -> Float:
    """The true magnitude at which one below `observed` has this probability; 0 if none.

    Magnitudes in units of the square root of the estimated variance.
    """
    chance = (np.arange(NODES) + 0.5) / NODES
    # nu C_estimated/C is gamma(nu): precision of the true noise, in units of the estimated.
    precision = special.gammaincinv(nu[:, None], chance) / nu[:, None]
    x = 2 * precision * observed[:, None] ** 2
    low = np.zeros_like(observed)
    high = observed + 10 + 30 / nu  # far out on Student's tails for every probability used
    for _ in range(BISECTIONS):
        middle = (low + high) / 2
        below = special.chndtr(x, 2.0, 2 * precision * middle[:, None] ** 2).mean(axis=1)
        up = np.asarray(below) > probability
        low, high = np.where(up, middle, low), np.where(up, high, middle)
    # Nothing but zero was ever low enough.
    return np.where(low == 0, 0.0, (low + high) / 2)


def _sum_dof(parts: Sequence[Complex], dofs: Sequence[Float]) -> Float:
    """Welch-Satterthwaite degrees of freedom of a sum of covariances, per line.

    Each channel is measured in units of its own sum, so that no unit rules.
    """
    diagonals = [np.diagonal(c, axis1=1, axis2=2).real for c in parts]
    total = np.sum(diagonals, axis=0)
    shares = [np.mean(d / np.where(total > 0, total, 1.0), axis=1) for d in diagonals]
    bottom = np.sum([s**2 / n for s, n in zip(shares, dofs, strict=True)], axis=0)
    return np.asarray(np.sum(shares, axis=0) ** 2 / bottom, float)


def _common_lines(
    a: FrequencyResponse, b: FrequencyResponse
) -> tuple[np.ndarray[tuple[int], np.dtype[np.intp]], np.ndarray[tuple[int], np.dtype[np.intp]]]:
    if [c.name for c in a.outputs] != [c.name for c in b.outputs]:
        raise EstimateError("responses to compare differ in outputs")
    # Grids of records of equal length agree to rounding; a line is common within 1e-6 Hz.
    _, ia, ib = np.intersect1d(
        np.round(a.frequency, 6), np.round(b.frequency, 6), return_indices=True
    )
    if ia.size == 0:
        raise EstimateError("responses to compare share no frequency")
    return ia, ib


def _lines_shared(response: FrequencyResponse) -> float:
    """About how many neighbouring lines went into one covariance."""
    per_line = max(response.n_averages - 1, 1)
    return max(1.0, float(np.median(response.dof)) / per_line)
