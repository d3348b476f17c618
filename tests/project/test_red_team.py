"""Whatever somebody leaves in a recording, a request, the index or a run's folder ends well or with
an error of ours; benchmarks/red_team.py tries it thousands of times."""

from __future__ import annotations

import json
import os
import random
import signal
from pathlib import Path
from typing import Any

import pytest
import red_kit
from file_fuzz_kit import count
from serve_kit import settings

from samii_rig.errors import RecordingError
from samii_rig.serve import job as jobs
from samii_rig.serve.analysis import Analysis
from samii_rig.serve.job import SO_FAR, STATE, STOPS, Job, JobState, Request
from samii_rig.serve.rooms import Rooms

OWN = 123_456_789  # no process has this number


@pytest.mark.parametrize(
    ("what", "tries"), [("files", 100), ("bodies", 60), ("index", 40), ("jobs", 10), ("live", 300)]
)
def test_no_attack_escapes(what: str, tries: int, tmp_path: Path) -> None:
    c = count(getattr(red_kit, what)(random.Random(1), tmp_path), tries)
    assert not c.escaped, c.escaped
    assert c.loaded > tries / 10, "what is refused at once tries nothing"


@pytest.fixture
def sent(monkeypatch: pytest.MonkeyPatch) -> list[tuple[int, int]]:
    found: list[tuple[int, int]] = []
    monkeypatch.setattr(jobs.os, "kill", lambda pid, number: found.append((pid, number)))
    return found


def begun(folder: Path) -> Job:
    job = Job.make(folder, Request("step", "run.mcap"), settings(folder).rig_toml, "")
    job.set(JobState("running", pid=OWN))
    return job


@pytest.mark.parametrize("pid", [-1, 0, 1, "7", 1.5, None, True, 2**70])
def test_a_stop_goes_to_the_run_alone_whatever_its_state_says(
    pid: Any, tmp_path: Path, sent: list[tuple[int, int]]
) -> None:
    """To process -1 it would go to all of them."""
    job = begun(tmp_path)
    with job.held() as lock:
        os.write(lock, str(OWN).encode())  # as the runner does
        (job.folder / STATE).write_text(json.dumps({"phase": "running", "pid": pid}))
        assert job.stop("Ada")
        assert job.moving
    assert sent == [(OWN, signal.SIGTERM)]


@pytest.mark.parametrize("state", [b"", b"{", b"[]", b'{"phase": "x"}', b'{"reason": "\\ud800"}'])
def test_a_run_whose_state_is_damaged_is_seen_and_given_up_when_it_is_gone(
    state: bytes, tmp_path: Path
) -> None:
    job = begun(tmp_path / ".samii-rig" / "jobs")
    with job.held():
        (job.folder / STATE).write_bytes(state)
        rooms = Rooms(settings(tmp_path))
        running = rooms.state()["running"]
        assert (running["id"], running["phase"]) == (job.id, "running")
    rooms.supervisor.turn()
    assert rooms.supervisor.current is None
    assert job.written.phase == "died"
    rooms.desk.close()


def test_an_order_that_cannot_be_read_is_shown_and_never_run(tmp_path: Path) -> None:
    job = begun(tmp_path)
    for damaged in ('{"experiment": "step"}', '{"experiment": "step", "recording": "../x.mcap"}'):
        (job.folder / "request.json").write_text(damaged)
        again = Job(job.folder)
        assert again.request.experiment == "unreadable"
        with pytest.raises(RecordingError, match=r"request\.json"):
            again.order()


@pytest.mark.parametrize(
    "line", ["7", '{"by": 1}', '{"by": "x", "time": "then"}', "\xff", "[" * 9000]
)
def test_stops_that_cannot_be_read_keep_nobody_from_stopping(
    line: str, tmp_path: Path, sent: list[tuple[int, int]]
) -> None:
    job = begun(tmp_path)
    with job.held():
        (job.folder / STOPS).write_text(line + "\n", encoding="latin-1")
        assert job.stop("Ada")
    assert sent == [(OWN, signal.SIGTERM)]
    assert [s["by"] for s in job.stops()] == ["Ada"]


@pytest.mark.parametrize(
    "told", ["[]", "{}", '{"time": "x"}', '{"time": 1, "repeats": 3, "probability": "x"}']
)
def test_what_an_analyst_cannot_have_told_is_not_shown(told: str, tmp_path: Path) -> None:
    job = begun(tmp_path)
    analysis = Analysis(tmp_path)
    analysis._job = job
    (job.folder / SO_FAR).write_text(told)
    analysis._look()
    assert analysis.state()["diagnosis"] is None
    assert not analysis.certain


def test_a_clock_that_was_set_back_makes_no_age_negative(tmp_path: Path) -> None:
    job = begun(tmp_path)
    analysis = Analysis(tmp_path)
    analysis._job = job
    path = job.folder / jobs.RESPONSES
    path.write_text("{}")
    os.utime(path, (4e9, 4e9))
    assert analysis.state()["responses_age_s"] == 0.0
