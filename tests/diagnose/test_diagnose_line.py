"""A line in one lump between valve and vane: its element, and what the diagnosis makes of it."""

import numpy as np
import pytest
from elements_kit import ANGLE, BEAM, SOURCE, part
from elements_kit import rig as made_of
from identify_kit import noiseless, samii
from table_kit import Effects, table_of

from samii_rig.diagnose.diagnose import diagnose
from samii_rig.diagnose.fit.gap import gap_of
from samii_rig.diagnose.fit.rigfile import toml
from samii_rig.diagnose.physics.grid import grid
from samii_rig.diagnose.physics.model import Model
from samii_rig.diagnose.result import Gap
from samii_rig.fem.model import Fem
from samii_rig.fem.reduce import reduce
from samii_rig.identify.bootstrap import redraw
from samii_rig.model.modes import natural_frequencies, poles
from samii_rig.model.realise import realise
from samii_rig.model.sampled import filter_response
from samii_rig.model.tmm import Chain
from samii_rig.rig.load import parse
from samii_rig.rig.schema import Rig

LINE = {"D": 1.475e-5, "C_h": 2e-12, "omega": 150.0, "zeta": 0.2}
DAMPED = part("beam", **BEAM, tau=2e-4)
LINK = part("rigid_link", "link", L=0.1, r=0.05, m=0.3, I=0.002)
F = np.geomspace(0.2, 200.0, 40)
BAND = (0.5, 40.0)
LINES = np.geomspace(*BAND, 200)
NAMES = ("hydraulic_compressibility", "valve_dynamics", "actuator_lag", "torsional_compliance")
FEW = Effects(lambda: table_of(samii(), *BAND, *NAMES))


def lined(kind: str = "lumped_line", **values: float) -> Rig:
    at_source = {"source": "source"} if kind.endswith("line") else {}
    angle = {**ANGLE, "across": ["source", "line"]}
    moment = {"name": "M", "kind": "moment", "after": "line", "unit": "N m"}
    return made_of(
        DAMPED, SOURCE, part(kind, "line", **at_source, **values), LINK, base="clamped", tip="free",
        sensor=[angle, moment],
    )  # fmt: skip


def test_the_element_is_the_finite_elements_spring_damper_and_inertance() -> None:
    r = lined(**LINE)
    fem = Fem(r, elements=24)
    theirs = fem.response(F)
    size = np.abs(theirs) + 1e-3 * np.abs(theirs).max(axis=0)
    assert np.max(np.abs(Chain(r).response(F) - theirs) / size) < 5e-4
    whole = reduce(fem, fem.basis([fem.mechanism.joints["source"]]).modes.omega.size)
    assert np.max(np.abs(whole.response(F) - theirs) / size) < 1e-6


def test_its_modes_and_poles_are_those_of_the_finite_elements() -> None:
    r = lined(**LINE)
    fem = Fem(r, elements=24)
    found = natural_frequencies(r, 0.3, 80.0)
    assert found.count >= 3
    hz = fem.modes(found.count + found.below).frequency_hz[found.below :]
    np.testing.assert_allclose(hz, found.hz, rtol=5e-5)
    theirs, ours = fem.poles(), poles(r, 50.0)
    for p in ours.pole[ours.oscillating]:
        assert np.min(np.abs(theirs - p)) < 1e-4 * abs(p)


def test_a_line_that_resonates_far_above_is_an_oil_column() -> None:
    oil = {symbol: LINE[symbol] for symbol in ("D", "C_h")}
    high = Chain(lined(**{**LINE, "omega": 1e8})).response(F)
    np.testing.assert_allclose(high, Chain(lined("oil_column", **oil)).response(F), rtol=1e-5)


def test_its_gradients_agree_with_differences() -> None:
    chain = Chain(lined(**LINE))
    H, dH = chain.gradient(F)
    assert np.allclose(H, chain.response(F), rtol=1e-12)
    for symbol, value in LINE.items():
        key = ("line", symbol)
        step = 1e-5 * value
        up, down = (chain.with_values({key: value + x}).response(F) for x in (step, -step))
        exact = dH[..., chain.parameters.index(key)] * value
        size = np.abs(exact).max(axis=0)
        assert np.all(np.abs((up - down) / 2e-5 - exact) < 1e-6 * size), symbol


