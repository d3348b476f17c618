"""Runs through the service, in processes as in a lab.

Plan: runs from start to recording, the queue and the stop; the lease and its loss; what is killed:
the service during a run, the runner.
"""

from __future__ import annotations

import errno
import os
import signal
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, suppress
from pathlib import Path
from unittest.mock import patch

import pytest
from serve_kit import Service, sweep
from wait_kit import WITHIN

from samii_rig.cli import main
from samii_rig.errors import RecordingError
from samii_rig.index.store import Index
from samii_rig.record.reader import read_recording
from samii_rig.record.verify import verify
from samii_rig.rig.load import load_rig
from samii_rig.run.experiments import shipped
from samii_rig.serve import runner
from samii_rig.serve.job import Job, JobState, Request
from samii_rig.serve.supervisor import Supervisor

PACE = "4"  # times real time: what is waited for takes seconds
SWEEPS = 5
LONG = sweep(duration=60.0, repeats=SWEEPS)  # a minute and more at that pace, never waited for


@pytest.fixture(autouse=True, scope="module")
def _own_state(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("SAMII_RIG_STATE", str(tmp_path_factory.mktemp("state")))
        yield


@pytest.fixture(scope="module")
def service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Service]:
    with Service(tmp_path_factory.mktemp("lab"), "--pace", PACE) as started:
        yield started


def ended(service: Service, id_: str) -> dict:
    """The job, asked for after the service has put its recording in the list."""

    def over() -> bool:
        last = service.state()["last"]
        return bool(last) and last["id"] == id_

    service.until(over)
    return service.job(id_)


def recording_of(service: Service, job: dict) -> Path:
    return service.folder / job["recording"]


def test_a_lab_s_afternoon(service: Service, capsys: pytest.CaptureFixture[str]) -> None:
    """Three runs are asked for; one is stopped by somebody, one taken back, one goes through."""
    with service.lease() as lease:
        first = service.start(lease, LONG)
        second = service.start(lease, sweep())
        third = service.start(lease, sweep())
        service.until(service.progressing)
        state = service.state()
        assert state["running"]["progress"]["n_segments"] == SWEEPS
        assert [j["id"] for j in state["queue"]] == [second, third]
        left = [
            state["running"]["progress"]["time_left"],
            *(j["duration_s"] for j in state["queue"]),
        ]
        assert state["time_left_s"] == pytest.approx(sum(left))
        assert service.http.delete(f"/api/queue/{third}", headers=lease).status_code == 200
        assert service.job(third)["phase"] == "cancelled"

        # By another, with nothing to show.
        answer = service.http.post("/api/stop", headers={"origin": "http://elsewhere"})
        assert answer.json()["stopped"] is True
        job = ended(service, first)
        assert job["status"] == "stopped"
        assert job["reason"].startswith("stop asked by Ada at 127.0.0.1")
        recording = read_recording(recording_of(service, job))
        assert recording.values[-1, recording.column("v_2")] == 0.0
        found = service.http.get(
            "/api/recordings", params={"text": "stop asked by Ada at 127.0.0.1"}
        )
        assert found.json()["recordings"][0]["path"] == job["recording"]
        assert found.json()["recordings"][0]["id"] == job["recording_id"]
        # The recording says the same as the page, and so does `verify`.
        assert recording.stop.reason == job["reason"]
        asked = ["samii-rig", "verify", str(recording_of(service, job))]
        with patch("sys.argv", asked), pytest.raises(SystemExit):
            main()
        assert f"stopped: {job['reason']}" in capsys.readouterr().out

        # What was stopped is looked at by a person before anything moves again.
        state = service.state()
        assert state["running"] is None
        assert "stop asked by Ada at 127.0.0.1" in state["held"]
        assert [j["id"] for j in state["queue"]] == [second]
        refused = service.http.post("/api/runs", headers=lease, json={"experiment": "step"})
        assert refused.status_code == 409
        service.http.post("/api/queue/resume", headers=lease)
        job = ended(service, second)
        assert (job["phase"], job["status"], job["error"]) == ("done", "completed", "")

    path = recording_of(service, job)
    assert verify(path).status == "whole"
    asked = {"experiment": "short", "status": "completed"}
    (entry,) = service.http.get("/api/recordings", params=asked).json()["recordings"]
    assert entry["path"] == path.name
    frf = service.http.get(f"/api/recordings/{entry['id']}/frf").json()["responses"]
    assert frf[0]["curves"][0]["input"] == "v_2"
    assert service.http.get(f"/api/recordings/{entry['id']}/file").content == path.read_bytes()


