"""Options of a command as one frozen dataclass, which its parts hand on whole."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import MISSING, Field, fields
from functools import wraps
from inspect import Parameter, Signature, get_annotations
from typing import Any, TypeVar, get_type_hints

O = TypeVar("O")  # noqa: E741
R = TypeVar("R")


def takes(options: type[O]) -> Callable[[Callable[[O], R]], Callable[..., R]]:
    """Make a command of a function of `options`: each field is a word of the command line.

    options : a dataclass, whose fields are annotated as typer's parameters are. Its help lists its
        own fields first, then those that it inherits.
    """
    hints = get_type_hints(options, include_extras=True)
    own = list(get_annotations(options))
    known: dict[str, Field[Any]] = {f.name: f for f in fields(options)}  # type: ignore[arg-type]
    order = [*own, *(name for name in known if name not in own)]

    def decorate(work: Callable[[O], R]) -> Callable[..., R]:
        @wraps(work)
        def command(**words: Any) -> R:
            return work(options(**words))

        parameters = [
            Parameter(
                name,
                Parameter.KEYWORD_ONLY,
                default=Parameter.empty if known[name].default is MISSING else known[name].default,
                annotation=hints[name],
            )
            for name in order
        ]
        command.__signature__ = Signature(parameters)  # type: ignore[attr-defined]
        command.__annotations__ = hints
        return command

    return decorate
