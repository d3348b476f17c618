"""Data as JSON can say it."""

from __future__ import annotations

import math
from typing import Any


def plain(value: Any) -> Any:
    """The same in dicts, lists and scalars: what is no number becomes null, what JSON does not know
    its text."""
    match value:
        case dict():
            return {str(k): plain(v) for k, v in value.items()}
        case list() | tuple():
            return [plain(v) for v in value]
        case float():
            return value if math.isfinite(value) else None
        case str() | int() | None:
            return value
        case _:
            return str(value)
