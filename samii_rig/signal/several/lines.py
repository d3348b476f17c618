"""Line by line over repeats, periods and realisations of experiments.

The residuals e = Y - H V distinguish two things. Over the repeats (bursts, periods) of an
experiment they scatter by noise alone. Over more experiments than inputs their means scatter by
the noise of a mean and by what is not linear, since that repeats with the period and changes with
the phases (robust method, Pintelon and Schoukens, 2nd ed., sections 4.3.1 and 4.3.2).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from samii_rig.errors import EstimateError
from samii_rig.signal import noise, periodic, repeats, spectra
from samii_rig.signal.groups import Group, Selection
from samii_rig.signal.quantisation import floor_of
from samii_rig.signal.several import solve
from samii_rig.signal.several.experiments import Columns, Experiment
from samii_rig.types import Complex, Float, Int

LEAST_SHARE = 0.2  # of an experiment's residual that solving leaves, below which it shows nothing
EXACT = 1e-24  # of a signal's power: what scatters less over periods is rounding of what was sent


@dataclass(frozen=True, slots=True)
class Measured:
    """Spectra of the repeats of one experiment.

    frequency (n_freq,) Hz; Z (n, n_freq, q), q as in `Columns`; n_samples of one repeat; floor
    (n_out,) variance of rounding that repeats do not show; shared, correlation : see
    `repeats.over_repeats`; left (n_freq, q - n_ref) what the start leaves in the mean of the
    inputs and outputs.
    """

    frequency: Float
    Z: Complex
    n_samples: int
    floor: Float
    shared: float = 1.0
    correlation: float = 0.0
    left: Complex | None = None


@dataclass(frozen=True, slots=True)
class Lines:
    """H (n_freq, n_out, n_in), covariance (n_freq, p, p), dof (n_freq,) of one input's column.

    at : the lines, of those asked for, that distinguish the inputs.
    noise : (n_freq, n_out) power of the noise of one repeat, NaN where no repeats show it.
    total : (n_freq, n_out) power of all that scatters over experiments, None where that was not
        looked at. output (n_freq, n_out), input (n_freq, n_in) : mean power over the experiments
        of what the inputs explain of the outputs; largest power of each input in any experiment.
    nu : degrees of freedom a line of noise and total. repeats : of each experiment, on average.
    n : repeats in all. lost : lines that do not distinguish the inputs.
    """

    at: Int
    frequency: Float
    H: Complex
    covariance: Complex
    dof: Float
    noise: Float
    total: Float | None
    output: Float
    input: Float
    nu: tuple[float, float]
    repeats: float
    n: int
    lost: int
    remark: str


@dataclass(frozen=True, slots=True)
class _Noise:
    """N (n_freq, p, p) of the mean of each member of a class, with dof (n_freq,); nu a line."""

    N: list[Complex]
    dof: Float
    nu: float
    remark: str


def measured(experiment: Experiment, method: str, columns: Columns) -> Measured:
    """Spectra of an experiment's repeats, by one of burst, settled, periodic."""
    group, rate = experiment.group, experiment.group.rate_hz
    shared, correlation, left = 1.0, 0.0, None
    if method == "burst":
        found, shared = spectra.burst_spectra(group.pieces, rate)
        pieces = group.pieces
    elif method == "settled":
        pieces = group.pieces[group.unsettled :]
        found, correlation = spectra.settled_spectra(group.pieces[group.unsettled - 1 :], rate)
    else:
        seen = periodic.periods(group)
        pieces, found = seen.pieces, seen.spectra[0]
        left = _left(seen, columns)
    outputs = columns.part("outputs").start
    narrow = [type(p)(p.name, p.r, p.z[:, [0, *range(outputs, p.z.shape[1])]]) for p in pieces[:1]]
    selection = Selection(columns.inputs[0], columns.outputs)
    floor, _ = floor_of(Group(selection, group.kind, group.level, group.unit, rate), narrow)
    Z = np.stack([s.Z for s in found])
    return Measured(found[0].frequency, Z, len(pieces[0]), floor, shared, correlation, left)


def estimate(
    parts: Sequence[Measured],
    columns: Columns,
    at: Int,
    R: Complex | None,
    classes: Sequence[Sequence[int]],
    *,
    realised: bool,
) -> Lines:
    """H on the lines `at` from all experiments.

    R : (n_freq, n_ref, E) references there, None without any. classes : experiments whose noise
        is alike, such as those that drive one input.
    realised : whether the covariance is taken over experiments, so that it holds distortion.

    Raises EstimateError if a class holds one repeat alone, which shows no noise.
    """
    inputs, outputs = columns.part("inputs"), columns.part("outputs")
    count = np.array([len(m.Z) for m in parts])
    mean = np.stack([m.Z[:, at].mean(axis=0) for m in parts], axis=2)
    W = solve.instrument(mean[:, inputs], R, count.astype(float))
    apart = solve.told_apart(mean[:, inputs], W)
    names = [c.name for c in columns.inputs]
    solve.require_independent(apart, len(parts), names, "estimate")
    at, V, Y = at[apart], mean[apart, inputs], mean[apart, outputs]
    found = solve.solve(V, Y, W[apart])
    H, Q = found.H, found.Q
    rest, free = Y - H @ V, 1 - solve.leverage(V, Q)
    covariance = _rings(parts, at, columns, found)
    of_repeats: list[_Noise] = []
    of_means: list[_Noise] = []
    for own in classes:
        if any(count[k] > 1 for k in own):
            of_repeats.append(_over_repeats([parts[k] for k in own], columns, at, H))
        if realised:
            of_means.append(_over_means(rest[:, :, own], free[:, own], H))
        used = (of_means if realised else of_repeats)[-1:]
        if not used:
            raise EstimateError("one repeat of an experiment shows no noise; two or more would")
        for k, N in zip(own, used[0].N, strict=True):
            covariance += solve.covariance(N, Q[:, [k]])
    used = of_means if realised else of_repeats
    return Lines(
        at=at,
        frequency=parts[0].frequency[at],
        H=H,
        covariance=covariance,
        dof=np.min([x.dof for x in used], axis=0),
        noise=_power(of_repeats, H) * float(np.mean(count)),
        total=_power(of_means, H) if realised else None,
        output=np.mean(np.abs(H @ V) ** 2, axis=2),
        input=np.max(np.abs(V) ** 2, axis=2),
        nu=(sum(x.nu for x in of_repeats), sum(x.nu for x in of_means)),
        repeats=float(np.mean(count)),
        n=int(count.sum()),
        lost=int(np.sum(~apart)),
        remark=used[0].remark,
    )


