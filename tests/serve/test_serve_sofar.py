"""What is known of a run while it goes on.

Plan: a recording cut off at moments of its run, estimated as far as it goes; which experiment can
follow; when an answer is certain; and the whole in processes as in a lab: a run that ends early at
rest, with its diagnosis in the index.
"""

from __future__ import annotations

import json
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from multiprocessing import Pipe
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import pytest
from few_kit import only
from serve_kit import Service, sweep
from wait_kit import WITHIN

from samii_rig.cli import main
from samii_rig.diagnose.diagnose import diagnose, table
from samii_rig.diagnose.result import Diagnosis
from samii_rig.index.remarks import read_remarks
from samii_rig.model.sampled import sampled_response
from samii_rig.record.reader import read_events, read_recording
from samii_rig.rig.load import load_rig
from samii_rig.rig.schema import Rig
from samii_rig.run.campaign import carry_out
from samii_rig.run.dryrun import predict
from samii_rig.run.experiments import load_experiment
from samii_rig.run.order import RunOrder
from samii_rig.run.plan import Plan
from samii_rig.serve.analysis import Analysis
from samii_rig.serve.analyst import Analyst, Diagnoser, said
from samii_rig.serve.drawn import Drawn, curves
from samii_rig.serve.following import following
from samii_rig.serve.job import DIAGNOSIS, DOING, RESPONSES, SO_FAR, Job, JobState, Request
from samii_rig.serve.sofar import SoFar, first
from samii_rig.signal.estimate import estimate
from samii_rig.types import Recording

RIG, RIG_TOML = load_rig("samii")
SWEEPS = sweep(duration=20.0, repeats=2).replace("[0.02]", "[0.02, 0.04]")
PERIODS = """
experiment = "multisine"
name = "periods"
actuator = "v_2"
unit = "V"
drive = "output"
period = 4.0
low_hz = 1.0
high_hz = 20.0
group = 4
realisations = 1
periods = 3
settle = 2
ramp = 1.0
crest = 3.0
amplitudes = [0.05]
order = "by_level"
seed = 1
"""


def made(
    folder: Path, text: str, rig: Rig = RIG, rig_toml: str = RIG_TOML
) -> tuple[Plan, Recording, int]:
    """Plan, whole recording and number of the plan's first sample of a simulated run."""
    file = folder / "experiment.toml"
    file.write_text(text)
    experiment, _ = load_experiment(str(file), rig)
    plan = experiment.plan(rig)
    path = folder / "run.mcap"
    carry_out(RunOrder(rig, rig_toml, text, plan, predict(plan, rig), {"seed": 1}), path)
    start = next(e.payload["start"] for e in read_events(path) if e.name == "plan")
    return plan, read_recording(path), int(start)


@pytest.fixture(scope="module")
def swept(tmp_path_factory: pytest.TempPathFactory) -> tuple[Plan, Recording, int]:
    return made(tmp_path_factory.mktemp("swept"), SWEEPS)


@pytest.fixture(scope="module")
def of_periods(tmp_path_factory: pytest.TempPathFactory) -> tuple[Plan, Recording, int]:
    return made(tmp_path_factory.mktemp("periods"), PERIODS)


def until(recording: Recording, stop: int) -> Recording:
    """As it is on the disk when its newest sample is `stop` - 1."""
    kept = recording.sequence < stop
    return replace(
        recording,
        sequence=recording.sequence[kept],
        time=recording.time[kept],
        values=recording.values[kept],
        quality=recording.quality[kept],
        segments=tuple(s for s in recording.segments if s.stop <= stop),
    )


def test_a_sweep_grows_with_what_it_has_passed(swept: tuple[Plan, Recording, int]) -> None:
    plan, recording, start = swept
    so_far, reached = SoFar(plan), []
    for part in (0.3, 0.5, 0.8):
        n = round(part * len(plan.segments[0].u))
        assert so_far.growing
        assert so_far.take(until(recording, start + n), start)
        ((r, going_on),) = so_far.responses()
        passed = plan.segments[0].frequency[:n]
        assert going_on
        assert r.frequency[-1] <= np.nanmax(passed)
        reached.append(r.frequency[-1])
        # Truth is within what it says of itself, line by line.
        H = sampled_response(RIG, r.frequency)
        z = np.abs(r.H - H) ** 2 / r.variance()
        assert np.median(z) < 3.0
    assert reached == sorted(reached)
    assert reached[-1] > 10.0
    # Nothing new, nothing done.
    assert not so_far.take(until(recording, start + n), start)


