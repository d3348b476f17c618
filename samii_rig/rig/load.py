"""Read TOML files into checked models; what is wrong is said in one line."""

from __future__ import annotations

import codecs
import logging
import re
import tomllib
from contextlib import suppress
from importlib.resources.abc import Traversable
from pathlib import Path
from typing import Any, Literal, TypeVar, get_args, get_origin

from pydantic import BaseModel, ValidationError
from pydantic.fields import FieldInfo

from samii_rig.errors import InputError, one_of
from samii_rig.files import open_file, reason
from samii_rig.rig.plausible import remarks
from samii_rig.rig.schema import Rig
from samii_rig.rig.schema.base import INTERNAL, Parameter
from samii_rig.rig.shipped import FOLDER
from samii_rig.rig.shipped import names_in as names_in
from samii_rig.rig.shipped import shipped as shipped

LOG = logging.getLogger(__name__)
# A file is loaded several times, its remarks are logged once.
_reported: set[tuple[str, str]] = set()
Model = TypeVar("Model", bound=BaseModel)
MAX_BYTES = 4_000_000  # a rig file is a few kB; more is not one
MAX_PARTS = 16  # of a dotted key; ours have three, and the time to parse one grows with the square
# What a text should be, by pydantic's word for what it is not: names alone have a pattern.
_TEXTS = {
    "string_pattern_mismatch": "letters, digits and _, with a letter first",
    "string_too_short": "a text that is not empty",
    "string_too_long": "{max_length} characters at most",
}
# Every character belongs to one of these and is passed once, whatever the text.
_TOKEN = re.compile(
    r"""(?P<part>[\w-]++|"(?:[^"\\\n]|\\.)*+"?|'[^'\n]*+'?)|(?P<dot>\.)|[ \t]++"""
    r"""|(?P<other>[^\w"'.\t -]++)"""
)


def read_text(path: Path, what: str) -> str:
    """The text of a file, or an InputError that says why it cannot be read."""
    try:
        with open_file(path) as file:
            raw = file.read(MAX_BYTES + 1)
        if len(raw) > MAX_BYTES:
            raise InputError(str(path), "", path.stat().st_size, f"a {what} under 4 MB")
        # As text files are read: any end of a line is a line break.
        return raw.decode().replace("\r\n", "\n").replace("\r", "\n")
    except OSError as error:
        said = f"cannot be read: {reason(error)}; expected a {what}"
        raise InputError.saying(str(path), "", said) from error
    except UnicodeDecodeError as error:
        said = f"byte {error.start} is not UTF-8{_encoding(raw)}; expected a {what} in UTF-8"
        raise InputError.saying(str(path), "", said) from error


def _encoding(raw: bytes) -> str:
    """What a text that is not UTF-8 gives itself out for, by its first bytes."""
    marked = raw.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))
    return " (the file begins as UTF-16)" if marked else ""


def check_depth(text: str, where: str) -> None:
    """InputError for a key of so many parts that it would take long to parse."""
    parts, dotted = 0, False
    for token in _TOKEN.finditer(text):
        match token.lastgroup:
            case "part":
                parts, dotted = parts + 1 if dotted else 1, False
                if parts > MAX_PARTS:
                    line = text.count("\n", 0, token.start()) + 1
                    expected = f"keys of at most {MAX_PARTS} dotted parts"
                    raise InputError(where, f"line {line}", token.group(), expected)
            case "dot":
                dotted = True
            case "other":
                parts, dotted = 0, False


def tables(text: str, where: str) -> dict[str, Any]:
    """`text` (TOML) as plain data; InputError names `where` and the line that is wrong."""
    check_depth(text, where)
    try:
        return tomllib.loads(text)
    except (tomllib.TOMLDecodeError, RecursionError) as error:
        why = str(error) or "nested too deep"
        said = f"is not valid TOML: {why[0].lower()}{why[1:]}{_decimal_comma(why, text)}"
        raise InputError.saying(where, "", said) from error


def _decimal_comma(why: str, text: str) -> str:
    """A hint where the line that `why` names has a number with a comma in place of its point."""
    named = re.search(r"at line (\d+)", why)
    lines = text.split("\n")
    if named is None or int(named[1]) > len(lines):
        return ""
    comma = re.search(r"=\s*([-+]?\d+),(\d+)\s*[,}#]?", lines[int(named[1]) - 1])
    return f"; did you mean {comma[1]}.{comma[2]} for {comma[1]},{comma[2]}?" if comma else ""


def parse(model: type[Model], text: str, where: str) -> Model:
    """`text` (TOML) as `model`; InputError names `where`, the field and what would be right."""
    return checked(model, tables(text, where), where)


def checked(model: type[Model], data: dict[str, Any], where: str) -> Model:
    """Plain data as `model`; errors as of `parse`."""
    try:
        return model.model_validate(data)
    except ValidationError as error:
        raise _one_line(model, error, data, where) from error


def load_rig(name: str) -> tuple[Rig, str]:
    """The rig called `name` (shipped, or the path of a file) and the text of its file. What is
    hardly meant is logged, as a warning."""
    rig, text = load_named(Rig, name, FOLDER, "--rig", "rig file")
    for remark in remarks(rig):
        if (name, remark) not in _reported:
            _reported.add((name, remark))
            LOG.warning("samii-rig: look: %s, %s", name, remark)
    return rig, text


