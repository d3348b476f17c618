"""A rig file says what it means, and what is wrong with it is said in one line.

Plan: the shipped rigs load and carry the papers' numbers; every kind of mistake names
file, field, value and what would be right; nothing but InputError ever leaves the loader.
"""

import contextlib
import re
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from samii_rig.errors import InputError
from samii_rig.rig import load
from samii_rig.rig.load import load_rig, parse, shipped
from samii_rig.rig.schema import Rig, TorsionalSpring, parameters

SAMII = load_rig("samii")[1]


def rejected(text: str, where: str = "my.toml") -> str:
    with pytest.raises(InputError) as caught:
        parse(Rig, text, where)
    line = str(caught.value)
    assert "\n" not in line
    assert line.startswith(where)
    return line


def test_shipped_rigs_load_and_say_where_every_number_comes_from() -> None:
    assert set(shipped()) >= {"samii", "samii_joint_3", "samii_braced", "sflr"}
    assert {"samii_torque_vertical", "samii_torque_horizontal"} < set(shipped())
    for name in shipped():
        rig, _ = load_rig(name)
        for element in rig.element:
            for symbol, parameter in parameters(element).items():
                assert parameter.source.startswith(("[", "absent")), (element.name, symbol)


PUSHED = """
name = "measured"
base = "clamped"
tip = "free"
rate_hz = 500.0
actuator = [{ name = "M", unit = "N m", low = -1.0, high = 1.0 }]
sensor = [{ name = "theta", kind = "absolute_angle", after = "disc", unit = "rad" }]
element = [
    {name = "shaft", kind = "torsional_spring", k = {value = 9, unit = "N m/rad", source = "-"}},
    { name = "disc", kind = "inertia", I = { value = 1, unit = "kg m^2", source = "-" } },
    {name = "push", kind = "torque_source", input = "M", K = {value = 2, unit = "U", source = "-"}},
]
"""


@pytest.mark.parametrize("unit", ["N m/(N m)", "N m/N m", "1"])
def test_the_gain_of_a_source_is_per_unit_of_its_input_whole(unit: str) -> None:
    push = parse(Rig, PUSHED.replace('"U"', f'"{unit}"'), "measured.toml").element[2]
    assert (push.K.value, push.K.unit) == (2.0, "N m/(N m)")


def test_a_bend_says_where_its_angle_came_from_as_any_parameter_does() -> None:
    elbow = (
        '[[element]]\nname = "elbow"\nkind = "bend"\nangle = { value = 30, unit = "deg"SOURCE }\n'
    )
    said = 'pose = { value = 0, unit = "deg", source = "hangs" }\n'
    text = SAMII.replace("[[sensor]]", elbow + "\n[[sensor]]", 1)
    text = text.replace("[[element]]", said + "gravity = 9.81\n\n[[element]]", 1)
    plain = parse(Rig, text.replace("SOURCE", ""), "bent.toml")
    assert parse(Rig, text.replace("SOURCE", ', source = "spirit level"'), "bent.toml") == plain
    line = rejected(text.replace("SOURCE", ", tolerance = 0.1"), "bent.toml")
    assert line.endswith("element[elbow].angle.tolerance: no such field; expected source")


