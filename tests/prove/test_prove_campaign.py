"""A campaign makes trials, has them diagnosed without the truth, and can be stopped anywhere.

Plan: every kind is spread over the campaign; the diagnosing process cannot open a truth; a trial
whose recordings do not carry the truth's hash is refused; one trial that hides nothing goes the
whole way to an answer, and is not done twice.
"""

from __future__ import annotations

import subprocess
import sys
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from samii_rig.errors import InputError
from samii_rig.prove import campaign, jobs, outcomes
from samii_rig.rig.load import load_rig
from samii_rig.rig.shipped import shipped
from samii_rig.workers import workers


class Maker:
    """A plant in name: it refuses rigs by their text and makes nothing."""

    def __init__(self, *texts: str) -> None:
        self.texts = texts

    def refuses(self, kind: str, rig_toml: str) -> str:
        if kind == "joints":
            return "no trials of kind 'joints'"
        return "" if rig_toml in self.texts else f"cannot be {rig_toml}"

    def __call__(self, kind: str, seed: int, out: Path, rig_toml: str) -> Path:
        raise AssertionError("not to be called")


MAKERS = {"first": Maker("A"), "second": Maker("A", "B")}
RIGS = {"a": "A", "b": "B"}


def having() -> jobs.Pairs:
    return jobs.pairs(("first", "second"), RIGS, find=MAKERS.__getitem__)[0]


def test_kinds_are_spread_over_the_campaign() -> None:
    todo = jobs.jobs({"nothing": 10, "one": 20}, 7, having())
    assert len(todo) == 30
    first = todo[:6]
    assert {job.kind for job in first} == {"nothing", "one"}
    assert sum(job.kind == "one" for job in first) == 4
    assert [job.seed for job in todo if job.kind == "nothing"] == list(range(7, 17))


def test_every_pair_of_plant_and_rig_is_as_likely_and_the_seed_draws_it() -> None:
    todo = jobs.jobs({"one": 900}, 0, having())
    drawn = Counter((job.plant, job.rig) for job in todo)
    assert set(drawn) == {("first", "a"), ("second", "a"), ("second", "b")}
    assert all(250 < n < 350 for n in drawn.values())  # 300 expected, 14 the standard deviation
    assert todo == jobs.jobs({"one": 900}, 0, having())
    assert todo != jobs.jobs({"one": 900}, 1, having())


def test_what_a_plant_cannot_make_is_said() -> None:
    found, left_out = jobs.pairs(("first", "second"), RIGS, find=MAKERS.__getitem__)
    assert left_out == ["first cannot make b: cannot be B"]
    with pytest.raises(InputError, match="--joints is 3"):
        jobs.jobs({"joints": 3}, 0, found)
    with pytest.raises(InputError, match="--rig is 'b'"):
        jobs.pairs(("first",), RIGS, find=MAKERS.__getitem__)


def test_each_plant_makes_the_rigs_that_it_says() -> None:
    rigs = {name: load_rig(name)[1] for name in shipped()}
    found, left_out = jobs.pairs(("assumed_modes", "concealed"), rigs, asked=())
    by = {p: {rig for q, rig in found["one"] if q == p} for p in ("assumed_modes", "concealed")}
    assert by["assumed_modes"] == set(rigs)
    assert all(words.startswith("concealed cannot make") for words in left_out)
    assert by["concealed"] == {"samii", "samii_braced", "samii_joint_3", "samii_two_joints", "sflr"}
    assert {p for p, _ in found["force"]} == {"assumed_modes"}
    assert {p for p, _ in found["joints"]} == {"concealed"}


def test_a_folder_of_other_rigs_is_not_gone_on_with(tmp_path: Path) -> None:
    made = {"plants": ["first"], "rigs": ["a"], "command": "x", "commit": "y"}
    campaign.claim(tmp_path, made)
    campaign.claim(tmp_path, made)
    with pytest.raises(InputError, match="--rig is 'a, b'; expected a"):
        campaign.claim(tmp_path, {**made, "rigs": ["a", "b"]})