def test_of_two_inputs_a_level_is_known_once_both_were_driven(tmp_path: Path) -> None:
    rig, rig_toml = load_rig("samii_two_joints")
    text = sweep(duration=8.0, repeats=1).replace('"v_2"', '"v_2"\nbeside = ["v_3"]')
    plan, recording, start = made(tmp_path, text, rig, rig_toml)
    one, both = (start + sum(len(s.u) for s in plan.segments[:k]) for k in (1, 2))
    assert first(plan) == both - start
    so_far = SoFar(plan)
    so_far.take(until(recording, one + 500), start)
    assert (so_far.responses(), so_far.trouble, so_far.growing) == ([], "", False)
    assert so_far.take(until(recording, both), start)
    ((r, going_on),) = so_far.responses()
    assert not going_on
    (whole,) = estimate([recording])
    np.testing.assert_array_equal(r.H, whole.H)
    told = Drawn(rig, plan).told(so_far.responses(), 2)
    pairs = {(s.name, a.name) for s in rig.sensor for a in rig.actuator}
    assert {(c["output"], c["input"]) for c in told["model"]["curves"]} == pairs
    assert {(c["output"], c["input"]) for c in told["responses"][0]["curves"]} == pairs


@pytest.mark.parametrize("run", ["swept", "of_periods"])
def test_when_the_first_estimate_comes_is_known_before(
    run: str, request: pytest.FixtureRequest
) -> None:
    plan, recording, start = request.getfixturevalue(run)
    n = first(plan)
    assert n is not None
    assert 0 < n < len(plan.segments[0].u)
    so_far = SoFar(plan)
    so_far.take(until(recording, start + n - 1), start)
    assert (so_far.responses(), so_far.trouble) == ([], "")
    so_far.take(until(recording, start + n), start)
    # There is enough to ask the estimator.
    assert so_far.responses() or so_far.trouble
    told = Drawn(RIG, plan).told([], 0)
    assert told["first_s"] == n / plan.rate_hz
    rests = [replace(s, kind="transient") for s in plan.segments]
    assert Drawn(RIG, replace(plan, segments=tuple(rests))).told([], 0)["first_s"] is None


def test_at_the_end_it_says_what_the_estimate_of_the_whole_says(
    swept: tuple[Plan, Recording, int],
) -> None:
    plan, recording, start = swept
    so_far = SoFar(plan)
    ends = [s.stop for s in recording.segments]
    for n, stop in enumerate(ends, 1):
        # The record of a segment may be there before the last of its samples.
        early = replace(until(recording, stop - 50), segments=recording.segments[:n])
        so_far.take(early, start)
        assert so_far.done == n - 1
        before = so_far.responses()
        assert so_far.take(until(recording, stop), start)
        assert so_far.done == n
        for (old, _), (new, _) in zip(before, so_far.responses(), strict=False):
            # A level of which nothing is new is not estimated again.
            assert old is new or old.level == recording.segments[n - 1].level
    assert not so_far.growing
    whole = estimate([recording])
    assert len(whole) == 2
    for r, (found, going_on) in zip(whole, so_far.responses(), strict=True):
        assert not going_on
        assert (r.level, r.method, r.n_averages) == (found.level, found.method, found.n_averages)
        np.testing.assert_array_equal(r.H, found.H)
        np.testing.assert_array_equal(r.covariance, found.covariance)


def test_a_level_counts_once_whatever_is_driven_at_it(
    swept: tuple[Plan, Recording, int],
) -> None:
    plan, recording, start = swept
    (*_, last) = plan.segments
    for more, levels in (
        ((), (2, 2)),
        ((replace(last, kind="periodic"),), (2, 2)),
        ((replace(last, level=0.08),), (2, 3)),
        ((replace(last, unit="rad"),), (2, 3)),
        ((replace(last, level=0.08, kind="transient"),), (2, 2)),
    ):
        so_far = SoFar(replace(plan, segments=(*plan.segments, *more)))
        assert so_far.levels == (0, levels[1])
        so_far.take(recording, start)
        assert so_far.levels == levels


