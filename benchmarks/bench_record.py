"""How fast samples are recorded and read, beside what else could hold them.

    python benchmarks/bench_record.py [--rows 4e6] [--repeats 5]

A row is one sample of 8 float64 channels. Two signals: `noise`, sines with noise down to the
last bit, which hardly compress; `adc`, the same rounded to the steps of a 16-bit converter.
Peers, in the same run: a JSON message a sample by the mcap library (what a newcomer writes)
and `np.fromfile` of the bare values.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import sys
import tempfile
import time
import zlib
from collections.abc import Callable
from functools import partial
from pathlib import Path

import lz4.frame
import numpy as np
from mcap.writer import CompressionType, Writer

from samii_rig.record import layout, scan
from samii_rig.record.appender import LZ4_ACCELERATION, Compression, build_chunk
from samii_rig.record.reader import read_recording, sample_records
from samii_rig.record.writer import CHUNK_BYTES, RunWriter
from samii_rig.types import Channel, SampleBlock, StopRecord

CHANNELS = tuple(Channel(f"a{i}", "m/s^2") for i in range(8))
RATE = 5000.0
BLOCK = 8192
COMPRESSIONS: tuple[Compression, ...] = ("lz4", "zstd", "")
PEER_ROWS = 40_000  # a message a call takes too long for more


def signal(kind: str, rows: int) -> np.ndarray:
    t = np.arange(rows) / RATE
    values = 0.5 * np.sin(2 * np.pi * np.outer(t, np.arange(1, 9)))
    values += 1e-3 * np.random.default_rng(0).standard_normal(values.shape)
    if kind == "adc":
        step = 20 / 65536  # a 16-bit converter of +-10 V
        values = np.round(values / step) * step
    return values


def blocks(values: np.ndarray) -> list[SampleBlock]:
    good = np.zeros((BLOCK, 8), np.uint8)
    found = []
    for start in range(0, len(values), BLOCK):
        part = values[start : start + BLOCK]
        sequence = np.arange(start, start + len(part))
        found.append(SampleBlock(CHANNELS, sequence * 200_000, sequence, part, good[: len(part)]))
    return found


def timed(call: Callable[[], object], rows: int, repeats: int) -> tuple[float, float]:
    """Median of rows a second, and of CPU time of all threads in ns a row."""
    wall, cpu = [], []
    for _ in range(repeats):
        a, b = time.perf_counter(), time.process_time()
        call()
        wall.append(time.perf_counter() - a)
        cpu.append(time.process_time() - b)
    return rows / statistics.median(wall), 1e9 * statistics.median(cpu) / rows


def record(path: Path, parts: list[SampleBlock], compression: Compression) -> None:
    path.unlink(missing_ok=True)
    with RunWriter(path, CHANNELS, RATE, compression=compression) as writer:
        for part in parts:
            writer.write(part)
        writer.close(StopRecord("completed", "benchmark"))


def peer(path: Path, values: np.ndarray) -> None:
    """One message a call through the mcap library's own writer."""
    with path.open("wb") as file:
        writer = Writer(file, compression=CompressionType.LZ4)
        writer.start()
        schema = writer.register_schema("samples", "jsonschema", b"{}")
        channel = writer.register_channel("/samples", "json", schema)
        for i, row in enumerate(values.tolist()):
            writer.add_message(channel, i * 200_000, as_json(i, row), i * 200_000)
        writer.finish()
        os.fsync(file.fileno())


def as_json(sequence: int, row: list[float]) -> bytes:
    return json.dumps({f"a{i}": x for i, x in enumerate(row)} | {"sequence": sequence}).encode()


def steps(values: np.ndarray, repeats: int) -> None:
    """Where the time goes: each step alone, in one thread, on one chunk in the cache."""
    of = layout.SampleLayout(CHANNELS, RATE)
    rows = CHUNK_BYTES // of.record.itemsize
    part = values[:rows]
    records = of.blank(rows, 1)
    opaque, quality = part.view("V64")[:, 0], np.zeros(rows, "V8")
    count = np.arange(rows)

    def pack() -> None:
        records["log_time"] = records["publish_time"] = records["sequence"] = count
        records["values"], records["quality"] = opaque, quality

    pack()
    raw = records.view(np.uint8).data
    packed = lz4.frame.compress(raw, compression_level=-LZ4_ACCELERATION, block_linked=False)
    chunk = build_chunk(raw, 1, count, count * records.itemsize, "lz4")
    memory = memoryview(b"".join(chunk.pieces))
    head = scan.chunk_head(memory, next(scan.spans(memory, 0, len(memory))))
    out = np.empty((rows, 8)).view("V64")[:, 0]

    def place() -> None:
        out[:] = records["values"]

    table: dict[str, Callable[[], object]] = {
        "pack": pack,
        "crc32 of the chunk": lambda: zlib.crc32(raw),
        "lz4 compress": lambda: lz4.frame.compress(
            raw, compression_level=-LZ4_ACCELERATION, block_linked=False
        ),
        "crc32 of the file": lambda: zlib.crc32(packed),
        "whole chunk (crc, lz4, index)": lambda: build_chunk(
            raw, 1, count, count * records.itemsize, "lz4"
        ),
        "lz4 decompress": lambda: lz4.frame.decompress(packed),
        "unpack (lz4, crc)": lambda: scan.unpack(memory, head),
        "check heads": lambda: sample_records(raw, 1, of.record),
        "place values": place,
    }
    for name, call in table.items():
        _, cpu = timed(call, rows, 10 * repeats)
        print(f"    {name:32s} {cpu:6.1f} ns CPU a row")


