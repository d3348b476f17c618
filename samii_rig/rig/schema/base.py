"""What the tables of a rig file are made of: names, numbers, parameters with their units."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache
from typing import Annotated, ClassVar, Literal, Self

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, model_validator

from samii_rig.units import convert, others

Name = Annotated[str, Field(pattern=r"^[A-Za-z][A-Za-z0-9_]*$", max_length=40)]
Finite = Annotated[float, Field(allow_inf_nan=False)]
Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
NonNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]

Key = tuple[str, str]
"""(element, symbol) of a parameter."""


INTERNAL = "not of the file"
"""Marks a field that a table holds and no person writes: no message offers it."""


class Strict(BaseModel):
    """A table of the rig file: unknown keys are errors, values cannot be changed."""

    model_config = ConfigDict(extra="forbid", frozen=True, ser_json_inf_nan="constants")


class Parameter(Strict):
    """A physical parameter.

    tolerance : relative standard deviation of `value` as a prior, 0 for exact.
    source : where the number came from, e.g. "[published] paper 1, Table II".
    written : the unit that the file gives it in, if that is not `unit`; see `shown`.
    """

    value: Annotated[Finite, Field(strict=True)]  # neither "300" nor true
    unit: str
    tolerance: NonNegative = 0.0
    source: str = Field(min_length=1)
    written: Annotated[str, INTERNAL] = ""

    def shown(self) -> tuple[float, str]:
        """Value and unit as the file has them."""
        if self.written:
            value = convert(self.value, self.unit, self.written)
            if value is not None:
                return value, self.written
        return self.value, self.unit


@dataclass(frozen=True, slots=True)
class Quantity:
    """What a parameter must be: its unit, and the sign of its value."""

    unit: str
    sign: Literal["positive", "not negative", "any"]

    @property
    def least(self) -> float:
        """The least number that is allowed."""
        least = {"positive": math.ulp(0.0), "not negative": 0.0}
        return least.get(self.sign, -sys.float_info.max)

    def refusal(self, value: float) -> str | None:
        """Why `value` is not allowed, as a statement with what would be; None if it is."""
        if not math.isfinite(value):
            return f"value {value:g} {self.unit}; expected a finite number"
        if value < self.least:
            expected = "more than 0" if self.sign == "positive" else "0 or more"
            return f"value {value:g} {self.unit}; expected {expected}"
        return None

    def __call__(self, parameter: Parameter | None) -> Parameter | None:
        """The parameter itself, in `unit`; ValueError if it is not allowed."""
        if parameter is None:
            return None
        made = converted(parameter, self.unit)
        if made is None:
            raise ValueError(f"unit {parameter.unit!r}; expected {self.unit!r}{others(self.unit)}")
        refusal = self.refusal(made.value)
        if refusal:
            raise ValueError(refusal)
        return made


def converted(parameter: Parameter, unit: str) -> Parameter | None:
    """The parameter in `unit`; None if its own measures something else."""
    if parameter.unit == unit:
        return parameter
    value = convert(parameter.value, parameter.unit, unit)
    if value is None:
        return None
    return parameter.model_copy(update={"value": value, "unit": unit, "written": parameter.unit})


def positive(unit: str) -> AfterValidator:
    """A parameter above 0 in `unit`."""
    return AfterValidator(Quantity(unit, "positive"))


def not_negative(unit: str) -> AfterValidator:
    """A parameter of 0 or more in `unit`."""
    return AfterValidator(Quantity(unit, "not negative"))


def zero(unit: str) -> Parameter:
    """A parameter that the file leaves out and that is then 0."""
    return Parameter(value=0.0, unit=unit, source="absent from the rig file: none")


Rule = Callable[[Mapping[str, float]], str | None]


class ElementBase(Strict):
    """What every element has.

    rule : what is wrong with the values of all its parameters together, by symbol.
    """

    rule: ClassVar[Rule | None] = None

    name: Name

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        wrong = contradiction(type(self), {k: p.value for k, p in parameters(self).items()})
        if wrong:
            raise ValueError(wrong)
        return self


def contradiction(kind: type[BaseModel], values: Mapping[str, float]) -> str | None:
    """What is wrong with an element's `values` (by symbol) together; None if nothing is."""
    rule: Rule | None = getattr(kind, "rule", None)
    return rule(values) if rule else None


@cache
def quantities(kind: type[BaseModel]) -> dict[str, Quantity]:
    """What each parameter of a kind of element must be, by symbol."""
    out: dict[str, Quantity] = {}
    for symbol, field in kind.model_fields.items():
        for item in field.metadata:
            if isinstance(item, AfterValidator) and isinstance(item.func, Quantity):
                out[symbol] = item.func
    return out


def parameters(element: BaseModel) -> dict[str, Parameter]:
    """The element's physical parameters by symbol, in the order of its class."""
    # Not `iter(element)`, which asks first what is private: a search reads them 10,000 times.
    return {k: v for k, v in vars(element).items() if isinstance(v, Parameter)}


def some_stiffness(v: Mapping[str, float]) -> str | None:
    """The rule of a spring in the chain."""
    return "k and c are both 0; expected one above 0" if v["k"] == 0 and v["c"] == 0 else None


def both_or_neither(one: str, other: str) -> Rule:
    """The rule of two numbers of one lag."""

    def rule(v: Mapping[str, float]) -> str | None:
        if (one in v) == (other in v):
            return None
        given, lacking = (one, other) if one in v else (other, one)
        return f"{given} without {lacking}; expected both, or neither for no lag"

    return rule


def not_zero(symbol: str) -> Rule:
    """The rule of a ratio."""

    def rule(v: Mapping[str, float]) -> str | None:
        return f"{symbol} is 0; expected another number" if v[symbol] == 0 else None

    return rule


def some_mass(v: Mapping[str, float]) -> str | None:
    """The rule of a body."""
    return "I without m; expected a mass above 0" if v["m"] == 0 and v["I"] > 0 else None
