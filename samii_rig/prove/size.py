"""How large a concealed effect is in the data: what is left when everything simpler did its best.

The size in sigma is the root of the least chi-square, at the noise of the estimate, of the
refitted nominal model against the noise-free truth; with two effects of the best model with one
of them, outside the vocabulary of the best single effect within it. What a refit absorbs is
not in the data. The truth's own `size` is drawn with a linear refit and is larger where the
refit goes far.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from samii_rig.diagnose.classes import SAME
from samii_rig.diagnose.diagnose import table
from samii_rig.diagnose.effect import Effect
from samii_rig.diagnose.measured import Measured
from samii_rig.diagnose.model import grid
from samii_rig.diagnose.search import FIRST, Explanation, Search
from samii_rig.rig.schema import Rig
from samii_rig.types import Complex, Float

LEAST = 10.0  # sigma from which it is asked what else might be meant
ARRAYS = ("frequency", "linear", "level", "reference", "sensitivity", "open_noise")


@dataclass(frozen=True, slots=True)
class Sized:
    """How large a concealed effect is, and how many single effects these data cannot tell from it.

    size : sigma. names, sites : of the effects, structural twins as one, and of their places, that
    stay nearer to the noise-free truth than `classes.SAME`; 0 where it is not one effect.
    said : how many such names an answer gave.
    """

    size: float
    names: int = 0
    sites: int = 0
    said: int = 0


def size_of(
    truth: Mapping[str, Any],
    arrays: Mapping[str, Any],
    rig: Rig,
    said: Collection[tuple[str, str]] = (),
) -> Sized:
    """The size of what `truth` conceals from the nominal `rig`.

    arrays : of the truth: `frequency` (n,) Hz, `linear` (n, q) or `settled` (levels, n, q),
        `level`, `reference` (n,), `sensitivity` (n,), `open_noise` (n, q, q). said : the names
        of one cause of an answer.
    """
    lines = _lines(truth, arrays, rig)
    at = grid(rig, lines.frequency, lines.sensor, lines.actuator)
    every = table(rig, float(lines.frequency[0]), float(lines.frequency[-1]))
    search = Search(rig, lines, at, _smaller(truth, every))
    # Of the lines, not of the bins that a refit looks at.
    here = at.at(lines.frequency, lines.level)

    def away(e: Explanation) -> float:
        """Sigma by which an explanation misses the truth."""
        return math.sqrt(float(np.sum(lines.chi_square(e.fitted.model.response(e.fitted.x, here)))))

    if truth["kind"] == "one":
        size = away(search.nominal)
        if size < LEAST:
            return Sized(size)
        search.grow(search.nominal, FIRST)
        hidden = {(e["physics"], e["site"]) for e in truth["effects"]}
        near = [
            e
            for e in every
            if (found := search.found.get(frozenset({e.key}))) is not None and away(found) < SAME
        ]
        near += [e for e in every if hidden & set(e.names) and e not in near]
        names = {e.name for e in near}
        told = {e.name for e in every if set(said) & set(e.names)}
        return Sized(size, len(names), len({site for _, site in names}), len(told))
    if search.table:
        search.grow(search.nominal, FIRST)
    return Sized(min(away(e) for e in search.found.values()))


def _smaller(truth: Mapping[str, Any], every: Sequence[Effect]) -> Sequence[Effect]:
    """Effects of which one may explain the truth before it counts as more."""
    if truth["kind"] not in ("one", "two", "outside"):
        return []
    names = {(e["physics"], e["site"]) for e in truth["effects"]}
    if truth["kind"] == "two":
        return [e for e in every if names & set(e.names)]
    return every


def _lines(truth: Mapping[str, Any], arrays: Mapping[str, Any], rig: Rig) -> Measured:
    f: Float = arrays["frequency"]
    design = truth["design"]
    samples = design["burst"] * rig.rate_hz
    unit = np.abs(arrays["reference"] * arrays["sensitivity"]) ** 2 * (design["bursts"] - 1)
    C = arrays["open_noise"].astype(complex) * (samples / unit)[:, None, None]
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
    names = [s.name for s in rig.sensor]
    sensors = truth["design"]["sensors"] or names
    return Measured(
        frequency=f,
        H=np.asarray(H, complex).reshape(f.size, q),
        W=W,
        expected=np.full(f.size, 2.0 * q),
        level=level.astype(np.int64),
        scatter=np.full(f.size, 4.0 * q),
        levels=tuple((x, rig.actuator[0].unit) for x in levels),
        periodic=(False,) * len(levels),
        sensor=np.array([names.index(s) for s in sensors], dtype=np.int64),
        actuator=np.zeros(q, dtype=np.int64),
        outputs=tuple(sensors),
        inside=(0.0, 0.0),
        rate_hz=rig.rate_hz,
    )
