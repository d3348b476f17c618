"""Diagnosis of whole records: sweeps that end with their record, once each, nothing repeated."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from concealed_kit import SAMII
from cut_kit import DESIGN, cut_sweeps
from table_kit import Effects, table_of

from samii_rig.diagnose.data.measured import measured
from samii_rig.diagnose.diagnose import diagnose
from samii_rig.diagnose.fit.record_search import RecordProblem
from samii_rig.diagnose.fit.records import Whole
from samii_rig.diagnose.fit.refit import Fitted, Problem, refit
from samii_rig.diagnose.forces.variation import BySpring, Variation
from samii_rig.diagnose.physics.grid import grid
from samii_rig.diagnose.physics.model import Model
from samii_rig.diagnose.result import Diagnosis, Gap, Value
from samii_rig.diagnose.verdict import by_record
from samii_rig.likelihood.excited import _unfolded
from samii_rig.likelihood.pieces import Piece
from samii_rig.progress import Counted
from samii_rig.signal.estimate import estimate
from samii_rig.types import Recording

SLOW_VALVE = "actuator_lag joint_2_source p=150"
# What a valve that lags could be taken for.
_FEW = ("actuator_lag", "transport_delay", "velocity_feedback", "input_not_held")
FEW = Effects(lambda: table_of(SAMII, 0.5, 40.0, *_FEW))


@pytest.fixture(scope="module")
def nothing(tmp_path_factory: pytest.TempPathFactory) -> list[Recording]:
    return cut_sweeps(tmp_path_factory.mktemp("nothing"))


@pytest.fixture(scope="module")
def answer(nothing: list[Recording]) -> tuple[Diagnosis, list[str]]:
    """What is found where nothing is missing, and what was told meanwhile."""
    said: list[str] = []
    return diagnose(estimate(nothing), SAMII, runs=nothing, progress=said.append), said


def test_where_nothing_is_missing_it_says_so_and_what_could_hide(answer):
    found, _ = answer
    assert found.verdict == "no_mismatch"
    assert found.chi2_per_dof < found.threshold < 1.3
    assert found.used.lines == found.used.of > 500
    hiding = {(h.physics, h.site): h for h in found.could_hide}
    # What the tolerances of the links' masses do not absorb is seen from grams to kilos.
    assert 1e-3 < hiding["added_mass", "link_3_6"].size < 5.0
    assert "What could hide: " in found.lines()[2]
    assert "a mass under" in found.lines()[2]


def test_who_waits_is_told_what_is_tried_in_every_stage(answer):
    _, said = answer
    stages = list(dict.fromkeys(s.stage if isinstance(s, Counted) else s for s in said))
    assert stages[0] == "nominal model"
    fits = stages.index("nominal model of whole records, fit 1 of at most 6")
    assert fits < stages.index("what is missing")
    assert stages[-3:] == [
        "what cannot be distinguished",
        "whether the recordings agree",
        "whether stiffnesses are constant",
    ]
    assert any(isinstance(s, Counted) and s.stage == "amplitude levels" for s in said)
    tried = [s for s in said if isinstance(s, Counted) and s.stage == "what is missing"]
    assert len(tried) > 3
    assert all(s.done < s.of and " at " in s.at for s in tried)


def with_column(run: Recording, name: str, values: np.ndarray) -> Recording:
    changed = run.values.copy()
    changed[:, run.column(name)] = values
    return replace(run, values=changed)


def test_a_sensor_that_stands_still_takes_no_part(nothing: list[Recording]):
    runs = [with_column(run, "a_1", np.full(len(run), 0.01)) for run in nothing[:1]]
    found = diagnose(estimate(runs), SAMII, runs=runs, effects=FEW)
    assert found.verdict == "no_mismatch"
    assert found.used.lines == found.used.of > 500
    assert {b.channel for b in found.bands} == {"theta_2", "a_0", "a_2"}
    assert any("a_1 never changes" in words for words in found.not_physics)


def test_a_segment_in_which_a_sensor_freezes_is_left_out_and_told(nothing: list[Recording]):
    a_1 = nothing[0].values[:, nothing[0].column("a_1")].copy()
    a_1[len(a_1) // 2 :] = a_1[len(a_1) // 2]
    rng = np.random.default_rng(1)
    live = replace(nothing[0], source="live.mcap")
    runs = [
        replace(with_column(nothing[0], "a_1", a_1 + 0.0), source="frozen.mcap"),
        # The same sweep once more, with other noise of the converter's size.
        with_column(
            live, "a_1", live.values[:, live.column("a_1")] + rng.normal(0, 1e-3, len(a_1))
        ),
    ]
    every = diagnose(estimate(runs), SAMII, runs=runs, effects=FEW)
    ((place, why),) = every.used.left_out
    assert place.startswith("frozen.mcap")
    assert "a_1 stands still" in why
    assert every.verdict == "no_mismatch"


def anything(seen: BySpring, _files: int) -> Variation | None:
    """A joint that swings in any phase, which does the work of every linear effect."""
    if seen.best.effects:
        return None
    return Variation(
        sites=(("joint_1", 1.0),),
        parameters={"depth": Value(0.01, "1", 0.009, 0.011), "f": Value(1.0, "Hz", 0.99, 1.01)},
        evidence=1e9, likelihood=1e9, gain=1e9, before=(9.0, 9.0), after=(1.0, 1.0),
        gap=Gap(1.0, 0.99, 1.0), inside=True, again=True,
    )  # fmt: skip


def test_a_valve_that_lags_is_named_though_every_sweep_ends_with_its_record(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(by_record, "variation", anything)
    runs = cut_sweeps(
        tmp_path, SLOW_VALVE, design=replace(DESIGN, levels=(1.0,), burst=20.0, high_hz=20.0)
    )
    found = diagnose(estimate(runs), SAMII, runs=runs, effects=FEW)
    names = {(c.physics, c.site) for c in found.causes}
    names |= {n for c in found.causes for n in c.equivalents}
    assert found.verdict in ("named", "ambiguous")
    assert ("actuator_lag", "joint_2_source") in names
    assert found.sigma > 10


def test_what_could_hide_is_what_a_refit_leaves(nothing: list[Recording], answer):
    """The size is told from weak effects; a refit of the stated size leaves that many sigma."""
    found, _ = answer
    told = next(h for h in found.could_hide if h.physics == "transport_delay")
    every = table_of(SAMII, 0.5, 40.0)
    whole = Whole.of(nothing, SAMII, None)
    model = Model(SAMII)
    none = Fitted(model, np.zeros(model.n), 0.0, 0.0, np.zeros((0, model.n)), np.eye(model.n))
    lines = measured(estimate(nothing), SAMII)
    by_line = Problem.of(lines, grid(SAMII, lines.frequency, lines.sensor, lines.actuator))
    problem = RecordProblem.about(whole, none, by_line)
    (effect,) = (e for e in every if e.name == ("transport_delay", told.site))
    hidden = Model(SAMII, (effect,))
    h = hidden.response(np.append(none.x, np.log(told.size)), problem.at)
    left = refit(model, problem.toward(h), none.x, far=False)
    assert 3.0 < np.sqrt(left.chi2) < 9.0


def test_where_not_every_sample_was_recorded_what_folds_back_bounds_the_band():
    """Of tones that follow each other at once, each change has power above half the rate, and at
    the record's samples it reads as of below. A sweep that comes and goes has none."""
    rate, n = 100.0, 4000
    t = np.arange(n) / rate
    smooth = np.sin(2 * np.pi * (1 + 0.4 * t) * t) * np.hanning(n)  # to 33 Hz
    hz = np.repeat([40.0, 37.0, 34.0, 31.0, 20.0, 9.0, 4.0, 2.0], n // 8)
    tones = np.sin(2 * np.pi * np.cumsum(hz) / rate)

    def top(u: np.ndarray, edges: tuple[tuple[int, int], ...] = ()) -> float:
        return _unfolded(Piece("a", u, np.zeros((n, 1)), 0, ((1.0, "V"),), edges=edges), rate)

    assert top(smooth) > 33
    assert top(tones) == 30
    assert top(tones, ((500, 0),)) == 50
