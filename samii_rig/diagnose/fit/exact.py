"""Lengths that the rig file takes for exact, and one of them that is wrong.

A length without a tolerance takes no part in a refit, and is no missing physics. One that was
measured or typed wrong bends every mode, and pairs of effects mimic it at great length. So each is
freed in turn where no single effect explains the records.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np

from samii_rig.diagnose.fit.explanations import threshold
from samii_rig.diagnose.fit.records import RecordSearch, Whole
from samii_rig.diagnose.fit.refit import Fitted
from samii_rig.diagnose.fit.search import GROSS, Search
from samii_rig.diagnose.result import Exact, Value
from samii_rig.errors import SamiiRigError
from samii_rig.rig.schema import Rig, parameters
from samii_rig.rig.schema.elements import Branch, flattened

LENGTH = "L"  # symbol of what is measured with a rule, and taken for exact
FREE = 0.5  # tolerance of a length whose value nobody trusts: a factor of e lies two of them away
# Of what the nominal model leaves of the lines: one that leaves more is held against no record.
LEAVES = 0.1
NINETY = 1.645  # standard deviations of a 90 % interval


def lengths(rig: Rig) -> tuple[str, ...]:
    """Lengths without a tolerance, as "element.L"."""
    return tuple(f"{name}.{LENGTH}" for name in _exact(rig))


def wrong_length(search: RecordSearch) -> tuple[Exact, RecordSearch] | None:
    """The length with which the rig file explains the records to their noise, and the search on the
    rig that has it free; None where the best single effect does, or no length.

    search : over single effects, ended.
    """
    whole, by_line = search.whole, search.by_line
    best = search.ranked()[0].fitted
    gross = by_line.ratio(by_line.nominal.fitted)
    close = search.ratio(best) <= threshold(search.spread)
    if close or gross < GROSS or by_line.lines.torn() or not isinstance(whole, Whole):
        return None
    freed = [
        (name, alone)
        for name in search.each(list(_exact(by_line.rig)), lambda n: f"another {n}.{LENGTH}")
        for alone in _on_lines(by_line, name)
    ]
    name, alone = min(
        freed, key=lambda one: one[1].ratio(one[1].nominal.fitted), default=("", by_line)
    )
    if not name or alone.ratio(alone.nominal.fitted) > LEAVES * gross:
        return None
    try:
        found = RecordSearch(replace(whole, rig=alone.rig), alone)
    except (SamiiRigError, np.linalg.LinAlgError):
        return None
    fitted = found.nominal.fitted
    if found.ratio(fitted) > threshold(found.spread):
        return None
    return _told(by_line.rig, name, fitted), found


def _exact(rig: Rig) -> Iterator[str]:
    for e in flattened(rig.element):
        p = parameters(e).get(LENGTH)
        if p is not None and p.value and not p.tolerance:
            yield e.name


def _on_lines(by_line: Search, name: str) -> Iterator[Search]:
    """The same lines with one length free, where that is a rig."""
    try:
        yield Search(_freed(by_line.rig, name), by_line.lines, by_line.grid, by_line.table)
    except (SamiiRigError, np.linalg.LinAlgError):
        return


def _freed(rig: Rig, name: str) -> Rig:
    """The rig, nothing known of the length of one element."""

    def element(e: Any) -> Any:
        update: dict[str, Any] = {}
        if e.name == name:
            free = {"tolerance": FREE}
            update[LENGTH] = parameters(e)[LENGTH].model_copy(update=free)
        if isinstance(e, Branch):
            update["element"] = tuple(map(element, e.element))
        return e.model_copy(update=update)

    return rig.model_copy(update={"element": tuple(map(element, rig.element))})


def _told(rig: Rig, name: str, fitted: Fitted) -> Exact:
    key = (name, LENGTH)
    at = fitted.model.keys.index(key)
    sd = float(np.sqrt(fitted.covariance()[at, at]))
    value = fitted.model.values(fitted.x)[key]
    low, high = (value * float(np.exp(way * NINETY * sd)) for way in (-1, 1))
    stated = next(parameters(e)[LENGTH] for e in flattened(rig.element) if e.name == name)
    return Exact(f"{name}.{LENGTH}", stated.value, Value(value, stated.unit, low, high))