def layouts(values: np.ndarray, repeats: int) -> None:
    """The same samples as other messages: bytes a row and time to write and read one chunk."""
    rows = 8192
    part = np.ascontiguousarray(values[:rows])
    of = layout.SampleLayout(CHANNELS, RATE)
    cdr = of.blank(rows, 1)
    cdr["values"] = part.view("V64")[:, 0]
    cdr["sequence"] = cdr["log_time"] = cdr["publish_time"] = np.arange(rows)
    # Protobuf: a tag byte before each fixed64 field, fixed in size as well.
    names = [("head", "V31"), ("tag", "u1"), ("sequence", "<i8")]
    for i in range(8):
        names += [(f"t{i}", "u1"), (f"a{i}", "<f8")]
    protobuf = np.zeros(rows, names)
    protobuf["sequence"], protobuf["tag"] = np.arange(rows), 9
    for i in range(8):
        protobuf[f"t{i}"], protobuf[f"a{i}"] = 17 + 8 * i, part[:, i]
    text = "".join(as_json(i, row).decode() for i, row in enumerate(part.tolist())).encode()
    columns = np.concatenate([np.arange(rows).view(np.float64), part.T.ravel()]).tobytes()
    for name, raw in (
        ("CDR, a message a row", cdr.tobytes()),
        ("protobuf, a message a row", protobuf.tobytes()),
        ("JSON, a message a row", text),
        ("one block of columns", columns),
    ):
        packed = lz4.frame.compress(raw, compression_level=-LZ4_ACCELERATION, block_linked=False)
        _, write = timed(
            lambda raw=raw: (
                zlib.crc32(raw),
                lz4.frame.compress(raw, compression_level=-LZ4_ACCELERATION, block_linked=False),
            ),
            rows,
            5 * repeats,
        )
        _, read = timed(
            lambda packed=packed: zlib.crc32(lz4.frame.decompress(packed)), rows, 5 * repeats
        )
        print(
            f"    {name:28s} {len(raw) / rows:6.1f} B a row, {len(packed) / rows:6.1f} packed; "
            f"crc + lz4 {write:6.1f} ns to write, {read:6.1f} ns to read"
        )


def compare(kind: str, rows: int, repeats: int, folder: Path) -> None:
    """Record and read one signal, then its peers."""
    values = signal(kind, rows)
    parts = blocks(values)
    print(f"{kind}: {rows} rows of 8 channels, medians of {repeats}")
    path, bare = folder / "run.mcap", folder / "bare.bin"
    written = {}
    for compression in COMPRESSIONS:
        speed, cpu = timed(partial(record, path, parts, compression), rows, repeats)
        size = path.stat().st_size / rows
        back, back_cpu = timed(partial(read_recording, path), rows, repeats)
        print(
            f"  {compression or 'none':5s} record {speed / 1e6:6.2f}e6 rows/s "
            f"({cpu:.0f} ns CPU a row, {size:.0f} B a row), "
            f"read {back / 1e6:6.2f}e6 rows/s ({back_cpu:.0f} ns CPU a row)"
        )
        written[compression] = speed
    values.tofile(bare)
    speed, cpu = timed(partial(np.fromfile, bare), rows, repeats)
    print(f"  np.fromfile of the values: {speed / 1e6:.2f}e6 rows/s ({cpu:.0f} ns CPU a row)")
    speed, _ = timed(partial(peer, path, values[:PEER_ROWS]), PEER_ROWS, min(repeats, 3))
    print(
        f"  JSON message a sample, mcap library: {speed / 1e6:.4f}e6 rows/s; "
        f"ours with lz4 is {written['lz4'] / speed:.0f} times that"
    )
    print("  one thread, one chunk:")
    steps(values, repeats)
    print("  layouts:")
    layouts(values, repeats)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rows", type=float, default=4e6)
    parser.add_argument("--repeats", type=int, default=5)
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        for kind in ("noise", "adc"):
            compare(kind, int(given.rows), given.repeats, Path(folder))
            sys.stdout.flush()
    return 0


if __name__ == "__main__":
    sys.exit(main())
