"""Parameters that a person states: known to differ from the rig file, and exact."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from samii_rig.errors import InputError, one_of
from samii_rig.rig.load import checked, tables
from samii_rig.rig.schema import Rig, parameters
from samii_rig.rig.schema.elements import flattened

WHERE = "--known"
SHAPE = "ELEMENT.PARAMETER=VALUE, as accelerometer_mass.m=0"


def stated(words: Sequence[str], where: str = WHERE) -> dict[str, float]:
    """{"element.parameter": value} from `element.parameter=value`, in the rig file's units. where :
    the option.

    Raises InputError for what is not of this form, a number that is none, or a name twice.
    """
    out: dict[str, float] = {}
    for word in words:
        name, sign, text = word.partition("=")
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        if not sign or "." not in name or not math.isfinite(value):
            raise InputError(where, "", word, SHAPE)
        if name in out:
            raise InputError(where, name, word, "each parameter once")
        out[name] = value
    return out


def check_names(rig: Rig, known: Mapping[str, float], where: str = WHERE) -> None:
    """InputError for an element or a parameter that the rig file does not have."""
    every = {e.name: e for e in flattened(rig.element)}
    for name in known:
        element, _, symbol = name.rpartition(".")
        if element not in every:
            raise InputError(where, name, element, one_of(element, every))
        have = parameters(every[element])
        if symbol not in have:
            raise InputError(where, name, symbol, one_of(symbol, have))


def with_known(rig: Rig, known: Mapping[str, float], where: str = WHERE) -> Rig:
    """The rig with these parameters, by "element.parameter", at these values, exactly. where : the
    option that states them.

    Raises InputError for an element or a parameter that the rig file does not have, or a value
    that no rig can have.
    """
    from samii_rig.diagnose.fit.rigfile import toml  # it imports the fits

    check_names(rig, known, where)
    data = tables(toml(rig), where)
    every = {e.name: e for e in flattened(rig.element)}
    rows = {row["name"]: row for row in _flat(data["element"])}
    for name, value in known.items():
        element, _, symbol = name.rpartition(".")
        have = parameters(every[element])
        rows[element][symbol] = {
            "value": value,
            "unit": have[symbol].unit,
            "source": f"stated as known; in the rig file {have[symbol].value:g}",
        }
    return checked(Rig, data, where) if known else rig


def _flat(rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Tables of elements, those in branches too."""
    return [x for row in rows for x in (row, *_flat(row.get("element", ())))]
