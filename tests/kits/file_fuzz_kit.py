"""Damaged rig, experiment and map files, recordings and DBC files, past the loaders."""

from __future__ import annotations

import contextlib
import random
import re
import struct
import sys
import time
import warnings
import zlib
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from importlib import resources
from pathlib import Path

from record_kit import blocks, write_run

from drivers.force_torque.frames import NEEDED, Frames
from samii_rig.errors import InputError, RecordingError
from samii_rig.record import scan
from samii_rig.record.maps import ImportMap
from samii_rig.record.reader import read_events, read_frequency_responses, read_recording
from samii_rig.rig.load import parse
from samii_rig.rig.schema import Rig
from samii_rig.run.experiments import kinds, shipped

CHUNK = 6  # opcode
# fmt: off
WORDS = (
    "0", "-1", "1", "1e308", "1e999", "-1e-320", "nan", "inf", "-inf", "9223372036854775808",
    "0x_ff", "1979-05-27", "true", "''", "'x'", "[]", "[[]]", "{}", "[1, 2]", "['a', 1]",
    "{ value = 1 }", "{ value = nan, unit = 's', source = '' }", '"\\ud800"', "'''a\nb'''",
    "1e5000", "100000000000000000000000000000000", "[nan, nan]", "[[1, 2], [1, -2]]",
)
# fmt: on
NUMBERS = (
    "0",
    "-1",
    "8",
    "64",
    "512",
    "65536",
    "2147484160",
    "4294967295",
    "99999999999",
    "-230000000",
    "1e999",
    "1e999999999",
    "0.5",
    "9" * 5000,
)  # fmt: skip
STATEMENTS = (
    "SG_MUL_VAL_ 512 G0 G2 0-4000000000;",
    'BA_DEF_ BO_ "x" INT 0 1e999999999;',
    'BA_DEF_ "x" FLOAT 0 1;\nBA_DEF_DEF_ "x" 1e999999999;\nBA_ "x" BO_ 512 1e999999999;',
    'CM_ BO_ 512 "BO_ 9 Gauges_0: 99999999 S";',
    'EV_ x: 0 [0|1] "" 0 1 DUMMY_NODE_VECTOR0 a;',
    "BO_TX_BU_ 512 : a,b,c;",
    "BO_ 600 Other: 99999999 Sensor",
    ' SG_ S m0M : 900000000|1@1+ (1,0) [0|0] "" Host',
    ' SG_ S M : 0|1@1+ (1,0) [0|0] "" Host',
    'VAL_ 520 ForceUnit 2 "N" 1e999999999 "x" ;',
    "NS_ :\n CM_\n BA_\n VAL_\nBS_:",
)
# fmt: off
LINES = ("[[element]]", "[element]", "[[sensor]]", "x = 1", "[a.b.c]", "a.b.c = 1", "=", "[[", '"')
# fmt: on


@dataclass(slots=True)
class Counted:
    """What became of the inputs. worst : CPU s of the slowest. grown : MB of memory at the end
    beyond what the first tenth needed. escaped : errors that are not ours, by kind and place."""

    loaded: int = 0
    refused: int = 0
    worst: float = 0.0
    grown: float = 0.0
    escaped: Counter[str] = field(default_factory=Counter)


def count(inputs: Iterator[Callable[[], object]], n: int) -> Counted:
    """Load them all. Every load returns or raises an error of ours, of one line."""
    c, memory = Counted(), 0.0
    for i in range(n):
        load = next(inputs)
        start = time.process_time()
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("error")
                load()
            c.loaded += 1
        except (InputError, RecordingError) as error:
            c.refused += 1
            if "\n" in str(error):
                c.escaped[f"more than a line: {str(error)[:100]!r}"] += 1
        except Exception as error:
            frame = error.__traceback__
            while frame and frame.tb_next:
                frame = frame.tb_next
            where = f"{frame.tb_frame.f_code.co_qualname}:{frame.tb_lineno}" if frame else ""
            c.escaped[f"{type(error).__name__} in {where}: {str(error)[:100]}"] += 1
        c.worst = max(c.worst, time.process_time() - start)
        if i == n // 10:
            memory = _memory()
    c.grown = _memory() - memory
    return c


def tables(rng: random.Random) -> Iterator[Callable[[], object]]:
    """Shipped TOML files with values, lines, blocks and bytes changed; most are short."""
    rigs = resources.files("samii_rig.rig") / "data"
    maps = resources.files("samii_rig.record") / "data"
    seeds = [(Rig, f.read_text("utf-8")) for f in rigs.iterdir()]
    seeds += [(ImportMap, f.read_text("utf-8")) for f in maps.iterdir()]
    models = {kind: point.load() for kind, point in kinds().items()}
    for file in shipped().values():
        text = file.read_text("utf-8")
        kind = re.search(r'^experiment = "(\w+)"', text, re.M)
        assert kind
        seeds.append((models[kind[1]], text))
    seeds = [(model, re.sub(r"(?m)\s*#[^\"\n]*$", "", text)) for model, text in seeds]
    while True:
        model, text = rng.choice(seeds)
        blocks_ = re.split(r"\n(?=\[)", text)
        if rng.random() < 0.9 and len(blocks_) > 5:
            kept = {0, *rng.sample(range(len(blocks_)), 4)}
            blocks_ = [b for i, b in enumerate(blocks_) if i in kept]
        lines = "\n".join(blocks_).split("\n")
        for _ in range(rng.choice((1, 1, 2, 8))):
            damage_lines(rng, lines)
        damaged = "\n".join(lines)
        yield lambda model=model, damaged=damaged: parse(model, damaged, "fuzz.toml")


