"""A search that is led into a valley gets out of it: each of these once ended at a wrong answer."""

from dataclasses import replace
from itertools import product
from types import SimpleNamespace

import numpy as np
import pytest
from diagnose_kit import ALL, LINES, concealing, effect
from identify_kit import noiseless, samii
from table_kit import table_of

from samii_rig.diagnose.data.measured import measured
from samii_rig.diagnose.diagnose import diagnose, table
from samii_rig.diagnose.fit.classes import Class
from samii_rig.diagnose.fit.growing import PENALISED
from samii_rig.diagnose.fit.ranking import moved
from samii_rig.diagnose.fit.record_search import RecordSearch
from samii_rig.diagnose.fit.refit import profiled, refit
from samii_rig.diagnose.fit.search import Search
from samii_rig.diagnose.forces.search import ForceSearch
from samii_rig.diagnose.physics import channels
from samii_rig.diagnose.physics.channels import METERED
from samii_rig.diagnose.physics.grid import grid
from samii_rig.diagnose.physics.model import Model
from samii_rig.diagnose.verdict import by_record
from samii_rig.diagnose.verdict.judge import Judgement, _is_insignificant
from samii_rig.identify.bootstrap import redraw
from samii_rig.rig.load import load_rig
from samii_rig.rig.schema import parameters


def search_of(response, effects, rig=None):
    lines = measured([response], rig or samii())
    at = grid(rig or samii(), lines.frequency, lines.sensor, lines.actuator)
    return Search(rig or samii(), lines, at, effects)


def test_an_oscillator_is_tried_elsewhere_from_the_values_that_it_has_here():
    near, there = (effect("attached_oscillator", n) for n in ("link_0", "beam"))
    m, w, zeta = 0.1, 46.5, 0.034
    search = search_of(concealing((there, [m, w, zeta])), [near, there])
    # From its own start it ends in a valley 100 rad/s away.
    for one, start in ((near, [m, w, zeta]), (there, [m / 5, 145.0, zeta])):
        end = search.refitted((one,), search.nominal, np.log(start).tolist())
        search.keep((one,), end)
    before = search.found[frozenset({there.key})].fitted.cost
    here = search.found[frozenset({near.key})]
    assert before > here.fitted.cost + 1000
    search.exchange(here)
    assert search.found[frozenset({there.key})].fitted.cost < here.fitted.cost + 25


def test_what_the_nominal_parameters_hide_is_found_from_the_files_own():
    mass = effect("added_mass", "link_2", "added")
    search = search_of(concealing((mass, [1.17])), [e for e in ALL if e.physics == "added_mass"])
    straight = search._straight(search.nominal)
    assert straight.fitted.penalty == 0
    assert straight.fitted.cost > search.nominal.fitted.cost
    search.forward(straight, 30, again=True)
    assert mass.name in search.ranked()[0].effects[0].names


def test_they_are_tried_though_another_effect_seems_to_be_enough():
    """About nominal parameters at unlikely values what is missing may not be among the first, and
    what mimics it may leave no more than noise."""
    mass = effect("added_mass", "link_2", "added")
    search = search_of(concealing((mass, [1.17])), [mass])
    assert search.nominal.fitted.penalty > PENALISED * search.nominal.fitted.model.n_nominal
    search.keep((mass,), search.refitted((mass,), search.nominal, [np.log(1.17)]))
    best = search.ranked()[0]
    assert best.effects == (mass,)
    assert search._enough(best)
    assert search._bent(best)


