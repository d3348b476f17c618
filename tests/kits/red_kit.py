"""What somebody who means harm does to recordings, to the API, and to the files that the service
and its processes share. Each attack yields calls that must end well or with an error of ours."""

from __future__ import annotations

import asyncio
import json
import os
import random
import shutil
import struct
import zlib
from collections.abc import Callable, Iterator
from dataclasses import asdict
from datetime import datetime, tzinfo
from functools import partial
from pathlib import Path
from typing import Any, Self
from unittest.mock import patch

import httpx
import numpy as np
from file_fuzz_kit import WORDS, damage_bytes, damage_lines
from index_kit import write_small
from record_kit import RATE, SEGMENT, response
from serve_kit import client, settings, sweep

from samii_rig.index.query import Query
from samii_rig.index.store import FILE, PRIVATE, Index
from samii_rig.record import scan
from samii_rig.record.reader import read_recording
from samii_rig.record.recover import recover
from samii_rig.record.verify import verify
from samii_rig.record.writer import Origin, RunWriter
from samii_rig.run.experiments import shipped
from samii_rig.serve.job import JOBS, Job, JobState, Request, ask_all_to_stop
from samii_rig.serve.live import PAGE, LiveReader, LiveWriter
from samii_rig.serve.rooms import Rooms
from samii_rig.signal.estimate import estimate
from samii_rig.types import Channel, Quality, SampleBlock, Segment, StopRecord

Attack = Iterator[Callable[[], object]]
CHUNK = 6  # opcode
CHANNELS = (Channel("v", "V", "command", -10.0, 10.0, 1e-3), Channel("theta", "rad"))
OTHERS = 123_456_789  # no process has this number
REPEATS, N = 3, 250  # of the bursts in the recording, and samples in each


def measured(path: Path) -> Path:
    """Three short sweeps of a lag, from which responses can be estimated."""
    n = np.arange(REPEATS * N)
    at = n % N / RATE
    v = np.where(at < 0.3, np.sin(2 * np.pi * (5.0 + 40.0 * at) * at), 0.0)
    theta = np.convolve(v, np.exp(-np.arange(60) / 10.0) / 10.0)[: len(n)]
    theta += 1e-3 * np.random.default_rng(1).standard_normal(len(n))
    quality = np.full((len(n), 2), Quality.GOOD, np.uint8)
    block = SampleBlock(CHANNELS, n * round(1e9 / RATE), n, np.stack([v, theta], 1), quality)
    with RunWriter(path, CHANNELS, RATE, Origin('name = "red"\n')) as writer:
        writer.write(block)
        for i in range(REPEATS):
            begin = i * N
            writer.segment(Segment(f"sweep {i}", "burst", begin, begin + N, 1.0, "V", i))
        writer.frequency_response(response())
        writer.close(StopRecord("completed", SEGMENT.name))
    return path


def files(rng: random.Random, folder: Path) -> Attack:
    """A recording that is damaged anywhere, in half of the tries with a CRC that fits again: read,
    checked, recovered, listed and estimated."""
    whole = measured(folder / "whole.mcap").read_bytes()
    data = memoryview(whole)
    chunks = [s for s in scan.spans(data, 8, len(data) - 8) if s.opcode == CHUNK]
    lab = folder / "lab"
    lab.mkdir()
    path, output = lab / "red.mcap", folder / "out.mcap"

    def recovered() -> None:
        output.unlink(missing_ok=True)
        recover(path, output)
        assert verify(output).status in ("whole", "lossy"), verify(output)

    def listed() -> None:
        index = Index(lab, folder / "private")
        index.refresh()
        assert index.search(Query()).total == 1

    uses = (lambda: verify(path), recovered, listed, lambda: estimate([read_recording(path)]))
    while True:
        b = bytearray(whole)
        chunk = rng.choice(chunks) if rng.random() < 0.5 else None
        if chunk is not None:
            head = scan.chunk_head(data, chunk)
            part = bytearray(data[head.data_start : head.span.end])
            damage_bytes(rng, part)
            b[head.data_start : head.span.end] = part
            if len(part) == head.size:
                struct.pack_into("<I", b, head.span.content + 24, zlib.crc32(part))
        else:
            for _ in range(rng.choice((1, 1, 3))):
                damage_bytes(rng, b)
        path.write_bytes(b)
        yield rng.choice(uses)


