"""Numbers that a rig file may hold and hardly means: told in a line, and used as they stand."""

from __future__ import annotations

import logging

import pytest

from samii_rig.errors import InputError
from samii_rig.rig.load import load_rig, parse
from samii_rig.rig.plausible import remarks
from samii_rig.rig.schema import Rig
from samii_rig.rig.shipped import shipped

BEAM = load_rig("beam_on_shaker")[1]


def said(old: str, new: str) -> list[str]:
    assert old in BEAM
    return remarks(parse(Rig, BEAM.replace(old, new), "bench.toml"))


@pytest.mark.parametrize("name", shipped())
def test_nothing_is_remarked_on_a_shipped_rig(name):
    assert remarks(load_rig(name)[0]) == []


def test_metres_where_millimetres_were_meant_are_told_with_field_value_and_what_is_usual():
    (line,) = said('value = 300.0, unit = "mm"', 'value = 450.0, unit = "m"')
    assert line == "element strip: L is 450 m; usual are 0.0001 to 30 m; were mm meant?"
    (line,) = said('value = 300.0, unit = "mm"', 'value = 0.003, unit = "mm"')
    assert line == "element strip: L is 0.003 mm; usual are 0.0001 to 30 m"
    (line,) = said('value = 20.0, unit = "g"', 'value = 20000.0, unit = "kg"')
    assert line == "element tip_mass: m is 20000 kg; usual are 1e-06 to 10000 kg; were g meant?"


def test_a_file_is_told_once_with_its_name_and_is_no_error(tmp_path, caplog):
    path = tmp_path / "bench.toml"
    path.write_text(BEAM.replace('value = 300.0, unit = "mm"', 'value = 450.0, unit = "m"'))
    with caplog.at_level(logging.WARNING):
        for _ in range(2):
            load_rig(str(path))
    (record,) = caplog.records
    assert record.getMessage().startswith(f"samii-rig: look: {path}, element strip: L is 450 m")


MOTOR = load_rig("flexible_joint")[1]
BASE = 'base = "clamped"'


def test_a_motor_that_pushes_against_nothing_is_told():
    text = MOTOR.replace(BASE, 'base = "pinned"')
    (line,) = remarks(parse(Rig, text, "bench.toml"))
    assert line.startswith("element motor: moves nothing, as base 'pinned' gives way")
    stator = '[[element]]\nname = "stator"\nkind = "inertia"\n'
    stator += 'I = { value = 0.1, unit = "kg m^2", source = "test" }\n\n'
    first = text.index("[[element]]")
    assert remarks(parse(Rig, text[:first] + stator + text[first:], "bench.toml")) == []


def test_a_chain_that_only_turns_is_held_in_place():
    """With nothing that shifts its matrices are singular at every frequency."""
    free = MOTOR.replace(BASE, 'base = "free"')
    with pytest.raises(InputError, match=r"base: 'free' of a chain that only turns.*'pinned'"):
        parse(Rig, free, "bench.toml")
    first = free.index("[[element]]")
    block = '[[element]]\nname = "block"\nkind = "mass"\n'
    block += 'm = { value = 0.1, unit = "kg", source = "test" }\n\n'
    assert parse(Rig, free[:first] + block + free[first:], "bench.toml").base == "free"


def test_two_motors_side_by_side_on_one_input_are_told():
    first = MOTOR.index("[[element]]")
    source = MOTOR[first : MOTOR.index("[[element]]", first + 1)]
    twin = source.replace('name = "motor"', 'name = "twin"')
    (line,) = remarks(parse(Rig, MOTOR[:first] + twin + MOTOR[first:], "bench.toml"))
    assert line == (
        "element motor: adds up with twin, which acts on the same point by the same input 'v'; "
        "was a spring between them meant?"
    )
