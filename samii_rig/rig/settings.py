"""Check [device.settings] of a rig file; what is wrong with them is said in one line."""

from __future__ import annotations

from typing import TypeVar

from pydantic import BaseModel, ValidationError

from samii_rig.errors import InputError, one_of
from samii_rig.rig.schema import Rig

Model = TypeVar("Model", bound=BaseModel)
TABLE = "device.settings"


def checked(
    model: type[Model],
    rig: Rig,
    given: object,
    *,
    table: str = TABLE,
    page: str = "",
    expected: str = "",
) -> Model:
    """What was given as `model`; InputError names the first wrong setting.

    page : of the docs, for one that is missing. expected : for all, in place of pydantic's words.
    """
    try:
        return model.model_validate(given)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        field = ".".join([table, *map(str, first["loc"])])
        if page and first["type"] == "missing":
            raise InputError.saying(rig.name, field, f"is missing; see {page}") from error
        words = first["msg"].removeprefix("Input should be ")
        if first["type"] == "extra_forbidden":
            words = one_of(first["loc"][-1], model.model_fields)
        raise InputError(rig.name, field, first["input"], expected or words) from error


def wrong(rig: Rig, setting: str, value: object, expected: str) -> InputError:
    """A setting that does not fit the rig or its device."""
    return InputError(rig.name, f"{TABLE}.{setting}", value, expected)