def bodies(rng: random.Random, folder: Path) -> Attack:
    """Any JSON at any route that takes a body, orders among it whose experiment is damaged."""
    write_small(folder / "a.mcap", experiment="swept_sine")
    rooms = Rooms(settings(folder))
    # Mostly one that is short: a plan of hours takes ten seconds to predict.
    texts = [f.read_text("utf-8") for f in shipped().values()] + 30 * [sweep()]
    (entry,) = rooms.index.search(Query()).entries
    one = f"/api/recordings/{entry.id}"
    routes = (
        ("POST", "/api/dry-run", ("experiment", "experiment_toml")),
        ("POST", "/api/dry-run", ("experiment_toml",)),
        ("POST", "/api/runs", ("experiment", "experiment_toml", "operator", "seed", "diagnosis")),
        ("POST", "/api/clear-fault", ("name", "reason")),
        ("PUT", f"{one}/tags", ("tags",)),
        ("POST", f"{one}/notes", ("text",)),
        ("POST", "/api/lease", ()),
        ("POST", "/api/lease/beat", ()),
        ("POST", "/api/recordings", ()),
    )

    def asked(method: str, path: str, body: bytes) -> None:
        async def ask() -> httpx.Response:
            async with client(rooms, {"content-type": "application/json"}) as http:
                return await http.request(method, path, content=body)

        answer = asyncio.run(ask())
        if answer.status_code >= 400:
            assert "\n" not in answer.json()["error"], answer.text
        assert answer.status_code < 500, f"{answer.status_code} to {path}: {body[:300]!r}"

    while True:
        method, path, keys = rng.choice(routes)
        fields: dict[str, Any] = {key: value(rng) for key in keys if rng.random() < 0.8}
        if "experiment_toml" in keys and rng.random() < 0.6:
            lines = rng.choice(texts).split("\n")
            for _ in range(rng.choice((1, 2, 4))):
                damage_lines(rng, lines)
            fields = {"experiment_toml": "\n".join(lines)[:48_000]}
        body = bytearray(json.dumps(fields if rng.random() < 0.95 else value(rng)).encode())
        if rng.random() < 0.1:
            damage_bytes(rng, body)
        yield partial(asked, method, path, bytes(body))


def value(rng: random.Random, depth: int = 0) -> Any:
    """Any JSON, with what Python's reader takes beyond it."""
    match rng.randrange(9 if depth < 4 else 7):
        case 0:
            return rng.choice((None, True, False))
        case 1:
            return rng.choice((0, -1, 2**53, 2**64, -(10**400), 1e308, float("nan"), float("inf")))
        case 2 | 3:
            return rng.choice(("", "..", "a\nb", "\0", "\ud800", "x" * 5000, "swept_sine", *WORDS))
        case 4 | 5 | 6:
            return "".join(chr(rng.choice((32, 65, 0x301, 0x1F600, 0x202E))) for _ in range(9))
        case 7:
            return [value(rng, depth + 1) for _ in range(rng.randrange(5))]
        case _:
            return {str(value(rng, 9)): value(rng, depth + 1) for _ in range(rng.randrange(5))}


def index(rng: random.Random, folder: Path) -> Attack:
    """The index damaged between two looks, and while it is open: the folder alone decides."""
    names = ["c.mcap", "b.mcap", "a.mcap"]
    for day, name in enumerate(reversed(names)):
        started = f"2026-03-0{day + 1}T09:00:00+00:00"
        write_small(folder / name, experiment="swept_sine", started=started)
    open_ = Index(folder)
    open_.refresh()
    path = folder / PRIVATE / FILE

    def asked(fresh: bool) -> None:
        looks = Index(folder) if fresh else open_
        looks.refresh()
        assert [e.path for e in looks.search(Query()).entries] == names
        assert looks.words()["experiment"] == ("swept_sine",)

    while True:
        b = bytearray(path.read_bytes() if path.is_file() else b"") or bytearray(100)
        for _ in range(rng.choice((1, 3, 30))):
            damage_bytes(rng, b)
            b = b or bytearray(1)
        path.write_bytes(b)
        yield partial(asked, rng.random() < 0.5)


