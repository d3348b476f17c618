"""Read TOML files into checked models; what is wrong is said in one line."""

from __future__ import annotations

import tomllib
from importlib import resources
from importlib.resources.abc import Traversable
from pathlib import Path
from typing import TypeVar, get_args

from pydantic import BaseModel, ValidationError

from samii_rig.errors import InputError
from samii_rig.rig.schema import Rig

Model = TypeVar("Model", bound=BaseModel)
_FOLDER = resources.files("samii_rig.rig") / "data"
MAX_BYTES = 4_000_000  # a rig file is a few kB; more is not one


def shipped() -> tuple[str, ...]:
    """Names of the rigs that come with the package."""
    return names_in(_FOLDER)


def names_in(folder: Traversable) -> tuple[str, ...]:
    """Names of the TOML files that come with the package in `folder`."""
    return tuple(sorted(p.name.removesuffix(".toml") for p in folder.iterdir()))


def read_text(path: Path, what: str) -> str:
    """The text of a file, or an InputError that says why it cannot be read."""
    try:
        if path.stat().st_size > MAX_BYTES:
            raise InputError(str(path), "", path.stat().st_size, f"a {what} under 4 MB")
        return path.read_text(encoding="utf-8")
    except OSError as error:
        raise InputError(str(path), "", error.strerror, f"a readable {what}") from error
    except UnicodeDecodeError as error:
        raise InputError(str(path), "", error.reason, f"a {what} in UTF-8") from error


def parse(model: type[Model], text: str, where: str) -> Model:
    """`text` (TOML) as `model`; InputError names `where`, the field and what would be right."""
    try:
        data = tomllib.loads(text)
    except (tomllib.TOMLDecodeError, RecursionError) as error:
        raise InputError(where, "", str(error) or "nested too deep", "valid TOML") from error
    try:
        return model.model_validate(data)
    except ValidationError as error:
        raise _one_line(model, error, data, where) from error


def load_rig(name: str) -> tuple[Rig, str]:
    """The rig called `name` (shipped, or the path of a file) and the text of its file."""
    return load_named(Rig, name, _FOLDER, "--rig", "rig file")


def load_named(
    model: type[Model], name: str, folder: Traversable, option: str, what: str
) -> tuple[Model, str]:
    """The `model` called `name` (of `folder`, or the path of a file) and the text of its file.

    option, what : the command line's option and the kind of file, for the error's line.
    """
    names = names_in(folder)
    if name in names:
        text = (folder / f"{name}.toml").read_text("utf-8")
        return parse(model, text, f"{name}.toml"), text
    path = Path(name)
    if not path.exists():
        expected = f"the path of a {what} or one of {', '.join(names)}"
        raise InputError(option, "", name, expected)
    text = read_text(path, what)
    return parse(model, text, str(path)), text


def _one_line(
    model: type[BaseModel], error: ValidationError, data: dict[str, object], where: str
) -> InputError:
    found = error.errors(include_url=False)
    # A name that is mistyped leaves the right one missing: the mistake is the former.
    first = next((e for e in found if e["type"] == "extra_forbidden"), found[0])
    field = ""
    node: object = data
    last = len(first["loc"]) - 1
    for i, key in enumerate(first["loc"]):
        if isinstance(key, int) and isinstance(node, list) and key < len(node):
            node = node[key]
            named = node.get("name") if isinstance(node, dict) else None
            field += f"[{named or key}]"
        elif isinstance(node, dict) and key in node:
            node = node[key]
            field += f".{key}"
        elif first["type"] == "missing" and i == last:
            field += f".{key}"
        # Otherwise the key is the tag of a union, which the file does not show.
    # Names and keys are the file's: a line break in one must not make two lines of this.
    field = "".join(c if c.isprintable() else "?" for c in field.lstrip("."))
    message = first["msg"].removeprefix("Value error, ").removeprefix("Input should be ")
    match first["type"]:
        case "value_error":
            return InputError.saying(where, field, message)
        case "missing":
            # Of a field of the file itself that has a choice of words, the words.
            wanted = model.model_fields.get(field)
            words = get_args(wanted.annotation) if wanted else ()
            choice = all(isinstance(word, str) for word in words) and words
            expected = f"one of {', '.join(words)}" if choice else "a value"
            return InputError.saying(where, field, f"missing; expected {expected}")
        case "extra_forbidden":
            beside = first["loc"][:-1]
            missing = (e["loc"] for e in found if e["type"] == "missing")
            lacking = [str(loc[-1]) for loc in missing if loc[:-1] == beside]
            expected = " or ".join(lacking) or "a known name"
            return InputError.saying(where, field, f"no such field; expected {expected}")
        case "union_tag_not_found":
            return InputError.saying(where, field, "has no kind; expected one, as in the docs")
        case "union_tag_invalid":
            kinds = first["ctx"]["expected_tags"]
            return InputError(where, f"{field}.kind", first["ctx"]["tag"], f"one of {kinds}")
    return InputError(where, field, first.get("input"), message)
