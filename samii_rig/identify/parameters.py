"""Which parameters of a rig are free, how far they may go, and what is known before."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from samii_rig.errors import InputError, one_of
from samii_rig.rig.schema import Rig, parameters
from samii_rig.types import Float

# Default bounds, as a factor of the rig file's value: wide enough that they are met only by
# a parameter that the data do not hold.
REACH = 30.0


@dataclass(frozen=True, slots=True)
class Free:
    """One free parameter, searched for in the logarithm of its value (its sign stays).

    element, symbol : as in the rig file; `name` is `element.symbol`.
    low, high : bounds of value/start.
    start : SI value to start from; None for the rig file's.
    tolerance : relative standard deviation of a Gaussian prior on the logarithm around the
        rig file's value; None for none.
    """

    element: str
    symbol: str
    low: float = 1 / REACH
    high: float = REACH
    start: float | None = None
    tolerance: float | None = None

    @property
    def key(self) -> tuple[str, str]:
        """(element, symbol), as `Chain.parameters` has it."""
        return self.element, self.symbol

    @property
    def name(self) -> str:
        """`element.symbol`."""
        return f"{self.element}.{self.symbol}"


@dataclass(frozen=True, slots=True)
class Space:
    """The free parameters of one rig as a vector x = log(value/start).

    free : in the order of x. keys : their (element, symbol).
    start : (n,) SI values at x = 0. lower, upper : (n,) bounds of x.
    prior_mean, prior_sd : (n,) of x; sd is inf where there is no prior.
    units : (n,) of the values.
    """

    free: tuple[Free, ...]
    start: Float
    lower: Float
    upper: Float
    prior_mean: Float
    prior_sd: Float
    units: tuple[str, ...]

    @property
    def keys(self) -> tuple[tuple[str, str], ...]:
        """(element, symbol) of each, as `Chain.parameters` has them."""
        return tuple(f.key for f in self.free)

    @property
    def names(self) -> tuple[str, ...]:
        """`element.symbol` of each."""
        return tuple(f.name for f in self.free)

    def values(self, x: Float) -> Float:
        """(n,) SI values at x."""
        return np.asarray(self.start * np.exp(x))

    def mapping(self, x: Float) -> dict[tuple[str, str], float]:
        """The same as the argument of `Chain.with_values`."""
        return {k: float(v) for k, v in zip(self.keys, self.values(x), strict=True)}


def space(rig: Rig, free: Sequence[str | Free], prior: bool = False) -> Space:
    """The free parameters of `rig` by name (`joint_1.k`) or as `Free`.

    prior : give every parameter that has a tolerance in the rig file that prior.

    Raises InputError for an unknown parameter, one named twice, none at all, a start of
    zero (a logarithm cannot leave it), bounds that do not hold the start.
    """
    known = {(e.name, s): p for e in rig.element for s, p in parameters(e).items()}
    items: list[Free] = []
    rows: list[tuple[float, float, float, float, float]] = []
    units: list[str] = []
    for given in free:
        item = given if isinstance(given, Free) else _named(given)
        if item.key not in known:
            raise InputError("free parameters", "", item.name, _choices(rig, item))
        if item.key in [f.key for f in items]:
            raise InputError("free parameters", "", item.name, "each parameter once")
        parameter = known[item.key]
        start = parameter.value if item.start is None else item.start
        if start == 0 or not math.isfinite(start):
            expected = "a start that is not zero: a parameter is searched for in its logarithm"
            raise InputError("free parameters", item.name, start, expected)
        if not 0 < item.low <= 1 <= item.high:
            expected = "bounds as factors of the start, low <= 1 <= high"
            raise InputError("free parameters", item.name, (item.low, item.high), expected)
        tolerance = item.tolerance
        if tolerance is None and prior and parameter.tolerance > 0:
            tolerance = parameter.tolerance
        if tolerance is not None and (tolerance <= 0 or parameter.value / start <= 0):
            raise InputError("free parameters", item.name, tolerance, "a tolerance above 0")
        mean, sd = (0.0, math.inf)
        if tolerance is not None:
            mean, sd = math.log(parameter.value / start), tolerance
        rows.append((start, math.log(item.low), math.log(item.high), mean, sd))
        items.append(item)
        units.append(parameter.unit)
    if not items:
        raise InputError("free parameters", "", [], "at least one, for example joint_1.k")
    start_, lower, upper, mean_, sd_ = np.array(rows).T
    return Space(tuple(items), start_, lower, upper, mean_, sd_, tuple(units))


def uncertain(rig: Rig) -> tuple[str, ...]:
    """Names of all parameters that the rig file says are uncertain: those to free, with their
    priors, when nothing else is asked for."""
    return tuple(
        f"{e.name}.{symbol}"
        for e in rig.element
        for symbol, p in parameters(e).items()
        if p.tolerance > 0 and p.value != 0
    )


def changed(rig: Rig, values: Mapping[tuple[str, str], float]) -> Rig:
    """The rig with other values of some parameters; `source` says that they were identified."""
    elements = []
    for element in rig.element:
        update = {
            symbol: p.model_copy(
                update={"value": values[element.name, symbol], "source": "identified from data"}
            )
            for symbol, p in parameters(element).items()
            if (element.name, symbol) in values
        }
        elements.append(element.model_copy(update=update) if update else element)
    return rig.model_copy(update={"element": tuple(elements)})


def _named(name: str) -> Free:
    element, dot, symbol = name.partition(".")
    if not (element and dot and symbol):
        raise InputError("free parameters", "", name, "element.symbol, for example joint_1.k")
    return Free(element, symbol)


def _choices(rig: Rig, item: Free) -> str:
    for element in rig.element:
        if element.name == item.element:
            return f"a parameter of {element.name}, {one_of(item.symbol, parameters(element))}"
    return f"an element of {rig.name}, {one_of(item.element, [e.name for e in rig.element])}"
