"""docs/reference/answer.md has every name that an answer uses, words.md each term, in one line."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator
from typing import Any, get_args

from conftest import ROOT

from samii_rig.diagnose.physics.rows import PHYSICS
from samii_rig.diagnose.result import (
    Band,
    Before,
    Cause,
    Diagnosis,
    Exact,
    Gap,
    Hiding,
    Moved,
    Used,
    Value,
    Verdict,
)

PAGES = [(ROOT / "docs" / "reference" / p).read_text("utf-8") for p in ("words.md", "answer.md")]
SECTIONS = dict(re.findall(r"^## (.*?)\n(.*?)(?=^## |\Z)", "\n".join(PAGES), re.M | re.S))
HEADS = r"term|name|field|`verdict` \| meaning|`physics` \| in|---"
ROW = re.compile(rf"^\| (?!{HEADS})(.+?) \| (.+) \|$", re.M)


def rows(section: str) -> dict[str, str]:
    """What a section's tables say, by their first column."""
    found = ROW.findall(SECTIONS[section])
    assert not [name for name, n in Counter(n for n, _ in found).items() if n > 1]
    return {name.strip("`"): meaning for name, meaning in found}


def keys(data: Any) -> Iterator[str]:
    """All names of fields in plain data; what stands under `parameters` has symbols for names."""
    if isinstance(data, dict):
        for key, value in data.items():
            yield key
            yield from keys([*value.values()] if key == "parameters" else value)
    elif isinstance(data, list):
        for value in data:
            yield from keys(value)


def whole() -> Diagnosis:
    """A diagnosis with something in every field."""
    one = Value(1.0, "kg", 0.9, 1.1)
    cause = Cause("added_mass", "beam", 0.9, (("ground_spring", "beam"),), {"m": one}, 0.5)
    return Diagnosis(
        verdict="named", chi2_per_dof=2.0, threshold=1.1, bands=(Band("a_0", 1.0, 2.0, 2.0),),
        sites=(("beam", 0.9),), causes=(cause,), alternatives=(((cause,), 0.1),),
        nominal=(2.0, 2.0), with_causes=(1.0, 1.0), noise_floor=1.0, gap=Gap(1.0, 0.9, 1.0),
        not_physics=("",), why="", experiment="", outside=0.0, rig=None, traces=(),
        moved=(Moved("beam.m", 3.0),), could_hide=(Hiding("added_mass", "beam", "m", 1.0, "kg"),),
        used=Used(1, 2, (("a", "b"),)), sigma=9.0, gain=1.0, before=Before("named", (cause,)),
        states=(("a",), ("b",)), exact=(Exact("beam.L", 1.0, one),), beyond="it varies",
    )  # fmt: skip


def test_every_physics_of_the_table_stands_there_with_its_words() -> None:
    assert rows("Physics of an answer") == {row.name: row.words for row in PHYSICS.values()}


def test_every_verdict_stands_there() -> None:
    assert tuple(rows("Verdicts")) == get_args(Verdict)


def test_every_field_of_an_answer_stands_there() -> None:
    named = set(re.findall(r"`(\w+)`", SECTIONS["Fields of an answer"]))
    assert named >= set(keys(whole().plain()))
    assert set(whole().plain()) <= set(rows("Fields of an answer"))


def test_a_term_is_said_in_one_plain_sentence() -> None:
    terms = rows("Terms")
    assert len(terms) >= 40
    for term, meaning in terms.items():
        assert len(meaning.split()) <= 25, term
