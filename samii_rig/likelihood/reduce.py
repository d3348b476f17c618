"""Whole records as few numbers: the likelihood of every model near a reference model.

With S the reference and d = H - S on the nodes of a contour, the spectra of all pieces are

    Z = L(S) + A d + noise,

A as in `leak`. chi-square = |A d - (Z - L(S))|^2 in noise units is a quadratic form in d: it is
kept as a triangular factor, and what no smooth d explains as one number. The noise is that of the
residual of the best d, smoothed along frequency: a transient is in A, and does it no harm.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from samii_rig.likelihood import rounding
from samii_rig.likelihood.algebra import (
    SAME,
    Shrinking,
    as_complex,
    as_real,
    directions,
    lengths,
)
from samii_rig.likelihood.before import with_past
from samii_rig.likelihood.form import Reduced, quadratic
from samii_rig.likelihood.free import Free, differing, residual_of, with_repeats
from samii_rig.likelihood.nodes import between, nodes_of, size_about
from samii_rig.likelihood.noise import Disturbances, Noise
from samii_rig.likelihood.pieces import Loops
from samii_rig.likelihood.records import Records, Response
from samii_rig.likelihood.rows import Rows, changes_of, rows_of
from samii_rig.likelihood.seen import Seen
from samii_rig.types import Complex, Float, Int

Part = Callable[[Int], NDArray[np.bool_]]
"""Which lines of a piece, by their number."""


@dataclass(frozen=True, slots=True)
class LineResiduals:
    """What a model leaves, line by line, nuisances at their best.

    frequency : (n,) Hz. chi2 : (n,) of all sensors together, 2 q in the mean.
    each : (n, q) of each sensor by itself, 1 in the mean.
    """

    frequency: Float
    chi2: Float
    each: Float


def residuals_by_line(
    records: Records, response: Response, noise: Reduced, loop: Loops = (), *parts: Part
) -> list[LineResiduals]:
    """The lines of all pieces under one model, in units of the noise that `noise` has: of each of
    some parts, nuisances at their best there; of all lines where none is said."""
    H = response(records.exact().s)
    records = records.without_spikes(H)
    every = rows_of(records, (), records.seen(H, loop, response))
    every = replace(every, e=every.e + noise.noise.cover(every.f, every.piece, every.k))
    out = []
    for part in parts or (lambda k: np.ones(k.size, bool),):
        rows = every.take(part(every.k))
        white = np.empty_like(rows.e)
        for on, N, prior in rows.each():
            both = np.concatenate([rows.e[on][:, :, None], N], axis=2)
            both = np.sqrt(2) * noise.noise.whitened(rows.f[on], rows.piece[on], both)
            beside = Shrinking.of(as_real(both[:, :, 1:].reshape(-1, N.shape[2])), prior)
            goal = beside.left(as_real(both[:, :, 0].ravel()))
            white[on] = as_complex(goal).reshape(on.size, -1)
        each = noise.noise.scaled(rows.f, rows.piece, white) / 2
        out.append(LineResiduals(rows.f, np.sum(np.abs(white) ** 2, axis=1), each))
    return out


def reduced(
    records: Records,
    response: Response,
    disturbances: Disturbances,
    loop: Loops = (),
    part: Part | None = None,
    at: Float | None = None,
) -> Reduced:
    """The likelihood of all models near a reference.

    disturbances : what each of them makes in all sensors, along frequency.
    loop : those that `response` has closed. part : which lines of a piece
    count, by their number. at : Hz of the nodes; None for as dense as the reference turns.
    """
    return formed(records, response, disturbances, loop, part, at)[0]


def formed(
    records: Records,
    response: Response,
    disturbances: Disturbances,
    loop: Loops = (),
    part: Part | None = None,
    at: Float | None = None,
    own_power: Float | None = None,
) -> tuple[Reduced, Rows]:
    """As `reduced`, and the lines that it was made of. own_power : as of `Noise.of_sensors_alone`,
    of noise that is not what the lines show; None for what they do."""
    smooth, exact = records.smooth(), records.exact()
    H, S = response(exact.s), response(smooth.s)
    records = records.without_spikes(H)
    shape = S / size_about(S)
    if at is None:
        nodes = nodes_of(smooth, shape, records.changing)
    else:
        nodes = np.rint(at * (smooth.samples / smooth.rate_hz)).astype(np.int64)
    seen = records.seen(H, loop, response)
    free = between(nodes, nodes_of(smooth, shape, records.changing, spare=True))
    rows, power = _with_noise(records, H, seen, nodes, free, disturbances)
    power = power if own_power is None else power.of_sensors_alone(own_power)
    counted = np.ones(rows.f.size, bool) if part is None else part(rows.k)
    rows = rows.take(counted)
    rows = replace(rows, e=rows.e + power.cover(rows.f, rows.piece, rows.k))
    form = quadratic(rows, power, S[nodes])
    count = 2.0 * rows.e.shape[1] * int(counted.sum()) - form.nuisances
    made = Reduced(
        frequency=smooth.frequency[nodes],
        sigma=smooth.sigma,
        reference=S[nodes],
        factor=form.factor,
        target=form.target,
        known=form.known,
        inside=(form.total - float(form.target @ form.target), count - form.known),
        noise=power,
        differing=differing(records, H, seen, power),
        log_determinant=form.log_determinant,
    )
    return made, rows


def _with_noise(
    records: Records,
    H: Complex,
    seen: Sequence[Seen],
    nodes: Int,
    free: Float,
    disturbances: Disturbances,
) -> tuple[Rows, Noise]:
    """The lines, beside motion from before their pieces where they show any, and their noise.

    H : the reference on the contour. free : (b, m) the change that is free where noise is told.
    """
    known = rounding.Added.of([s.rounding for s in seen])

    def told(whole: Records) -> tuple[Rows, Free, Callable[[rounding.Added], Noise]]:
        changes = changes_of(whole, records.smooth(), nodes)
        rows = rows_of(records, changes, seen)
        change = Free.of(rows, changes, free)
        left = with_repeats(records, H, seen, rows, *residual_of(change, seen))
        return rows, change, lambda known: Noise.of(*left, disturbances=disturbances, known=known)

    rows, change, noise = told(records)
    power = noise(known)
    moved = with_past(records, change, seen, power)
    if moved is not None:
        rows, _, noise = told(moved)
        power = noise(known)
    times = _as_changes(rows, seen, power)
    return rows, noise(replace(known, times=times)) if np.any(times > 1) else power


def _as_changes(rows: Rows, seen: Sequence[Seen], noise: Noise) -> Float:
    """(q,) times by which rounding shows more in a change of each sensor's response than noise of
    its power that is independent from line to line, 1 at least.

    The error of a motion of few steps repeats as the motion does: after each step, at each passage
    of a mode, in pieces that move alike. Of all places in the step at which the sensor may rest,
    alike in all pieces, those count that leave least of what is read.
    """
    out = np.ones(rows.e.shape[1])
    coarse = sorted({c for s in seen for c in s.rounding.draws})
    if not coarse:
        return out
    C = np.diagonal(noise.covariance(rows.f, rows.piece), axis1=1, axis2=2).real
    for c in coarse:
        draws = [
            s.rounding.draws[c].T
            if c in s.rounding.draws
            else np.zeros((len(s.e), rounding.OFFSETS), complex)
            for s in seen
        ]
        scale = 1 / np.sqrt(C[:, c])[:, None]
        errors = np.asarray(np.concatenate(draws)[rows.order] * scale, np.complex128)
        beyond = np.sum(np.abs(rows.e[:, c, None] * scale - errors) ** 2, axis=0)
        errors = errors[:, np.argsort(beyond)[: rounding.LIKELY]]
        along, independent = _along(rows, scale, errors)
        if independent > 0:
            out[c] = max(float(np.sum(along**2)) / rounding.LIKELY / independent, 1.0)
    return out


def _along(rows: Rows, scale: Float, errors: Complex) -> tuple[Float, float]:
    """(m, k) errors (n, k) along the directions of all changes of lines times scale (n, 1), and the
    power that independent ones of their size have there."""
    each = [(on, as_real(X * scale[on])) for on, X in rows.changes()]
    values, turn = directions(np.asarray(sum(X.T @ X for _, X in each)))
    kept = values > SAME * np.max(values, initial=0.0)
    root = turn[:, kept] / np.sqrt(values[kept])
    along, independent = np.zeros((root.shape[1], errors.shape[1])), 0.0
    power = np.mean(np.abs(errors) ** 2, axis=1) / 2  # of the real part, and of the other
    for on, X in each:
        Q = X @ root
        along += Q.T @ as_real(errors[on])
        independent += float(np.tile(power[on], 2) @ lengths(Q))
    return along, independent
