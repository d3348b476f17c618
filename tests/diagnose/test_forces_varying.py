"""A stiffness that is not the same all the time, in the likelihood of whole records."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from concealed_kit import SAMII, SAMII_TOML
from cut_kit import DESIGN, cut_sweeps

from samii_rig.diagnose.diagnose import case_of, diagnose, table
from samii_rig.diagnose.forces.laws import HARDENING
from samii_rig.diagnose.forces.search import ForceSearch
from samii_rig.diagnose.forces.varying import Pulled, _between, pulled, varying
from samii_rig.diagnose.result import Diagnosis
from samii_rig.diagnose.verdict.by_record import on_records
from samii_rig.record.reader import read_recording
from samii_rig.signal.estimate import estimate
from samii_rig.types import Recording
from sim.assumed_modes import trial
from sim.assumed_modes.outside import between_runs, parametric

FEW = [e for e in table(SAMII, 0.5, 20.0) if e.physics in ("actuator_lag", "added_mass")]


def found_in(runs: list[Recording]) -> Diagnosis:
    return diagnose(estimate(runs), SAMII, runs=runs, effects=FEW)


def test_a_spring_that_swings_is_found_where_how_fast_and_by_how_much(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A plant of another kind, under noise that says nothing of when it swings: 49 sigma, of which
    the nominal model leaves no more than noise."""
    monkeypatch.setattr(trial, "OUTSIDE", {"parametric_stiffness": parametric})
    folder = trial.make("outside", 3, tmp_path, SAMII_TOML, ("random", "clean"))
    (truth,) = json.loads((tmp_path / "truth" / "outside_3.json").read_text())["effects"]
    runs = [read_recording(path) for path in sorted(folder.glob("*.mcap"))]
    found = found_in(runs)
    assert found.chi2_per_dof < found.threshold
    assert found.verdict == "unknown"
    assert found.sites[0][0] == truth["site"] == "joint_1"
    assert found.sites[0][1] > 0.99
    words = (
        "the stiffness of joint_1 is not constant: it varies, as by a swing at 1.46 Hz, by 0.11 % "
        "(+/- 0.00"  # 8 or 9, by how the machine rounds
    )
    assert found.lines()[0].startswith(f"Something is missing that is in no table: {words}")
    assert truth["parameters"]["depth"]["value"] == pytest.approx(0.0011, rel=0.1)


def test_a_joint_that_differs_from_run_to_run_is_found(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Four sweeps, cut off where they end: a clamp that differs by 0.04 %, 11 sigma."""
    monkeypatch.setattr(trial, "OUTSIDE", {"run_to_run_stiffness": between_runs})
    folder = trial.make("outside", 1, tmp_path, SAMII_TOML, ("cut", "clean"))
    (truth,) = json.loads((tmp_path / "truth" / "outside_1.json").read_text())["effects"]
    found = found_in([read_recording(path) for path in sorted(folder.glob("*.mcap"))])
    assert found.verdict == "unknown"
    assert found.sites[0][0] == truth["site"] == "clamp"
    assert found.beyond.startswith("the stiffness of clamp is not constant: it varies between rec")


@pytest.fixture(scope="module")
def nothing(tmp_path_factory: pytest.TempPathFactory) -> ForceSearch:
    runs = cut_sweeps(tmp_path_factory.mktemp("nothing"), design=DESIGN)
    linear = on_records(case_of(estimate(runs), SAMII, None, FEW, runs), None)
    assert linear is not None
    return ForceSearch(linear)


def test_what_a_force_adds_to_the_lines_is_turned_round_exactly(nothing: ForceSearch) -> None:
    rng, reach = np.random.default_rng(1), nothing.reach
    span, piece = reach.spans[0], nothing.levels.records.pieces[0]
    k = nothing.levels.records.lines(piece).k
    spring = next(e.quasi for e in nothing.forces if e.quasi and e.quasi.law is HARDENING)
    ports = reach.ports(spring.place, of_speed=False)
    assert ports is not None
    force = rng.standard_normal(span.decay.size) * span.alive
    some = rng.standard_normal((2, k.size, ports.sensors[0].shape[1]))
    lines = some[0] + 1j * some[1]
    added = span.lines(span.damped(force), ports.sensors[0], k)
    back = pulled(span, ports.sensors[0], k, lines, span.times)
    assert force @ back == pytest.approx(float(np.sum(lines.conj() * added).real), rel=1e-9)


def test_under_noise_alone_every_frequency_has_chi_square_of_two_freedoms(
    nothing: ForceSearch,
) -> None:
    """Noise that is white in the likelihood's own units, at the lines of real records."""
    rng, reach = np.random.default_rng(2), nothing.reach
    left = nothing.unexplained(nothing.nominal.fitted)
    f, each = (0.05, 0.1, 0.4, 1.6, 6.4), []
    for spring in (e.quasi for e in nothing.forces if e.quasi and e.quasi.law is HARDENING):
        ports = reach.ports(spring.place, of_speed=False)
        assert ports is not None
        motion = reach.motion(spring.place, of_speed=False)
        for _ in range(40):
            noise = [
                replace(
                    x,
                    white=rng.standard_normal(x.white.shape)
                    + 1j * rng.standard_normal(x.white.shape),
                )
                for x in left
            ]
            parts = zip(reach.spans, motion, ports.sensors, noise, strict=True)
            pieces = [Pulled.of(*one) for one in parts]
            apart = _between(pieces)
            swings = [np.sum([one.exact(hz) for one in pieces], axis=0) for hz in f]
            each += [[(apart.chi2, apart.free, 0.0), *swings]]
    chi2, free, _ = np.moveaxis(np.array(each), 2, 0)
    rows = sum(len(x.white) for x in left)
    assert set(free[:, 0]) == {rows - 1}
    assert set(free[:, -1]) == {2 * rows}
    unit = (chi2 - free) / np.sqrt(2 * free)
    assert np.max(np.abs(np.mean(unit, axis=0))) < 0.3, np.mean(unit, axis=0)
    assert np.max(np.abs(np.var(unit, axis=0) - 1)) < 0.5, np.var(unit, axis=0)


def test_where_nothing_is_missing_every_stiffness_is_constant(nothing: ForceSearch) -> None:
    assert varying(nothing, nothing.nominal) is None
