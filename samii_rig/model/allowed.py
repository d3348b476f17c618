"""Which values a chain's parameters may have: those that its rig file would allow."""

from __future__ import annotations

import math
import sys
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from pydantic import BaseModel

from samii_rig.errors import InputError
from samii_rig.rig.schema import Acceleration, Key, Rig, Strain, flattened, parameters
from samii_rig.rig.schema.elements import contradiction, quantities
from samii_rig.types import Float, Int


@dataclass(frozen=True, slots=True)
class _Element:
    """What the values of one element must be.

    first : place of its first parameter among the chain's. reach : m, the farthest sensor on it.
    """

    name: str
    kind: type[BaseModel]
    first: int
    symbols: tuple[str, ...]
    reach: float

    def least(self) -> list[float]:
        """The least value that each of its parameters may have."""
        allowed, any_ = quantities(self.kind), -sys.float_info.max
        least = {x: allowed[x].least if x in allowed else any_ for x in self.symbols}
        return [max(low, self.reach) if x == "L" else low for x, low in least.items()]

    def refuse(self, values: Float, given: Mapping[Key, float]) -> None:
        """InputError of the first of those given that may not be what it is."""
        allowed = quantities(self.kind)
        for i, symbol in enumerate(self.symbols):
            key = self.name, symbol
            if key not in given:
                continue
            value = float(values[self.first + i])
            wrong = allowed[symbol].refusal(value) if symbol in allowed else None
            if wrong is None and not math.isfinite(value):
                wrong = f"value {value:g}; expected a finite number"
            if wrong is None and symbol == "L" and value < self.reach:
                wrong = f"value {value:g} m; expected at least {self.reach:g}, where a sensor is"
            if wrong:
                raise InputError.saying("with_values", ".".join(key), wrong)

    def refuse_together(self, values: Float) -> None:
        """InputError where its values contradict each other."""
        some = values[self.first : self.first + len(self.symbols)].tolist()
        own = dict(zip(self.symbols, some, strict=True))
        if wrong := contradiction(self.kind, own):
            raise InputError.saying("with_values", self.name, wrong)


@dataclass(frozen=True, slots=True)
class _Given:
    """Some parameters: at (k,) their places, least (k,) their least values, and those of their
    elements that have a rule for all their values together."""

    at: Int
    least: Float
    ruled: tuple[_Element, ...]


class Allowed:
    """The values that a rig's parameters may have.

    A search asks thousands of times for the same parameters: what is to be known of them is kept.
    """

    def __init__(self, rig: Rig, keys: Sequence[Key]) -> None:
        self._place = {key: i for i, key in enumerate(keys)}
        self._elements: dict[str, _Element] = {}
        first = 0
        for element in flattened(rig.element):
            symbols = tuple(parameters(element))
            on = (
                x.position
                for x in rig.sensor
                if isinstance(x, Acceleration | Strain) and x.on == element.name
            )
            own = _Element(element.name, type(element), first, symbols, max(on, default=0.0))
            self._elements[element.name] = own
            first += len(symbols)
        self._known: dict[tuple[Key, ...], _Given] = {}

    def put(self, values: Mapping[Key, float], into: Float) -> Int:
        """Put values into those of all parameters, which are changed; their places (k,).

        Raises InputError for an unknown parameter or a value that the rig file would not allow.
        """
        keys = tuple(values)
        given = self._known.get(keys) or self._known.setdefault(keys, self._given(values))
        new = np.fromiter(values.values(), np.float64, len(keys))
        into[given.at] = new
        if not np.all((new >= given.least) & (new < math.inf)):
            for element in self._whose(values):
                element.refuse(into, values)
        for element in given.ruled:
            element.refuse_together(into)
        return given.at

    def _given(self, values: Mapping[Key, float]) -> _Given:
        for key, value in values.items():
            if key not in self._place:
                raise InputError("with_values", ".".join(key), value, "a known parameter")
        at = np.array([self._place[key] for key in values], np.int64)
        whose = self._whose(values)
        least = {
            (e.name, symbol): low
            for e in whose
            for symbol, low in zip(e.symbols, e.least(), strict=True)
        }
        ruled = tuple(e for e in whose if getattr(e.kind, "rule", None) is not None)
        return _Given(at, np.array([least[key] for key in values]), ruled)

    def _whose(self, keys: Iterable[Key]) -> list[_Element]:
        """The elements that have these parameters."""
        return [self._elements[name] for name in dict.fromkeys(name for name, _ in keys)]
