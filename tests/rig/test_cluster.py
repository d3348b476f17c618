"""A cluster found by its address says what this machine says.

Plan: a concealed trial of a campaign, a folder of recordings and a parameter study, each on two
workers of a cluster and here; every digit is the same, and what cannot be diagnosed says why.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from samii_rig.cli.app import app
from samii_rig.diagnose.batch import each
from samii_rig.index.remarks import read_remarks
from samii_rig.prove import campaign, jobs
from samii_rig.rig.load import load_rig
from samii_rig.workers import workers

SWEEP = """
experiment = "swept_sine"
name = "sweep"
actuator = "v_2"
unit = "V"
sweep = "logarithmic"
start_hz = 1.0
stop_hz = 30.0
duration = 12.0
ramp = 0.5
ring_down = 6.0
amplitudes = [0.3]
repeats = 3
"""


@pytest.fixture(scope="module")
def scheduler() -> Iterator[str]:
    # Here: a fifth of a second for each process that collects the tests.
    distributed = pytest.importorskip("distributed")
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, processes=True, dashboard_address=":0"
    ) as cluster:
        yield cluster.scheduler_address


def call(*arguments: object) -> Any:
    done = CliRunner().invoke(app, [str(a) for a in arguments])
    assert done.exception is None, done.exception
    return json.loads(done.stdout)


def answers(out: Path) -> dict[str, Any]:
    files = sorted((out / "answers").glob("*.json"))
    return {f.stem: json.loads(f.read_text().replace(str(out), "")) for f in files}


@pytest.mark.slow  # a campaign's trial three times over
def test_a_campaign_on_a_cluster_says_what_it_says_here(tmp_path: Path, scheduler: str) -> None:
    here, there = tmp_path / "here", tmp_path / "there"
    options = ["--nothing", 1, "--one", 0, "--two", 0, "--outside", 0, "--joints", 0, "--force", 0,
               "--varying", 0, "--seed", 3, "--rig", "samii"]  # fmt: skip
    said = call("prove", "--out", there, *options, "--scheduler", scheduler, "--json")
    assert said["failures"] == []
    assert said["trials"] == 1
    rigs = {"samii": load_rig("samii")[1]}
    todo = jobs.jobs({"nothing": 1}, 3, jobs.pairs(jobs.plants(), rigs)[0])
    with workers(1) as pool:
        assert campaign.carry_out(campaign.Campaign(here, rigs), todo, pool) == []
    assert len(answers(here)) == 1
    assert answers(here) == answers(there)


@pytest.mark.slow  # three diagnoses twice over; a study below crosses the same wire
def test_a_folder_is_diagnosed_on_a_cluster_as_it_is_here(tmp_path: Path, scheduler: str) -> None:
    sweep = tmp_path / "sweep.toml"
    sweep.write_text(SWEEP)
    runs = tmp_path / "runs"
    for seed in (1, 2):
        call("run", sweep, "--out", runs / f"{seed}.mcap", "--seed", seed, "--no-report",
             "--no-diagnosis", "--json")  # fmt: skip
    (runs / "cut_off.mcap").write_bytes((runs / "1.mcap").read_bytes()[:5000])
    out = tmp_path / "out"
    arguments = ["diagnose", runs, "--each", "--scheduler", scheduler, "--out", out, "--json"]
    there = {Path(d.pop("recording")).name: d for d in call(*arguments)["recordings"]}
    with workers(1) as pool:
        here = {log.name: said for log, said in each(sorted(runs.glob("*.mcap")), pool)}
    assert here == there
    assert {name: d.get("verdict", "none") for name, d in there.items()} == {
        "1.mcap": "no_mismatch",
        "2.mcap": "no_mismatch",
        "cut_off.mcap": "none",
    }
    assert "cut_off.mcap" in there["cut_off.mcap"]["error"]
    assert json.loads((out / "2.json").read_text())["verdict"] == "no_mismatch"
    assert read_remarks(runs / "2.mcap").diagnosis["verdict"] == "no_mismatch"


def test_a_parameter_study_on_a_cluster_writes_what_it_writes_here(
    tmp_path: Path, scheduler: str
) -> None:
    here, there = tmp_path / "here.csv", tmp_path / "there.csv"
    # More points than one piece of work has, some of them impossible.
    grid = ["--vary", "joint_1.k=6800:27200:5:log", "--vary", "joint_2.c=-20:160:4"]
    call("study", *grid, "--out", there, "--scheduler", scheduler, "--json")
    call("study", *grid, "--out", here, "--workers", 1, "--json")
    assert len(there.read_text().splitlines()) == 2 + 5 * 4
    assert here.read_bytes() == there.read_bytes()


def test_processes_here_have_one_thread_each(monkeypatch: pytest.MonkeyPatch) -> None:
    import os

    monkeypatch.setenv("OMP_NUM_THREADS", "7")
    with workers(1) as pool:
        assert pool.submit(os.getenv, "OMP_NUM_THREADS").result() == "1"
    assert os.environ["OMP_NUM_THREADS"] == "7"
