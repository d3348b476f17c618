"""What the service's workers are asked comes back as an answer or as one line.

Plan: experiments whose numbers cannot be planned, or whose code misbehaves; texts that would hold a
worker; the same through the API.
"""

from __future__ import annotations

import asyncio
import os
from pathlib import Path
from typing import Any

import pytest
from serve_kit import client, settings, sweep

from experiments.swept_sine import SweptSine
from samii_rig.errors import InputError
from samii_rig.rig.load import load_rig
from samii_rig.run import dryrun
from samii_rig.run.experiments import shipped
from samii_rig.serve import desk
from samii_rig.serve.rooms import Rooms

RIG = load_rig("samii")[1]
STEP = shipped()["step"].read_text().replace("hold = 30.0", "hold = 1e308")
SINE = shipped()["stepped_sine"].read_text().replace("low_hz = 0.5", "low_hz = 5e-324")


def line(text: str) -> str:
    with pytest.raises(InputError) as raised:
        desk.dry_run(RIG, "", text)
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


def test_work_for_others_stands_behind_the_run() -> None:
    made = desk.Desk()
    try:
        assert made._pool.submit(os.nice, 0).result() == min(19, os.nice(0) + desk.NICE)
    finally:
        made.close()


def test_the_api_answers_with_the_line(tmp_path: Path) -> None:
    rooms = Rooms(settings(tmp_path))

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