def jobs(rng: random.Random, folder: Path) -> Attack:
    """The files of a run's folder damaged while it goes on, or between two services: the state is
    told, and a stop is heard."""
    write_small(folder / "a.mcap")
    text = sweep()
    asked = Request("swept_sine", "run.mcap", duration_s=10.0)
    rig_toml = settings(folder).rig_toml
    places = folder / PRIVATE / JOBS
    hurt = ("state.json", "request.json", "stops.jsonl", "responses.json", "diagnosis_so_far.json")

    def told(name: str, data: bytes, fresh: bool, phase: Any) -> None:
        # The clock of the machine is set between any two looks at it.
        with patch("samii_rig.serve.job.datetime", _set(rng)):
            job = Job.make(places, asked, rig_toml, text)
            hurt_while_it_runs(job, name, data, fresh, phase)
        shutil.rmtree(job.folder)

    def hurt_while_it_runs(job: Job, name: str, data: bytes, fresh: bool, phase: Any) -> None:
        job.set(JobState(phase=phase, pid=OTHERS))
        rooms, sent = None if fresh else Rooms(settings(folder)), list[int]()
        with job.held() as lock, patch("samii_rig.serve.job.os.kill", lambda p, n: sent.append(p)):
            os.write(lock, str(OTHERS).encode())
            (job.folder / name).write_bytes(data)
            rooms = rooms or Rooms(settings(folder))
            asyncio.run(_looked_at(rooms, job.id))
            assert ask_all_to_stop(places, "Ada"), "the run is not seen"
            assert set(sent) <= {OTHERS}, f"signals to {sent}"
            assert sent or job.written.phase not in ("starting", "running"), "nobody was told"
        rooms.supervisor.turn()
        assert rooms.supervisor.current is None, "a run that is gone goes on"
        rooms.desk.close()

    while True:
        name = rng.choice(hurt)
        good: Any = asdict(asked) if name == "request.json" else asdict(JobState("running", OTHERS))
        if rng.random() < 0.5:
            for _ in range(rng.choice((1, 2))):
                good[rng.choice((*good, "unknown"))] = value(rng)
            b = bytearray(json.dumps(good if rng.random() < 0.8 else value(rng)).encode())
        else:
            b = bytearray(json.dumps(good).encode())
            damage_bytes(rng, b)
        phase = rng.choice(("running", "analysing", "starting"))
        yield partial(told, name, bytes(b), rng.random() < 0.5, phase)


def _set(rng: random.Random) -> type[datetime]:
    """A clock that is set by years whenever it is looked at."""

    class Set(datetime):
        @classmethod
        def now(cls, tz: tzinfo | None = None) -> Self:
            year = rng.randrange(1990, 2100)
            return super().now(tz).replace(year=year, day=1)

    return Set


def live(rng: random.Random, folder: Path) -> Attack:
    """The live data in memory damaged: read, or called none of ours."""
    whole = folder / "whole.live"
    writer = LiveWriter(whole, CHANNELS, RATE)
    n = np.arange(700)
    values = np.zeros((700, 2))
    quality = np.zeros((700, 2), np.uint8)
    writer.samples(SampleBlock(CHANNELS, n * 2_000_000, n, values, quality))
    writer.progress({"segment": 1, "time_left": 3.0})
    good, path = whole.read_bytes(), folder / "red.live"

    def read() -> None:
        reader = LiveReader(path)
        for _ in range(2):
            reader.since(rng.choice((0, 5, 699, 10**9)))
            reader.progress().get("time_left")
            reader.beat()
            assert all(c["name"] for c in reader.channels)

    while True:
        b = bytearray(good)
        for _ in range(rng.choice((1, 1, 4))):
            # Where something is told; most of the rest are samples.
            at = rng.choice((0, PAGE, 2 * PAGE, rng.randrange(len(b))))
            part = b[at : at + 100]
            damage_bytes(rng, part)
            b[at : at + 100] = part
            b = b or bytearray(1)
        path.write_bytes(b)
        yield read


async def _looked_at(rooms: Rooms, id_: str) -> None:
    """As the service's own work does it, and by all that the page asks."""
    rooms.supervisor.turn()
    rooms.supervisor.beat()
    with patch("samii_rig.serve.analysis.subprocess.Popen"):
        rooms._analyse()
    async with client(rooms) as http:
        for path in ("/api/state", f"/api/jobs/{id_}", "/api/recordings"):
            answer = await http.get(path)
            assert answer.status_code == 200, f"{answer.status_code} from {path}: {answer.text}"
        assert (await http.post("/api/stop")).status_code == 200
