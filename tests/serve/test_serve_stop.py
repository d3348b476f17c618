"""Nothing keeps a stop from being heard.

Plan: the door, that lets in who has something to say; the service under half-sent heads, with few
descriptors; the stop's own listener while the service hangs, is gone, or comes again; many stops
at once.
"""

from __future__ import annotations

import asyncio
import os
import signal
import socket
from collections.abc import Awaitable, Callable, Iterator
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any

import httpx
import pytest
from serve_kit import Service, client, settings, sweep
from wait_kit import WITHIN, found

from samii_rig.record.reader import read_recording
from samii_rig.rig.load import load_rig
from samii_rig.serve import access, door, job
from samii_rig.serve.access import MAX_HEAD
from samii_rig.serve.door import RESERVE, Door, Guest
from samii_rig.serve.job import Job, JobState, Request, asked_to_stop
from samii_rig.serve.rooms import Rooms
from samii_rig.serve.stopper import Stopper
from samii_rig.serve.supervisor import Supervisor

HALF = b"GET / HTTP/1.1\r\nhost: x\r\n"
ATTACK = 1100  # connections, more than the descriptors that are allowed below
LONG = sweep(duration=60.0, repeats=5)


@pytest.fixture(autouse=True, scope="module")
def _own_state(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("SAMII_RIG_STATE", str(tmp_path_factory.mktemp("state")))
        yield


class Asking:
    """Connections to a door before stops, all in this process."""

    def __init__(self, port: int) -> None:
        self.port, self._open = port, list[asyncio.StreamWriter]()

    async def said(self, head: bytes) -> asyncio.StreamReader:
        """Begin to ask."""
        reader, writer = await asyncio.open_connection("127.0.0.1", self.port)
        self._open.append(writer)
        writer.write(head)
        await writer.drain()
        return reader

    async def answer(self, head: str) -> str:
        reader = await self.said(f"{head}\r\n".encode("latin-1"))
        return (await asyncio.wait_for(reader.read(), WITHIN)).decode()

    async def leave(self) -> None:
        for writer in self._open:
            writer.close()
            with suppress(OSError):
                await writer.wait_closed()


def with_door(work: Callable[[Asking], Awaitable[Any]], jobs: Path) -> Any:
    """What `work` gives, of a door with eight places."""

    async def run() -> Any:
        with socket.create_server(("127.0.0.1", 0)) as listening:
            opened = asyncio.create_task(
                Door(listening, lambda g: Stopper(g, jobs, lambda: None), 8).open()
            )
            asking = Asking(listening.getsockname()[1])
            try:
                return await work(asking)
            finally:
                await asking.leave()
                opened.cancel()
                await asyncio.gather(opened, return_exceptions=True)

    return asyncio.run(run())


def test_who_owes_a_head_for_longest_makes_way(tmp_path: Path) -> None:
    async def work(asking: Asking) -> None:
        held = [await asking.said(HALF) for _ in range(8)]
        said = await asking.answer("POST /api/stop HTTP/1.1\r\n")
        assert '{"stopped": false, "moving": false}' in said
        assert await held[0].read() == b""
        with pytest.raises(TimeoutError):
            await asyncio.wait_for(held[-1].read(), 0.05)

    with_door(work, tmp_path)


def test_a_head_that_does_not_end_is_cut_off(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(door, "HEAD_WITHIN", 0.1)
    monkeypatch.setattr(door, "LOOK", 0.02)

    async def work(asking: Asking) -> bytes:
        return await asyncio.wait_for((await asking.said(HALF)).read(), WITHIN)

    assert with_door(work, tmp_path) == b""


def test_those_who_are_served_leave_room_for_a_stop(tmp_path: Path) -> None:
    """As long as there is one place beyond those who are served, everybody who comes is heard."""

    def guests(of: Door, address: str, n: int) -> None:
        for _ in range(n):
            guest = Guest(socket.socket(), address)
            guest.owes(False)
            of._guests[guest] = None

    with socket.socket() as listening:
        of = Door(listening, lambda g: asyncio.Protocol(), 3 * RESERVE, each=2 * RESERVE)
        guests(of, "a", RESERVE)
        assert not of.crowded("a")
        guests(of, "a", 1)
        assert of.crowded("a")
        assert not of.crowded("b")
        guests(of, "b", RESERVE)
        assert of.crowded("c")
        for guest in of._guests:
            guest.connection.close()
        assert not of.crowded("a")


def test_where_it_is_crowded_only_a_stop_is_served(tmp_path: Path) -> None:
    rooms = Rooms(settings(tmp_path))
    http = client(rooms)
    http._transport.app._crowded = lambda address: True  # type: ignore[attr-defined]

    async def ask() -> list[int]:
        return [
            (await http.get("/api/state")).status_code,
            (await http.get("/api/stop")).status_code,
            (await http.post("/api/stop")).status_code,
        ]

    assert asyncio.run(ask()) == [503, 200, 200]
    rooms.desk.close()


def test_a_body_that_stalls_is_given_up(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(access, "BODY_WITHIN", 0.05)
    rooms = Rooms(settings(tmp_path))

    async def stalling() -> Any:
        yield b"{"
        await asyncio.sleep(WITHIN)

    async def ask() -> int:
        async with client(rooms) as http:
            return (await http.post("/api/dry-run", content=stalling())).status_code

    assert asyncio.run(ask()) in (400, 422)
    rooms.desk.close()


@pytest.mark.parametrize(
    ("head", "said"),
    [
        ("POST /api/stop HTTP/1.1\r\norigin: http://lab:8340\r\n", "Allow-Origin: http://lab:8340"),
        ("OPTIONS /api/stop HTTP/1.1\r\norigin: http://x\r\n", "204 No Content"),
        ("GET /api/stop HTTP/1.1\r\n", '{"moving": false}'),
        ("GET /api/state HTTP/1.1\r\n", "404 Not Found"),
        ("POST http://[ HTTP/1.1\r\n", "400 Bad Request"),
        ("\x00\xff\r\n:\r\n::\r\n", "404 Not Found"),
        (f"POST /api/stop HTTP/1.1\r\nx: {'y' * 2 * MAX_HEAD}", "431"),
    ],
)
def test_the_listener_of_the_stop_answers_whatever_it_is_told(
    tmp_path: Path, head: str, said: str
) -> None:
    assert said in with_door(lambda asking: asking.answer(head), tmp_path)


def made(folder: Path, phase: str) -> Job:
    one = Job.make(folder / ".samii-rig" / "jobs", Request("short", "run.mcap"), "", "")
    one.set(JobState(phase=phase, pid=os.getpid()))  # type: ignore[arg-type]
    return one


@pytest.fixture
def signals(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    sent: list[int] = []
    monkeypatch.setattr(job.os, "kill", lambda pid, number: sent.append(number))
    return sent


def test_many_who_stop_at_once_send_one_signal(tmp_path: Path, signals: list[int]) -> None:
    """A second signal cuts off what the first has begun: it waits until that had its time."""
    one = made(tmp_path, "running")
    with one.held():
        for i in range(5):
            assert one.stop(f"{i}")
        assert signals == [signal.SIGTERM]
        assert [s["by"] for s in one.stops()] == ["0", "1", "2", "3", "4"]


@pytest.mark.parametrize(("phase", "sent"), [("running", 2), ("analysing", 1)])
def test_who_insists_cuts_off_a_run_that_hangs(
    tmp_path: Path, signals: list[int], monkeypatch: pytest.MonkeyPatch, phase: str, sent: int
) -> None:
    one = made(tmp_path, phase)
    monkeypatch.setattr(job, "INSIST_AFTER", 0.0)
    with one.held():
        one.stop("a")
        one.stop("b")
    assert len(signals) == sent


def test_a_full_disk_keeps_nobody_from_stopping(
    tmp_path: Path, signals: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    one = made(tmp_path, "running")

    def full(*_: Any) -> int:
        raise OSError(28, "No space left on device")

    with one.held():
        monkeypatch.setattr(job.os, "open", full)
        assert one.stop("a")
    assert signals == [signal.SIGTERM]


def test_a_stop_beside_the_service_holds_its_queue(tmp_path: Path) -> None:
    made(tmp_path, "queued")
    rig, text = load_rig("samii")
    rooms = settings(tmp_path)
    from samii_rig.index.store import Index

    supervisor = Supervisor(rig, text, Index(tmp_path), 0.0)
    supervisor.held = ""
    assert job.ask_all_to_stop(rooms.jobs, "Ada") is False  # nothing ran
    supervisor.turn()
    assert supervisor.held == "stop asked by Ada"
    assert supervisor.current is None
    assert asked_to_stop(rooms.jobs) == ""


@pytest.fixture(scope="module")
def service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Service]:
    with Service(tmp_path_factory.mktemp("lab"), "--pace", "1", descriptors=1024) as started:
        yield started


def stopped(service: Service, id_: str) -> dict[str, Any]:
    """The job, once its run has ended; the output was at zero at the end."""
    one = Job(service.folder / ".samii-rig" / "jobs" / id_)
    found(lambda: one.written.phase == "done", WITHIN)
    recording = read_recording(service.folder / one.request.recording)
    assert recording.stop.status == "stopped"
    assert recording.values[-1, recording.column("v_2")] == 0.0
    assert one.written.at_zero is True
    return {"reason": one.written.reason}


def test_half_sent_heads_do_not_keep_a_stop_out(service: Service) -> None:
    with service.lease() as lease, ExitStack() as held:
        id_ = service.start(lease, LONG)
        service.until(service.progressing)
        for port in (service.port, service.stop_port):
            for _ in range(ATTACK):
                one = socket.create_connection(("127.0.0.1", int(port)), WITHIN)
                held.enter_context(one)
                one.sendall(HALF)
        for url in (f"{service.url}/api/stop", service.stop_url):
            answer = httpx.post(url, timeout=WITHIN)
            assert answer.json()["stopped"] is True
        stopped(service, id_)


@pytest.mark.parametrize("size", [40_000, 100_000])
def test_a_head_that_comes_at_once_is_refused_by_its_size(service: Service, size: int) -> None:
    answer = service.http.get("/api/state", headers={"x-long": "y" * size})
    assert answer.status_code == 431
    assert "expected at most 32768" in answer.json()["error"]


def test_a_service_that_hangs_does_not_keep_a_run_from_stopping(service: Service) -> None:
    with service.lease() as lease:
        id_ = service.start(lease, LONG)
        waits = service.start(lease, LONG)
        service.until(service.progressing)
        service.process.send_signal(signal.SIGSTOP)
        try:
            answer = httpx.post(f"{service.stop_url}?name=Ada", timeout=WITHIN)
            assert answer.json()["stopped"] is True
            assert stopped(service, id_)["reason"] == "stop asked by Ada at 127.0.0.1"
            assert httpx.get(service.stop_url).json() == {"moving": False}
        finally:
            service.process.send_signal(signal.SIGCONT)
        service.until(lambda: "stop asked by Ada" in service.state()["held"])
        assert [j["id"] for j in service.state()["queue"]] == [waits]
        service.http.delete(f"/api/queue/{waits}", headers=lease)


def test_a_listener_that_is_killed_is_begun_again(service: Service) -> None:
    def listener() -> int:
        """Its process."""
        for task in Path(f"/proc/{service.process.pid}/task").iterdir():
            for pid in (task / "children").read_text().split():
                with suppress(FileNotFoundError):  # it ended since
                    if b"samii_rig.serve.stopper" in Path(f"/proc/{pid}/cmdline").read_bytes():
                        return int(pid)
        return 0

    if not Path("/proc/self/task").exists():
        pytest.skip("no /proc to find it in")
    killed = found(listener, WITHIN)
    os.kill(killed, signal.SIGKILL)
    found(lambda: listener() not in (0, killed), WITHIN)
    assert httpx.post(service.stop_url, timeout=WITHIN).status_code == 200


def test_a_stop_is_heard_while_the_service_is_gone(tmp_path: Path) -> None:
    with Service(tmp_path, "--pace", "1") as lab:
        with lab.lease() as lease:
            id_ = lab.start(lease, LONG)
            lab.until(lab.progressing)
            lab.kill()
            # The listener made way for that of the service which comes after.
            lab.begin()
            lab.until(lab.progressing)
            lab.kill()
        assert httpx.get(lab.stop_url).json() == {"moving": True}
        assert httpx.post(lab.stop_url).json()["stopped"] is True
        stopped(lab, id_)

        def left() -> bool:
            try:
                socket.create_connection(("127.0.0.1", int(lab.stop_port)), 1.0).close()
            except OSError:
                return True
            return False

        # Nobody needs it now.
        found(left, WITHIN)