def _over_repeats(parts: Sequence[Measured], columns: Columns, at: Int, H: Complex) -> _Noise:
    """From the scatter of e about its mean in each experiment, as `repeats.over_repeats`."""
    e = []
    for m in parts:
        Z = m.Z[:, at]
        V, Y = Z[:, :, columns.part("inputs")], Z[:, :, columns.part("outputs")]
        own = Y - np.einsum("foi,nfi->nfo", H, V)
        e.append(own - own.mean(axis=0))
    count = [len(m.Z) for m in parts]
    n, nu, p = float(np.mean(count)), float(sum(count) - len(count)), H.shape[1]
    correlation = max(m.correlation for m in parts)
    found = noise.pooled(np.concatenate(e), nu, _width(nu, p, len(at)), H)
    each = found.covariance / (1 - 2 * correlation / n)
    scatter = np.diagonal(each, axis1=1, axis2=2).real
    more = 1 + 2 * correlation * (n - 1) / n
    N = [
        each * more / len(m.Z) + np.eye(p) * np.maximum(m.floor - scatter, 0.0)[:, None, :]
        for m in parts
    ]
    return _Noise(N, found.dof / max(m.shared for m in parts), nu, found.remark)


def _over_means(rest: Complex, free: Float, H: Complex) -> _Noise:
    """From the residuals (n_freq, n_out, n) of the means of experiments, of which each leaves
    the part `free` (n_freq, n)."""
    share = float(np.mean(np.sum(free, axis=1)))
    if share < LEAST_SHARE * free.shape[1]:
        raise EstimateError(
            "too few experiments drive each input to tell distortion from noise; "
            "another realisation would do"
        )
    width = _width(share, H.shape[1], len(H))
    found = noise.pooled(rest.transpose(2, 0, 1), share, width, H)
    return _Noise([found.covariance] * free.shape[1], found.dof, share, found.remark)


def _width(nu: float, p: int, n_lines: int) -> int:
    """How many lines to pool, as `repeats.pooling_lines`, with nu degrees of freedom a line."""
    width = int(-(-repeats.wanted_dof(p) // max(nu, 1e-9)))
    width += 1 - width % 2
    if min(width, n_lines) * nu <= p:
        raise EstimateError(
            f"{nu:g} degrees of freedom at each of {n_lines} lines do not give a covariance of "
            f"{p} outputs; more repeats, a wider band or fewer outputs would"
        )
    return width


def _power(found: Sequence[_Noise], H: Complex) -> Float:
    """(n_freq, n_out) mean power of the noise of a mean over all experiments."""
    if not found:
        return np.full(H.shape[:2], np.nan)
    every = [np.diagonal(N, axis1=1, axis2=2).real for x in found for N in x.N]
    return np.asarray(np.mean(every, axis=0))


def _rings(parts: Sequence[Measured], at: Int, columns: Columns, found: solve.Solved) -> Complex:
    """(n_freq, p, p) what the starts left in the means do to H, dH dH^H; no scatter shows it."""
    n_in, (n_freq, n_out, _) = len(columns.inputs), found.H.shape
    covariance = np.zeros((n_freq, n_out * n_in, n_out * n_in), complex)
    for k, m in enumerate(parts):
        if m.left is None or not np.any(m.left[at]):
            continue
        e = m.left[at, n_in:] - np.einsum("foi,fi->fo", found.H, m.left[at, :n_in])
        dH = (e[:, :, None] * found.Q[:, k, None, :]).reshape(n_freq, -1)
        covariance += dH[:, :, None] * dH[:, None, :].conj()
    return covariance


def _left(seen: periodic.Periods, columns: Columns) -> Complex | None:
    """What a transient left in the mean of the periods of each input and output, None where no
    period was left to estimate it from. What is sent is exact and never rings."""
    if not seen.before:
        return None
    n_ref = len(columns.references)
    Z = np.stack([s.Z for s in (seen.before[0], *seen.spectra[0])])[:, :, n_ref:]
    last = np.mean(np.abs(Z[-1] - Z[-2]) ** 2, axis=0)
    noisy = np.flatnonzero(last > EXACT * np.mean(np.abs(Z[-1]) ** 2, axis=0))
    out = np.zeros(Z.shape[1:], complex)
    if noisy.size:  # `transient_left` wants a first column that it does not judge by
        out[:, noisy] = periodic.transient_left(Z[:, :, [noisy[0], *noisy]])[:, 1:]
    return out
