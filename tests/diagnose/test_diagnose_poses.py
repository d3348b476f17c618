"""One rig in several poses: one set of parameters, one answer, and what only another pose tells.

Plan: the sum of likelihoods against its parts, and its derivatives against differences; nothing and
a mass hidden in recordings of the simulated rig; a spring to the ground against a weight, which one
pose cannot tell apart; poses that are wrong; the command line.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from poses_kit import BAND, held, in_pose, loaded, named_mass, two_links, weighed
from table_kit import Effects
from typer.testing import CliRunner

from samii_rig.cli.app import app
from samii_rig.diagnose.diagnose import diagnose, table
from samii_rig.diagnose.fit import records
from samii_rig.diagnose.fit.poses import InPoses, Posed
from samii_rig.diagnose.fit.records import Whole
from samii_rig.diagnose.fit.refit import Fitted
from samii_rig.diagnose.fit.rigfile import toml
from samii_rig.diagnose.fit.summed import Stacked
from samii_rig.diagnose.posed import InPose, in_poses
from samii_rig.errors import EstimateError, InputError
from samii_rig.identify.poses import at_pose, read_pose
from samii_rig.record.store import write_recording

RIG = two_links()
POSES = ("0 deg", "110 deg")
RIGS = [at_pose(RIG, read_pose(pose)) for pose in POSES]
TABLE = Effects(lambda: table(RIGS[0], *BAND, poses=RIGS))


def some(*names):
    return Effects(lambda: [e for e in TABLE if e.name in names])


FEW = some(("added_mass", "upper"), ("added_mass", "fore"), ("torsional_compliance", "elbow"))
HELD = some(("ground_spring", "elbow"), ("gravity_stiffness", "elbow"))


@pytest.fixture(scope="module")
def plain() -> list[InPose]:
    return [in_pose(RIG, pose, i) for i, pose in enumerate(POSES, 1)]


def names(found):
    return {n for c in found.causes for n in ((c.physics, c.site), *c.equivalents)}


def test_where_nothing_is_missing_two_poses_say_so_and_a_wrong_pose_does_not(plain):
    found = in_poses(plain, RIG, effects=FEW)
    assert found.verdict == "no_mismatch"
    assert found.chi2_per_dof < found.threshold < 1.4
    alone = [diagnose(p.responses, RIGS[0], runs=p.runs, effects=FEW).used for p in plain[:1]]
    assert found.used.lines == 2 * alone[0].lines
    assert found.not_physics[0] == "one set of parameters in 2 poses (0 deg, 110 deg)"
    assert any("friction" in words and "several poses" in words for words in found.not_physics)
    # Said to hang nearly as the first: no one set of parameters fits.
    wrong = in_poses([plain[0], replace(plain[1], pose=read_pose("5 deg"))], RIG, effects=FEW)
    assert wrong.verdict != "no_mismatch"
    assert wrong.chi2_per_dof > 20 * wrong.threshold


def test_a_mass_that_is_missing_in_all_poses_has_its_place_and_size():
    hidden = [in_pose(RIG, pose, i, loaded(0.1)) for i, pose in enumerate(POSES, 1)]
    found = in_poses(hidden, RIG, effects=FEW)
    assert named_mass(found, 0.1).position == pytest.approx(0.4, abs=0.02)
    assert "the new rig file are of the first" in found.not_physics[0]
    assert found.rig.pose == RIGS[0].pose
    # The new rig file fits recordings of the other pose, which its own pose does not show.
    after = in_poses([hidden[1]], found.rig, effects=FEW[:1])
    assert after.chi2_per_dof < after.threshold


@pytest.mark.parametrize(
    ("change", "is_", "is_not"),
    [
        (held, "ground_spring", "gravity_stiffness"),
        pytest.param(weighed, "gravity_stiffness", "ground_spring", marks=pytest.mark.slow),
    ],
)
def test_a_spring_to_the_ground_and_a_weight_are_told_apart_by_a_second_pose(change, is_, is_not):
    hidden = [in_pose(RIG, pose, i, change(3.0)) for i, pose in enumerate(POSES, 1)]
    alone = in_poses(hidden[:1], RIG, effects=HELD)
    assert {(is_, "elbow"), (is_not, "elbow")} <= names(alone)
    assert "at 90 deg to the way down too, and give both, each with --pose" in alone.experiment
    assert alone.gain > 5
    both = in_poses(hidden, RIG, effects=HELD)
    assert both.verdict == "named"
    assert (is_, "elbow") in names(both)
    assert (is_not, "elbow") not in names(both)
    # The weight's stiffness is told as that of the chain that hangs.
    assert both.causes[0].parameters["k"].value == pytest.approx(3.0, rel=0.02)


def test_parts_that_weigh_have_a_place_of_their_own_where_there_is_gravity():
    own = {e.jump.place for e in TABLE if e.physics == "added_mass" and e.jump}
    others = {e.jump.place for e in TABLE if e.physics == "viscous_damping" and e.jump}
    assert own
    assert others
    assert not own & others
    light = table(RIG.model_copy(update={"gravity": 0.0, "pose": None}), *BAND)
    own = {e.jump.place for e in light if e.physics == "added_mass" and e.jump}
    assert own & {e.jump.place for e in light if e.physics == "viscous_damping" and e.jump}


@pytest.fixture(scope="module")
def summed(plain):
    wholes = [Whole.of(p.runs, rig) for p, rig in zip(plain, RIGS, strict=True)]
    model = Posed(RIGS, some(("gravity_stiffness", "elbow"))[:1])
    x = np.append(np.zeros(model.n_nominal), np.log(3.0))
    fitted = Fitted(model, x, 0.0, 0.0, np.zeros((0, model.n)), np.eye(model.n))
    both = InPoses(tuple(wholes))
    found = both.about(fitted)
    return fitted, found, both.nodes(found, fitted)


def test_the_likelihood_of_poses_is_the_sum_of_theirs(summed):
    fitted, found, at = summed
    assert isinstance(at, Stacked)
    h = fitted.model.response(fitted.x, at) * 1.001
    n = at.sizes[0]
    each = [
        float(np.sum(part.residual(own) ** 2))
        for part, own in zip(found.each, (h[:n], h[n:]), strict=True)
    ]
    assert min(each) > 1
    assert float(np.sum(found.residual(h) ** 2)) == pytest.approx(sum(each), rel=1e-9)


def test_each_pose_is_looked_at_up_to_where_its_own_response_shows(plain, summed, monkeypatch):
    fitted, found, _ = summed
    both = InPoses(tuple(Whole.of(p.runs, rig) for p, rig in zip(plain, RIGS, strict=True)))
    assert both.showing(fitted, found).lines == both.lines  # it shows at all lines
    monkeypatch.setattr(records, "LOST", 1000.0)  # of chi-square
    tops = [whole.records.band[1] for whole in both.showing(fitted, found).each]
    assert max(tops) < both.each[0].records.band[1]
    assert tops[0] != tops[1]


def test_all_poses_share_what_is_fitted(summed):
    fitted, _, at = summed
    model, x, n = fitted.model, fitted.x, at.sizes[0]
    assert all(one.keys == model.keys for one in model.each)
    h, dh = model.gradient(x, at)
    for j in (0, 2, model.n_nominal):
        ahead = x.copy()
        ahead[j] += 1e-6
        slope = (model.response(ahead, at) - h) / 1e-6
        assert slope == pytest.approx(dh[:, :, j], abs=1e-3 * np.max(np.abs(dh[:, :, j])))
        assert np.max(np.abs(dh[:n, :, j])) > 0 < np.max(np.abs(dh[n:, :, j]))
    # k cos(pose): the weight of a chain beyond level pulls the other way.
    (weight, other) = (one.values(x)["added_gravity_4", "k"] for one in model.each)
    assert other / weight == pytest.approx(np.cos(np.radians(110)))


def test_recordings_that_cannot_be_fitted_together_say_why_in_one_line(plain):
    without = tuple(c for c in plain[1].runs[0].channels if c.name != "v")
    bare = [
        replace(r, channels=without, values=r.values[:, [0, 1, 3, 4]], quality=r.quality[:, 1:])
        for r in plain[1].runs
    ]
    with pytest.raises(EstimateError, match=r"^the recordings in pose 110 deg") as error:
        in_poses([plain[0], replace(plain[1], runs=bare)], RIG, effects=FEW)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("{0} {1} --pose 30deg", "one --pose for each of 2 recordings"),
        ("{0} --pose 30", "an angle with its unit"),
        ("--before {0} --after {1} --pose 30deg", "no --before, --after or --each"),
        ("--before {0} --after {1}", "both states in one pose"),
        ("{0} {1} --each --pose 30deg", "no --before, --after or --each"),
        ("{0} --rig samii --pose 30deg", "SAMII has no gravity"),
    ],
)
def test_a_pose_that_cannot_be_is_refused_in_one_line(kept, words, said):
    done = CliRunner().invoke(app, ["diagnose", *words.format(*kept).split()])
    assert isinstance(done.exception, InputError)
    assert said in str(done.exception)
    assert "\n" not in str(done.exception)


@pytest.fixture(scope="module")
def kept(plain, tmp_path_factory) -> list[Path]:
    """A recording in each pose, with the rig file of that pose."""
    folder = tmp_path_factory.mktemp("poses")
    out = []
    for i, (pose, rig) in enumerate(zip(plain, RIGS, strict=True)):
        out.append(folder / f"run_{i}.mcap")
        write_recording(out[-1], replace(pose.runs[0], rig_toml=toml(rig)))
    return out


def test_the_command_line_takes_the_poses_of_the_recordings(kept, tmp_path: Path):
    words = ["diagnose", *map(str, kept), "--band", "1", "15", "--out", str(tmp_path)]
    done = CliRunner().invoke(app, words, catch_exceptions=False)
    assert done.exit_code == 0, done.output
    assert "Nothing is missing" in done.output
    assert "One set of parameters in 2 poses (0 deg, 110 deg)" in done.output
    assert "another rig file" not in done.output  # it is kept with them
    assert "in 2 poses" in (tmp_path / "diagnosis.html").read_text("utf-8")
    report = CliRunner().invoke(app, ["report", *map(str, kept), "--diagnosis"])
    assert "expected recordings in one pose" in str(report.exception)