def test_a_trial_that_fails_is_noted_and_ends_nothing(tmp_path: Path) -> None:
    broken = campaign.Campaign(tmp_path, {"a": "no rig file"})
    todo = [jobs.Job("nothing", seed, "assumed_modes", "a") for seed in (1, 2)]
    with ThreadPoolExecutor(1) as pool:
        failures = campaign.carry_out(broken, todo, pool)
    assert len(failures) == 2
    _, kept = outcomes.collected(tmp_path)
    assert [o["at"] for o in kept] == ["plant", "plant"]
    assert all("not valid TOML" in o["error"] for o in kept)


def test_none_is_begun_after_the_time_is_up(tmp_path: Path) -> None:
    broken = campaign.Campaign(tmp_path, {"a": "no rig file"})
    todo = [jobs.Job("nothing", seed, "assumed_modes", "a") for seed in range(3)]
    with ThreadPoolExecutor(1) as pool:
        assert campaign.carry_out(broken, todo, pool, until=-1.0) == []
    assert outcomes.collected(tmp_path)[1] == []


@pytest.mark.parametrize(
    "touch",
    ["open({!r})", "os.listdir({!r})", "pathlib.Path({!r}).read_text()", "os.open({!r}, 0)"],
)
def test_the_diagnosing_process_cannot_open_a_truth(tmp_path: Path, touch: str) -> None:
    truths = tmp_path / "truth"
    truths.mkdir()
    (truths / "x.json").write_text("{}")
    target = truths if "listdir" in touch else truths / "x.json"
    code = (
        "import os, pathlib\n"
        "from samii_rig.prove.reader import hide\n"
        f"hide(pathlib.Path({str(truths)!r}))\n"
        f"pathlib.Path({str(tmp_path / 'seen.txt')!r}).write_text('seen')\n"
        f"{touch.format(str(target))}\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert "the truth is not for the diagnosis" in done.stderr
    assert (tmp_path / "seen.txt").read_text() == "seen"


def test_an_unknown_plant_costs_one_line() -> None:
    with pytest.raises(InputError, match="--plant"):
        jobs.plant("no_such_plant")


def test_a_scheduler_that_does_not_answer_costs_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("distributed")
    monkeypatch.setattr("samii_rig.workers.ANSWERS_WITHIN", "1s")
    with (
        pytest.raises(InputError, match="--scheduler"),
        workers(scheduler="tcp://127.0.0.1:9"),
    ):
        pass


# Of the one bursts of finite elements, of the other what its seed draws.
@pytest.mark.slow  # a whole trial, made, diagnosed and scored
@pytest.mark.parametrize("plant", ["concealed", "assumed_modes"])
def test_a_trial_goes_the_whole_way_and_only_once(tmp_path: Path, plant: str) -> None:
    one = campaign.Campaign(tmp_path, {"samii": load_rig("samii")[1]}, keep=True)
    todo = [jobs.Job("nothing", 3, plant, "samii")]
    with ThreadPoolExecutor(1) as pool:
        assert campaign.carry_out(one, todo, pool) == []
    (answer,) = (tmp_path / "answers").glob("*.json")
    ((outcome),) = outcomes.collected(tmp_path)[1]
    (trial,) = outcomes.trials([outcome])
    assert trial.truth.kind == "nothing"
    assert (trial.truth.plant, trial.truth.rig) == (plant, "samii")
    assert trial.answer.verdict in ("no_mismatch", "named", "ambiguous", "unknown")
    # Two independent models of one plant, one of them refitted within its tolerances.
    assert 0 <= trial.truth.size < 3
    assert 0 < trial.seconds < campaign.LONGEST
    written = answer.stat().st_mtime_ns
    with ThreadPoolExecutor(1) as pool:
        campaign.carry_out(one, todo, pool)
    assert answer.stat().st_mtime_ns == written
    # A truth that is changed afterwards no longer has the hash that the recordings carry.
    answer.unlink()
    (tmp_path / "outcomes" / "nothing_3.json").unlink()
    (truth,) = (tmp_path / "truth").glob("*.json")
    truth.write_text(truth.read_text() + " ")
    with ThreadPoolExecutor(1) as pool:
        (failure,) = campaign.carry_out(one, todo, pool)
    assert "truth" in failure
