"""Effects that are stated instead of drawn: which physics, where, with which parameters."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from samii_rig.errors import InputError
from sim.concealed.effects import OUTSIDE, ROWS, VARYING, Row, clamp_of, places
from sim.concealed.parts import Description
from sim.concealed.scales import Concealed

WHERE, POSITION = "where", "position"


@dataclass(frozen=True, slots=True)
class Stated:
    """One effect. parameters : SI, by the vocabulary's symbols; those that are not given are the
    rig's own scale. where : the variant of an effect that has some (a ground spring's).
    position : m along the site, of an effect that has one (a crack's)."""

    physics: str
    site: str
    parameters: Mapping[str, float] = field(default_factory=dict)
    where: str = ""
    position: float | None = None

    @classmethod
    def of(cls, words: Sequence[str]) -> Stated:
        """From `PHYSICS SITE [SYMBOL=NUMBER ...] [where=VARIANT] [position=NUMBER]`."""
        if len(words) < 2:
            raise InputError("--effect", "", " ".join(words), "PHYSICS SITE [SYMBOL=NUMBER ...]")
        parameters: dict[str, float] = {}
        where = ""
        for word in words[2:]:
            symbol, _, text = word.partition("=")
            if symbol == WHERE:
                where = text
                continue
            try:
                parameters[symbol] = float(text)
            except ValueError:
                raise InputError("--effect", symbol, text, "SYMBOL=NUMBER") from None
        position = parameters.pop(POSITION, None)
        return cls(words[0], words[1], parameters, where, position)


def row_of(plant: Description, effect: Stated) -> Row:
    """The row of the vocabulary, or of what lies outside it, that has this physics at this place.

    InputError for another physics or place, or a number that is none. The clamp may give, or
    lose its damping, where that is stated: whether a burst still settles is then seen.
    """
    for symbol, value in (*effect.parameters.items(), (POSITION, effect.position or 0.0)):
        if not math.isfinite(value):
            raise InputError(effect.physics, symbol, value, "a finite number")
    rows = [row for row in (*ROWS, *OUTSIDE, *VARYING) if row.physics == effect.physics]
    if not rows:
        known = ", ".join(dict.fromkeys(row.physics for row in (*ROWS, *OUTSIDE, *VARYING)))
        raise InputError("effect", "physics", effect.physics, f"one of {known}")
    sites = []
    for row in sorted(rows, key=lambda row: not row.along):
        if row.along and effect.position is None:  # what has no position is at its site's end
            continue
        own = places(plant, row)
        if row.at in ("loose", "junction") and clamp_of(plant):
            own.append(clamp_of(plant))
        if effect.site in own:
            return row
        sites += own
    known = ", ".join(dict.fromkeys(sites))
    raise InputError(effect.physics, "site", effect.site, f"one of {known}")


def as_stated(effect: Stated, put: Concealed) -> None:
    """InputError if what was stated is a parameter, variant or position that it does not have."""
    if effect.where and effect.where != put.where:
        raise InputError(effect.physics, WHERE, effect.where, repr(put.where))
    if effect.position not in (None, put.position):
        raise InputError(effect.physics, POSITION, effect.position, "none along its site")
    for symbol, value in effect.parameters.items():
        if put.parameters.get(symbol) != value:
            known = ", ".join(put.parameters) or "none: it is there or not"
            raise InputError(effect.physics, symbol, value, f"a parameter that it has ({known})")
