"""Every example of the pages: commands are accepted, sessions are run and their digits compared.

A block with `$ samii-rig` or `>>>` in it is a session: its commands run, and print what
the page says. Other commands are read by the command line itself, which refuses an option that it
does not have; what they need is not at hand here.
"""

from __future__ import annotations

import ast
import doctest
import re
import shlex
import subprocess
import sys
import tomllib
from collections.abc import Callable
from functools import cache
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path

import pytest
import typer
from conftest import ROOT
from typer.exceptions import Exit, TyperException

from samii_rig.cli.app import app

PAGES = sorted((*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md")))
PAGES = [p for p in PAGES if (ROOT / "docs" / "reference" / "api") not in p.parents]
COMMANDS = typer.main.get_command(app)
OURS = re.compile(r"(samii_rig|drivers|sim|experiments)\b")
ALIKE = doctest.NORMALIZE_WHITESPACE | doctest.ELLIPSIS


def blocks(page: Path) -> list[tuple[str, str]]:
    """(language, text) of all code on a page, indented or fenced."""
    text = page.read_text("utf-8")
    fenced = re.findall(r"^```(\S*)\n(.*?)^```", text, re.M | re.S)
    rest = re.sub(r"^```.*?^```", "", text, flags=re.M | re.S)
    return [
        *fenced,
        *(("", b) for b in re.findall(r"(?:^(?: {4}.*)?\n)+", rest, re.M) if b.strip()),
    ]


def commands(page: Path) -> list[str]:
    """Lines that call samii-rig, whole and without their comments."""
    found = []
    for language, block in blocks(page):
        if language not in ("python", "toml"):
            text = re.sub(r"\\\n\s*", "", block)
            found += re.findall(r"^ *(?:\$ )?(samii-rig [^#\n]*?) *(?:#.*)?$", text, re.M)
    return found


def refused(words: list[str]) -> str:
    """Why the command line does not take these words; "" if it does."""
    try:
        with COMMANDS.make_context("samii-rig", list(words)) as context:
            name, command, rest = COMMANDS.resolve_command(context, words)
            command.make_context(name, rest, parent=context)
    except TyperException as error:
        return error.format_message()
    except Exit:  # --help and --version have said all
        return ""
    return ""


def named(pages: list[Path]) -> list[str]:
    return [str(p.relative_to(ROOT)) for p in pages]


WITH_COMMANDS = [p for p in PAGES if commands(p)]


@pytest.mark.parametrize("page", WITH_COMMANDS, ids=named(WITH_COMMANDS))
def test_every_command_of_a_page_is_accepted(page: Path) -> None:
    for line in commands(page):
        if "..." not in line:
            assert refused(shlex.split(line)[1:]) == "", line


def test_a_command_that_does_not_exist_is_refused() -> None:
    assert "--nonesuch" in refused(["frf", "a.mcap", "--nonesuch"])
    assert "nonesuch" in refused(["nonesuch"])
    assert refused(["identify", "a.mcap", "--free", "joint_1.k"]) == ""


def test_every_command_that_is_named_in_a_sentence_exists() -> None:
    for page in PAGES:
        for name in re.findall(r"`samii-rig ([a-z][a-z-]*)(?! 1)\b", page.read_text("utf-8")):
            assert name in COMMANDS.commands, f"{page.name}: samii-rig {name}"


def test_every_table_of_a_page_can_be_read() -> None:
    for page in PAGES:
        for language, block in blocks(page):
            if language == "toml":
                tomllib.loads(block.replace("...", ""))


def test_whatever_a_page_imports_is_there() -> None:
    """Also in the examples that a device or a person would have to be at hand for."""
    seen = 0
    for page in PAGES:
        for language, block in blocks(page):
            if language != "python":
                continue
            for node in ast.walk(ast.parse(block)):
                if isinstance(node, ast.ImportFrom) and OURS.match(node.module or ""):
                    module = import_module(str(node.module))
                    for alias in node.names:
                        there = hasattr(module, alias.name) or find_spec(
                            f"{node.module}.{alias.name}"
                        )
                        assert there, f"{page.name}: {alias.name}"
                        seen += 1
    assert seen > 5


RECORDING = re.compile(r"^ *(samii-rig run .*--out bench\.mcap)$", re.M)


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Path]:
    """The recording that a command of a page makes, made once."""
    folder = tmp_path_factory.mktemp("bench")

    @cache
    def of(command: str) -> Path:
        subprocess.run(called(command), cwd=folder, capture_output=True, check=True)
        return folder

    return of


def called(command: str) -> list[str]:
    return [str(Path(sys.executable).parent / "samii-rig"), *shlex.split(command)[1:]]


SESSIONS = [p for p in PAGES if re.search(r"^ *>>> ", p.read_text("utf-8"), re.M)]


@pytest.mark.parametrize("page", SESSIONS, ids=named(SESSIONS))
def test_what_python_says_on_a_page_is_what_it_says(
    page: Path, recorded: Callable[[str], Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    made = RECORDING.search(page.read_text("utf-8"))
    if made:
        monkeypatch.chdir(recorded(made[1]))
    failed, tried = doctest.testfile(str(page), module_relative=False, optionflags=ALIKE)
    assert tried > 0
    assert failed == 0


def consoles(page: Path) -> list[tuple[str, str]]:
    """(command, what it prints) of the blocks that begin with `$ samii-rig`."""
    found = []
    for _, block in blocks(page):
        for part in re.split(r"^ *\$ ", block, flags=re.M)[1:]:
            command, _, said = part.partition("\n")
            if said.strip():
                found.append((command, said))
    return found


SHOWN = [(p, *c) for p in PAGES for c in consoles(p)]


@pytest.mark.parametrize(
    ("page", "command", "said"), SHOWN, ids=[f"{p.name}: {c}" for p, c, _ in SHOWN]
)
def test_what_a_command_says_on_a_page_is_what_it_says(
    page: Path, command: str, said: str, tmp_path: Path
) -> None:
    assert command.startswith("samii-rig ")
    done = subprocess.run(called(command), cwd=tmp_path, capture_output=True, text=True, check=True)
    assert doctest.OutputChecker().check_output(said, done.stdout, ALIKE), done.stdout
