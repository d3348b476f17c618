"""Small files that the service and its processes share, read as if somebody else had written them.

A disk that lies, a power cut or another version may leave anything in them. What comes of it is an
error of ours, never a name, a number of a process or a text that something else trips over.
"""

from __future__ import annotations

import json
import math
import os
import tempfile
from dataclasses import fields
from pathlib import Path
from types import UnionType
from typing import Any, Literal, TypeVar, get_args, get_origin, get_type_hints

from samii_rig.errors import RecordingError

T = TypeVar("T")


def put(path: Path, data: dict[str, Any], *, durable: bool) -> None:
    """Whole or not at all, whoever else writes it; `durable` if it is to outlive a power cut."""
    text = json.dumps(data, allow_nan=False)
    handle, name = tempfile.mkstemp(dir=path.parent)
    with os.fdopen(handle, "w", encoding="utf-8") as file:
        file.write(text)
        if durable:
            file.flush()
            os.fsync(file.fileno())
    Path(name).replace(path)


def get(path: Path) -> dict[str, Any]:
    """What stands in a file, as JSON that can be said again; RecordingError if it is none."""
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
        json.dumps(found, allow_nan=False, ensure_ascii=False).encode()
    except (OSError, ValueError, RecursionError) as error:
        raise RecordingError(f"{path} cannot be read: {error}") from error
    if not isinstance(found, dict):
        raise RecordingError(f"{path} is not what this version writes")
    return found


def made(kind: type[T], path: Path) -> T:
    """A dataclass from a file; RecordingError if a field is missing or of another type."""
    found, hints = get(path), get_type_hints(kind)
    names = [f.name for f in fields(kind)]  # type: ignore[arg-type]
    for name in names:
        if name in found and not _fits(found[name], hints[name]):
            raise RecordingError(f"{path}: {name} is {str(found[name])[:40]!r}, of another type")
    try:
        return kind(**{name: found[name] for name in names if name in found})
    except TypeError as error:
        raise RecordingError(f"{path} is not what this version writes: {error}") from error


def _fits(value: object, hint: Any) -> bool:
    kind = get_origin(hint)
    if kind is Literal:
        return value in get_args(hint)
    if kind is UnionType:
        return any(_fits(value, part) for part in get_args(hint))
    if hint is float:
        return type(value) in (int, float) and math.isfinite(float(str(value)))
    return type(value) is (kind or hint)
