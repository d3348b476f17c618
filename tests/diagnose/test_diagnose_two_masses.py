"""Two masses integrated by themselves: strong forces, and what passes for noise in one record."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from table_kit import table_of
from two_masses_kit import (
    CORNER,
    GAIN,
    K1,
    K2,
    M1,
    M2,
    RATE,
    RIG,
    diagnosed,
    random_command,
    recorded,
)

from samii_rig.diagnose.diagnose import case_of, diagnose
from samii_rig.diagnose.fit.classes import Class
from samii_rig.diagnose.forces.search import ForceSearch
from samii_rig.diagnose.forces.variation import Uneven
from samii_rig.diagnose.physics.effect import Effect
from samii_rig.diagnose.result import Cause, Diagnosis, Moved
from samii_rig.diagnose.verdict import by_record, stages
from samii_rig.diagnose.verdict.by_record import on_records
from samii_rig.diagnose.verdict.judge import Judgement
from samii_rig.rig.schema import Rig, parameters
from samii_rig.signal.estimate import estimate
from samii_rig.types import Float

V = random_command(3000, 1.0, 1)
K3 = 1.5e9  # N/m^3: at 3.4 mm as much as the spring itself


@pytest.fixture(scope="module")
def nothing() -> Diagnosis:
    return diagnosed(recorded(V, 1))


def noisy(found: Diagnosis) -> list[str]:
    return [words for words in found.not_physics if "times the noise" in words]


def test_noise_that_is_more_than_the_sensors_is_no_force() -> None:
    """Ten times as much of both, as on a floor that shakes the meter: every force was tried as one
    that passes for it."""
    run = recorded(V, 4)
    more = np.random.default_rng(8).standard_normal((V.size, 2)) * [10e-6, 0.2]
    values = run.values.copy()
    values[:, 1:] += more
    found = diagnosed(replace(run, values=values), effects=table_of(RIG, 0.5, 40.0, "added_mass"))
    assert found.verdict == "no_mismatch"
    assert len(noisy(found)) == 1


def test_nothing_is_missing_and_the_noise_is_the_sensors_own(nothing: Diagnosis) -> None:
    assert nothing.verdict == "no_mismatch"
    assert noisy(nothing) == []


def test_so_where_nothing_is_looked_for() -> None:
    assert diagnosed(recorded(V[:1500], 1), effects=()).verdict == "no_mismatch"


def test_a_band_may_begin_at_0_hz() -> None:
    run = recorded(V[:1500], 1)
    found = diagnose(estimate([run], gaps="auto"), RIG, band=(0.0, 40.0), runs=[run])
    assert found.verdict == "no_mismatch"


def test_that_no_reference_was_recorded_is_the_last_to_be_said(nothing: Diagnosis) -> None:
    assert nothing.not_physics[-1].startswith("no reference was recorded")


def test_what_could_hide_in_a_weighed_mass_is_six_of_its_tolerances(nothing: Diagnosis) -> None:
    sizes = {h.site: h.size for h in nothing.could_hide if h.physics == "added_mass"}
    masses = {e.name: e.m for e in RIG.element if e.kind == "mass"}
    for name, mass in masses.items():
        size = sizes[name]
        assert size is not None
        assert size >= 6 * mass.tolerance * mass.value * (1 - 1e-9)
        assert size < 0.2 * mass.value


def surer(rig: Rig, **tolerances: float) -> Rig:
    """With smaller tolerances of elements' first parameters."""
    every = []
    for e in rig.element:
        if e.name in tolerances:
            symbol, p = next(iter(parameters(e).items()))
            p = p.model_copy(update={"tolerance": tolerances[e.name]})
            e = e.model_copy(update={symbol: p})
        every.append(e)
    return rig.model_copy(update={"element": tuple(every)})


def slow_command(seed: int) -> Float:
    """(8000,) V, random below both modes; from its largest on, so that both ring from there."""
    f = np.fft.rfftfreq(8000, 1 / RATE)
    turn = np.exp(2j * np.pi * np.random.default_rng(seed).random(f.size))
    v = np.fft.irfft(np.where((f > 0.5) & (f < 6.0), turn, 0.0), 8000)
    v = np.roll(v, -int(np.argmax(np.abs(v))))
    return np.asarray(np.round(v / np.std(v) / 0.3e-3) * 0.3e-3)


