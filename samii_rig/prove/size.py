"""How large a concealed effect is in the data: what is left when everything simpler did its best.

The size in sigma is the root of the least chi-square, at the noise of the estimate, of the
refitted nominal model against the noise-free truth; with two effects of the best model with one
of them, outside the vocabulary of the best single effect within it. What a refit absorbs is
not in the data. The truth's own `size` is drawn with a linear refit and is larger where the
refit goes far.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from samii_rig.diagnose.data.measured import Measured
from samii_rig.diagnose.diagnose import table
from samii_rig.diagnose.fit.around import FIRST
from samii_rig.diagnose.fit.explanations import Explanation
from samii_rig.diagnose.fit.search import Search
from samii_rig.diagnose.physics.effect import Effect
from samii_rig.diagnose.physics.grid import grid
from samii_rig.rig.schema import Rig
from samii_rig.types import Complex, Float


@dataclass(frozen=True, slots=True)
class Sized:
    """How large a concealed effect is. size : sigma. twins : other sites of a single one, by
    structure."""

    size: float
    twins: tuple[str, ...] = ()


def size_of(truth: Mapping[str, Any], arrays: Mapping[str, Any], rig: Rig) -> Sized:
    """The size of what `truth` conceals from the nominal `rig`.

    arrays : of the truth, of q entries (sensor, actuator) with indices `sensor` (q,) and `actuator`
        (q,): `frequency` (n,) Hz, `linear` (n, q) or `settled` (levels, n, q), `level`, `reference`
        (n,), `noise` (n, q, q) a sample of the response to reference 1.
    """
    lines = _lines(truth, arrays, rig)
    every = table(rig, float(lines.frequency[0]), float(lines.frequency[-1]))
    search = _search(rig, lines, _smaller(truth, every))
    if truth["kind"] == "one":
        hidden = {(e["physics"], e["site"]) for e in truth["effects"]}
        twins = {n for e in every if hidden & set(e.names) for n in e.names} - hidden
        return Sized(_away(search, search.nominal), tuple(sorted({site for _, site in twins})))
    if search.table:
        search.forward(search.nominal, FIRST)
        search.rebin_and_refit(min(search.found.values(), key=lambda e: e.fitted.cost))
    size = min(_away(search, e) for e in search.found.values())
    if truth["kind"] == "two" and "settled" in arrays:
        # The table that is refitted has no forces, so this is the force's. The other effect's is
        # what it does to the plant without the force.
        alone = {name: a for name, a in arrays.items() if name != "settled"}
        rest = _search(rig, _lines(truth, alone, rig), [])
        size = min(size, _away(rest, rest.nominal))
    return Sized(size)


def _search(rig: Rig, lines: Measured, effects: Sequence[Effect]) -> Search:
    return Search(rig, lines, grid(rig, lines.frequency, lines.sensor, lines.actuator), effects)


def _away(search: Search, e: Explanation) -> float:
    """Sigma by which an explanation misses the truth: of the lines, not of the bins that a refit
    looks at."""
    lines = search.lines
    here = search.grid.at(lines.frequency, lines.level)
    return math.sqrt(float(np.sum(lines.chi_square(e.fitted.model.response(e.fitted.x, here)))))


def _smaller(truth: Mapping[str, Any], every: Sequence[Effect]) -> Sequence[Effect]:
    """Effects of which one may explain the truth before it counts as more."""
    if truth["kind"] not in ("two", "outside", "varying"):
        return []
    names = {(e["physics"], e["site"]) for e in truth["effects"]}
    if truth["kind"] == "two":
        return [e for e in every if names & set(e.names)]
    return every


def _lines(truth: Mapping[str, Any], arrays: Mapping[str, Any], rig: Rig) -> Measured:
    f: Float = arrays["frequency"]
    design = truth["design"]
    samples = design["burst"] * rig.rate_hz
    unit = np.abs(arrays["reference"]) ** 2 * (design["bursts"] - 1)
    C = arrays["noise"].astype(complex) * (samples / unit)[:, None, None]
    # Twice the inverse covariance: real and imaginary parts have half the variance each.
    W: Complex = 2 * np.linalg.inv(C)
    settled = arrays.get("settled")
    levels = [float(x) for x in arrays["level"]]
    q = W.shape[1]
    if settled is None:
        H, W = arrays["linear"], W * sum(x**2 for x in levels)
        level = np.full(f.size, -1)
    else:
        order = np.argsort(np.tile(f, len(levels)), kind="stable")
        H = np.concatenate(list(settled))[order]
        W = np.concatenate([W * x**2 for x in levels])[order]
        level = np.repeat(np.arange(len(levels)), f.size)[order]
        f = np.tile(f, len(levels))[order]
    sensor = np.asarray(arrays["sensor"], dtype=np.int64)
    return Measured(
        frequency=f,
        H=np.asarray(H, complex).reshape(f.size, q),
        W=W,
        expected=np.full(f.size, 2.0 * q),
        level=level.astype(np.int64),
        scatter=np.full(f.size, 4.0 * q),
        levels=tuple((x, rig.actuator[0].unit) for x in levels),
        periodic=(False,) * len(levels),
        ringing=(False,) * len(levels),
        sensor=sensor,
        actuator=np.asarray(arrays["actuator"], dtype=np.int64),
        outputs=tuple(rig.sensor[i].name for i in sensor),
        inside=(0.0, 0.0),
        rate_hz=rig.rate_hz,
    )
