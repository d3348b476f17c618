"""Which parameters of a rig are free, how far they may go, and what is known before."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from samii_rig.errors import InputError, one_of
from samii_rig.rig.schema import Key, Rig, parameters
from samii_rig.types import Float

# Default bounds, as a factor of the rig file's value: wide enough that they are met only by
# a parameter that the data do not hold.
REACH = 30.0
WHERE = "free parameters"


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
    def key(self) -> Key:
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
    def keys(self) -> tuple[Key, ...]:
        """(element, symbol) of each, as `Chain.parameters` has them."""
        return tuple(f.key for f in self.free)

    @property
    def names(self) -> tuple[str, ...]:
        """`element.symbol` of each."""
        return tuple(f.name for f in self.free)

    def values(self, x: Float) -> Float:
        """(n,) SI values at x."""
        return np.asarray(self.start * np.exp(x))

    def mapping(self, x: Float) -> dict[Key, float]:
        """The same as the argument of `Chain.with_values`."""
        return {k: float(v) for k, v in zip(self.keys, self.values(x), strict=True)}


def check_names(rig: Rig, names: Sequence[str | Free], where: str = WHERE) -> list[Free]:
    """Each as a parameter of the rig. where : who asked, for the error's line.

    Raises InputError for an unknown parameter or one named twice.
    """
    known = {(e.name, s) for e in rig.element for s in parameters(e)}
    found: list[Free] = []
    for given in names:
        item = given if isinstance(given, Free) else _named(rig, given, where)
        if item.key not in known:
            raise InputError(where, "", item.name, _choices(rig, item))
        if item.key in [f.key for f in found]:
            raise InputError(where, "", item.name, "each parameter once")
        found.append(item)
    return found


def space(rig: Rig, free: Sequence[str | Free], prior: bool = False) -> Space:
    """The free parameters of `rig` by name (`joint_1.k`) or as `Free`.

    prior : give every parameter that has a tolerance in the rig file that prior.

    Raises InputError for an unknown parameter, one named twice, none at all, a start of
    zero (a logarithm cannot leave it), bounds that do not hold the start.
    """
    known = {(e.name, s): p for e in rig.element for s, p in parameters(e).items()}
    items = check_names(rig, free)
    rows: list[tuple[float, float, float, float, float]] = []
    units: list[str] = []
    for item in items:
        parameter = known[item.key]
        start = parameter.value if item.start is None else item.start
        if start == 0 or not math.isfinite(start):
            expected = "a start that is not zero: a parameter is searched for in its logarithm"
            raise InputError(WHERE, item.name, start, expected)
        if not 0 < item.low <= 1 <= item.high:
            expected = "bounds as factors of the start, low <= 1 <= high"
            raise InputError(WHERE, item.name, (item.low, item.high), expected)
        tolerance = item.tolerance
        if tolerance is None and prior and parameter.tolerance > 0:
            tolerance = parameter.tolerance
        if tolerance is not None and (tolerance <= 0 or parameter.value / start <= 0):
            raise InputError(WHERE, item.name, tolerance, "a tolerance above 0")
        mean, sd = (0.0, math.inf)
        if tolerance is not None:
            mean, sd = math.log(parameter.value / start), tolerance
        rows.append((start, math.log(item.low), math.log(item.high), mean, sd))
        units.append(parameter.unit)
    if not items:
        raise InputError(WHERE, "", [], f"at least one, for example {_example(rig)}")
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


def changed(rig: Rig, values: Mapping[Key, float]) -> Rig:
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


def _example(rig: Rig, element: str = "") -> str:
    """A parameter of the rig that one may want to free, of this element if it has one."""
    every = [f"{e.name}.{s}" for e in rig.element for s, p in parameters(e).items() if p.value]
    own = [name for name in every if name.startswith(f"{element}.")]
    return next(iter((*own, *uncertain(rig), *every)), "ELEMENT.SYMBOL")


def _named(rig: Rig, name: str, where: str) -> Free:
    element, dot, symbol = name.partition(".")
    if not (element and dot and symbol):
        raise InputError(where, "", name, f"element.symbol, for example {_example(rig, element)}")
    return Free(element, symbol)


def _choices(rig: Rig, item: Free) -> str:
    for element in rig.element:
        if element.name == item.element:
            return f"a parameter of {element.name}, {one_of(item.symbol, parameters(element))}"
    return f"an element of {rig.name}, {one_of(item.element, [e.name for e in rig.element])}"