@pytest.mark.parametrize("seed", [1, 2])
def test_nothing_is_missing_where_modes_above_the_band_ring_from_the_start(seed: int) -> None:
    """What is fitted within the band leaves them anywhere in their tolerances."""
    effects = table_of(RIG, 0.5, 40.0, "added_mass")
    assert diagnosed(recorded(slow_command(seed), seed), effects=effects).verdict == "no_mismatch"


def test_what_shows_in_such_modes_alone_is_found() -> None:
    """Ten grams more, of parameters that are known to a thousandth."""
    known = {"spring_1": K1, "spring_2": K2, "mass_1": M1, "mass_2": M2, "coil": GAIN}
    every = []
    for e in RIG.element:
        symbol, p = next(iter(parameters(e).items()))
        p = p.model_copy(update={"value": known[e.name], "tolerance": 1e-3})
        every.append(e.model_copy(update={symbol: p}))
    rig = RIG.model_copy(update={"element": tuple(every)})
    effects = table_of(rig, 0.5, 40.0, "added_mass")
    found = diagnosed(recorded(slow_command(1), 1, more=0.01), rig=rig, effects=effects)
    (cause,) = found.causes
    assert (found.verdict, cause.physics, cause.site) == ("named", "added_mass", "mass_2")
    assert cause.parameters["m"].low < 0.01 < cause.parameters["m"].high


def test_a_lag_that_is_longer_than_the_file_says_is_one_cause() -> None:
    """Of 120 Hz, stated as 480: another in series and none of the file's would do the same."""
    coil = next(e for e in RIG.element if e.kind == "force_source")
    stated = coil.model_copy(
        update={"p": coil.p.model_copy(update={"value": 4 * CORNER, "tolerance": 0.1})}
    )
    rig = RIG.model_copy(update={"element": tuple(stated if e is coil else e for e in RIG.element)})
    found = diagnosed(recorded(V, 1), rig=rig)
    assert found.verdict == "named"
    (cause,) = found.causes
    assert (cause.physics, cause.site) == ("actuator_lag", coil.name)
    assert cause.parameters["p ratio"].low < 0.25 < cause.parameters["p ratio"].high


def test_a_gap_in_which_nothing_acts_is_play() -> None:
    gap = 4e-4
    found = diagnosed(recorded(V[:2000], 1, gap=gap))
    (cause,) = found.causes
    assert (found.verdict, cause.physics, cause.site) == ("named", "backlash", "spring_2")
    width = cause.parameters["width"]
    assert width.value == pytest.approx(gap, rel=0.05)


@pytest.mark.parametrize(("gap", "least", "most"), [(0.0, 0.8, 1.2), (4e-5, 0.005, 0.05)])
@pytest.mark.parametrize("levels", [(1.0,), (1.0, 2.0)])
def test_repeats_scatter_by_noise_and_not_by_play_that_passes_for_it(gap, least, most, levels):
    v = V[:1500]
    runs = [recorded(x * v, int(9 * x) + i, gap=gap) for x in levels for i in (1, 2)]
    search = on_records(case_of(estimate(runs, gaps="auto"), RIG, None, (), runs))
    assert search is not None
    whole = search.whole.by_level().with_harmonics()
    fitted = search.nominal.fitted
    ratio = whole.scatter(fitted, whole.about(fitted))
    assert ratio.shape == (2,)
    assert np.all((ratio > least) & (ratio < most))


def test_friction_that_gives_before_it_slides_has_both_its_values() -> None:
    """By Bouc's and Wen's law, which gives less stiffly backwards, k is 30 % high."""
    T_c, k = 2.0, 4e4  # slides after 0.05 mm of 2 mm
    found = diagnosed(recorded(V[:2000], 1, dry=(T_c, k)), effects=())
    (cause,) = found.causes
    assert (found.verdict, cause.physics, cause.site) == ("named", "coulomb_friction", "spring_1")
    assert cause.parameters["T_c"].value == pytest.approx(T_c, rel=0.05)
    assert cause.parameters["k"].low < k < cause.parameters["k"].high < 1.15 * k