def test_of_a_multisine_whole_periods_count(of_periods: tuple[Plan, Recording, int]) -> None:
    plan, recording, start = of_periods
    so_far = SoFar(plan)
    begin, last = plan.segments[0].recorded or (0, len(plan.segments[0].u))
    length = round(4.0 * RIG.rate_hz)
    methods = []
    for n in range(begin + length // 2, last, length):
        so_far.take(until(recording, start + n), start)
        methods += [r.estimator for r, going_on in so_far.responses() if going_on]
    assert methods
    assert set(methods) == {"periodic"}


def test_a_page_gets_few_points_and_no_number_that_json_cannot_say(
    swept: tuple[Plan, Recording, int],
) -> None:
    (r, *_) = estimate([swept[1]])
    said = curves(r)
    assert len(said["frequency"]) <= 201
    json.dumps(said, allow_nan=False)
    for c in said["curves"]:
        low, gain, high = (np.array(c[k], float) for k in ("low", "gain", "high"))
        assert (low <= gain).all()
        assert (gain <= high).all()


@pytest.fixture(scope="module")
def right(swept: tuple[Plan, Recording, int]) -> Diagnosis:
    return diagnose(estimate([swept[1]]), RIG)


def test_what_is_missing_is_told_with_its_chances(
    swept: tuple[Plan, Recording, int], right: Diagnosis
) -> None:
    """A rig file that calls joint 1 rigid, held against a rig whose joint gives."""
    joint = next(e for e in RIG.element if e.name == "joint_1")
    rigid = joint.model_copy(update={"k": joint.k.model_copy(update={"value": 1e9})})  # type: ignore[union-attr]
    wrong = RIG.model_copy(
        update={"element": tuple(rigid if e is joint else e for e in RIG.element)}
    )
    some = ("torsional_compliance", "sensor_gain")
    few = [e for e in table(wrong, 1.0, 20.0) if e.physics in some]
    found = said(diagnose(estimate([swept[1]]), wrong, effects=few))
    json.dumps(found, allow_nan=False)
    assert found["verdict"] not in ("", "no_mismatch")
    assert found["nothing"] < 0.01
    assert found["sites"]
    nothing = said(right)
    assert nothing["verdict"] == "no_mismatch"
    assert nothing["nothing"] == nothing["probability"] > 0.5


def test_without_an_answer_no_chance_is_told(right: Diagnosis) -> None:
    """Shares of explanations none of which describes the data are no chances."""
    found = said(replace(right, verdict="unknown"))
    assert found["nothing"] is None
    assert found["probability"] == 0.0


def test_the_diagnosis_of_the_command_line_is_kept_beside_the_recording(
    of_periods: tuple[Plan, Recording, int],
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    only(monkeypatch, ("torsional_compliance", "joint_1"))
    path = Path(of_periods[1].source)
    with (
        patch("sys.argv", ["samii-rig", "diagnose", str(path)]),
        pytest.raises(SystemExit) as ended,
    ):
        main()
    assert not ended.value.code
    assert "Nothing is missing" in capsys.readouterr().out
    assert read_remarks(path).verdict == "no_mismatch"


@pytest.mark.parametrize(
    ("words", "changed"),
    [
        ("widen the band to 31.5 Hz", {"stop_hz": 31.5}),
        ("start the sweep at 0.5 Hz", {"start_hz": 0.5}),
        ("repeat the sweep at half and at twice the amplitude", {"amplitudes": [0.01, 0.08]}),
        (
            "repeat the runs at half the lowest and at twice the highest amplitude, a random-phase "
            "multisine with odd lines among them",
            {"amplitudes": [0.01, 0.08]},
        ),
        ("repeat each run three times, each from rest", {"repeats": 3}),
        ("brace the rig behind link_1", {}),
        ("add a known mass of 2.1 kg at link_3_6", {}),
        ("put another accelerometer on beam", {}),
        ("", {}),
    ],
)
def test_an_experiment_that_can_be_run_is_a_file(
    words: str, changed: dict[str, Any], tmp_path: Path
) -> None:
    text = following(words, SWEEPS)
    if not changed:
        assert text == ""
        return
    file = tmp_path / "next.toml"
    file.write_text(text)
    experiment, _ = load_experiment(str(file), RIG)
    for name, value in changed.items():
        assert np.array_equal(getattr(experiment, name), value)
    assert experiment.plan(RIG).segments
    # What was done already is none.
    assert following(words, text) == "" or "amplitudes" in changed


def test_the_words_of_the_diagnosis_are_known_here() -> None:
    """The sentences above are those of the planner; a change there must be one here."""
    import samii_rig.diagnose

    room = Path(samii_rig.diagnose.__path__[0])
    text = " ".join(f.read_text("utf-8") for f in sorted(room.rglob("*.py")))
    text = text.replace('"\n        "', "")
    for words in (
        "widen the band to {",
        "start the sweep at {",
        "repeat the sweep at half and at twice the amplitude",
        "repeat the runs at half the lowest and at twice the highest amplitude",
        "repeat each run three times, each from rest",
    ):
        assert words in text


NAMED = {
    "verdict": "named",
    "probability": 0.97,
    "repeats": True,
    "levels": 1,
    "of_levels": 3,
    "causes": [{"physics": "mass", "site": "link_1"}],
}
NOTHING = {**NAMED, "verdict": "no_mismatch", "causes": [], "levels": 3}
ELSEWHERE = {**NAMED, "causes": [{"physics": "mass", "site": "link_2"}]}


@pytest.mark.parametrize(
    ("told", "certain"),
    [
        ([NAMED], ""),
        ([NAMED, NAMED], "mass at link_1"),
        ([NAMED, ELSEWHERE], ""),
        ([NAMED, NAMED, ELSEWHERE], ""),
        ([NAMED, {**NAMED, "probability": 0.95}, NAMED], ""),
        ([NAMED, {**NAMED, "repeats": False}], ""),
        ([NAMED, {**NAMED, "verdict": "ambiguous"}], ""),
        ([{"verdict": "", "trouble": "x", "repeats": True}] * 2, ""),
        ([NOTHING, NOTHING], "nothing is missing"),
        # A level that was not measured may show what depends on amplitude.
        ([{**NOTHING, "levels": 2}] * 2, ""),
    ],
)
def test_certain_is_the_same_answer_twice_in_a_row(
    told: list[dict[str, Any]], certain: str, tmp_path: Path
) -> None:
    job = Job.make(tmp_path, Request("x", "x.mcap"), RIG_TOML, SWEEPS)
    analysis = Analysis(tmp_path)
    analysis.turn(job)
    for i, found in enumerate(told):
        job.tell(SO_FAR, {"time": time.time(), "next_toml": "", "number": i, **found})
        analysis.turn(job)
        analysis.turn(job)  # looked at twice is not told twice
    assert analysis.certain == certain
    state = analysis.state()
    assert state["diagnosis"]["certain"] == certain
    assert state["diagnosis"]["age_s"] < 60.0
    # Another run begins with nothing.
    analysis.turn(Job.make(tmp_path, Request("y", "y.mcap"), RIG_TOML, SWEEPS))
    assert analysis.certain == ""
    assert analysis.state()["diagnosis"] is None


def test_the_last_word_of_the_runner_is_none_of_the_analyst(tmp_path: Path) -> None:
    job = Job.make(tmp_path, Request("x", "x.mcap"), RIG_TOML, SWEEPS)
    analysis = Analysis(tmp_path)
    job.tell(DIAGNOSIS, {"verdict": "no_mismatch", "next_toml": "", "final": True})
    analysis.turn(job)
    assert analysis.state()["diagnosis"] is None
    assert analysis.certain == ""


def test_a_run_that_ends_while_it_is_looked_at_is_looked_at_once_more(
    swept: tuple[Plan, Recording, int], tmp_path: Path
) -> None:
    plan, recording, _ = swept
    job = Job.make(tmp_path / "jobs", Request("swept_sine", "run.mcap"), RIG_TOML, SWEEPS)
    job.set(JobState(phase="analysing"))
    with patch("samii_rig.serve.analyst.Diagnoser"):
        Analyst(job, Path(recording.source).parent).go()
    told = json.loads((job.folder / RESPONSES).read_text())
    assert told["done"] == told["of"] == len(plan.segments)
    assert [(r["level"], r["n"], r["going_on"]) for r in told["responses"]] == [
        (0.02, 2, False),
        (0.04, 2, False),
    ]


def test_what_two_tell_of_a_job_at_once_is_whole(tmp_path: Path) -> None:
    job = Job.make(tmp_path, Request("x", "x.mcap"), RIG_TOML, SWEEPS)

    def tell(by: int) -> None:
        for n in range(200):
            job.tell(RESPONSES, {"by": by, "long": [n] * 500})

    with ThreadPoolExecutor(2) as pool:
        told = [pool.submit(tell, by) for by in range(2)]
        while not all(t.done() for t in told):
            if (job.folder / RESPONSES).exists():
                assert len(json.loads((job.folder / RESPONSES).read_text())["long"]) == 500
        for t in told:
            t.result()
    assert not [f for f in job.folder.iterdir() if f.name.startswith("tmp")]


def test_a_diagnosis_ends_with_who_asked_for_it() -> None:
    """An analyst that is killed leaves no process behind, not even one in the midst of it."""
    program = """
import time
from samii_rig.rig.load import load_rig
from samii_rig.serve.analyst import Diagnoser

class Long:
    def __reduce__(self):
        return time.sleep, (600,)

kept = Diagnoser(load_rig("samii")[1])
kept.ask({}, Long())
print("asked", flush=True)
time.sleep(600)
"""
    command = [sys.executable, "-c", program]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as analyst:
        assert analyst.stdout is not None
        assert analyst.stdout.readline() == "asked\n"
        analyst.kill()
        # Its end is read once nobody has it open any more.
        analyst.communicate(timeout=WITHIN)


def test_what_a_diagnosis_tries_is_told_until_it_is_found(tmp_path: Path) -> None:
    ours, theirs = Pipe()
    diagnoser = Diagnoser.__new__(Diagnoser)
    diagnoser._line, diagnoser.idle, diagnoser.doing = ours, False, ""
    for words in ("what is missing: 1 of 3", "what is missing: 2 of 3, 4 s left"):
        theirs.send(words)
    assert diagnoser.taken() is None
    assert diagnoser.doing == "what is missing: 2 of 3, 4 s left"
    job = Job.make(tmp_path, Request("x", "x.mcap"), RIG_TOML, SWEEPS)
    analysis = Analysis(tmp_path)
    analysis._job = job
    job.set(JobState(phase="running"))
    assert analysis.state()["doing"] == ""
    job.tell(DOING, {"doing": diagnoser.doing})
    assert analysis.state()["doing"] == diagnoser.doing
    # The last word is the runner's, who says what it tries itself.
    job.set(JobState(phase="analysing"))
    assert analysis.state()["doing"] == ""
    job.set(JobState(phase="running"))
    (job.folder / DOING).write_text("[")
    assert analysis.state()["doing"] == ""
    theirs.send({"verdict": "named"})
    assert diagnoser.taken() == {"verdict": "named"}
    assert (diagnoser.idle, diagnoser.doing) == (True, "")


def test_a_run_that_may_end_early_ends_at_rest(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Nothing is missing on a rig that is its model; its one level is measured again and again.
    A rig of two masses and a spring: it has a third of SAMII's table, and so of the wait. Slowly:
    what is measured while a diagnosis is made takes time from it."""
    monkeypatch.setenv("SAMII_RIG_STATE", str(tmp_path / "state"))
    text = sweep(duration=4.0, repeats=200).replace("[0.02]", "[2.0]").replace('"v_2"', '"v"')
    rig = ("--rig", "flexible_joint")
    with Service(tmp_path / "runs", "--pace", "2", *rig) as service, service.lease() as lease:
        id_ = service.start(lease, text, diagnosis=True, stop_when_certain=True)
        service.until(lambda: (service.state()["so_far"] or {}).get("diagnosis"))
        last = service.until(lambda: service.state()["last"])
        assert last["id"] == id_
        assert (last["phase"], last["status"], last["error"]) == ("done", "stopped", "")
        assert "certain after segment" in last["early"]
        # The order itself ended it: nothing holds the queue, nobody stopped it.
        assert service.state()["held"] == ""
        assert last["verdict"] == "no_mismatch"
        asked = {"verdict": "no_mismatch", "text": "ended early"}
        (entry,) = service.http.get("/api/recordings", params=asked).json()["recordings"]
        assert service.http.get(f"/api/jobs/{id_}/diagnosis").json()["final"]
        responses = service.http.get(f"/api/jobs/{id_}/responses").json()
        assert responses["responses"][0]["n"] >= 2

    recording = read_recording(tmp_path / "runs" / entry["path"])
    assert 2 <= len(recording.segments) < 200
    after = recording.sequence >= recording.segments[-1].stop
    # Between two sweeps: all that moves the output is the loop that keeps the joint's angle.
    assert (recording.values[after, recording.column("u")] == 0.0).all()
    v = recording.values_of("v")
    assert np.abs(v[after]).max() < 0.05 * np.abs(v).max()
    assert v[-1] == 0.0
