"""The proof's page says every score with its goal, and shows what failed first."""

from __future__ import annotations

import re
from pathlib import Path

from prove_kit import MASS, NOTHING, SPRING, UNKNOWN, diagnosis, trial

from samii_rig.prove.page import acceptable, render, write_page
from samii_rig.prove.trial import Trial


def trials() -> list[Trial]:
    right = [trial("one", diagnosis("named", (*SPRING, 0.9)), SPRING, size=s) for s in (5, 50, 500)]
    wrong = trial("one", diagnosis("named", (*MASS, 0.95)), SPRING, size=321.0)
    outside = trial("outside", UNKNOWN, ("hysteresis", "joint_1"))
    return [*right, wrong, outside, *[trial("nothing", NOTHING)] * 20]


def test_the_page_holds_scores_and_the_failure(tmp_path: Path) -> None:
    path = write_page(tmp_path / "proof.html", trials())
    text = path.read_text()
    assert "25 concealed trials" in text
    assert "torsional_compliance at joint_1" in text
    assert "named: added_mass at link_2 (0.95)" in text
    assert text.count("<svg") == 3
    assert not re.search(r'(src|href)="http', text)
    assert not list(tmp_path.glob("*.part*"))


def test_the_same_trials_give_the_same_page() -> None:
    assert render(trials(), "x") == render(trials(), "x")


def test_a_page_without_failures_says_so() -> None:
    text = render([trial("nothing", NOTHING)] * 5, "x")
    assert "<p>Nothing.</p>" in text
    assert "no trial tells" in text


def test_what_was_outside_the_table_and_is_named_by_its_name_did_not_fail() -> None:
    name, other = ("hysteresis", "joint_1"), ("hysteresis", "joint_2")
    own = trial("outside", diagnosis("named", (*name, 0.99)), name)
    another = trial("outside", diagnosis("named", (*other, 0.99)), name)
    assert acceptable(own)
    assert not acceptable(another)
