"""Units as people write them: exact factors, one table for recordings and rig files."""

import math
from contextlib import suppress
from fractions import Fraction

import pytest
from axial_kit import axial, part, place
from hypothesis import given
from hypothesis import strategies as st

from samii_rig.errors import InputError
from samii_rig.rig.load import load_rig, parse
from samii_rig.rig.schema import Rig
from samii_rig.rig.schema.conversion import in_si
from samii_rig.safety.limits import gate_limits
from samii_rig.units import convert, factor, pretty, quantity

TWO = load_rig("two_masses")[1]
CARRIAGE = load_rig("carriage")[1]


@pytest.mark.parametrize(
    ("given_", "wanted", "expected"),
    [
        ("mm", "m", 1e-3),
        ("g", "kg", 1e-3),
        ("g", "m/s^2", 9.80665),
        ("mg", "m/s^2", 9.80665e-3),
        ("kN", "N", 1e3),
        ("bar", "Pa", 1e5),
        ("deg", "rad", math.pi / 180),
        ("rpm", "rad/s", math.pi / 30),
        ("Hz", "rad/s", 2 * math.pi),
        ("N/mm", "N/m", 1e3),
        ("kN/mm", "N/m", 1e6),
        ("N·s/mm", "N s/m", 1e3),
        ("Nm/deg", "N m/rad", 180 / math.pi),
        ("kg cm²", "kg m^2", 1e-4),
        ("g/cm", "kg/m", 0.1),
        ("mm/(s V)", "m/(s V)", 1e-3),
        ("rpm/V", "rad/(s V)", math.pi / 30),
        ("l/min", "m^3/s", 1 / 60000),
        ("cm^3/bar", "m^3/Pa", 1e-11),
        ("GPa", "Pa", 1e9),
        ("%", "1", 0.01),
        ("N", "N m", None),
        ("N m", "N m/rad", None),
        ("kg", "N", None),
        ("Hz", "1", None),
        ("furlong", "m", None),
        ("furlong", "furlong", 1.0),
        ("N//mm", "N/m", None),
        ("(N/mm", "N/m", None),
        ("N)/mm", "N/m", None),
        ("N/", "N", None),
        ("", "1", None),
        ("m" * 9999, "m", None),
        ("m^99999", "m", None),
        ("m " * 500, "m", None),
    ],
)
def test_a_factor_is_exact_or_none(given_: str, wanted: str, expected: float | None) -> None:
    if expected is None:
        assert factor(given_, wanted) is None
    else:
        assert factor(given_, wanted) == pytest.approx(expected, rel=1e-15)


@given(
    st.decimals(allow_nan=False, allow_infinity=False, min_value=-9999, max_value=9999, places=4)
)
def test_a_number_is_converted_as_it_is_written(value: object) -> None:
    # 0.7 N/mm is 700 N/m and not 699.9999999999999.
    text = str(value)
    assert convert(float(text), "N/mm", "N/m") == float(Fraction(text) * 1000)


def test_a_letter_that_stands_alone_means_what_recordings_mean() -> None:
    assert [quantity(x) for x in ("g", "mm", "bar", "N/mm")] == [
        "acceleration", "length", "pressure", "",
    ]  # fmt: skip


def test_a_parameter_is_reckoned_in_si_and_shown_as_written() -> None:
    rig = parse(Rig, TWO, "two.toml")
    k = rig.element[0].k  # type: ignore[union-attr]
    assert (k.value, k.unit) == (12000.0, "N/m")
    assert k.shown() == (12.0, "N/mm")
    again = Rig.model_validate_json(rig.model_dump_json())
    assert again == rig
    assert again.element[0].k.shown() == (12.0, "N/mm")  # type: ignore[union-attr]


def test_a_sensor_limit_and_loop_in_millimetres_are_those_in_metres() -> None:
    rig = parse(Rig, CARRIAGE, "carriage.toml")
    x = rig.sensor[0]
    assert (x.unit, x.resolution, x.noise_rms, x.high) == ("m", 1e-6, 5e-7, 0.1)
    assert (rig.limit[0].unit, rig.limit[0].max) == ("m", 0.04)
    assert rig.centring is not None
    assert rig.centring.kp == 150.0  # V/m


def test_the_gate_knows_the_way_that_a_velocity_source_makes() -> None:
    rig = parse(Rig, CARRIAGE, "carriage.toml")
    assert gate_limits(rig, "v", 150.0, "x_spindle").turning == 0.02  # m/s a volt
    assert gate_limits(rig, "v", 150.0, "x").turning == 0.02
    held = axial(
        part("velocity_source", "drive", K=0.02, p=60.0), part("spring", k=1e4),
        part("mass", m=1.0), part("ground_spring", k=1e3), sensor=[place("displacement", "mass")],
    )  # fmt: skip
    with pytest.raises(InputError, match="or a displacement through a velocity source, or kp = 0"):
        gate_limits(held, "v", 1.0, "y")


JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.sampled_from(["m", "mm", "v"]),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(
        st.sampled_from(["name", "kind", "unit", "K", "value", "input", "channel", "max"]),
        inner, max_size=5,
    ),
    max_leaves=12,
)  # fmt: skip
TABLES = ["sensor", "actuator", "element", "limit", "agreement", "feedback", "centring", "device"]


@given(st.dictionaries(st.sampled_from(TABLES), JSON))
def test_tables_of_any_form_come_through_or_are_refused(data: dict[str, object]) -> None:
    with suppress(ValueError):
        in_si(data)


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ("max = 8.0", f"max = 1{'0' * 400}", "limit[0].max"),
        ("high = 10.0", f"high = 1{'0' * 400}", "sensor[x_1].high"),
        ("value = 12.0", "value = 1e306", "element[spring_1].k: value inf N/m; expected a finite"),
        ("value = 12.0", "value = nan", "element[spring_1].k"),
        ('unit = "N/mm"', 'unit = "N mm"', "element[spring_1].k: unit 'N mm'; expected 'N/m'"),
        (
            'unit = "g"',
            'unit = "mm"',
            "[mass_2].m: unit 'mm'; expected 'kg', or g, mg, t, lb",
        ),
        (
            'unit = "N/V"',
            'unit = "kg/V"',
            "element coil: K has unit 'kg/V'; expected 'N/V'",
        ),
        ('unit = "mm"\nresolution', 'unit = "g"\nresolution', "sensor[x_1].unit: is 'g'; exp"),
        ('unit = "mm"\nmax', 'unit = "N"\nmax', "limit on x_1: unit 'N'; expected 'm'"),
        (
            'driver = "simulated"',
            'driver = "ni_daq"',
            "two.toml: sensor x_1: unit 'mm' with the driver 'ni_daq', whose scales count in the "
            "sensor's unit; expected 'm'",
        ),
        ('unit = "Hz"', 'unit = "s"', "element[coil].p: unit 's'; expected 'rad/s'"),
    ],
)
def test_a_unit_of_another_kind_is_one_line(old: str, new: str, says: str) -> None:
    assert old in TWO
    with pytest.raises(InputError) as caught:
        parse(Rig, TWO.replace(old, new, 1), "two.toml")
    assert says in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_printed_unit_is_one_that_a_file_may_have():
    for unit in ("m/s^2", "kg m^2", "N s^2/m", "m^4", "rad/s"):
        assert "^" not in pretty(unit)
        assert factor(pretty(unit), unit) == 1.0