def test_a_narrow_valley_that_bends_with_the_nominal_parameters_is_followed() -> None:
    """Of a cylinder whose support gives: beside its oil and its leak 1e-5 of the response are left,
    along which stiffness and damping change by factors."""
    rig, _ = load_rig("cylinder")
    f = np.geomspace(0.3, 50.0, 150)
    gives = next(e for e in table_of(rig, 0.3, 50.0, "translational_compliance"))
    model = Model(rig, (gives,))
    true = [3.456e8, 0.049]
    x = np.append(np.zeros(model.n_nominal), np.log(true))
    at = grid(rig, f, np.arange(len(rig.sensor)), np.zeros(len(rig.sensor), dtype=np.int64))
    exact = replace(noiseless(rig, f), H=model.response(x, at)[:, :, None])
    exact = replace(exact, covariance=1e-6 * exact.covariance)
    search = search_of(exact, [gives], rig)
    known = moved(search.nominal.fitted.model, search.nominal.fitted.x, model)
    each = [np.linspace(np.log(u.low), np.log(u.high), 12) for u in gives.unknowns]
    starts = [np.append(known, own) for own in product(*each)]
    found = profiled(model, search.problem, search.nominal.fitted, starts)
    assert found[0].cost < 0.5 * search.nominal.fitted.cost
    end = search.refitted_from((gives,), found[0].x)
    assert end is not None
    assert end.cost < 0.05 * search.nominal.fitted.cost
    np.testing.assert_allclose(np.exp(end.x[-2:]), true, rtol=0.3)


def test_nothing_hangs_on_a_rig_that_is_ten_times_as_heavy() -> None:
    for name in ("sflr", "samii", "two_masses"):
        rig, _ = load_rig(name)
        hung = table_of(rig, 0.5, 40.0, "attached_oscillator")
        bodies = [parameters(e) for e in rig.element]
        mass = sum(p["m"].value for p in bodies if "m" in p)
        mass += sum(p["mu"].value * p["L"].value for p in bodies if "mu" in p)
        assert hung
        assert all(e.unknowns[0].high <= 10 * mass * (1 + 1e-12) for e in hung)
        assert all(
            e.unknowns[0].low < s < e.unknowns[0].high for e in hung for s in e.unknowns[0].starts
        )


@pytest.mark.parametrize(("even", "verdict"), [(True, "named"), (False, "unknown")])
def test_what_an_effect_explains_at_some_lines_only_is_unknown(even: bool, verdict: str) -> None:
    hung = effect("attached_oscillator", "beam")
    nominal = SimpleNamespace(effects=(), key=frozenset())
    best = SimpleNamespace(effects=(hung,), key=frozenset([hung.key]), fitted=None)
    best.fitted = SimpleNamespace(model=SimpleNamespace(own=lambda _: ()))
    asked = []

    def evenly(before: object, after: object) -> bool:
        asked.append((before, after))
        return even

    judged = Judgement("named", (Class((best,), (0.0,), 1.0),), 0.0, 0.9, None, 1.0)
    forces = SimpleNamespace(explains_evenly=evenly)
    search = SimpleNamespace(found={nominal.key: nominal}, nominal=nominal)
    looked = by_record._Looked(judged, 2.0, 1.0, None)
    assert by_record._even(forces, search, looked).judged.verdict == verdict
    assert asked == [(nominal, best)]


@pytest.mark.parametrize(("left", "even"), [(5000.0, False), (5990.0, True)])
def test_lines_at_which_nothing_is_left_of_an_effect_do_not_judge_it(
    left: float, even: bool
) -> None:
    """A refit to more lines, of which a model leaves more than noise, may lose what is there."""
    ends = iter([SimpleNamespace(chi2=6000.0), SimpleNamespace(chi2=left)])
    forces = SimpleNamespace(
        refitted=lambda *_, **__: next(ends),
        critical_value=28.0,
        unexplained=lambda _: [],
        _even=lambda *_: 0.0,
    )
    base, best = SimpleNamespace(effects=()), SimpleNamespace(effects=("hung",))
    assert ForceSearch.explains_evenly(forces, base, best) is even


def of(chi2, *effects):
    """An explanation that leaves so much."""
    return SimpleNamespace(
        effects=effects,
        key=frozenset(e.key for e in effects),
        fitted=SimpleNamespace(chi2=chi2),
    )


def searched(found):
    """A search that found these, the first with nothing missing."""
    search = SimpleNamespace(
        found={e.key: e for e in found},
        critical_value_of=lambda _: 28.0,
        overdispersion=1.0,
        nominal=found[0],
        without=lambda e, i: search.found[e.key - {e.effects[i].key}],
    )
    return search


