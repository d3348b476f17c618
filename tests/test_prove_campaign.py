"""A campaign makes trials, has them diagnosed without the truth, and can be stopped anywhere.

Plan: every kind is spread over the campaign; the diagnosing process cannot open a truth; a trial
whose recordings do not carry the truth's hash is refused; one trial that hides nothing goes the
whole way to an answer, and is not done twice.
"""

from __future__ import annotations

import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from samii_rig.errors import InputError
from samii_rig.prove import campaign
from samii_rig.rig.load import load_rig
from samii_rig.workers import workers


def test_kinds_are_spread_over_the_campaign() -> None:
    todo = campaign.jobs({"nothing": 10, "one": 20}, seed=7)
    assert len(todo) == 30
    first = todo[:6]
    assert {job.kind for job in first} == {"nothing", "one"}
    assert sum(job.kind == "one" for job in first) == 4
    assert [job.seed for job in todo if job.kind == "nothing"] == list(range(7, 17))


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
        campaign.plant("no_such_plant")


def test_a_scheduler_that_does_not_answer_costs_one_line() -> None:
    pytest.importorskip("distributed")
    with (
        pytest.raises(InputError, match="--scheduler"),
        workers(scheduler="tcp://127.0.0.1:9"),
    ):
        pass


@pytest.mark.slow  # a whole trial, made, diagnosed and scored
def test_a_trial_goes_the_whole_way_and_only_once(tmp_path: Path) -> None:
    one = campaign.Campaign(tmp_path, load_rig("samii")[1], keep=True)
    todo = campaign.jobs({"nothing": 1}, seed=3)
    with ThreadPoolExecutor(1) as pool:
        assert campaign.carry_out(one, todo, pool) == []
    (answer,) = (tmp_path / "answers").glob("*.json")
    (trial,) = campaign.results(tmp_path)
    assert trial.truth.kind == "nothing"
    assert trial.answer.verdict in ("no_mismatch", "named", "ambiguous", "unknown")
    # Two independent models of one plant, one of them refitted within its tolerances.
    assert 0 < trial.truth.size < 3
    written = answer.stat().st_mtime_ns
    with ThreadPoolExecutor(1) as pool:
        campaign.carry_out(one, todo, pool)
    assert answer.stat().st_mtime_ns == written
    # A truth that is changed afterwards no longer has the hash that the recordings carry.
    answer.unlink()
    (truth,) = (tmp_path / "truth").glob("*.json")
    truth.write_text(truth.read_text() + " ")
    with ThreadPoolExecutor(1) as pool:
        (failure,) = campaign.carry_out(one, todo, pool)
    assert "truth" in failure