def load_named(
    model: type[Model], name: str, folder: Traversable, option: str, what: str
) -> tuple[Model, str]:
    """The `model` called `name` (of `folder`, or the path of a file) and the text of its file.

    option, what : the command line's option and the kind of file, for the error's line.

    Raises InputError if there is neither such a name nor such a file.
    """
    names = names_in(folder)
    if name in names:
        text = (folder / f"{name}.toml").read_text("utf-8")
        return parse(model, text, f"{name}.toml"), text
    path = Path(name)
    if not path.exists():
        expected = f"the path of a {what} or {one_of(name, names)}"
        raise InputError(option, "", name, expected)
    text = read_text(path, what)
    return parse(model, text, str(path)), text


def _one_line(
    model: type[BaseModel], error: ValidationError, data: dict[str, object], where: str
) -> InputError:
    found = error.errors(include_url=False)
    # A name that is mistyped leaves the right one missing: the mistake is the former.
    first = next((e for e in found if e["type"] == "extra_forbidden"), found[0])
    field = _field(first["loc"], data, missing=first["type"] == "missing")
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
            known = [k for k in _fields_at(model, beside) if k not in _given(data, beside)]
            near = one_of(first["loc"][-1], known) if len(known) > 1 else "no more than there is"
            near = known[0] if len(known) == 1 else near
            if model is Rig and field == "experiment":
                said = "is an experiment's file; expected a rig file"
                return InputError.saying(where, "", said)
            expected = " or ".join(lacking) or near
            return InputError.saying(where, field, f"no such field; expected {expected}")
        case "model_type":
            whole = first["ctx"]["class_name"] == Parameter.__name__
            table = '{ value = ..., unit = "...", source = "..." }' if whole else "a table, { ... }"
            return InputError(where, field, first["input"], table)
        case "dict_type":
            return InputError(where, field, first["input"], "a table, { ... }")
        case "string_pattern_mismatch" | "string_too_short" | "string_too_long":
            said = _TEXTS[first["type"]].format(**first["ctx"])
            return InputError(where, field, first["input"], said)
        case "tuple_type" | "list_type":
            return InputError(where, field, first["input"], "a list, in brackets: [ ... ]")
        case "union_tag_not_found":
            return InputError.saying(where, field, "has no kind; expected one, as in the docs")
        case "union_tag_invalid":
            kinds = re.findall(r"'([^']*)'", first["ctx"]["expected_tags"])
            tag = first["ctx"]["tag"]
            return InputError(where, f"{field}.kind", tag, one_of(tag, kinds))
        case "literal_error":
            choices = re.findall(r"'([^']*)'", message)
            if choices:
                return InputError(where, field, first["input"], one_of(first["input"], choices))
    return InputError(where, field, first.get("input"), message)


def _field(loc: tuple[int | str, ...], data: dict[str, object], *, missing: bool) -> str:
    """The field at `loc` as a person finds it in the file, such as `element[joint_1].k.unit`.

    missing : it is not in the file itself, but where it would stand is.
    """
    field = ""
    node: object = data
    last = len(loc) - 1
    for i, key in enumerate(loc):
        if isinstance(key, int) and isinstance(node, list) and key < len(node):
            node = node[key]
            named = node.get("name") if isinstance(node, dict) else None
            field += f"[{named or key}]"
        elif isinstance(node, dict) and key in node:
            node = node[key]
            field += f".{key}"
        elif missing and i == last:
            field += f".{key}"
        # Otherwise the key is the tag of a union, which the file does not show.
    # Names and keys are the file's: a line break in one must not make two lines of this.
    return "".join(c if c.isprintable() else "?" for c in field.lstrip("."))


def _fields_at(model: type[BaseModel], loc: tuple[int | str, ...]) -> list[str]:
    """Names of the fields that may stand in the table at `loc` of a file of this model."""
    there = [model]
    for key in loc:
        if isinstance(key, int):
            continue
        inside = [m for t in there if key in t.model_fields for m in _models(t.model_fields[key])]
        # A key that is no field is the tag of a union, which picks one of its kinds.
        tagged = [t for t in there if any(key in _words(f) for f in t.model_fields.values())]
        there = inside or tagged or there
    fields = ((name, field) for t in there for name, field in t.model_fields.items())
    return list(dict.fromkeys(name for name, field in fields if INTERNAL not in field.metadata))


def _models(field: FieldInfo) -> list[type[BaseModel]]:
    """The tables of which a field may hold one, or many."""
    waiting, found = [field.annotation], []
    while waiting:
        kind = waiting.pop(0)
        if isinstance(kind, type) and issubclass(kind, BaseModel):
            found.append(kind)
        waiting += get_args(kind)
    return found


def _words(field: FieldInfo) -> tuple[object, ...]:
    return get_args(field.annotation) if get_origin(field.annotation) is Literal else ()


def _given(data: Any, loc: tuple[int | str, ...]) -> set[str]:
    """What stands in the table at `loc` already."""
    for key in loc:
        with suppress(KeyError, IndexError, TypeError):  # the tag of a union, which no file shows
            data = data[key]
    return set(data) if isinstance(data, dict) else set()
