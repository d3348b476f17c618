"""What the service's workers are asked comes back as an answer or as one line.

Plan: experiments whose numbers cannot be planned, or whose code misbehaves; texts that would hold a
worker; the same through the API. A run is never kept waiting by those who look.
"""

from __future__ import annotations

import asyncio
import os
import signal
import sys
import time
from contextlib import AsyncExitStack
from pathlib import Path
from typing import Any

import httpx
import pytest
from serve_kit import client, settings, sweep

from experiments.swept_sine import SweptSine
from samii_rig.errors import InputError, RecordingError
from samii_rig.rig.load import load_rig
from samii_rig.run import dryrun
from samii_rig.run.experiments import shipped
from samii_rig.serve import desk, questions
from samii_rig.serve.access import Role, Tokens
from samii_rig.serve.lease import Lease
from samii_rig.serve.rooms import Rooms

RIG = load_rig("samii")[1]
STEP = shipped()["step"].read_text().replace("hold = 30.0", "hold = 1e308")
PEOPLE: dict[str, Role] = {"Ada": "operator", "Eve": "viewer"}
SINE = shipped()["stepped_sine"].read_text().replace("low_hz = 0.5", "low_hz = 5e-324")


def line(text: str) -> str:
    with pytest.raises(InputError) as raised:
        questions.dry_run(RIG, "", text)
    said = str(raised.value)
    assert "\n" not in said
    assert str(Path("/tmp")) not in said  # where we keep it is none of theirs
    return said


@pytest.mark.parametrize("text", [STEP, SINE], ids=["hold", "low_hz"])
def test_numbers_that_cannot_be_planned_are_said_in_a_line(text: str) -> None:
    assert "1e308" in text or "5e-324" in text
    assert line(text).startswith("experiment")


def test_many_dotted_keys_hold_no_worker() -> None:
    assert "expected keys of at most 16 dotted parts" in line("a." * 20_000)


@pytest.mark.parametrize("raised", [SystemExit(0), ZeroDivisionError("x\ny"), TypeError(None)])
def test_whatever_an_experiment_raises_is_a_line(
    raised: BaseException, monkeypatch: pytest.MonkeyPatch
) -> None:
    def misbehaves(*_: Any) -> None:
        raise raised

    for where, name in ((dryrun, "predict"), (SweptSine, "plan")):
        with monkeypatch.context() as patch:
            patch.setattr(where, name, misbehaves)
            assert type(raised).__name__ in line(sweep())


@pytest.mark.parametrize("raised", [SystemExit(0), MemoryError(), InputError("a", "b", 1, "c")])
def test_no_work_ends_the_service(raised: BaseException) -> None:
    def work() -> dict[str, Any]:
        raise raised

    assert set(desk._answered(work, ())) == {"raised", "line"}


def test_work_stands_behind_the_service() -> None:
    made = desk.Desk()
    try:
        for workers in (made._kept, made._open):
            assert workers._all[0].submit(os.nice, 0).result() == min(19, os.nice(0) + desk.NICE)
    finally:
        made.close()


def test_who_breaks_a_worker_breaks_no_other(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(desk, "WITHIN", 0.2)
    made = desk.Desk()

    async def ask() -> None:
        first, second = made._open._all
        with pytest.raises(RecordingError, match="took more than"):
            await made.do(time.sleep, 60, by="Eve")
        assert first in made._open._all
        assert second not in made._open._all

    try:
        asyncio.run(ask())
    finally:
        made.close()


def test_a_worker_that_died_is_replaced() -> None:
    made = desk.Desk()

    async def ask() -> None:
        def pid() -> Any:
            return made.do(os.getpid, by="Ada", kept=True)  # type: ignore[arg-type]

        first = await pid()
        os.kill(first, signal.SIGKILL)
        with pytest.raises(RecordingError):
            await pid()
        assert await pid() != first

    try:
        asyncio.run(ask())
    finally:
        made.close()


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere each worker loads for itself")
def test_who_loads_for_all_is_replaced_once_it_is_gone() -> None:
    async def loader() -> int:
        made = desk.Desk()
        try:
            return await made.do(os.getppid, by="Ada")  # type: ignore[arg-type, return-value]
        finally:
            made.close()

    first = asyncio.run(loader())
    assert asyncio.run(loader()) == first
    os.kill(first, signal.SIGKILL)
    os.waitid(os.P_PID, first, os.WEXITED | os.WNOWAIT)
    assert asyncio.run(loader()) not in (first, os.getpid())


def test_a_run_never_waits_for_viewers(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Viewers hold every open place until the end. They wait in turn, and no longer than they may;
    the run that an operator asks for is predicted all the same."""
    monkeypatch.setattr(desk, "WAITS", 0.05)
    tokens = Tokens(tmp_path / "tokens.json")
    shown = {n: {"authorization": f"Bearer {tokens.add(n, r)}"} for n, r in PEOPLE.items()}
    rooms = Rooms(settings(tmp_path, tokens))
    rooms.lease = Lease(lambda: 0.0)  # nobody gives signs of life here
    plan = {"experiment_toml": STEP}

    async def ask() -> tuple[httpx.Response, httpx.Response]:
        async with AsyncExitStack() as held, client(rooms) as http:
            for viewer in ("token of Eve", "token of Mallory"):
                await held.enter_async_context(rooms.desk._open._places.place(viewer))
            ada = shown["Ada"]
            ada["x-lease"] = (await http.post("/api/lease", headers=ada)).json()["lease"]
            looks = await http.post("/api/dry-run", json=plan, headers=shown["Eve"])
            return looks, await http.post("/api/runs", json=plan, headers=ada)

    try:
        looks, runs = asyncio.run(ask())
    finally:
        rooms.desk.close()
    assert looks.status_code == 503
    assert looks.json()["error"].startswith("others had all 2 places for 0.05 s")
    # It was predicted: what it holds is refused.
    assert (runs.status_code, "expected" in runs.json()["error"]) == (422, True)


def test_the_api_answers_with_the_line(tmp_path: Path) -> None:
    rooms = Rooms(settings(tmp_path))
    rooms.lease = Lease(lambda: 0.0)  # nobody gives signs of life here

    async def ask() -> list[tuple[int, str]]:
        async with client(rooms) as http:
            lease = {"x-lease": (await http.post("/api/lease")).json()["lease"]}
            asked = [("/api/dry-run", STEP), ("/api/runs", STEP), ("/api/dry-run", "a." * 20_000)]
            answers = [
                await http.post(to, json={"experiment_toml": text}, headers=lease)
                for to, text in asked
            ]
            return [(a.status_code, a.json()["error"]) for a in answers]

    try:
        for status, said in asyncio.run(ask()):
            assert status == 422
            assert "\n" not in said
    finally:
        rooms.desk.close()
