"""How large a concealed effect is in the data: what is left when everything simpler did its best.

The size in sigma is the root of the least chi-square, at the noise of the estimate, of the
refitted nominal model against the noise-free truth; with two effects of the best model with one
of them, outside the vocabulary of the best single effect within it. What a refit absorbs is
not in the data. The truth's own `size` is drawn with a linear refit and is larger where the
refit goes far.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence, Set
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from samii_rig.diagnose.classes import SAME, apart
from samii_rig.diagnose.diagnose import table
from samii_rig.diagnose.effect import Effect
from samii_rig.diagnose.explanations import Explanation
from samii_rig.diagnose.measured import Measured
from samii_rig.diagnose.model import grid
from samii_rig.diagnose.search import FIRST, Search
from samii_rig.prove.trial import Name
from samii_rig.rig.schema import Rig
from samii_rig.types import Complex, Float

LEAST = 10.0  # sigma from which it is asked what else might be meant


@dataclass(frozen=True, slots=True)
class Sized:
    """How large a concealed effect is, and how many single effects these data cannot tell from it.

    size : sigma. names, sites : of the effects, structural twins as one, and of their places, that
    come nearer than `classes.SAME` to the concealed effect as it fits the noise-free truth; 0
    where it is not one effect, or none that has a linear model. said : the fewest effects of the
    table that bear all names that an answer gave. twins : other sites of the concealed effect.
    """

    size: float
    names: int = 0
    sites: int = 0
    said: int = 0
    twins: tuple[str, ...] = ()


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
    every = table(rig, float(lines.frequency[0]), float(lines.frequency[-1]))
    search = _search(rig, lines, _smaller(truth, every))
    if truth["kind"] == "one":
        size = _away(search, search.nominal)
        if size < LEAST:
            return Sized(size)
        hidden = {(e["physics"], e["site"]) for e in truth["effects"]}
        twins = {n for e in every if hidden & set(e.names) for n in e.names} - hidden
        told = len(bearers(set(said), [set(e.names) for e in every]))
        known = Sized(size, said=told, twins=tuple(sorted({site for _, site in twins})))
        search.grow(search.nominal, FIRST)
        if (own := _own(search, hidden)) is not None:
            # Held against the effect as the model has it, not against the truth: what model and
            # plant differ by anyhow is in every candidate's distance to that.
            search.renew(own)
            own = _own(search, hidden)
        if own is None:
            return replace(known, said=0)
        single = [e for e in search.found.values() if e.effects]
        near = [e.effects[0] for e in single if e is own or apart(own, e, search.problem) < SAME]
        names = bearers({n for e in near for n in e.names}, [set(e.names) for e in near])
        sites = {near[i].site for i in names}
        return replace(known, names=len(names), sites=len(sites))
    if search.table:
        search.grow(search.nominal, FIRST)
        search.renew(min(search.found.values(), key=lambda e: e.fitted.cost))
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


def _own(search: Search, hidden: Set[Name]) -> Explanation | None:
    """The concealed effect as the model fits it best; None where no refit of it ended."""
    mine = [e for e in search.found.values() if e.effects and hidden & set(e.effects[0].names)]
    return min(mine, key=lambda e: e.fitted.cost, default=None)


def bearers(names: Set[Name], effects: Sequence[Set[Name]]) -> list[int]:
    """The fewest of `effects`, each given by all its names, that bear all of `names`: one that
    stands between two elements is called by either (greedily, which so small a cover allows)."""
    left, out = set(names), []
    while left:
        best = max(range(len(effects)), key=lambda i: len(left & effects[i]), default=None)
        if best is None or not left & effects[best]:
            break
        out.append(best)
        left -= effects[best]
    return out


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
        ringing=(False,) * len(levels),
        sensor=np.array([names.index(s) for s in sensors], dtype=np.int64),
        actuator=np.zeros(q, dtype=np.int64),
        outputs=tuple(sensors),
        inside=(0.0, 0.0),
        rate_hz=rig.rate_hz,
    )
