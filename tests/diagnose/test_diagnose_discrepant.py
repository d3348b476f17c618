"""What no law describes beside the noise of whole records.

Plan: scale and length are found again where a discrepancy was drawn; an effect beside one is named
with an interval that holds; an effect that one sensor or one level alone asks for is refused, and
so is one that leaves nominal parameters at unlikely values; one that is there is not.
"""

from __future__ import annotations

import copy
import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from sweep_kit import swept

from samii_rig.diagnose.diagnose import case_of
from samii_rig.diagnose.fit.discrepancy import Discrepancy
from samii_rig.diagnose.fit.discrepant import DiscrepantSearch
from samii_rig.diagnose.fit.explanations import Explanation
from samii_rig.diagnose.fit.record_search import RecordProblem, RecordSearch
from samii_rig.diagnose.fit.records import Whole
from samii_rig.diagnose.fit.refit import refit
from samii_rig.diagnose.fit.rigfile import explained
from samii_rig.diagnose.physics.model import Model
from samii_rig.diagnose.physics.vocabulary import hypotheses
from samii_rig.diagnose.verdict.by_record import on_records
from samii_rig.errors import EstimateError
from samii_rig.likelihood.form import Reduced
from samii_rig.rig.load import load_rig
from samii_rig.rig.schema import Rig
from samii_rig.signal.estimate import estimate
from samii_rig.types import Complex, Float, Recording

RIG, _ = load_rig("two_masses")
FEW = [
    e
    for e in hypotheses(RIG, 0.8, 35.0)
    if e.name in (("added_mass", "mass_2"), ("transport_delay", "coil"))
    or e.name == ("attached_oscillator", "mass_2")
]
MASS, OSCILLATOR = (
    next(e for e in FEW if e.physics == p) for p in ("added_mass", "attached_oscillator")
)
RINGS = (0.05, 0.05 * (2 * math.pi * 20.0) ** 2, 0.3)  # kg, N/m, N s/m: at 20 Hz
DRAWS = 40
FEWER = 16  # of which 12 and more must have the length; half a second each
TRUE = Discrepancy(0.03, 0.2)


def of(*runs: Recording) -> RecordSearch:
    found = on_records(case_of(estimate(runs), RIG, None, FEW, runs))
    assert found is not None
    return found


def sweep(rig: Rig, level: float, seed: int) -> Recording:
    return swept(
        rig, level, repeats=1, duration=10.0, ring_down=3.0, seed=seed, actuator="v",
        source=f"{level:g}.mcap",
    )  # fmt: skip


@pytest.fixture(scope="module")
def nothing() -> RecordSearch:
    return of(sweep(RIG, 1.0, 1))


def drawn(search: RecordSearch, rng: np.random.Generator, h: Complex) -> RecordSearch:
    """The same records, had a rig of response h and with a discrepancy made them; the nominal model
    refitted."""
    assert isinstance(search.problem, RecordProblem)
    form = search.problem.reduced
    f = np.log(np.maximum(form.frequency, form.frequency[1]))
    alike = np.exp(-0.5 * ((f[:, None] - f) / TRUE.length) ** 2) + 1e-9 * np.eye(f.size)
    white = rng.standard_normal((2, *h.shape)) / math.sqrt(2)
    epsilon = TRUE.scale * (np.linalg.cholesky(alike) @ (white[0] + 1j * white[1]))
    noise = rng.standard_normal(form.target.size)
    goal = form.residual(h * (1 + epsilon)) + form.target + noise
    out = copy.copy(search)
    out.problem = replace(search.problem, reduced=replace(form, target=goal))
    model = Model(RIG)
    out.found = {}
    out.keep((), refit(model, out.problem, np.zeros(model.n)))
    return out


def truth(rng: np.random.Generator, *values: float) -> tuple[Model, Float]:
    """A rig with nominal parameters within their tolerances, and an added mass; its vector."""
    model = Model(RIG, (MASS,) if values else ())
    x = rng.standard_normal(model.n) * np.where(np.isfinite(model.prior), model.prior, 0.0)
    x[model.n_nominal :] = np.log(values)
    return model, x


@pytest.mark.slow  # half a minute on a loaded machine
def test_scale_and_length_of_a_discrepancy_are_found_again(nothing):
    rng = np.random.default_rng(1)
    found = []
    for _ in range(FEWER):
        model, x = truth(rng)
        linear = drawn(nothing, rng, model.response(x, nothing.problem.at))
        linear.use([])
        search = DiscrepantSearch(linear)
        search.settle()
        found.append(search.discrepancy)
    scale = [d.scale for d in found]
    assert np.median(scale) == pytest.approx(TRUE.scale, rel=0.2)
    assert np.std(np.log(scale)) < 0.3
    assert sum(d.length == TRUE.length for d in found) > 0.75 * FEWER


