"""A command of a dataclass: every field is a word of the command line."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import pytest
import typer
from typer.testing import CliRunner

from samii_rig.cli.options import takes


@dataclass(frozen=True, kw_only=True)
class Shared:
    """Words of several commands."""

    band: Annotated[float, typer.Option(help="Hz.")] = 24.0


@dataclass(frozen=True, kw_only=True)
class Own(Shared):
    """Words of one."""

    log: Annotated[str, typer.Argument()]
    free: Annotated[list[str] | None, typer.Option()] = None


app = typer.Typer()
given: list[Own] = []


@app.command()
@takes(Own)
def work(o: Own) -> None:
    """What it is for."""
    given.append(o)


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["a"], Own(log="a")),
        (["--band", "3", "a"], Own(log="a", band=3.0)),
        (["a", "--free", "x", "--free", "y"], Own(log="a", free=["x", "y"])),
    ],
)
def test_words_become_fields(words: list[str], expected: Own) -> None:
    given.clear()
    assert CliRunner().invoke(app, words).exit_code == 0
    assert given == [expected]


def test_a_field_without_a_default_is_asked_for() -> None:
    done = CliRunner().invoke(app, [])
    assert done.exit_code == 2
    assert "log" in done.output.lower()


def test_the_help_is_the_functions_and_lists_own_words_first() -> None:
    shown = CliRunner().invoke(app, ["--help"]).output
    assert "What it is for." in shown
    assert shown.index("--free") < shown.index("--band")
