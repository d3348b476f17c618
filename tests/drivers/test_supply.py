"""What an installation brings is pinned, with hashes, under licences that an MIT program may use.

Plan: the pins satisfy pyproject.toml, have hashes and name no host; a plain installation brings no
licence that would become ours; an audit that reached nothing does not look like one that found
nothing.
"""

from __future__ import annotations

import re
import sys
import tomllib

import pytest
from conftest import ROOT
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

sys.path.insert(0, str(ROOT))
from tools import audit, licences, lock

PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
PLAIN = (ROOT / "requirements.txt").read_text("utf-8")
ALL = (ROOT / "requirements-dev.txt").read_text("utf-8")
EXTRAS = [r for group in PROJECT["optional-dependencies"].values() for r in group]


@pytest.mark.parametrize(
    ("text", "wanted"), [(PLAIN, PROJECT["dependencies"]), (ALL, PROJECT["dependencies"] + EXTRAS)]
)
def test_the_pins_are_what_the_project_asks_for(text: str, wanted: list[str]) -> None:
    pinned = dict(re.findall(r"^([\w.-]+)==([^\s;]+)", text, re.M))
    for asked in map(Requirement, wanted):
        version = pinned.get(canonicalize_name(asked.name))
        assert version in asked.specifier if version else False, f"{asked}: python3 make.py lock"


def test_the_constraints_are_the_same_pins() -> None:
    pins = (ROOT / "constraints.txt").read_text("utf-8").splitlines()[1:]
    assert pins == lock.pins(ALL)
    assert {p.split(" ;")[0] for p in lock.pins(PLAIN)} <= {p.split(" ;")[0] for p in pins}


@pytest.mark.parametrize("text", [PLAIN, ALL])
def test_every_pin_has_hashes_and_no_host_is_named(text: str) -> None:
    blocks = re.split(r"\n(?=\w)", text.split("\n", 1)[1])
    for block in blocks:
        assert re.fullmatch(r"[\w.-]+==.*(\n    --hash=sha256:[0-9a-f]{64}( \\)?)+\n?", block), (
            block
        )
    assert len(blocks) == len(lock.pins(text))


def test_a_plain_installation_brings_no_licence_that_would_become_ours() -> None:
    found = {p.name: p for p in licences.packages()}
    assert not [p for p in found.values() if p.refused]
    assert found["numpy"].licence.startswith("BSD-3-Clause")
    assert found["python-can"].licence == "LGPL-3.0-only"


@pytest.mark.parametrize(
    ("licence", "refused"),
    [
        ("MIT", False),
        ("LGPL-3.0-only", False),
        ("GNU Lesser General Public License v3", False),
        ("GPL-2.0-or-later", True),
        ("GNU General Public License v3 (GPLv3)", True),
        ("AGPL-3.0", True),
        (licences.NONE, True),
    ],
)
def test_which_licences_are_refused(licence: str, refused: bool) -> None:
    assert licences.Package("a", "1", licence, plain=True).refused is refused
    assert not licences.Package("a", "1", licence, plain=False).refused


def test_an_audit_that_reached_nothing_says_so() -> None:
    missed = [{"name": n, "skip_reason": "not found on PyPI"} for n in "ab"]
    code, lines = audit.verdict(missed)
    assert code == audit.UNREACHED
    assert "was not reached. Nothing is known. It said: not found on PyPI" in lines[0]


def test_an_audit_names_what_is_vulnerable_and_what_was_not_looked_up() -> None:
    packages = [
        {"name": "a", "version": "1", "vulns": [{"id": "PYSEC-1", "fix_versions": ["2"]}]},
        {"name": "b", "version": "1", "vulns": []},
        {"name": "c", "skip_reason": "no such name"},
    ]
    code, lines = audit.verdict(packages)
    assert code == audit.VULNERABLE
    assert lines == [
        "a 1: PYSEC-1, mended in 2",
        "c: not looked up: no such name",
        "audit: 1 vulnerabilities; 2 of 3 looked up",
    ]
    assert audit.verdict(packages[1:2])[0] == 0