def test_a_service_that_is_told_to_end_leaves_nothing_behind(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    with Service(tmp_path) as ending:
        assert ending.http.get("/api/rig").status_code == 200
    assert ending.process.returncode == 0
    assert capfd.readouterr().err == ""


def test_a_service_that_ends_during_a_run_says_what_becomes_of_it(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    with Service(tmp_path, "--pace", "2") as ending:
        with ending.lease() as lease:
            id_ = ending.start(lease, LONG)
            ending.until(ending.progressing)
        ending.process.terminate()
        ending.process.wait(WITHIN)
        job = Job(tmp_path / ".samii-rig" / "jobs" / id_)
        line = capfd.readouterr().err
        assert f"{job.request.recording} goes on without the service" in line
        # What it says ends the run at zero output.
        os.kill(int(line.rpartition("kill ")[2]), signal.SIGTERM)
        ending.until(lambda: not job.alive())
    recording = read_recording(tmp_path / job.request.recording)
    assert recording.stop.status == "stopped"
    assert recording.values[-1, recording.column("v_2")] == 0.0


def test_a_service_ends_without_a_word_whatever_is_asked_of_it(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    """An upload that stalls, a download and live data that nobody reads, and a rig to be drawn."""
    with (tmp_path / "large.mcap").open("wb") as file:
        file.truncate(64 << 20)
    with ExitStack() as stack, Service(tmp_path) as ending:
        (entry,) = ending.http.get("/api/recordings").json()["recordings"]
        for head in (
            "POST /api/recordings HTTP/1.1\r\ncontent-length: 1000",
            f"GET /api/recordings/{entry['id']}/file HTTP/1.1",
            "GET /api/live HTTP/1.1\r\nconnection: upgrade\r\nupgrade: websocket\r\n"
            "sec-websocket-version: 13\r\nsec-websocket-key: MDAwMDAwMDAwMDAwMDAwMA==",
            "GET /api/rig HTTP/1.1",
        ):
            address = ("127.0.0.1", int(ending.port))
            asking = stack.enter_context(socket.create_connection(address, WITHIN))
            asking.sendall(f"{head}\r\nhost: 127.0.0.1:{ending.port}\r\n\r\n".encode())
        assert ending.http.get("/api/state").status_code == 200  # what came before is being done
    assert ending.process.returncode == 0
    assert capfd.readouterr().err == ""


def test_after_a_stop_all_that_was_recorded_is_estimated(service: Service) -> None:
    with service.lease() as lease:
        id_ = service.start(lease, LONG)
        # The first sweep, from 1 Hz on, has passed 5 Hz and is not over.
        service.until(lambda: frequency(service) > 5.0)
        service.http.post("/api/stop")
        job = ended(service, id_)
        # No diagnosis was asked for, and none is there to be asked for.
        assert (job["estimated"], job["diagnosed"]) == (True, False)
        told = service.http.get(f"/api/jobs/{id_}/responses").json()
        assert (told["final"], told["done"], told["of"]) == (True, 0, SWEEPS)
        (response,) = told["responses"]
        assert response["going_on"]
        assert response["high_hz"] > 4.0


def frequency(service: Service) -> float:
    """That the run has reached, Hz; 0 at rest."""
    running = service.state()["running"]
    return (running or {"progress": {}})["progress"].get("frequency") or 0.0


def test_a_stop_while_it_starts_keeps_anything_from_moving(service: Service) -> None:
    with service.lease() as lease:
        id_ = service.start(lease, LONG)
        assert service.http.post("/api/stop").json()["stopped"] is True
        job = ended(service, id_)
        assert job["phase"] in ("refused", "died")
        assert "before " in job["error"] + job["reason"]
        assert not recording_of(service, job).exists()


def test_without_the_lease_nothing_starts(service: Service) -> None:
    with service.lease() as lease:
        for headers in ({}, {"x-lease": "guess"}):
            answer = service.http.post("/api/runs", headers=headers, json={"experiment": "step"})
            assert answer.status_code == 409
            assert "not your lease" in answer.json()["error"]
        assert service.http.post("/api/lease").status_code == 409
        assert service.http.delete("/api/lease", headers=lease).status_code == 200


def test_a_plan_beyond_a_limit_is_refused_with_the_amplitude_that_is_not(service: Service) -> None:
    with service.lease() as lease:
        hard = sweep().replace("[0.02]", "[9.0]")
        answer = service.http.post("/api/runs", headers=lease, json={"experiment_toml": hard})
        assert answer.status_code == 400
        assert "largest level that would not" in answer.json()["error"]
        planned = service.http.post("/api/dry-run", json={"experiment_toml": hard}).json()
        assert planned["refused"] == answer.json()["error"]
        assert planned["runs"][0]["margins"][0]["margin"] < 0.0


def test_an_early_end_wants_a_diagnosis_that_can_become_certain(service: Service) -> None:
    scan, *places = shipped()["mode_scan"].read_text().split("[[place]]")
    two_runs = "[[place]]".join([scan.replace("repeats = 3", "repeats = 1"), *places[:2]])
    with service.lease() as lease:
        for order, said in (
            ({"experiment_toml": sweep(), "diagnosis": False}, "without one nothing"),
            ({"experiment_toml": two_runs}, "diagnosed together"),
        ):
            asked = {**order, "stop_when_certain": True}
            answer = service.http.post("/api/runs", headers=lease, json=asked)
            assert answer.status_code == 422
            assert "order: stop_when_certain is True; expected false" in answer.json()["error"]
            assert said in answer.json()["error"]
        assert service.state()["queue"] == []
        assert service.state()["running"] is None


def test_an_operator_who_goes_silent_stops_the_run(service: Service) -> None:
    silent = threading.Event()
    with service.lease(silent) as lease:
        id_ = service.start(lease, LONG)
        service.until(service.progressing)
        silent.set()
        job = ended(service, id_)
        assert job["status"] == "stopped"
        found = service.http.get("/api/recordings", params={"text": "Ada gave no sign of life"})
        assert found.json()["recordings"][0]["path"] == job["recording"]


def test_a_diagnosis_that_is_killed_leaves_the_run_as_it_ended(tmp_path: Path) -> None:
    jobs = tmp_path / ".samii-rig" / "jobs"
    request = Request("short", "run.mcap")
    for phase, status in (("analysing", "completed"), ("starting", "")):
        job = Job.make(jobs, request, "", "")
        job.set(JobState(phase=phase, pid=1, status=status))  # type: ignore[arg-type]
    rig, text = load_rig("samii")
    found = Supervisor(rig, text, Index(tmp_path), 0.0)
    states = [job.written for job in Job.all(jobs)]
    assert [(s.phase, s.status) for s in states] == [("done", "completed"), ("died", "failed")]
    assert found.current is None
    assert "without a word" in found.held


@pytest.mark.parametrize(
    ("status", "stops", "held"),
    [("stopped", False, False), ("stopped", True, True), ("tripped", False, True)],
)
def test_only_an_end_by_the_order_itself_lets_the_queue_go_on(
    tmp_path: Path, status: str, stops: bool, held: bool
) -> None:
    """A limit may trip on the way to the rest at which a run ends early."""
    job = Job.make(tmp_path / ".samii-rig" / "jobs", Request("short", "run.mcap"), "", "")
    rig, text = load_rig("samii")
    supervisor = Supervisor(rig, text, Index(tmp_path), 0.0)
    supervisor.held = ""
    job.set(JobState(phase="done", status=status, reason="why", early="its diagnosis was certain"))
    if stops:
        with job.held():
            job.stop("somebody")
    supervisor.turn()
    assert bool(supervisor.held) is held


def test_a_recording_that_cannot_be_closed_did_not_go_through(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The queue is held, though the rig had come to rest in good order."""

    def full(self: runner.Runner, *_: object) -> None:
        self._set(phase="analysing", status="completed", reason="done", at_zero=True)
        raise RecordingError("no space left on device")

    monkeypatch.setattr(runner, "planned", lambda job: (None, "", None))
    monkeypatch.setattr(runner.Runner, "_carry_out", full)
    job = Job.make(tmp_path / ".samii-rig" / "jobs", Request("short", "run.mcap"), "", "")
    rig, text = load_rig("samii")
    supervisor = Supervisor(rig, text, Index(tmp_path), 0.0)
    supervisor.held = ""
    with pytest.raises(RecordingError):
        runner.Runner(job, tmp_path).go()
    assert (job.written.phase, job.written.status) == ("refused", "failed")
    assert job.written.at_zero is True
    supervisor._open = [job]
    supervisor.turn()
    assert "run.mcap: failed" in supervisor.held


def test_a_disk_without_room_for_the_word_of_the_end_still_takes_the_recording(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    text = load_rig("samii")[1]
    request = Request("short", "run.mcap", diagnosis=False, settings={"pace": 0.0})
    job = Job.make(tmp_path / ".samii-rig" / "jobs", request, text, sweep(1.5, 1))
    put = Job.set

    def full(self: Job, state: JobState) -> None:
        if state.phase == "analysing":
            raise OSError(errno.ENOSPC, "No space left on device")
        put(self, state)

    monkeypatch.setattr(Job, "set", full)
    with suppress(OSError):  # said again when there is more to say
        runner.Runner(job, tmp_path).go()
    assert verify(tmp_path / "run.mcap").status == "whole"


def test_a_runner_that_is_killed_leaves_what_it_recorded(service: Service) -> None:
    with service.lease() as lease:
        id_ = service.start(lease, LONG)
        service.until(service.progressing)
        job = Job(service.folder / ".samii-rig" / "jobs" / id_)
        time.sleep(1.5)  # the recorder is on the disk within a second
        os.kill(job.written.pid, signal.SIGKILL)
        done = ended(service, id_)
        assert (done["phase"], done["status"]) == ("died", "failed")
        (back,) = service.folder.glob("*.recovered.mcap")
        assert len(read_recording(back)) > 0


KILLS = 2  # the second service of a run that another had found going on


def test_a_service_that_is_killed_loses_nothing(tmp_path: Path) -> None:
    """Killed twice during a run, and started again: the run goes on as if nothing were."""
    with Service(tmp_path, "--pace", "4") as service:
        with service.lease() as lease:
            id_ = service.start(lease, sweep(repeats=10))
            for i in range(KILLS):
                if i:
                    service.until(service.progressing)
                service.kill()
                service.begin()
                running = service.state()["running"]
                assert running is not None
                assert running["id"] == id_
            job = ended(service, id_)
        assert (job["phase"], job["status"], job["error"]) == ("done", "completed", "")
        found = service.http.get("/api/recordings").json()["recordings"]
        assert [(e["path"], e["status"]) for e in found] == [(job["recording"], "completed")]
    recording = read_recording(tmp_path / job["recording"])
    assert verify(tmp_path / job["recording"]).status == "whole"
    assert len(recording.segments) == 10
    assert recording.stop.missing_samples == 0
    assert not list(tmp_path.glob("*.partial"))


def test_a_run_stops_without_the_service_if_the_rig_file_says_so(tmp_path: Path) -> None:
    file = tmp_path / "careful.toml"
    file.write_text(load_rig("samii")[1] + '\n[service]\nwhen_lost = "stop"\n')
    started = Service(tmp_path / "runs", "--pace", "2", "--rig", str(file))
    with started as service, service.lease() as lease:
        id_ = service.start(lease, LONG)
        service.until(service.progressing)
        service.kill()
        job = Job(service.folder / ".samii-rig" / "jobs" / id_)
        service.until(lambda: not job.alive())
        service.begin()
        done = ended(service, id_)
        assert done["status"] == "stopped"
        found = service.http.get("/api/recordings", params={"text": "service gave no sign"})
        assert found.json()["recordings"][0]["path"] == done["recording"]