def test_a_mistake_of_the_data_is_no_effect_that_may_be_too_little_beside_another():
    """Removed, it costs little chi-square but unlikely nominal parameters; the cause beside it is
    the answer all the same, and no less probable one."""

    mistake, inertia, lag = (
        SimpleNamespace(key=key, physical=key != "mistake", force=None, rough=0.0)
        for key in ("mistake", "inertia", "lag")
    )
    fewer = [of(2000.0), of(900.0, mistake), of(583.0, inertia), of(583.0, lag)]
    search = searched(fewer)
    assert not _is_insignificant(search, of(570.0, mistake, inertia))
    assert _is_insignificant(search, of(570.0, lag, inertia))
    fewer[1].fitted.chi2 = 590.0
    assert _is_insignificant(search, of(570.0, mistake, inertia))


def wandering(eta, by):
    """A measurement of a beam whose loss factor `eta` wanders by this part over frequency."""
    loss = effect("structural_damping", "beam")
    model = Model(samii(), [loss])
    exact = noiseless(samii(), LINES, relative=1e-3)
    n = len(samii().sensor)
    at = grid(samii(), LINES, np.arange(n), np.zeros(n, dtype=np.int64))
    x = np.append(np.zeros(model.n_nominal), np.log(eta))
    H = model.response(x, at)
    ahead = model.response(np.append(x[:-1], x[-1] + 1e-4), at)
    ripple = by * np.sin(2 * np.pi * 1.5 * np.log10(LINES))[:, None]
    H = H + (ahead - H) / 1e-4 * ripple
    return redraw(exact, H[:, :, None], np.random.default_rng(3), 10)


def test_beside_a_loss_that_is_not_quite_constant_nothing_else_is_told():
    few = [effect("structural_damping", "beam"), effect("attached_oscillator", "link_1")]
    response = wandering(0.04, 0.04)
    found = diagnose([response], samii(), effects=few)
    assert [c.physics for c in found.causes] == ["structural_damping"]
    eta = found.causes[0].parameters["eta"]
    assert eta.low < 0.04 < eta.high
    # Its law is not believed to more than its own 5 %, and were it, an oscillator would be named.
    believed = [replace(e, rough=0.0) for e in few]
    assert len(diagnose([response], samii(), effects=believed).causes) == 2


def test_a_strength_is_known_no_better_than_its_law():
    loss = effect("structural_damping", "beam")
    search = search_of(concealing((loss, [0.04])), [loss])
    end = refit(
        Model(samii(), [loss]), search.problem, np.append(search.nominal.fitted.x, np.log(0.04))
    )
    rough = end.with_model_error()
    assert rough.covariance()[-1, -1] == pytest.approx(end.covariance()[-1, -1] + loss.rough**2)
    assert np.allclose(rough.covariance()[:-1, :-1], end.covariance()[:-1, :-1], rtol=1e-4)
    sure = refit(Model(samii(), [replace(loss, rough=0.0)]), search.problem, end.x, steps=0)
    assert sure.with_model_error() is sure


@pytest.mark.slow  # half a minute on a loaded machine
def test_of_two_effects_the_one_behind_what_mimics_both_is_grown():
    """An oil line mimics damper and late sensor together better than either does alone."""
    element = tuple(
        e.model_copy(update={"c": e.c.model_copy(update={"value": 0.0, "tolerance": 0.0})})
        if e.name == "joint_2"
        else e
        for e in samii().element
    )
    rig = samii().model_copy(update={"element": element})
    some = ("viscous_damping", "torsional_compliance", "translational_compliance")
    channels = ("sensor_lag", "sensor_delay", "hydraulic_compressibility")
    few = [e for e in table(rig, 0.5, 40.0) if e.physics in (*some, *channels)]
    both = [
        next(e for e in few if e.name == name and e.variant in ("", "beside the spring"))
        for name in (("viscous_damping", "joint_2"), ("sensor_lag", "a_0"))
    ]
    model = Model(rig, both)
    n = len(rig.sensor)
    at = grid(rig, LINES, np.arange(n), np.zeros(n, dtype=np.int64))
    H = model.response(np.append(np.zeros(model.n_nominal), np.log([2.6, 14000.0])), at)
    exact = noiseless(rig, LINES, relative=1e-4)
    search = search_of(redraw(exact, H[:, :, None], np.random.default_rng(1), 10), few, rig)
    search.run()
    assert {e.key for e in search.ranked()[0].effects} == {e.key for e in both}