def test_it_has_a_realisation_in_time() -> None:
    r = lined(**LINE)
    made = realise(r.model_copy(update={"sensor": r.sensor[:1]}))
    f = np.geomspace(0.1, 50.0, 40)
    exact = Chain(r).response(f)[:, :1]
    exact = exact * filter_response(r.sensor[0], 2j * np.pi * f)[:, None, None]
    assert np.max(np.abs(made.response(f) / exact - 1)) < 5e-4
    assert made.poles.real.max() < 1e-9


def found_of(is_line: bool, values: list[float]):
    """The diagnosis of the rig with oil in it, as a line or as a plain compliance."""
    rig = samii()
    effect = next(
        e
        for e in FEW
        if ("hydraulic_compressibility", "joint_2_source") in e.names
        and (e.variant == "line") == is_line
    )
    model = Model(rig, [effect])
    at = grid(rig, LINES, np.arange(len(rig.sensor)), np.zeros(len(rig.sensor), dtype=np.int64))
    x = np.concatenate([np.zeros(model.n_nominal), np.log(values)])
    H = model.response(x, at)[:, :, None]
    measured = redraw(noiseless(rig, LINES), H, np.random.default_rng(3), 10)
    return diagnose([measured], rig, effects=FEW), model, x


@pytest.fixture(scope="module")
def line_found():
    return found_of(True, [8e-15, 600.0, 0.2])


def test_a_line_is_named_with_its_resonance(line_found) -> None:
    found, _, _ = line_found
    assert found.verdict == "named"
    (cause,) = found.causes
    assert (cause.physics, cause.site) == ("hydraulic_compressibility", "joint_2_source")
    assert cause.parameters["C_h"].value == pytest.approx(8e-15, rel=0.3)
    assert cause.parameters["omega"].value == pytest.approx(600.0, rel=0.1)
    assert cause.parameters["zeta"].value == pytest.approx(0.2, rel=0.5)


def test_the_new_rig_file_has_the_line(line_found) -> None:
    found, model, x = line_found
    again = parse(Rig, toml(found.rig), "diagnosed.toml")
    assert again == found.rig
    kinds = [e.kind for e in again.element]
    assert kinds[kinds.index("lumped_line") - 1] == "angular_velocity_source"
    truth = model.chain.with_values(model.values(x)).response(LINES)
    before, after = (np.abs(Chain(r).response(LINES) / truth - 1) for r in (samii(), again))
    assert np.median(after) < 0.2 * np.median(before)


def test_a_plain_compliance_stays_the_simplest_form() -> None:
    found, _, _ = found_of(False, [2e5, 0.05])
    assert found.verdict == "named"
    (cause,) = found.causes
    names = {(cause.physics, cause.site), *cause.equivalents}
    assert ("hydraulic_compressibility", "joint_2_source") in names
    assert "omega" not in cause.parameters


@pytest.mark.parametrize(
    ("gap", "said"),
    [
        (Gap(1.0, 0.9999, 1.0001), "they account for over 99.9 % of what the model missed"),
        (
            Gap(0.97, 0.95, 0.98),
            "they account for 97 % of what the model missed (90 % interval 95 % to 98 %)",
        ),
        (
            Gap(0.9996, 0.98, 1.0),
            "they account for over 99.9 % of what the model missed "
            "(90 % interval 98 % to over 99.9 %)",
        ),
    ],
)
def test_a_closed_gap_is_said_once_and_never_as_a_hundred_percent(gap, said):
    assert gap.words() == said


def test_where_no_gap_is_left_the_change_itself_is_told():
    rng = np.random.default_rng(5)
    floor = np.full(400, 4.0)
    noise = rng.chisquare(4, 400)
    before = 0.95 * noise / noise.mean() * 4.0  # what chance leaves on test lines: less than noise
    better, worse = gap_of(before, 0.9 * before, floor), gap_of(before, 1.1 * before, floor)
    assert 0 < better.low < better.value < better.high
    assert worse.low < worse.value < worse.high < 0
    assert better.value == pytest.approx(0.095)
    assert better.words() == "there the model had left no more than noise"


def test_an_interval_of_a_small_gap_has_the_direction_of_the_change():
    rng = np.random.default_rng(6)
    floor = np.full(400, 4.0)
    before = rng.chisquare(4, 400)
    before *= 1.01 * 4.0 / before.mean()  # of a hundredth of the noise half the draws see nothing
    found = gap_of(before, 0.8 * before, floor)
    assert 0 < found.low <= found.value <= found.high < np.inf