def test_samii_carries_table_ii_of_paper_1() -> None:
    rig, _ = load_rig("samii")
    stiffness = {e.name: e.k.value for e in rig.element if isinstance(e, TorsionalSpring)}
    assert stiffness == {
        "clamp": 2.674e5,
        "joint_1": 0.136e5,
        "joint_2": 0.108e5,
        "joint_3": 0.252e5,
    }


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ('unit = "N m^2"', 'unit = "N/m"', r"element\[beam\].EI.*'N/m'; expected 'N m\^2'"),
        ("value = 2.674e5", "value = -2.674e5", r"clamp.*-267400.*0 or more"),
        ("value = 2.674e5", "value = nan", r"clamp.*k\.value.*finite"),
        ("value = 2.674e5", 'value = "stiff"', r"clamp.*k\.value is 'stiff'"),
        ('base = "clamped"', 'base = "glued"', r"base is 'glued'; expected one of clamped, "),
        ('base = "clamped"\n', "", r"base: missing; expected one of clamped, pinned, free$"),
        ('tip = "free"\n', "", r"tip: missing; expected one of clamped, pinned, free$"),
        (
            'name = "v_2"\n',
            'name = "v_2"\ndelay = -0.1\n',
            r"actuator\[v_2\].delay is -0.1.*or equal to 0",
        ),
        (
            "value = 150.0",
            "value = -150.0",
            r"joint_2_source.*p: value -150 rad/s; expected more than 0",
        ),
        ("rate_hz = 500.0", "rate_hz = 0.0", r"rate_hz is 0.0.*greater than 0"),
        ('name = "a_1"', 'name = "a_0"', r"'a_0' occurs twice"),
        ('on = "link_1"', 'on = "link_9"', r"a_1.*'link_9' does not exist.*'link_1'"),
        ('on = "link_1"', 'on = "joint_1"', r"a_1: joint_1 has no extent"),
        ("position = 0.1969", "position = 0.2", r"a_1.*0.2 m lies beyond link_1.*0.1969"),
        ('"joint_2_source", "joint_2"]', '"joint_2", "joint_2_source"]', r"not neighbours"),
        ('input = "v_2"', 'input = "v_3"', r"input 'v_3' is no actuator.*v_2"),
        (
            'name = "beam"',
            'name = "a beam"',
            "name is 'a beam'; expected letters, digits and _, with",
        ),
        ('name = "SAMII"', 'name = ""', "my.toml: name is ''; expected a text that is not empty"),
        ('name = "beam"', f'name = "{"b" * 41}"', "name is 'b+'; expected 40 characters at most"),
        ("tolerance = 0.1,", "tol = 0.1,", r"tol: no such field; expected tolerance$"),
        ('unit = "rad/(s V)"', 'unit = "rad/s"', r"K has unit 'rad/s'; expected 'rad/\(s V\)'"),
        (
            'kind = "relative_angle"',
            'kind = "gyroscope"',
            r"sensor\[theta_2\].kind is 'gyroscope'; expected one of relative_angle, ",
        ),
        ('unit = "m/s^2"\nnoise', 'unit = "kg"\nnoise', r"a_0.*unit: is 'kg'.*'m/s\^2'"),
        ('channel = "theta_2"', 'channel = "theta_9"', r"limit on 'theta_9'.*no such channel"),
        ("max = 0.35", "max = 0.0", r"limit.*max is 0.0.*greater than 0"),
        ("low = -1.5", "low = 2.0", r"theta_2.*low 2, high 1.5; expected low below high"),
        ('sensor = "theta_2"', 'sensor = "theta_7"', r"centring.*'theta_7' does not exist"),
        ("rate_hz", "rate", r"rate: no such field; expected rate_hz"),
        ('tip = "free"', "", r"tip: missing; expected one of"),
        ('tip = "free"', 'tip = "free"\ntop = 1', r"top: no such field"),
        (
            "value = 150.0",
            'value = "150"',
            r"\.p\.value is '150'; expected a valid number",
        ),
        (
            "value = 150.0",
            "value = true",
            r"\.p\.value is True; expected a valid number",
        ),
        ("value = 150.0", "value = 150,0", r"TOML.*; did you mean 150.0 for 150,0\?$"),
        (
            'tip = "free"',
            'tip = "free"\nexperiment = "swept_sine"',
            r"my.toml: is an experiment's file; expected a rig file$",
        ),
    ],
)
def test_a_mistake_is_named_with_field_value_and_remedy(old: str, new: str, says: str) -> None:
    assert old in SAMII
    line = rejected(SAMII.replace(old, new, 1))
    assert re.search(says, line), line


def test_a_rig_without_elements_or_a_missing_file_is_refused(tmp_path: Path) -> None:
    assert "element" in rejected(re.sub(r"(?ms)^\[\[element\]\].*?(?=^#|^\[\[sensor)", "", SAMII))
    with pytest.raises(InputError, match=r"--rig is 'nowhere'.*samii, .*sflr"):
        load_rig("nowhere")
    with pytest.raises(InputError, match="cannot be read: Is a directory; expected a rig file"):
        load_rig(str(tmp_path))
    (tmp_path / "latin.toml").write_bytes(b'name = "\xff"')
    with pytest.raises(InputError, match="UTF-8"):
        load_rig(str(tmp_path / "latin.toml"))


