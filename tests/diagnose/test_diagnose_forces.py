"""Forces that depend on amplitude in the likelihood of whole records."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from concealed_kit import SAMII
from cut_kit import DESIGN, cut_sweeps
from diagnose_kit import effect
from table_kit import table_of
from weak_forces_kit import weak_ones

from samii_rig.diagnose.data.measured import measured
from samii_rig.diagnose.diagnose import case_of, diagnose
from samii_rig.diagnose.fit.explanations import Explanation, Explanations
from samii_rig.diagnose.fit.record_search import RecordProblem
from samii_rig.diagnose.fit.records import Whole
from samii_rig.diagnose.fit.refit import Fitted, Problem
from samii_rig.diagnose.fit.screen import Screen
from samii_rig.diagnose.fit.stated import IN_DATA
from samii_rig.diagnose.forces import beside as beside_force
from samii_rig.diagnose.forces.fits import MOST_MARCHED, ForceFits
from samii_rig.diagnose.forces.laws import CLIPPED
from samii_rig.diagnose.forces.model import ForceModel
from samii_rig.diagnose.forces.problem import ForceProblem
from samii_rig.diagnose.forces.search import ForceSearch, compete_on_records
from samii_rig.diagnose.forces.way import Ways
from samii_rig.diagnose.physics.effect import Effect
from samii_rig.diagnose.physics.grid import grid
from samii_rig.diagnose.physics.model import Model
from samii_rig.diagnose.result import Diagnosis
from samii_rig.diagnose.verdict import by_line
from samii_rig.diagnose.verdict.by_record import on_records
from samii_rig.diagnose.verdict.force_words import distorted
from samii_rig.diagnose.verdict.judge import _is_insignificant
from samii_rig.errors import InputError
from samii_rig.record.importer import import_file
from samii_rig.record.maps import load_map
from samii_rig.rig.load import load_rig
from samii_rig.signal.estimate import estimate
from samii_rig.types import Recording

# One level alone, short: every response and every search is what takes the time here.
ONE = replace(DESIGN, levels=(1.0,), burst=18.0, high_hz=20.0)
FEW = ("actuator_lag", "transport_delay", "added_mass")
HARD = 3e7  # N m/rad^3 at joint_1, some 40 noise units


def found_in(runs: list[Recording]) -> Diagnosis:
    """With a table of few linear effects, and all forces."""
    few = table_of(SAMII, 0.5, 20.0, *FEW)
    return diagnose(estimate(runs), SAMII, runs=runs, effects=few)


@pytest.mark.slow  # a minute on a loaded machine
def test_a_hardening_joint_is_named_from_one_sweep_though_a_column_stands_late(tmp_path: Path):
    """Of a sweep that ends with its record. The column alone is a hundred times what the force is,
    and no place for it."""
    (run,) = cut_sweeps(tmp_path, f"cubic_stiffness joint_1 k3={HARD:g}", design=ONE)
    values, late = run.values.copy(), run.column("a_2")
    values[:, late] = np.roll(values[:, late], 3)
    few = table_of(SAMII, 0.5, 20.0, *FEW, "column_shifted")
    runs = [replace(run, values=values)]
    found = diagnose(estimate(runs), SAMII, runs=runs, effects=few)
    assert found.verdict == "named"
    (cause,) = found.causes
    assert (cause.physics, cause.site) == ("cubic_stiffness", "joint_1")
    k3 = cause.parameters["k3"]
    assert k3.low < k3.value < k3.high
    assert k3.value == pytest.approx(HARD, abs=1.5 * (k3.high - k3.low))
    assert found.with_causes[0] < found.threshold < found.nominal[0]
    assert any(words.startswith("a_2 stands") for words in found.not_physics)


def test_a_valve_that_lags_is_no_force(tmp_path: Path):
    found = found_in(cut_sweeps(tmp_path, "actuator_lag joint_2_source p=150", design=ONE))
    assert [c.physics for c in found.causes] == ["actuator_lag"]


@pytest.fixture(scope="module")
def nothing(tmp_path_factory: pytest.TempPathFactory) -> list[Recording]:
    return cut_sweeps(tmp_path_factory.mktemp("nothing"), design=ONE)


def test_where_nothing_is_missing_no_force_is(nothing: list[Recording]):
    found = found_in(nothing)
    assert found.verdict == "no_mismatch"
    assert found.causes == ()


def test_linear_models_are_weighed_alike_with_and_without_the_lines_no_model_explains(
    nothing: list[Recording],
):
    whole = Whole.of(nothing, SAMII).by_level()
    model = Model(SAMII)
    none = Fitted(model, np.zeros(model.n), 0.0, 0.0, np.zeros((0, model.n)), np.eye(model.n))
    lines = measured(estimate(nothing), SAMII)
    lines_problem = Problem.of(lines, grid(SAMII, lines.frequency, lines.sensor, lines.actuator))
    few = RecordProblem.about(whole, none, lines_problem)
    every = ForceProblem.near(whole, none, lines_problem, Ways())
    chi2 = np.array(
        [
            [float(np.sum(problem.residual(h) ** 2)) for problem in (few, every)]
            for h in (model.response(x, few.at) for x in (none.x, none.x + 1e-3))
        ]
    )
    # A disturbance of less than 2 % of a block's power is left out of the quadratic form alone.
    assert chi2[0, 1] - chi2[1, 1] == pytest.approx(chi2[0, 0] - chi2[1, 0], rel=1e-3)
    assert chi2[0, 1] == pytest.approx(chi2[0, 0] + few.reduced.inside[0], rel=0.02)


def test_both_parts_of_the_lines_are_joined_again(nothing: list[Recording]) -> None:
    """Products with what a fit leaves are those of whitened lines."""
    search = forces_of(nothing)
    complete, screen = search.problem.complete, Screen.of(search.problem, search.nominal.fitted)
    rows = complete.rows.e.size * 2 + len(complete.factor)
    parts = np.column_stack([screen.residual(), screen.directions])[:rows]
    rng = np.random.default_rng(4)
    e = rng.normal(size=(2, *complete.rows.e.shape)) * np.abs(complete.rows.e)
    lines = e[0] + 1j * e[1]
    want = complete.split(lines) @ parts
    joined, white = complete.joined(parts), complete.white(lines)
    got = np.einsum("nq,nqj->j", white.conj(), joined).real
    # A disturbance of less than 2 % of a block's power is left out of the quadratic form alone.
    np.testing.assert_allclose(got, want, rtol=3e-2)
    assert np.sum(np.abs(white) ** 2) == pytest.approx(np.sum(complete.split(lines) ** 2), rel=1e-2)


def test_a_weak_force_does_to_first_order_what_it_does_in_time(nothing: list[Recording]) -> None:
    for law, _, first_order, in_time in weak_ones(forces_of(nothing)):
        # Harmonics above the third fold back at the low rate.
        assert in_time == pytest.approx(first_order, rel=0.2), law.tag


def test_no_dead_band_is_narrower_than_a_step_of_the_commands_converter(
    nothing: list[Recording],
) -> None:
    search = forces_of(nothing)
    (dead,) = (e for e in search.forces if e.physics == "valve_deadband")
    step = search.rig.actuator[0].resolution
    assert dead.unknowns[0].low == step < dead.unknowns[0].high


def forces_of(runs: list[Recording]) -> ForceSearch:
    few = table_of(SAMII, 0.5, 20.0, *FEW)
    linear = on_records(case_of(estimate(runs), SAMII, None, few, runs))
    assert linear is not None
    return ForceSearch(linear)


@pytest.mark.slow  # a minute on a loaded machine; trials of two effects show the same
def test_a_force_and_a_linear_effect_are_both_named(tmp_path: Path) -> None:
    found = found_in(
        cut_sweeps(
            tmp_path,
            "cubic_stiffness joint_1 k3=1e8",
            "transport_delay joint_2_source tau=0.002",
            design=ONE,
        )
    )
    named = {(c.physics, c.site) for c in found.causes}
    assert named == {("cubic_stiffness", "joint_1"), ("transport_delay", "joint_2_source")}
    assert found.with_causes[0] < found.threshold


def test_without_recordings_levels_that_differ_are_unknown_and_say_what_is_asked_for(
    tmp_path: Path,
) -> None:
    runs = cut_sweeps(
        tmp_path, "cubic_stiffness joint_1 k3=3e8", design=replace(ONE, levels=(0.4, 1.0))
    )
    few = table_of(SAMII, 0.5, 20.0, *FEW)
    found = diagnose(estimate(runs), SAMII, effects=few)
    assert found.verdict == "unknown"
    assert found.causes == ()
    assert by_line.DIFFER in found.not_physics


def test_the_lines_that_a_multisine_leaves_silent_are_told(nothing: list[Recording]) -> None:
    (one,) = estimate(nothing)
    silent = np.zeros_like(one.H[:, :, 0], dtype=float)
    odd = replace(one, level=0.5, level_unit="V", odd=silent + 0.03, even=silent)
    assert distorted([odd]) == ["odd distortion of 3 % at 0.5 V", "even distortion of 0 % at 0.5 V"]


def test_levels_that_differ_are_told_without_a_model(nothing: list[Recording]) -> None:
    (one,) = estimate(nothing)
    lower = replace(one, level=one.level / 2)
    alike = measured([one, lower], SAMII)
    other = measured([one, replace(lower, H=lower.H * 1.2)], SAMII)
    assert alike.differing() < 1e-6
    assert other.depends_on_level()
    assert np.isnan(alike.take(alike.level == 0).differing())


@pytest.mark.parametrize(("gained", "told"), [(14.0, False), (60.0, True)])
def test_a_linear_effect_beside_a_force_must_show_in_the_data(gained: float, told: bool) -> None:
    force = Effect("coulomb_friction", "joint_2", force=object())  # type: ignore[arg-type]
    beside = Effect("added_mass", "beam")
    one = SimpleNamespace(key=frozenset({force.key}), effects=(force,), fitted=fit_of(1000.0))
    both = SimpleNamespace(
        key=frozenset({force.key, beside.key}),
        effects=(force, beside),
        fitted=fit_of(1000.0 - gained),
    )
    search = SimpleNamespace(
        found={one.key: one},
        overdispersion=1.0,
        critical_value_of=lambda _: IN_DATA,
        nominal=SimpleNamespace(effects=(), fitted=fit_of(5000.0)),
        ratio=lambda _: 1.0,
        spread=1e-3,
    )
    assert _is_insignificant(search, both) is not told


@pytest.mark.parametrize(
    ("better", "rough", "told"),
    [(2000.0, 0.05, False), (6000.0, 0.05, True), (2000.0, 0.0, True)],
)
def test_several_effects_must_outdo_a_law_by_more_than_it_is_off(
    better: float, rough: float, told: bool
) -> None:
    loss = Effect("structural_damping", "beam", rough=rough)
    a, b = Effect("torsional_compliance", "clamp"), Effect("viscous_damping", "joint_1")
    one = SimpleNamespace(key=frozenset({loss.key}), effects=(loss,), fitted=fit_of(4500.0))
    both = SimpleNamespace(
        key=frozenset({a.key, b.key}), effects=(a, b), fitted=fit_of(4500.0 - better)
    )
    without = SimpleNamespace(effects=(a,), fitted=fit_of(1e5))
    search = SimpleNamespace(
        found={one.key: one},
        overdispersion=1.0,
        critical_value_of=lambda _: IN_DATA,
        nominal=SimpleNamespace(fitted=fit_of(1.6e6)),
        without=lambda _e, _i: without,
    )
    assert _is_insignificant(search, both) is not told


def fit_of(chi2: float) -> SimpleNamespace:
    return SimpleNamespace(chi2=chi2)


def test_the_real_motor_has_dry_friction(recordings: Path) -> None:
    rig = load_rig("sflr")[0]
    off = ("clamp", "beam", "accelerometer_mass")
    motor = rig.model_copy(
        update={
            "element": tuple(e for e in rig.element if e.name not in off),
            "sensor": tuple(s for s in rig.sensor if s.name == "theta"),
            "limit": (),
        }
    )
    band = (1.0, 6.0)  # above it the drive's gain falls with the amplitude, which friction cannot
    runs = [
        import_file(f, *load_map("sflr_motor"))
        for n in (50, 100, 150)
        for f in sorted(recordings.glob(f"*motor-only_swept*amp-{n}_*"))
    ]
    rivals = table_of(motor, *band, "viscous_damping", "actuator_lag")
    linear = on_records(case_of(estimate(runs, band=band), motor, band, rivals, runs))
    assert linear is not None
    linear.run(briefly=True)
    search = compete_on_records(linear)
    assert search is not None
    best = search.ranked()[0]
    force = next(e for e in best.effects if e.force is not None)
    assert force.physics == "coulomb_friction"
    # Two fifths and more of what the nominal model leaves over the noise.
    assert search.ratio(best.fitted) - 1 < 0.6 * (search.ratio(search.nominal.fitted) - 1)


def test_a_force_is_held_against_what_is_wrong_with_the_data_alone():
    """A measured command hides friction of 160 noise units; a slip of the valve mimics both."""
    unheld, slip = effect("input_not_held", "v_2"), effect("velocity_feedback", "joint_2_source")
    fitted = SimpleNamespace(model=None)
    nominal, mistake, both = (
        Explanation(some, fitted, weight)
        for some, weight in (((), -1e6), ((unheld,), -500.0), ((unheld, slip), -200.0))
    )
    linear = object.__new__(Explanations)
    linear.found = {e.key: e for e in (nominal, mistake, both)}

    class Kept(ForceSearch):
        def use(self, table):
            pass

        def _about(self, fitted):
            pass

        def _only(self, some):
            self.kept = list(some)

        def _where_nothing_was_fitted(self, best):
            pass

    search = object.__new__(Kept)
    search.linear, search.table = linear, ()
    search.__post_init__()
    assert search.kept == [nominal, mistake, both]


def test_a_force_that_changes_nothing_leaves_what_the_linear_rig_does(
    nothing: list[Recording],
) -> None:
    """A limit that no command comes near."""
    search = forces_of(nothing)
    (clipped,) = (e for e in search.table if e.force is not None and e.force.law is CLIPPED)
    end = search.refitted_from(
        (clipped,), np.append(search.nominal.fitted.x, math.log(1e3 * clipped.unknowns[0].high))
    )
    assert end is not None
    assert end.chi2 == pytest.approx(search.nominal.fitted.chi2, rel=1e-6)


@pytest.mark.parametrize(("by_itself", "first"), [(-283_482.7, -4_433.8), (-4_430.0, -4_430.0)])
def test_a_force_that_stopped_elsewhere_is_refitted_from_where_it_stands_beside_another(
    by_itself: float, first: float
) -> None:
    """By itself it had ended far off, and so an oscillator beside it seemed to be needed. What had
    ended better stays; what seemed better through a chain that was not its own does not."""
    force = Effect("cubic_stiffness", "spring", force=object())  # type: ignore[arg-type]
    beside = Effect("attached_oscillator", "mass")
    ends = iter((-4_420.0, -4_433.8, -4_433.8))

    # An oscillator takes the place of a parameter of the rig file, which is back without it.
    keys = {force.key: (("mass", "m"), ("spring", "k")), beside.key: (("spring", "k"),)}

    def model_of(effects: tuple[Effect, ...]) -> ForceModel:
        model = object.__new__(ForceModel)
        model.keys = keys[effects[0].key]
        model.n_nominal = len(model.keys)
        model.own = lambda i: range(model.n_nominal + i, model.n_nominal + i + 1)  # type: ignore[method-assign]
        return model

    def fit(weight: float, x: float, *effects: Effect) -> SimpleNamespace:
        model = model_of(effects)
        size = model.n_nominal + len(effects)
        return SimpleNamespace(model=model, weight=weight, x=np.full(size, x))

    def ended(weight: float, *effects: Effect) -> Explanation:
        return Explanation(effects, fit(weight, 0.0, *effects), weight)  # type: ignore[arg-type]

    class Kept(ForceSearch):
        exhausted = False  # type: ignore[assignment]

        def refitted_from(self, effects, start, *_, **__):  # type: ignore[no-untyped-def, override]
            assert effects == (force,)
            assert len(start) == 3
            assert not self._ways  # the chain through which it acts is made anew
            self._ways[b""] = None
            return fit(next(ends), float(start[0]) + 1.0, force)

        def model(self, effects: tuple[Effect, ...]) -> ForceModel:
            return model_of(effects)

        def weigh(self, effects: tuple[Effect, ...], fitted: Fitted) -> float:
            return float(fitted.weight)  # type: ignore[attr-defined]

    search = object.__new__(Kept)
    search._ways = {}  # type: ignore[assignment]
    both, alone = ended(-4_429.0, beside, force), ended(by_itself, force)
    search.found = {e.key: e for e in (both, alone)}
    search._alone()
    assert search.found[alone.key].weight == first


def test_beside_a_force_all_compete_that_do_there_as_well_as_what_was_found_without_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A lag had fitted best without the force, where a shift of the columns is right. What the
    linear search could not tell from the lag competes, whatever a screen says of it."""
    force = Effect("cubic_stiffness", "spring", force=object())  # type: ignore[arg-type]
    lag, delay = Effect("actuator_lag", "motor"), Effect("transport_delay", "motor")
    shift, other = (Effect("columns_shifted", "v", variant=f"{n}") for n in (2, 3))
    costs = {lag.key: 1269.0, shift.key: 1270.0, other.key: 3000.0, delay.key: 1271.0}

    def fit(effects: tuple[Effect, ...]) -> SimpleNamespace:
        cost = costs[effects[0].key] if effects else 1.5e4
        return SimpleNamespace(cost=cost, effects=effects)

    def explained(*effects: Effect, weight: float = 0.0) -> SimpleNamespace:
        key = frozenset(e.key for e in effects)
        return SimpleNamespace(effects=effects, fitted=fit(effects), key=key, weight=weight)

    class Plain:
        problem, model = None, None

        def without_refit(self, rest: SimpleNamespace, i: int) -> SimpleNamespace:
            assert rest.effects[i] is lag
            return explained()

        def refitted(self, effects: tuple[Effect, ...], *_: object) -> SimpleNamespace:
            return fit(effects)

    tried: list[tuple[Effect, ...]] = []

    class Kept(ForceSearch):
        def ranked(self) -> list[SimpleNamespace]:  # type: ignore[override]
            return [SimpleNamespace(effects=(lag, force))]

        def linear_part(self, best: object) -> tuple[Plain, SimpleNamespace]:  # type: ignore[override]
            del best
            return Plain(), explained(lag)

        def each(self, some, _name):  # type: ignore[no-untyped-def, override]
            return some

        def _beside_force(self, effects, plain, best) -> None:  # type: ignore[no-untyped-def, override]
            del best
            assert plain.effects == effects[:1]
            tried.append(effects)

    monkeypatch.setattr(beside_force.Screen, "of", lambda *_: None)
    found = [(100.0, e, [()]) for e in (lag, shift, other)]
    monkeypatch.setattr(beside_force, "ranking", lambda *_: found)
    search = object.__new__(Kept)
    before = [explained(lag), explained(delay, weight=-1.0), explained(other, weight=-900.0)]
    search.linear = SimpleNamespace(  # type: ignore[assignment]
        table=(), found={e.key: e for e in before}, ranked=lambda: before
    )
    search._rivals()
    assert tried == [(shift, force), (delay, force)]