@pytest.mark.parametrize(("tolerance", "told"), [(0.006, False), (0.0035, True)])
def test_a_number_of_the_rig_file_is_wrong_from_five_tolerances_on(tolerance, told) -> None:
    """The second spring is 2 % softer than stated: 3.4 tolerances, or 5.8."""
    rig = surer(RIG, mass_1=1e-3, mass_2=1e-3, spring_2=tolerance)
    found = diagnosed(recorded(V, 5), effects=(), rig=rig)
    assert found.verdict == ("unknown" if told else "no_mismatch")
    assert [one.parameter for one in found.exact] == (["spring_2.k"] if told else [])
    for one in found.exact:
        assert one.value.low is not None
        assert one.value.high is not None
        assert one.value.low < K2 < one.value.high < one.stated
        what, how_well, next_ = found.lines()
        assert what.startswith("A number of the rig file is wrong: spring_2.k = ")
        assert "the model with it has" in how_well
        assert "measure spring_2.k" in next_


def test_numbers_that_are_wrong_are_fitted_without_what_the_file_says() -> None:
    """Both springs are 2 % off, 5.7 and 5.8 tolerances."""
    rig = surer(RIG, mass_1=1e-3, mass_2=1e-3, spring_1=0.0035, spring_2=0.0035)
    found = diagnosed(recorded(V, 5), effects=(), rig=rig)
    assert found.verdict == "unknown"
    values = {one.parameter: one.value for one in found.exact}
    assert set(values) == {"spring_1.k", "spring_2.k"}
    for name, true in {"spring_1.k": K1, "spring_2.k": K2}.items():
        assert values[name].value == pytest.approx(true, rel=2e-3)
        assert abs(next(m.sigmas for m in found.moved if m.parameter == name)) > 5
    what, _, next_ = found.lines()
    assert what.startswith("Two numbers of the rig file are wrong: ")
    assert "measure spring_" in next_


