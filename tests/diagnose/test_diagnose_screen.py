"""What ranks a hypothesis before its refit: one number a frequency stands for the whole chain."""

import numpy as np
import pytest
from identify_kit import noiseless, samii
from table_kit import Effects, table_of

from samii_rig.diagnose.data.measured import measured
from samii_rig.diagnose.fit.moebius import place_of
from samii_rig.diagnose.fit.refit import Problem, refit
from samii_rig.diagnose.fit.screen import Screen
from samii_rig.diagnose.fit.search import Search
from samii_rig.diagnose.physics.causal import RISE, CausalChain
from samii_rig.diagnose.physics.grid import grid
from samii_rig.diagnose.physics.model import Model
from samii_rig.diagnose.physics.vocabulary import hypotheses
from samii_rig.diagnose.verdict.judge import judge
from samii_rig.diagnose.verdict.locate import traces
from samii_rig.identify.bootstrap import redraw
from samii_rig.model.sampled import sampled_response
from samii_rig.model.tmm import Chain

BAND = (0.5, 40.0)
LINES = np.geomspace(*BAND, 160)
ALL = Effects(lambda: table_of(samii(), *BAND))
PARTS = [e for e in hypotheses(samii(), *BAND) if e.jump is not None]
ROWS = {f"{e.physics} {e.jump.states or e.jump.place.split()[0]} {e.jump.fixed}": e for e in PARTS}
# Of a logger that shifts its columns.
ROW = "is in another row than what it moved: the sensors' stand"


def effect(physics, site, variant=""):
    return next(e for e in ALL if (physics, site) in e.names and e.variant.startswith(variant))


def concealing(*effects, seed=1):
    """A measurement of the rig with (effect, values) in it."""
    rig = samii()
    model = Model(rig, [e for e, _ in effects])
    x = np.concatenate([np.zeros(model.n_nominal), *(np.log(values) for _, values in effects)])
    at = grid(rig, LINES, np.arange(len(rig.sensor)), np.zeros(len(rig.sensor), dtype=np.int64))
    exact = noiseless(rig, LINES)
    return redraw(exact, model.response(x, at)[:, :, None], np.random.default_rng(seed), 10)


@pytest.fixture(scope="module")
def lines():
    return measured([concealing()], samii())


@pytest.fixture(scope="module")
def problem(lines):
    return Problem.of(lines, grid(samii(), lines.frequency, lines.sensor, lines.actuator))


@pytest.fixture(scope="module")
def nominal(problem):
    model = Model(samii())
    return refit(model, problem, np.zeros(model.n))


@pytest.mark.parametrize("part", ROWS.values(), ids=ROWS)
def test_two_evaluations_of_the_chain_stand_for_every_strength_of_a_part(part, problem):
    model, trial = Model(samii()), Model(samii(), (part,))
    known = np.zeros(model.n)
    a = model.response(known, problem.at)
    free = len(part.unknowns) - part.jump.fixed
    fixed = tuple(u.starts[-1] for u in part.unknowns[free:])
    place = place_of(trial, known, part, problem.at, a, fixed)
    s = 2j * np.pi * problem.at.frequency
    for share in (0.35, 0.6):
        values = [u.low ** (1 - share) * u.high**share for u in part.unknowns[:free]] + [*fixed]
        direct = trial.response(np.append(known, np.log(values)), problem.at)
        free_of_chain = a + place.b * place.phi(part.jump.x(s, np.array([values])))[0][:, None]
        size = np.abs(direct).max(axis=0)
        assert np.all(np.abs(free_of_chain - direct) <= 1e-7 * size)


@pytest.mark.parametrize("physics", sorted({e.physics for e in PARTS}))
def test_the_screen_of_a_part_says_what_the_chain_says(physics, nominal, problem):
    part = next(e for e in PARTS if e.physics == physics and not e.jump.fixed)
    screen = Screen.of(problem, nominal)
    trial = Model(samii(), (part,))
    place = place_of(trial, nominal.x, part, problem.at, screen.response)
    drop, starts = screen.through(place, part)
    h = trial.response(np.append(nominal.x, np.log(starts[0])), problem.at)
    r = np.concatenate([problem.residual(h), screen.tail])
    left = r - screen.directions @ (screen.directions.T @ r)
    assert nominal.cost - drop == pytest.approx(left @ left, rel=1e-7)


def test_a_screen_finds_the_strength_that_a_refit_finds():
    brace = effect("gravity_stiffness", "joint_3")
    here = measured([concealing((brace, [40.0]))], samii())
    at = grid(samii(), here.frequency, here.sensor, here.actuator)
    search = Search(samii(), here, at, [brace])
    ((drop, found, starts),) = search.screen(search.nominal)
    end = search.refitted((found,), search.nominal, np.log(starts[0]).tolist())
    assert drop == pytest.approx(search.nominal.fitted.cost - end.cost, rel=0.05)
    assert starts[0][0] == pytest.approx(np.exp(end.x[-1]), rel=0.05)


def test_a_factor_on_a_channel_acts_on_what_is_folded_into_the_band_too():
    late = effect("transport_delay", "joint_2_source")
    tau = 2e-4
    rig = samii()
    at = grid(rig, LINES, np.arange(len(rig.sensor)), np.zeros(len(rig.sensor), dtype=np.int64))
    model = Model(rig, (late,))
    x = np.append(np.zeros(model.n_nominal), np.log(tau))
    actuator = rig.actuator[0].model_copy(update={"delay": rig.actuator[0].delay + tau})
    truth = sampled_response(rig.model_copy(update={"actuator": (actuator,)}), LINES)[:, :, 0]
    direct = np.abs(sampled_response(rig, LINES)[:, :, 0] - truth).max(axis=0)
    assert np.all(np.abs(model.response(x, at) - truth).max(axis=0) < 2e-3 * direct)