def test_a_refit_by_differences_that_begins_where_no_rig_is_ends_in_none() -> None:
    def response(_x: object, _at: object) -> None:
        raise InputError("rig", "element", "pole at 1 rad/s", "a stable chain")

    nothing = SimpleNamespace(goal=np.zeros(4), at=None, residual=np.real)
    ways = SimpleNamespace(clear=lambda: None, marched=0)
    levels = SimpleNamespace(
        records=SimpleNamespace(pieces=(SimpleNamespace(r=np.zeros(4)),)), every=1
    )
    search = SimpleNamespace(_force_problem=nothing, _ways=ways, levels=levels)
    bounds = {"lower": -np.ones(2), "upper": np.ones(2)}
    model = SimpleNamespace(n=2, n_nominal=1, prior=np.ones(2), response=response, **bounds)
    assert ForceFits.refitted_exactly(search, model, np.zeros(2)) is None


@pytest.mark.parametrize(("marched", "end"), [(0, 0.0), (MOST_MARCHED, 3.0)])
def test_a_refit_by_differences_ends_with_what_a_person_waits_for(marched: int, end: float) -> None:
    """From far above the root of exp(x) - 1, where Newton's steps go down by one."""

    def response(x: np.ndarray, _at: object) -> np.ndarray:
        return np.exp(x[:1, None]).astype(complex)

    nothing = SimpleNamespace(
        goal=np.zeros(1), at=None,
        residual=lambda h: 1e3 * (h[0].real - 1.0), whiten=lambda dh: 1e3 * dh[0].real,
    )  # fmt: skip
    ways = SimpleNamespace(clear=lambda: None, marched=marched)
    pieces = (SimpleNamespace(r=np.zeros(100)),)
    levels = SimpleNamespace(records=SimpleNamespace(pieces=pieces), every=1)
    search = SimpleNamespace(_force_problem=nothing, _ways=ways, levels=levels)
    bounds = {"lower": -9 * np.ones(1), "upper": 9 * np.ones(1)}
    model = SimpleNamespace(n=1, n_nominal=1, prior=np.ones(1), response=response, **bounds)
    found = ForceFits.refitted_exactly(search, model, np.array([4.0]))
    assert found is not None
    assert found.x[0] == pytest.approx(end, abs=0.1)
