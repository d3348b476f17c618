"""The file of outcomes holds what scores need, and the page is written from it alone."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import pytest
from prove_kit import MASS, NOTHING, SPRING, diagnosis
from typer.testing import CliRunner

from samii_rig.cli.app import app
from samii_rig.errors import InputError
from samii_rig.prove import evidence, outcomes
from samii_rig.prove.score import scores

MADE = {
    "plants": ["p"],
    "rigs": ["samii"],
    "left_out": ["p cannot make sflr: why"],
    "command": "samii-rig prove --seed 7",
    "commit": "0123456789",
}


def outcome(
    seed: int, answer: dict[str, Any], *names: tuple[str, str], **more: Any
) -> dict[str, Any]:
    effects = [{"physics": p, "site": s, "parameters": {"k": 1.0}, "also": []} for p, s in names]
    answer = {
        **answer,
        "evidence": {"sigma": 47.123456, "causes": [], "drop": 0.0, "beyond": False},
    }
    return {
        "kind": "one" if names else "nothing", "seed": seed, "plant": "p", "rig": "samii",
        "seconds": {"plant": 1.0, "diagnosis": 2.5, "size": 0.1}, "effects": effects, "size": 50.0,
        "size_is": "whole records", "styles": ["cut", "hum"], "answer": answer, **more,
    }  # fmt: skip


def some() -> list[dict[str, Any]]:
    broken = {"kind": "one", "seed": 9, "plant": "p", "rig": "samii", "seconds": {},
              "at": "diagnosis", "error": "ValueError: a | b"}  # fmt: skip
    return [
        outcome(1, NOTHING),
        outcome(1, diagnosis("named", (*SPRING, 0.9)), SPRING),
        outcome(2, diagnosis("named", (*MASS, 0.95)), SPRING),
        broken,
    ]


def test_what_is_kept_scores_as_what_was_made(tmp_path: Path) -> None:
    file = tmp_path / "x.jsonl.xz"
    outcomes.write(file, MADE, some())
    made, again = outcomes.read(file)
    assert made == MADE
    before, after = (scores(outcomes.trials(x), 1) for x in (some(), again))
    assert [(s.what, s.n) for s in before] == [(s.what, s.n) for s in after]
    for a, b in zip(before, after, strict=True):
        assert a.value == pytest.approx(b.value, rel=1e-4, nan_ok=True)


def test_the_page_says_every_score_the_commit_and_what_broke() -> None:
    text = evidence.render({**MADE, "page": "samii-rig"}, some(), "x.jsonl.xz")
    for s in scores(outcomes.trials(some()), 1):
        assert f"| {s.what} |" in text
    assert "`0123456789`" in text
    assert "samii-rig prove --seed 7" in text
    assert "p cannot make sflr" in text
    assert "| one 9 | p, samii, diagnosis | ValueError: a / b |" in text
    assert "named: added_mass at link_2 (0.95)" in text
    assert "| hum |" in text
    # Every row of a table has as many cells as its head.
    for table in re.findall(r"(?:^\|.*\n)+", text, re.MULTILINE):
        assert len({line.count("|") for line in table.splitlines()}) == 1, table


def test_one_command_writes_the_page_again(tmp_path: Path) -> None:
    file, page = tmp_path / "proof-trials.jsonl.xz", tmp_path / "proof.md"
    outcomes.write(file, MADE, some())
    call = ["prove", "--of", str(file), "--page", str(page), "--json"]
    done = CliRunner().invoke(app, call)
    assert done.exit_code == 0, done.output
    assert json.loads(done.stdout)["trials"] == 3
    first, kept = page.read_text(), file.read_bytes()
    CliRunner().invoke(app, call)
    assert page.read_text() == first
    assert file.read_bytes() == kept


def test_another_file_costs_one_line(tmp_path: Path) -> None:
    file = tmp_path / "x.jsonl.xz"
    file.write_text("no outcomes")
    with pytest.raises(InputError, match="is no file of outcomes"):
        outcomes.read(file)


def test_groups_of_the_calibration_are_plant_and_excitation() -> None:
    cause = {"physics": SPRING[0], "site": SPRING[1], "probability": 0.9, "parameters": {},
             "equivalent_to": []}  # fmt: skip
    told = {"odds": 9.0, "left": 1.0, "held": 1.0, "effects": 1, "forced": False,
            "confirmed": False,
            "gain": 200.0, "drop": 400.0, "names": 1, "pair": False, "closed": 1.0, "beyond": False,
            "causes": [cause]}  # fmt: skip
    one = outcome(1, NOTHING, SPRING)
    one["answer"]["evidence"] = told
    rows, groups, places, of_places = outcomes.evidence([one, *some()])
    assert [right for _, right in rows] == [True]
    assert groups == of_places == ["p, cut"]
    assert len(places) == 1
