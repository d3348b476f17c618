"""Numbers of the rig file that are wrong: lengths that it takes for exact, and what a refit needs
far from where it is stated.

A length without a tolerance takes no part in a refit, and is no missing physics. One that was
measured or typed wrong bends every mode, and pairs of effects mimic it at great length. So each is
freed in turn where no single effect explains the records, and where no length does, each with the
few that help most.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Sequence
from dataclasses import replace
from itertools import combinations
from typing import Any

import numpy as np

from samii_rig.diagnose.fit.explanations import threshold
from samii_rig.diagnose.fit.growing import LARGE_MISMATCH
from samii_rig.diagnose.fit.record_search import RecordSearch
from samii_rig.diagnose.fit.records import Whole
from samii_rig.diagnose.fit.refit import Fitted, refit
from samii_rig.diagnose.fit.search import Search
from samii_rig.diagnose.physics.effect import Key
from samii_rig.diagnose.physics.model import Model
from samii_rig.diagnose.result import Exact, Value
from samii_rig.errors import SamiiRigError
from samii_rig.rig.schema import Rig, parameters
from samii_rig.rig.schema.elements import Branch, flattened

LENGTH = "L"  # symbol of what is measured with a rule, and taken for exact
# Tolerance of a number whose value nobody trusts: a factor of e lies two of them away.
FREE = 0.5
# Of what the nominal model leaves of the lines: one that leaves more is held against no record.
LEAVES = 0.1
HELPING = 3  # lengths that explain most by themselves, each of which is freed with every other
CLEARLY = 2.0  # times what the best pair leaves of the lines: another that leaves less is as good
# Tolerances, standard deviations of a rig file, by which a number of it is off with a chance of
# 6e-7: of 467 answers "nothing is missing" three stood farther, all with something concealed, and
# of those with nothing concealed none beyond 4.1.
OFF_THE_FILE = 5.0
MOST_WRONG = 3  # numbers that are told: a file with more is of another rig
NINETY = 1.645  # standard deviations of a 90 % interval


def wrong_lengths(search: RecordSearch) -> tuple[tuple[Exact, ...], RecordSearch] | None:
    """The length or the two lengths with which the rig file explains the records to their noise,
    and the search on the rig that has them free; None where the best single effect does, or
    neither.

    search : over single effects, ended.
    """
    whole, by_line = search.whole, search.by_line
    best = search.ranked()[0].fitted
    mismatch = by_line.ratio(by_line.nominal.fitted)
    close = search.ratio(best) <= threshold(search.spread)
    if (
        close
        or mismatch < LARGE_MISMATCH
        or by_line.lines.depends_on_level()
        or not isinstance(whole, Whole)
    ):
        return None
    names = list(_exact(by_line.rig))
    alone = _freed_each(search, [(name,) for name in names])
    if found := _explaining(search, whole, alone[:1], LEAVES * mismatch):
        return found
    helping = [one for (one,), _ in alone[:HELPING]]
    pairs = [pair for pair in combinations(names, 2) if set(pair) & set(helping)]
    together = _freed_each(search, pairs)
    if len(together) > 1 and _left(together[1]) < CLEARLY * _left(together[0]):
        return None  # another pair does as well: which are wrong is not known
    return _explaining(search, whole, together[:1], LEAVES * mismatch)


Freed = tuple[tuple[str, ...], Search]


def _left(freed: Freed) -> float:
    """Chi-square per degree of freedom that the nominal model leaves of the lines."""
    return freed[1].ratio(freed[1].nominal.fitted)


def _freed_each(search: RecordSearch, several: Sequence[tuple[str, ...]]) -> list[Freed]:
    """The lines with each of some sets of lengths free, those first that explain most."""

    def words(names: tuple[str, ...]) -> str:
        return "another " + " and ".join(f"{name}.{LENGTH}" for name in names)

    found = [
        (names, one)
        for names in search.each(several, words)
        for one in _on_lines(search.by_line, names)
    ]
    return sorted(found, key=_left)


def _explaining(
    search: RecordSearch, whole: Whole, some: Sequence[Freed], leaves: float
) -> tuple[tuple[Exact, ...], RecordSearch] | None:
    """The first of these that explains the records too. leaves : of the lines, at most."""
    for names, by_line in some:
        if _left((names, by_line)) > leaves:
            continue
        try:
            found = RecordSearch(replace(whole, rig=by_line.rig), by_line)
        except (SamiiRigError, np.linalg.LinAlgError):
            continue
        fitted = found.nominal.fitted
        if found.ratio(fitted) <= threshold(found.spread):
            rig = search.by_line.rig
            return tuple(_exact_of(rig, (name, LENGTH), fitted) for name in names), found
    return None


def _exact(rig: Rig) -> Iterator[str]:
    for e in flattened(rig.element):
        p = parameters(e).get(LENGTH)
        if p is not None and p.value and not p.tolerance:
            yield e.name


def _on_lines(by_line: Search, names: Collection[str]) -> Iterator[Search]:
    """The same lines with these lengths free, where that is a rig."""
    try:
        rig = _freed(by_line.rig, [(name, LENGTH) for name in names])
        yield Search(rig, by_line.lines, by_line.grid, by_line.table)
    except (SamiiRigError, np.linalg.LinAlgError):
        return


def _freed(rig: Rig, keys: Collection[Key]) -> Rig:
    """The rig, nothing known of these parameters."""

    def element(e: Any) -> Any:
        own = parameters(e)
        free = {"tolerance": FREE}
        update: dict[str, Any] = {s: own[s].model_copy(update=free) for n, s in keys if n == e.name}
        if isinstance(e, Branch):
            update["element"] = tuple(map(element, e.element))
        return e.model_copy(update=update)

    return rig.model_copy(update={"element": tuple(map(element, rig.element))})


def wrong_numbers(search: Search, fitted: Fitted) -> tuple[tuple[Exact, ...], Fitted]:
    """The nominal parameters that a fit needs farther from where the rig file states them than
    their tolerances let them be: these numbers are wrong, or something adds to them. And the fit in
    which nothing is known of them. At most `MOST_WRONG`, the farthest."""
    found: list[Key] = []
    end = fitted
    while len(found) < MOST_WRONG:
        far = [key for key in _far(end, fitted.model) if key not in found]
        # The others had come as far as their tolerances let them to spare this one its way.
        freed = _without(search, fitted, end, [*found, *far[:1]]) if far else None
        if freed is None:
            break
        found, end = [*found, far[0]], freed
    # One that stood in for another is back where the file has it.
    stays = [key for key in _far(end, fitted.model) if key in found]
    if stays != found and (freed := _without(search, fitted, end, stays)) is not None:
        found, end = stays, freed
    if not found:  # nothing could be fitted without it
        found = _far(fitted, fitted.model)[:1]
    return tuple(_exact_of(search.rig, key, end) for key in found), end


def off_the_file(fitted: Fitted, stated: Model) -> dict[Key, float]:
    """The parameters that a fit has beyond the tolerances of a model of the same, the farthest
    first, each with how many of them."""
    n = stated.n_nominal
    away = np.abs(fitted.x[:n] / stated.prior[:n])
    far = [i for i in np.argsort(-away).tolist() if away[i] >= OFF_THE_FILE]
    return {stated.keys[i]: float(away[i]) for i in far}


def _far(fitted: Fitted, stated: Model) -> list[Key]:
    """As `off_the_file`, the parameters alone."""
    return list(off_the_file(fitted, stated))


def _without(search: Search, fitted: Fitted, start: Fitted, keys: Sequence[Key]) -> Fitted | None:
    """The same fit, nothing known of some parameters, from where another ended."""
    try:
        model = Model(_freed(search.rig, keys), fitted.model.effects)
        return refit(model, search.problem, start.x)
    except (SamiiRigError, np.linalg.LinAlgError):
        return None


def _exact_of(rig: Rig, key: Key, fitted: Fitted) -> Exact:
    name, symbol = key
    at = fitted.model.keys.index(key)
    sd = float(np.sqrt(fitted.covariance()[at, at]))
    value = fitted.model.values(fitted.x)[key]
    low, high = (value * math.exp(way * NINETY * sd) for way in (-1, 1))
    stated = next(parameters(e)[symbol] for e in flattened(rig.element) if e.name == name)
    return Exact(".".join(key), stated.value, Value(value, stated.unit, low, high))