def damage_lines(rng: random.Random, lines: list[str]) -> None:
    at = rng.randrange(len(lines))
    line = lines[at]
    match rng.randrange(7):
        case 0:
            name, equal, _ = line.partition("=")
            lines[at] = f"{name}= {rng.choice(WORDS)}" if equal else line
        case 1:
            found = re.findall(r"-?\d[\d.e+-]*|\"[^\"]*\"", line)
            if found:
                lines[at] = line.replace(rng.choice(found), rng.choice(WORDS), 1)
        case 2:
            lines.insert(at, rng.choice(LINES))
        case 3:
            lines.insert(rng.randrange(len(lines)), line)
        case 4:
            lines[at] = line[: rng.randrange(len(line) + 1)]
        case 5:
            k = rng.randrange(len(line) + 1)
            lines[at] = line[:k] + chr(rng.choice((0, 10, 34, 91, 123, 0x2028, 0x1F600))) + line[k:]
        case _:
            opening = rng.choice("[{") * rng.choice((1, 50, 2000))
            lines[at] = f"x = {opening}"


def recordings(rng: random.Random, folder: Path) -> Iterator[Callable[[], object]]:
    """A small recording with bytes changed, cut, doubled; half of them inside a chunk, whose CRC
    then fits again, so that what is within must be judged."""
    path = folder / "fuzz.mcap"
    write_run(path, blocks(2, 5), compression="")
    whole = path.read_bytes()
    data = memoryview(whole)
    chunks = [s for s in scan.spans(data, 8, len(data) - 8) if s.opcode == CHUNK]
    while True:
        b = bytearray(whole)
        if rng.random() < 0.5:
            head = scan.chunk_head(data, rng.choice(chunks))
            part = bytearray(data[head.data_start : head.span.end])
            damage_bytes(rng, part)
            if len(part) == head.size:
                b[head.data_start : head.span.end] = part
                struct.pack_into("<I", b, head.span.content + 24, zlib.crc32(part))
        else:
            damage_bytes(rng, b)
            if rng.random() < 0.3:
                damage_bytes(rng, b)
        path.write_bytes(b)
        yield rng.choice(
            (
                lambda: read_recording(path),
                lambda: read_recording(path, partial=True),
                lambda: read_events(path),
                lambda: read_frequency_responses(path),
            )
        )


def buses(rng: random.Random, folder: Path) -> Iterator[Callable[[], object]]:
    """The shipped DBC file with numbers, lines, statements and bytes changed. What is loaded must
    read any data."""
    path = folder / "fuzz.dbc"
    text = resources.files("drivers.force_torque").joinpath("ati.dbc").read_text()

    def load() -> None:
        frames = Frames(0x20, str(path))
        for fill in (b"\0", b"\x7f", b"\x80", b"\xff"):
            data = {name: fill * frames.length(name) for name in NEEDED}
            for name in NEEDED:
                frames.values(name, data[name])
            frames.gauges(data["Gauges_0"], data["Gauges_1"])
            with contextlib.suppress(InputError):
                frames.units(data["Units"])

    while True:
        lines = text.split("\n")
        for _ in range(rng.choice((1, 1, 2, 4))):
            _damage_bus(rng, lines)
        b = bytearray("\n".join(lines).encode())
        if rng.random() < 0.2:
            damage_bytes(rng, b)
        path.write_bytes(b)
        yield load


def _damage_bus(rng: random.Random, lines: list[str]) -> None:
    at = rng.randrange(len(lines))
    line = lines[at]
    numbers = list(re.finditer(r"-?\d+", line))
    match rng.randrange(8):
        case 0 | 1 if numbers:
            found = rng.choice(numbers)
            lines[at] = line[: found.start()] + rng.choice(NUMBERS) + line[found.end() :]
        case 2 if numbers:
            found = rng.choice(numbers)
            lines[at] = line[: found.start()] + str(rng.randrange(70)) + line[found.end() :]
        case 3:
            lines.insert(at, rng.choice(STATEMENTS))
        case 4:
            lines.insert(rng.randrange(len(lines)), line)
        case 5:
            del lines[at]
        case 6:
            k = rng.randrange(len(line) + 1)
            lines[at] = line[:k] + rng.choice('"\\;:|@/ \0\u20ac') + line[k:]
        case _:
            part = rng.choice(('\\"', '"', "(", "/", "a ", "CM_ ", "BO_ 1 A: 1 B ", "NS_ : ", "1"))
            lines[at] = line + part * rng.choice((1, 2, 40, 5000))


def damage_bytes(rng: random.Random, b: bytearray) -> None:
    at = rng.randrange(len(b))
    match rng.randrange(6):
        case 0:
            b[at] ^= 1 << rng.randrange(8)
        case 1:
            b[at] = rng.choice((0, 1, 0x7F, 0x80, 0xFF))
        case 2:
            word = rng.choice((0, 1, 2**31, 2**32 - 1, 2**63, 2**64 - 1, len(b)))
            b[at : at + 8] = struct.pack("<Q", word)[: len(b) - at]
        case 3:
            n = rng.randrange(1, 40)
            b[at : at + n] = rng.randbytes(len(b[at : at + n]))
        case 4:
            del b[at:]
            b += b"" if rng.random() < 0.5 else rng.randbytes(20)
        case _:
            n = rng.randrange(1, 200)
            b[at:at] = b[at : at + n]


def _memory() -> float:
    if sys.platform == "win32":
        return 0.0
    import resource

    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