@pytest.mark.slow
def test_an_effect_beside_a_discrepancy_is_named_with_an_interval_that_holds(nothing):
    rng = np.random.default_rng(2)
    added = 0.1
    named, holds = 0, 0
    for _ in range(DRAWS):
        model, x = truth(rng, added)
        linear = drawn(nothing, rng, model.response(x, nothing.problem.at))
        linear.use([e for e in FEW if e is not OSCILLATOR])
        linear.keep((MASS,), refit(model, linear.problem, x, far=False))
        search = DiscrepantSearch(linear)
        search.settle()
        best = next(e for e in search.ranked() if search.holds(e))
        if best.effects != (MASS,):
            continue
        named += 1
        (at,) = best.fitted.model.own(0)
        sd = math.sqrt(best.fitted.covariance()[at, at])
        holds += abs(best.fitted.x[at] - math.log(added)) < 1.645 * sd
    assert named >= 0.9 * DRAWS
    # 90 %, within three standard deviations of so many draws.
    assert abs(holds / named - 0.9) < 3 * math.sqrt(0.09 / named)


def with_oscillator(search: DiscrepantSearch) -> Explanation:
    """The oscillator as it is where it is."""
    model = Model(RIG, (OSCILLATOR,))
    x = np.zeros(model.n)
    x[model.n_nominal :] = np.log(RINGS)
    return Explanation((OSCILLATOR,), refit(model, search.problem, x, far=False, steps=0), 0.0)


@pytest.mark.parametrize("seen_by", [("x_1", "a_2"), ("x_1",), ("a_2",)])
def test_an_oscillator_that_one_sensor_alone_asks_for_is_refused(nothing, seen_by):
    rng = np.random.default_rng(3)
    bare, ringing = Model(RIG), Model(RIG, (OSCILLATOR,))
    h = bare.response(np.zeros(bare.n), nothing.problem.at)
    x = np.append(np.zeros(bare.n), np.log(RINGS))
    by = ringing.response(x, nothing.problem.at)
    on = [i for i, s in enumerate(RIG.sensor) if s.name in seen_by]
    h[:, on] = by[:, on]
    search = DiscrepantSearch(drawn(nothing, rng, h))
    search.discrepancy = TRUE
    search._with_discrepancy()
    worse = search.worse(with_oscillator(search))
    assert set(worse) == {s.name for s in RIG.sensor} - set(seen_by)


def test_an_oscillator_at_one_of_two_levels_is_refused_and_one_at_both_is_not():
    ringing = Model(RIG, (OSCILLATOR,))
    x = np.append(np.zeros(ringing.n_nominal), np.log(RINGS))
    fitted = refit(ringing, of(sweep(RIG, 1.0, 1)).problem, x, far=False, steps=0)
    rig = explained(fitted)
    assert isinstance(rig, Rig)
    for other, worse in ((RIG, ["0.5 V alone"]), (rig, [])):
        search = DiscrepantSearch(of(sweep(rig, 1.0, 1), sweep(other, 0.5, 2)))
        search.discrepancy = TRUE
        search._with_discrepancy()
        assert search.worse(with_oscillator(search)) == worse


def test_a_level_that_is_too_short_to_show_its_noise_has_no_say(monkeypatch):
    search = DiscrepantSearch(of(sweep(RIG, 1.0, 1), sweep(RIG, 0.5, 2)))
    about = Whole.about

    def shown(whole: Whole, *arguments: Any) -> Reduced:
        if {p.levels for p in whole.records.pieces} == {((0.5, "V"),)}:
            raise EstimateError("the records are too short")
        return about(whole, *arguments)

    monkeypatch.setattr(Whole, "about", shown)
    assert [words for words, _ in search._levels] == ["1 V"]


def test_what_leaves_a_nominal_parameter_at_the_end_of_its_range_does_not_hold(nothing):
    search = DiscrepantSearch(nothing)
    model = Model(RIG, (MASS,))
    x = np.append(nothing.nominal.fitted.x, math.log(1e-3))
    small = refit(model, search.problem, x, far=False, steps=0)
    assert search.holds(Explanation((MASS,), small, 0.0))
    there = x.copy()
    there[0] = model.upper[0]
    assert not search.holds(Explanation((MASS,), replace(small, x=there), 0.0))
    # Eight parameters, none at its end: 29.2 is exceeded with a chance of 3e-4.
    for penalty, holds in ((27.0, True), (32.0, False)):
        assert search.holds(Explanation((MASS,), replace(small, penalty=penalty), 0.0)) is holds
