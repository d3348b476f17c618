"""Recordings through the service: found, looked at, noted, compared, brought in.

Plan: what each answer holds against the file itself; uploads that are whole, damaged, hostile.
"""

from __future__ import annotations

import asyncio
import os
import socket
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest
from index_kit import lab, write_small
from record_kit import CHANNELS, RATE, STOP, block, blocks, response, write_run
from serve_kit import client, settings

from samii_rig.index.entry import identity
from samii_rig.index.remarks import read_remarks
from samii_rig.record.reader import read_frequency_responses, read_recording
from samii_rig.record.writer import RunWriter
from samii_rig.serve import upload
from samii_rig.serve.rooms import Rooms
from samii_rig.serve.viewers import HEAD


@pytest.fixture(scope="module")
def rooms(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Rooms]:
    folder = tmp_path_factory.mktemp("lab")
    write_run(folder / "a.mcap", blocks())
    write_run(folder / "b.mcap", blocks())
    made = Rooms(settings(folder))
    yield made
    made.desk.close()


def ask(rooms: Rooms, method: str, path: str, **more: Any) -> httpx.Response:
    async def go() -> httpx.Response:
        async with client(rooms) as http:
            return await http.request(method, path, **more)

    return asyncio.run(go())


def id_of(rooms: Rooms, name: str) -> str:
    found = ask(rooms, "GET", "/api/recordings").json()["recordings"]
    return next(e["id"] for e in found if e["path"] == name)


def test_a_recording_is_found_and_given_byte_by_byte(rooms: Rooms) -> None:
    id_ = id_of(rooms, "a.mcap")
    answer = ask(rooms, "GET", f"/api/recordings/{id_}/file")
    assert answer.content == (rooms.index.folder / "a.mcap").read_bytes()
    assert "a.mcap" in answer.headers["content-disposition"]
    part = ask(rooms, "GET", f"/api/recordings/{id_}/file", headers={"range": "bytes=0-7"})
    assert part.content == b"\x89MCAP0\r\n"


def test_signals_have_the_outline_of_the_samples(rooms: Rooms) -> None:
    recording = read_recording(rooms.index.folder / "a.mcap")
    id_ = id_of(rooms, "a.mcap")
    asked = {"channel": "v", "pixels": 10}
    found = ask(rooms, "GET", f"/api/recordings/{id_}/signals", params=asked).json()
    (curve,) = found["curves"]
    v = recording.values[:, recording.column("v")]
    assert len(curve["values"]) <= 20
    assert (min(curve["values"]), max(curve["values"])) == (v.min(), v.max())
    assert (found["rate_hz"], found["gaps"]) == (RATE, 1)
    all_ = ask(rooms, "GET", f"/api/recordings/{id_}/signals").json()["curves"]
    assert [c["name"] for c in all_] == [c.name for c in CHANNELS]
    assert None in all_[2]["values"]  # missing stays missing
    wrong = ask(rooms, "GET", f"/api/recordings/{id_}/signals", params={"channel": "nope"})
    assert wrong.status_code == 422
    assert "expected" in wrong.json()["error"]