def test_a_pendulum_may_stand_on_its_head():
    signs = {e.report(np.array([2.0]))[0] for e in ALL if e.physics == "gravity_stiffness"}
    assert signs == {2.0, -2.0}


def test_oil_that_gives_way_is_a_spring_between_valve_and_load():
    spring = effect("hydraulic_compressibility", "joint_2_source")
    assert "torsional_compliance" in {p for p, _ in spring.names}


def test_a_lossy_beam_is_stiffer_the_faster_it_is_bent():
    f0, eta = 4.0, 0.02
    beam = next(e.name for e in samii().element if e.kind == "beam")
    chain = Chain(samii()).with_values({(beam, "eta"): eta})
    causal = CausalChain(chain, (beam,), f0)
    EI = chain.values()[chain.parameters.index((beam, "EI"))]
    f = np.array([0.9, 3.9, 17.0])
    there = causal.response(f)
    for i, one in enumerate(f):
        stiff = chain.with_values({(beam, "EI"): EI * (one / f0) ** (RISE * eta)})
        assert np.allclose(there[i], stiff.response([one])[0], rtol=1e-4)
    assert np.all(np.abs(there - chain.response(f)).max(axis=(1, 2)) > 1e-5)


def test_the_gradient_of_a_causal_chain_is_its_derivative():
    beam = next(e.name for e in samii().element if e.kind == "beam")
    keys = ((beam, "EI"), (beam, "eta"), ("joint_1", "k"))
    f = np.geomspace(*BAND, 25)
    chain = Chain(samii()).with_values({(beam, "eta"): 0.02})
    causal = CausalChain(chain, (beam,), 4.0)
    values = dict(zip(chain.parameters, chain.values(), strict=True))
    H, dH = causal.gradient(f, keys)
    assert np.allclose(H, causal.response(f), rtol=1e-12)
    for i, key in enumerate(keys):
        step = 1e-5 * values[key]
        ahead, behind = (
            causal.with_values({key: values[key] + sign * step}).response(f) for sign in (1, -1)
        )
        slope = (ahead - behind) / (2 * step)
        assert np.allclose(dH[..., i], slope, rtol=1e-3, atol=1e-4 * np.abs(slope).max())


def test_a_cause_is_shown_at_its_own_place_about_the_rig_with_the_other_one():
    spring = effect("translational_compliance", "joint_1")
    late = effect("sensor_delay", "a_1")
    here = measured([concealing((spring, [1e6, 0.1]), (late, [2e-3]))], samii())
    at = grid(samii(), here.frequency, here.sensor, here.actuator)
    search = Search(samii(), here, at, [spring, late])
    end = search.refitted((spring, late), search.nominal, np.log([1e6, 0.1, 2e-3]).tolist())
    search.keep((spring, late), end)
    judged = judge(search)
    assert {e.key for e in judged.best.effects} == {spring.key, late.key}
    first = traces(search, judged)[0]
    assert (first.site, first.jump, first.by) == (spring.site, "w", "V")
    assert first.chi2_per_dof < 1.3
    sure = first.sd < 0.1 * np.abs(first.x)
    assert sure.sum() > 20
    assert np.median((1 / first.x[sure]).real) == pytest.approx(-1e6, rel=0.05)


def test_of_sensors_that_are_all_early_it_is_the_input_that_is_late():
    """Each sensor early by a part of a sample fits as well, and is found first where one of them is
    late beside the others."""
    names = [x.name for x in samii().sensor]
    not_held, late = effect("input_not_held", "v_2"), effect("sensor_delay", "a_1")
    early = tuple(effect("time_offset", name) for name in names)
    here = measured([concealing((not_held, []), (late, [2e-4]))], samii())
    at = grid(samii(), here.frequency, here.sensor, here.actuator)
    search = Search(samii(), here, at, [not_held, late, *early])
    half = 0.5 / samii().rate_hz
    start = np.log([half - 2e-4 if name == "a_1" else half for name in names])
    end = search.refitted(early, search.nominal, start.tolist())
    search.keep(early, end)
    assert search.ranked()[0].effects == early
    search._behind_the_input()
    assert set(search.ranked()[0].effects) == {not_held, late}


def test_a_shift_told_one_sample_too_far_is_found_with_the_dead_time_that_it_stood_for():
    """The input late by 0.9 samples, its columns two samples early: one early fits nearly as
    well, the nominal parameters bent, and with less of a dead time beside it."""
    one, two = (
        effect("columns_shifted", "v_2", f"{ROW} {n}")
        for n in ("1 sample earlier", "2 samples earlier")
    )
    dead = effect("transport_delay", "joint_2_source")
    here = measured([concealing((two, []), (dead, [0.9 / samii().rate_hz]))], samii())
    at = grid(samii(), here.frequency, here.sensor, here.actuator)
    search = Search(samii(), here, at, [one, two, dead])
    end = search.refitted((one, dead), search.nominal, [np.log(1e-4)])
    search.keep((one, dead), end)
    search._beside_next_shifts()
    best = search.ranked()[0]
    assert set(best.effects) == {two, dead}
    assert np.exp(best.fitted.x[-1]) == pytest.approx(0.9 / samii().rate_hz, rel=0.05)