@pytest.mark.parametrize("bent", [False, True])
def test_an_uneven_spring_is_no_answer_but_for_the_geometry_of_a_bend(
    bent: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(by_record, "uneven_spring", lambda _: Uneven("spring_1", 100.0, bent))
    found = diagnosed(recorded(V[:1500], 1), effects=())
    assert found.verdict == ("no_mismatch" if bent else "unknown")
    (words,) = [w for w in found.not_physics if "10 sigma" in w]
    assert ("bent chain" in words) == bent


def test_nothing_is_missing_is_not_said_where_a_force_explains_some_lines(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    force = Effect("coulomb_friction", "spring_1")
    monkeypatch.setattr(ForceSearch, "uneven", (force, 400.0))
    found = diagnosed(recorded(V[:1500], 1), effects=())
    assert found.verdict == "unknown"
    assert any("explains 20 sigma, but not of all lines alike" in w for w in found.not_physics)


@pytest.mark.parametrize(("fall", "verdict"), [(400.0, "unknown"), (30.0, "named")])
def test_a_cause_is_not_told_that_explains_less_than_a_force_at_some_lines(
    fall: float, verdict: str
) -> None:
    judged = SimpleNamespace(
        verdict="named", varies=None, evidence=SimpleNamespace(drop=5.0),
        best=SimpleNamespace(effects=(Effect("torsional_compliance", "spring_1"),)),
    )  # fmt: skip
    pieces = [SimpleNamespace(edges=((3, 0),))]  # also where an input jumps
    ends = iter([SimpleNamespace(chi2=1043.0), SimpleNamespace(chi2=1000.0)])
    forces = SimpleNamespace(
        nominal=SimpleNamespace(effects=()),
        refitted=lambda *_, **__: next(ends),
        uneven=(Effect("coulomb_friction", "spring_1"), fall),
        levels=SimpleNamespace(records=SimpleNamespace(pieces=pieces)),
    )
    looked = SimpleNamespace(judged=judged, remarks=())
    changed = []

    def unknown(one: object) -> SimpleNamespace:
        changed.append(one)
        return SimpleNamespace(judged=SimpleNamespace(verdict="unknown"), remarks=())

    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(by_record, "_unknown", unknown)
        patched.setattr(by_record, "replace", lambda one, **kept: one)
        found = by_record._or_uneven(forces, looked)
    assert found.judged.verdict == verdict
    assert bool(changed) == (verdict == "unknown")


@pytest.mark.parametrize(
    ("said", "away", "told"),
    [
        ("named", 5.5, "ambiguous"),
        ("ambiguous", -5.5, "ambiguous"),
        ("named", 4.5, "named"),
        ("no_mismatch", 5.5, "no_mismatch"),
    ],
)
def test_a_cause_that_needs_a_number_off_the_file_is_not_sure(said, away, told) -> None:
    model = SimpleNamespace(
        n_nominal=2, prior=np.array([0.1, 0.2]), keys=(("spring_1", "k"), ("spring_1", "c"))
    )
    fitted = SimpleNamespace(model=model, x=np.array([0.1 * away, 0.2]))
    best = SimpleNamespace(fitted=fitted, effects=())
    judged = Judgement(said, (Class((best,), (0.0,), 1.0),), 0.0, 0.9, None, 1.0)
    less, words = stages._beyond_the_file(judged)
    assert less.verdict == told
    assert (words is not None) == (abs(away) > 5 and said != "no_mismatch")
    if words is not None:
        assert words[0].startswith("spring_1.k is 5.5 tolerances off the rig file")
        assert words[1].startswith("measure spring_1.k, ")


def test_a_spring_that_hardens_as_much_as_it_is_stiff_has_its_value() -> None:
    """Its force depends on the chain's parameters as much as the linear motion does."""
    few = table_of(RIG, 0.5, 40.0, "added_mass", "ground_spring")
    found = diagnosed(recorded(2 * V[:1500], 2, k3=K3), recorded(V[:1500], 3, k3=K3), effects=few)
    assert found.verdict == "named"
    (cause,) = found.causes
    assert (cause.physics, cause.site) == ("cubic_stiffness", "spring_1")
    k3 = cause.parameters["k3"]
    assert k3.value == pytest.approx(K3, rel=0.005)
    assert k3.low is not None
    assert k3.high is not None
    assert k3.low < K3 < k3.high


def test_what_a_meter_shows_of_an_input_at_rest_bends_no_spring() -> None:
    """A meter's offset of a third of the input: as a force it would be a preload of the spring."""
    few = table_of(RIG, 0.5, 40.0, "input_not_held")
    lead = np.zeros(int(0.2 * RIG.rate_hz))
    runs = []
    for seed, level in ((2, 2.0), (3, 1.0)):
        run = recorded(np.append(lead, level * V[:1200]), seed, k3=K3 / 10, meter=0.004)
        values = run.values.copy()
        values[:, 0] += 0.3 * np.std(2 * V)
        runs.append(replace(run, values=values))
    found = diagnosed(*runs, effects=few)
    (cause,) = found.causes
    assert (cause.physics, cause.site) == ("cubic_stiffness", "spring_1")
    assert cause.parameters["k3"].value == pytest.approx(K3 / 10, rel=0.05)


@pytest.mark.parametrize("part", [0.2, 0.04])
def test_a_gain_that_sags_in_one_record_is_never_taken_for_noise_in_silence(part: float) -> None:
    end = len(V) / RIG.rate_hz
    found = diagnosed(recorded(V, 3, gain=lambda t: 1 - part * t / end))
    (words,) = noisy(found)
    assert words.startswith("x_1 has ")
    assert found.verdict == ("unknown" if part > 0.1 else "no_mismatch")


def test_a_swinging_gain_fits_too_well_to_be_noise() -> None:
    found = diagnosed(recorded(V, 4, gain=lambda t: 1 + 0.1 * np.sin(2 * np.pi * 1.3 * t)))
    assert found.verdict == "unknown"
    assert found.chi2_per_dof < 1
    assert noisy(found)


def test_far_moved_parameters_and_partial_causes_are_said_in_words(nothing: Diagnosis) -> None:
    far = replace(nothing, moved=(Moved("spring_2.k", -4.2), Moved("mass_1.m", 1.1)))
    assert far.lines()[2].startswith("The fit moved spring_2.k by -4.2 of its tolerances: check it")
    near = replace(nothing, moved=(Moved("spring_2.k", -2.2),))
    assert "The fit moved" not in near.lines()[2]
    swing = Cause("stiffness_variation", "spring_1", 0.0004, (), {})
    partly = replace(nothing, verdict="ambiguous", causes=(swing,))
    assert partly.lines()[0].startswith("Much of what is missing goes as this would: ")
    assert partly.lines()[1].startswith("As the whole it is improbable (under 0.1 %); ")
    likely = replace(partly, causes=(replace(swing, probability=0.5),))
    assert likely.lines()[0].startswith("Most likely left out: ")
