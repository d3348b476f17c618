"""Effects that are stated: what a draw of the same numbers is, or refused in one line."""

from __future__ import annotations

import json
import re
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest
from concealed_kit import SAMII, SAMII_TOML

from samii_rig.errors import InputError
from sim.concealed.__main__ import main
from sim.concealed.draw import draw, trial_id
from sim.concealed.effects import OUTSIDE, ROWS, Row, places
from sim.concealed.parts import described
from sim.concealed.runs import Design
from sim.concealed.scales import Dose
from sim.concealed.stated import Stated, as_stated, row_of

SHORT = Design(levels=(0.5,), burst=12.0, ring_down=3.0, bursts=2, period=2.0, settle=1, periods=1,
               steps=1)  # fmt: skip
NUMBER = re.compile(r"-?\d+\.?\d*(?:e[-+]?\d+)?")
FEEDBACK = Stated("velocity_feedback", "joint_2_source", {"g_v": 700.0})


@pytest.mark.parametrize("row", [*ROWS, *OUTSIDE], ids=lambda r: f"{r.physics} {r.at}")
def test_what_was_drawn_and_is_then_stated_is_the_same_plant(row: Row) -> None:
    site = places(described(SAMII), row)[-1]
    drawn, again = described(SAMII), described(SAMII)
    effect = row.put(drawn, site, Dose(1.0 if row.fixed else 0.7, np.random.default_rng(5)))
    said = Stated(row.physics, site, effect.parameters, effect.where, effect.position)
    assert row_of(again, said) is row
    dose = Dose(1.0, np.random.default_rng(8), said.parameters, said.where, position=said.position)
    as_stated(said, row.put(again, site, dose))
    old, new = (NUMBER.findall(repr(asdict(plant))) for plant in (drawn, again))
    assert NUMBER.sub("", repr(drawn)) == NUMBER.sub("", repr(again))
    assert [float(x) for x in new] == pytest.approx([float(x) for x in old], rel=1e-12)


def test_what_is_stated_is_concealed_and_nothing_else() -> None:
    spring = Stated("torsional_compliance", "clamp", {"k": 2.5e5, "c": 1500.0})
    drawn = draw("stated", 3, SAMII_TOML, SHORT, (FEEDBACK, spring))
    assert [(e.physics, e.site, e.parameters) for e in drawn.effects] == [
        (s.physics, s.site, s.parameters) for s in (FEEDBACK, spring)
    ]
    assert drawn.plant.part("clamp").values == spring.parameters
    rigid = [e.name for e in drawn.nominal.element if getattr(e, "k", None) and e.k.value > 1e8]
    assert rigid == ["clamp"]
    assert drawn.values["joint_1.k"] != described(SAMII).part("joint_1").values["k"]
    assert draw("stated", 4, SAMII_TOML, SHORT, (FEEDBACK,)).values != drawn.values


def test_names_of_stated_trials_differ_and_say_nothing() -> None:
    weaker = Stated("velocity_feedback", "joint_2_source", {"g_v": 900.0})
    names = {trial_id("stated", s, (e,)) for s in (0, 1) for e in (FEEDBACK, weaker)}
    assert len(names) == 4
    assert all(re.fullmatch("[0-9a-f]{12}", name) for name in names)


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["velocity_feedback"], "PHYSICS SITE"),
        (["glue", "joint_2"], "one of torsional_compliance, "),
        (["velocity_feedback", "joint_2", "g_v=1"], "one of joint_2_source"),
        (["velocity_feedback", "joint_2_source", "g_v=much"], "SYMBOL=NUMBER"),
        (["velocity_feedback", "joint_2_source", "g_v=nan"], "a finite number"),
        (["velocity_feedback", "joint_2_source", "k=1"], "a parameter that it has (g_v)"),
        (["noncollocated_encoder", "theta_2", "k=1"], "none: it is there or not"),
        (["ground_spring", "beam", "where=sky"], "one of torsional_ground_spring, "),
        (["added_mass", "beam", "where=sky"], "where is 'sky'; expected ''"),
        (["added_mass", "beam", "position=1"], "position is 1.0; expected none"),
        (["torsional_compliance", "beam", "position=nan"], "a finite number"),
        (["torsional_compliance", "beam", "position=4.7"], "and less than 4.5"),
    ],
)
def test_what_cannot_be_concealed_is_refused_in_one_line(words: list[str], expected: str) -> None:
    with pytest.raises(InputError) as raised:
        draw("stated", 0, SAMII_TOML, SHORT, (Stated.of(words),))
    assert expected in str(raised.value)
    assert "\n" not in str(raised.value)


def test_drawn_kinds_take_no_effects_and_stated_needs_some() -> None:
    for kind, effects in (("one", (FEEDBACK,)), ("stated", ())):
        with pytest.raises(InputError, match="if, and only if, stated"):
            draw(kind, 0, SAMII_TOML, SHORT, effects)


def test_command_line_conceals_what_it_is_told(tmp_path: Path) -> None:
    asked = ["make", "--seed", "2", "--burst", "12", "--levels", "0.5", "--out", str(tmp_path)]
    assert main([*asked, "--effect", "velocity_feedback", "joint_2_source", "g_v=700"]) == 0
    (truth,) = (tmp_path / "truth").glob("*.json")
    record = json.loads(truth.read_text())
    assert record["kind"] == "stated"
    assert record["effects"][0]["parameters"] == {"g_v": 700.0}
    assert record["size"] > 100
    assert len(list((tmp_path / "recordings" / truth.stem).glob("*.mcap"))) == 3
    assert main([*asked, "--effect", "glue", "joint_2"]) == 2