def test_who_starts_far_away_runs_on_while_that_falls_fast():
    """Of two candidates the better one is still far after the first leg of the race."""
    near, far = (effect("attached_oscillator", n) for n in ("link_0", "beam"))
    # Where they start, and after each leg.
    costs = {near: iter([1200.0, 1150.0]), far: iter([1e5, 1.6e4, 770.0, 769.0])}

    class Raced(Search):
        def refitted_from(self, effects, start, give_up=np.inf, steps=0, *, far=True):
            return SimpleNamespace(cost=next(costs[effects[0]]), x=start)

    raced = object.__new__(Raced)
    raced.progress = lambda _: None
    ends = raced._ahead([(1.0, (near,), [1]), (1.0, (far,), [2])])
    assert [(cost, effects) for cost, effects, _ in ends] == [(769.0, (far,)), (1150.0, (near,))]


def test_a_sensor_that_lags_is_seen_beside_a_command_that_was_measured():
    """What is wrong with the data hides what is missing of the rig, and is no answer by itself."""
    unheld, late = effect("input_not_held", "v_2"), effect("sensor_lag", "a_1")
    found = concealing((unheld, []), (late, [3000.0]))
    search = search_of(found, [unheld, late, effect("added_mass", "link_2", "added")])
    best = search.run(briefly=True)[0]
    assert {e.physics for e in best.effects} == {"input_not_held", "sensor_lag"}


def test_of_two_unknowns_a_rival_is_refitted_from_weak_to_strong():
    """A soft spring ended in a valley beside its own: it lost to a sensor's delay by that alone."""
    spring, late = effect("ground_spring", "joint_1"), effect("sensor_delay", "a_1")
    search = search_of(concealing((spring, [3e3, 20.0])), [spring, late])
    for one in (spring, late):
        start = [np.log(u.middle) for u in one.unknowns]
        search.keep((one,), search.refitted((one,), search.nominal, start))
    found = search.found[frozenset({spring.key})]
    x, valley = found.fitted.x.copy(), found.fitted.chi2
    x[-2:] = np.log(spring.unknowns[0].starts[-1]), np.log(0.05)
    stopped = refit(found.fitted.model, search.problem, x, far=False, steps=0)
    search.found[found.key] = replace(found, fitted=stopped, weight=-1e9)
    search.found[found.key] = replace(
        search.found[found.key], weight=search.ranked()[0].weight - 20.0
    )
    search._from_everywhere()
    assert search.found[found.key].fitted.chi2 < valley + 0.5


def test_the_noise_of_records_is_told_anew_by_the_rig_that_was_found():
    late = effect("sensor_lag", "a_1")
    told = []

    class Told(RecordSearch):
        def _stands(self, fitted, times=1.0):
            return True

        def _about(self, fitted):
            told.append(fitted.model.effects)
            self._rig = fitted.model.effects

    search = object.__new__(Told)
    search._rig = ()
    for effects in ((), (late,), (late,)):
        search.rebin(SimpleNamespace(model=SimpleNamespace(effects=effects)))
    assert told == [(late,)]


@pytest.mark.parametrize("force", [None, object()], ids=["a dead time", "friction"])
@pytest.mark.parametrize(("rough", "insignificant"), [(METERED, True), (0.0, False)])
def test_what_a_meter_may_be_off_by_is_no_physics(
    rough: float, insignificant: bool, force: object
) -> None:
    """Of 712,000 of chi-square that a meter explains, 47 more by a dead time of a hundredth of a
    sample, or by a force."""

    meter = SimpleNamespace(key="meter", physical=False, force=None, rough=rough)
    late = SimpleNamespace(key="late", physical=True, force=force, rough=0.0)
    fewer = [of(712_000.0), of(550.0, meter), of(30_000.0, late)]
    search = searched(fewer)
    assert _is_insignificant(search, of(503.0, meter, late)) is insignificant
    table = channels.effects(samii(), 0.5, 40.0)
    meters = [e for e in table if e.physics == "input_not_held"]
    assert [e.rough for e in meters] == [METERED] * len(samii().actuator)