@pytest.mark.parametrize(("rate", "step"), [(500.0, 1), (5000.0, 5)])
def test_frames_hold_every_sample_or_its_outline_and_end_at_gaps(
    rooms: Rooms, rate: float, step: int
) -> None:
    name = f"gap_{rate:g}.mcap"
    path = rooms.index.folder / name
    with RunWriter(path, CHANNELS, rate) as writer:
        for start in (1000, 1100, 1230, 1330):
            writer.write(block(start, 100))
        writer.close(STOP)
    rooms.index.refresh()
    recording, place = read_recording(path), f"/api/recordings/{id_of(rooms, name)}/frames"
    # In one answer, and in two that were asked one after the other.
    for spans in ([(0.0, 10.0)], [(0.0, 205 / rate), (205 / rate, 10.0)]):
        data = b"".join(
            ask(rooms, "GET", place, params={"start": a, "length": b}).content for a, b in spans
        )
        at, numbers, rows_of = 0, [], []
        while at < len(data):
            _, _, columns, rows, said, _, hz, first = HEAD.unpack_from(data, at)
            assert (said, hz) == (step, rate if step == 1 else 2 * rate / step)
            values = np.frombuffer(data, "<f4", rows * columns, at + HEAD.size)
            rows_of.append(values.reshape(rows, columns))
            at += HEAD.size + values.nbytes
            numbers.append(first + np.arange(rows * step // (2 if step > 1 else 1)))
        shown = np.concatenate(numbers)
        np.testing.assert_array_equal(shown, recording.sequence - 1000)
        bins = recording.values.reshape(-1, step, recording.values.shape[1])
        outline = (
            np.stack([np.fmin.reduce(bins, axis=1), np.fmax.reduce(bins, axis=1)], axis=1)
            if step > 1
            else bins
        )
        outline = outline.reshape(-1, recording.values.shape[1])
        np.testing.assert_array_equal(np.concatenate(rows_of), outline.astype("<f4"))


def test_frequency_responses_are_those_of_the_file(rooms: Rooms) -> None:
    stored = read_frequency_responses(rooms.index.folder / "a.mcap")[0]
    id_ = id_of(rooms, "a.mcap")
    found = ask(rooms, "GET", f"/api/recordings/{id_}/frf").json()["responses"][0]
    curve = found["curves"][1]
    assert curve["output"] == "a"
    H = np.array(curve["re"]) + 1j * np.array(curve["im"])
    np.testing.assert_array_equal(H, stored.H[:, 1, 0])
    np.testing.assert_array_equal(curve["sd"], np.sqrt(stored.variance())[:, 1, 0])


def test_a_report_shows_the_recording_and_may_ask_for_nothing(rooms: Rooms) -> None:
    id_ = id_of(rooms, "a.mcap")
    answer = ask(rooms, "GET", f"/api/recordings/{id_}/report")
    assert answer.status_code == 200, answer.text
    assert "sandbox" in answer.headers["content-security-policy"]
    assert "allow-same-origin" not in answer.headers["content-security-policy"]
    assert "a.mcap" in answer.text
    assert "Content-Security-Policy" in answer.text  # of the page's own, for its scripts
    assert ask(rooms, "GET", "/api/recordings/nope/report").status_code == 404


def test_a_recording_compared_with_its_like_does_not_differ(rooms: Rooms) -> None:
    ids = {"a": id_of(rooms, "a.mcap"), "b": id_of(rooms, "b.mcap")}
    pairs = ask(rooms, "GET", "/api/compare", params=ids).json()["pairs"]
    assert [p["level"] for p in pairs] == [p["other_level"] for p in pairs] == [0.5, 1.0]
    for pair in pairs:
        for row in pair["outputs"]:
            assert row["lines"] == len(response().frequency)
            assert row["mean_square"] == row["beyond_noise"] == row["median_relative"] == 0


def test_notes_and_tags_are_found_at_once(rooms: Rooms) -> None:
    id_ = id_of(rooms, "b.mcap")
    put = ask(rooms, "PUT", f"/api/recordings/{id_}/tags", json={"tags": ["new clamp"]})
    assert put.json()["recording"]["tags"] == ["new clamp"]
    ask(rooms, "POST", f"/api/recordings/{id_}/notes", json={"text": "<b>squeaks</b>"})
    for asked in ({"tag": "new clamp"}, {"text": "squeaks"}):
        found = ask(rooms, "GET", "/api/recordings", params=asked).json()
        assert [e["path"] for e in found["recordings"]] == ["b.mcap"]
    (note,) = read_remarks(rooms.index.folder / "b.mcap").notes
    assert (note.author, note.text) == ("somebody at 127.0.0.1", "<b>squeaks</b>")
    wrong = ask(rooms, "PUT", f"/api/recordings/{id_}/tags", json={"tags": ["../x"]})
    assert wrong.status_code == 422


def bring(rooms: Rooms, content: bytes) -> httpx.Response:
    before = sorted(rooms.index.folder.rglob("*"))
    answer = ask(rooms, "POST", "/api/recordings", content=content)
    if answer.status_code != 201:
        assert sorted(rooms.index.folder.rglob("*")) == before  # nothing is left of it
    return answer


def test_a_whole_recording_is_brought_in_under_a_name_of_ours(rooms: Rooms, tmp_path: Path) -> None:
    content = write_small(tmp_path / "x.mcap", operator="Bo").read_bytes()
    answer = bring(rooms, content)
    assert answer.status_code == 201, answer.text
    entry = answer.json()["recording"]
    assert entry["operator"] == "Bo"
    assert entry["path"].startswith("uploaded_")
    assert (rooms.index.folder / entry["path"]).read_bytes() == content


def test_what_is_not_whole_is_refused_with_its_problem(rooms: Rooms, tmp_path: Path) -> None:
    content = write_small(tmp_path / "x.mcap").read_bytes()
    flipped = bytearray(content)
    flipped[len(content) // 2] ^= 1
    for bad in (b"", b"PK\x03\x04", content[:-20], bytes(flipped), b"\x89MCAP0\r\n" + b"\0" * 99):
        answer = bring(rooms, bad)
        assert answer.status_code == 400
        assert "it is not whole" in answer.json()["error"]


def bomb(claims: int) -> bytes:
    """A recording that claims a chunk of this size in next to no bytes."""
    packed = b"\x04\x22\x4d\x18" + b"\0" * 60
    content = struct.pack("<QQQII", 0, 0, claims, 0, 3) + b"lz4" + struct.pack("<Q", len(packed))
    record = struct.pack("<BQ", 6, len(content) + len(packed)) + content + packed
    return b"\x89MCAP0\r\n" + record + b"\x89MCAP0\r\n"


@pytest.mark.parametrize("claims", [10**9, 2**40, 2**63])
def test_a_file_that_claims_to_be_vast_is_refused(rooms: Rooms, claims: int) -> None:
    assert bring(rooms, bomb(claims)).status_code == 400


def test_a_check_that_takes_too_much_memory_ends_in_a_line(
    rooms: Rooms, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Less than numpy needs to start: the process dies, the service does not.
    program = (
        "import resource; from samii_rig.serve import upload; upload.UPLOAD_MEMORY = 50 << 20; "
    )
    file = tmp_path / "check.py"
    file.write_text(program + "upload.main()")
    monkeypatch.setattr(upload, "COMMAND", (str(file),))
    content = write_small(tmp_path / "x.mcap").read_bytes()
    answer = bring(rooms, content)
    assert answer.status_code == 400
    assert "could not be checked" in answer.json()["error"]


@pytest.mark.parametrize("kind", ["pipe", "socket"])
def test_what_is_no_file_is_listed_as_such_and_never_read(tmp_path: Path, kind: str) -> None:
    lab(tmp_path)
    odd = tmp_path / "odd.mcap"
    with socket.socket(socket.AF_UNIX) as there:
        if kind == "pipe":
            os.mkfifo(odd)
        else:
            there.bind(str(odd))
        os.mkfifo(tmp_path / "c.mcap.remarks.json")
        rooms = Rooms(settings(tmp_path))
        found = ask(rooms, "GET", "/api/recordings").json()["recordings"]
        assert {e["path"] for e in found} == {"a.mcap", "march/b.mcap", "c.mcap", "odd.mcap"}
        problem = {e["path"]: e["problem"] for e in found}
        assert kind in problem["odd.mcap"]
        assert "pipe" in problem["c.mcap"]  # its remarks
        # One that became such a thing since it was listed.
        path = tmp_path / "a.mcap"
        path.unlink()
        os.mkfifo(path)
        for name in ("a.mcap", "odd.mcap"):
            for end in ("/file", "/frf", "/signals", "/report", ""):
                answer = ask(rooms, "GET", f"/api/recordings/{identity(name)}{end}")
                assert answer.status_code == 404
                assert f"{name} is no file" in answer.json()["error"]
        rooms.desk.close()