@given(st.text(max_size=200))
def test_no_text_gets_anything_but_an_input_error_out_of_the_loader(text: str) -> None:
    with pytest.raises(InputError):
        parse(Rig, text, "fuzz.toml")


def value(number: float, unit: str) -> str:
    return f'{{ value = {number}, unit = "{unit}", source = "test" }}'


LINE = f"""
[[element]]
name = "line"
kind = "hydraulic_line"
source = "joint_2_source"
D = {value(1e-5, "m^3/rad")}
L = {value(1.0, "m")}
A = {value(1e-4, "m^2")}
rho = {value(870.0, "kg/m^3")}
B = {value(1e9, "Pa")}
"""
BRANCH = f"""
[[element]]
name = "hose"
kind = "branch"

[[element.element]]
name = "mount"
kind = "torsional_spring"
k = {value(40.0, "N m/rad")}
"""
SENSORS = SAMII.index("[[sensor]]")


def with_element(text: str) -> str:
    """SAMII with one more element at its tip."""
    return SAMII[:SENSORS] + text + SAMII[SENSORS:]


def test_an_element_of_a_branch_is_named_by_its_place() -> None:
    rig = parse(Rig, with_element(BRANCH), "my.toml")
    assert rig.element[-1].name == "hose"
    line = rejected(with_element(BRANCH.replace("40.0", "-40.0")))
    assert re.search(r"element\[hose\].element\[mount\].k: value -40 .*0 or more", line), line
    line = rejected(with_element(BRANCH.replace('"mount"', '"clamp"')))
    assert "'clamp' occurs twice" in line


@pytest.mark.parametrize(
    ("text", "says"),
    [
        (LINE, r"element line: source 'joint_2_source' is no angular velocity source right before"),
        (
            BRANCH.replace("[[element.element]]", "[[element.part]]"),
            r"element\[hose\].part: no such field; expected element",
        ),
        (
            BRANCH.replace('kind = "torsional', 'kind = "magic'),
            r"mount\].kind is 'magic_spring'.*one of",
        ),
        (
            f'[[element]]\nname = "push"\nkind = "force_source"\ninput = "v_2"\n'
            f"K = {value(1.0, 'N m/V')}\n",
            r"element push: K has unit 'N m/V'; expected 'N/V'",
        ),
        (
            f'[[element]]\nname = "nothing"\nkind = "translational_spring"\n'
            f"k = {value(0.0, 'N/m')}\n",
            r"element\[nothing\]: k and c are both 0; expected one above 0",
        ),
    ],
)
def test_a_mistake_in_a_new_kind_of_element_is_named(text: str, says: str) -> None:
    line = rejected(with_element(text))
    assert re.search(says, line), line


LINES = SAMII.splitlines()


@given(st.integers(0, len(LINES) - 1), st.sampled_from(["", "x = 1", "[[", "value = {}", "k = 3"]))
def test_a_damaged_line_loads_or_is_an_input_error(at: int, instead: str) -> None:
    text = "\n".join([*LINES[:at], instead, *LINES[at + 1 :]])
    with contextlib.suppress(InputError):
        parse(Rig, text, "fuzz.toml")


@pytest.mark.parametrize(
    "text",
    [
        "a." * 20_000 + "a = 1",
        "[" + "a . " * 17 + "a]",
        '"\\"".' * 17 + "a = 1",
        "x = { " + "'a'." * 17 + "a = 1 }",
    ],
)
def test_a_key_of_very_many_parts_is_refused_before_it_is_parsed(text: str) -> None:
    """The time that it takes to parse one grows with the square of its parts."""
    with pytest.raises(InputError, match=r"line 1 is .*; expected keys of at most 16 dotted parts"):
        parse(Rig, text, "x.toml")


@pytest.mark.parametrize("text", ['"\\' * 24_000, '"' * 48_000, "a" * 48_000, "a = 1.5\n" * 6_000])
def test_no_text_takes_long_to_be_looked_at(text: str) -> None:
    steps = sum(1 for _ in load._TOKEN.finditer(text))
    assert steps <= len(text)
    assert "".join(m.group() for m in load._TOKEN.finditer(text)) == text
    load.check_depth(text, "x.toml")
