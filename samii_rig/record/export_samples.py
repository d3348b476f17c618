"""The samples of a recording as files for other programs: CSV, Parquet, MATLAB, WAV, UFF 58.

Values, units and names are those of the recording. What each format can hold:

- CSV, Parquet, MAT: every sample with its time since the first one (s), its sequence number, and
  its quality where a channel has any but good; gaps stay gaps.
- WAV, UFF 58: channels at one step in time, so that a recording with gaps is refused. WAV holds
  32-bit floats, not scaled to its full scale of 1, at a whole number of samples/s.
"""

from __future__ import annotations

import json
import re
import struct
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from samii_rig.errors import InputError
from samii_rig.record.convert import seconds
from samii_rig.record.export import replacing
from samii_rig.record.structured import arrow
from samii_rig.record.uff.channels import recording_sets, require_even
from samii_rig.record.uff.file import write_uff
from samii_rig.types import Recording

_ROWS_AT_ONCE = 10_000  # of a CSV file that are made at a time
_MAX_IDENTIFIER = 63  # characters of a variable's name in MATLAB
_MAX_WAV = 1 << 32  # bytes: its lengths have 32 bits
_RESERVED = ("time_s", "sequence", "quality", "channels", "units", "rate_hz", "start", "metadata")


def export_samples(path: Path, recording: Recording) -> Path:
    """Write the samples in the format that the suffix of `path` names.

    Raises
    ------
    InputError : another suffix, a place that cannot be written to, a recording that the format
        cannot hold, Parquet without its library.
    """
    check_suffix(path)
    with replacing(path) as part:
        WRITERS[path.suffix.lower()](part, recording)
    return path


def check_suffix(path: Path) -> None:
    """InputError unless samples can be written to a file of this name."""
    if path.suffix.lower() not in WRITERS:
        raise InputError("--out", "suffix", path.suffix, f"one of {', '.join(WRITERS)}")
    if path.suffix.lower() == ".parquet":
        arrow("parquet")


def start(recording: Recording) -> str:
    """When the first sample was taken, ISO 8601 in UTC to the nanosecond; "" if nobody knows."""
    if not len(recording) or not recording.clock_offset:
        return ""
    whole, rest = divmod(int(recording.wall_time[0]), 1_000_000_000)
    return f"{datetime.fromtimestamp(whole, UTC):%Y-%m-%dT%H:%M:%S}.{rest:09d}Z"


def _about(r: Recording) -> dict[str, str]:
    """What a person wants to know of it, for the head of a file."""
    about = {"source": Path(r.source).name, "rate": f"{r.rate_hz:g} Hz", "start": start(r)}
    about["ended"] = f"{r.stop.status}: {r.stop.reason}"
    return {key: " ".join(text.split()) for key, text in about.items() if text}


def _marked(r: Recording) -> list[int]:
    """Columns of channels that have a quality but good somewhere."""
    return np.flatnonzero(r.quality.any(axis=0)).tolist()


def _write_csv(path: Path, r: Recording) -> None:
    marked = _marked(r)
    labels = ["time [s]", "sequence", *(f"{c.name} [{c.unit}]" for c in r.channels)]
    labels += [f"quality {r.channels[i].name}" for i in marked]
    time = seconds(r)
    with path.open("w", encoding="utf-8", newline="") as stream:
        stream.writelines(f"# {key}: {text}\n" for key, text in _about(r).items())
        stream.write(",".join(f'"{" ".join(label.split())}"' for label in labels) + "\n")
        for at in range(0, len(r), _ROWS_AT_ONCE):
            rows = slice(at, at + _ROWS_AT_ONCE)
            columns = [time[rows].tolist(), r.sequence[rows].tolist()]
            columns += [column.tolist() for column in r.values[rows].T]
            columns += [r.quality[rows, i].tolist() for i in marked]
            # repr is the shortest text that reads back as the same number.
            stream.writelines(",".join(map(repr, row)) + "\n" for row in zip(*columns, strict=True))


def _write_parquet(path: Path, r: Recording) -> None:
    pyarrow, parquet = arrow("lib"), arrow("parquet")
    fields = [
        pyarrow.field("time_s", pyarrow.float64(), metadata={"unit": "s"}),
        pyarrow.field("sequence", pyarrow.int64()),
    ]
    columns: list[Any] = [seconds(r), r.sequence]
    if r.clock_offset:
        fields.insert(0, pyarrow.field("wall_time", pyarrow.timestamp("ns", tz="UTC")))
        columns.insert(0, r.wall_time)
    for i, c in enumerate(r.channels):
        about = {"unit": c.unit, "role": c.role, "description": c.description}
        fields.append(pyarrow.field(c.name, pyarrow.float64(), metadata=about))
        columns.append(np.ascontiguousarray(r.values[:, i]))
    for i in _marked(r):
        fields.append(pyarrow.field(f"quality {r.channels[i].name}", pyarrow.uint8()))
        columns.append(np.ascontiguousarray(r.quality[:, i]))
    schema = pyarrow.schema(fields, metadata=_about(r))
    arrays = [
        pyarrow.array(column, type=field.type)
        for column, field in zip(columns, fields, strict=True)
    ]
    parquet.write_table(pyarrow.Table.from_arrays(arrays, schema=schema), path)


def _write_mat(path: Path, r: Recording) -> None:
    from scipy.io import savemat

    names = _identifiers([c.name for c in r.channels])
    held: dict[str, Any] = {
        "time_s": seconds(r),
        "sequence": r.sequence,
        "quality": r.quality,
        "channels": np.array(names, dtype=object),
        "units": np.array([c.unit for c in r.channels], dtype=object),
        "rate_hz": r.rate_hz,
        "start": start(r),
        "metadata": json.dumps(r.metadata),
    }
    held |= {name: r.values[:, i] for i, name in enumerate(names)}
    savemat(str(path), held, do_compression=True, oned_as="column", long_field_names=True)


def _identifiers(names: list[str]) -> list[str]:
    """Names that MATLAB takes for variables, each its own."""
    taken = set(_RESERVED)
    found = []
    for given in names:
        name = re.sub(r"[^A-Za-z0-9_]", "_", given)[: _MAX_IDENTIFIER - 4]
        name = base = name if name[:1].isalpha() else f"c_{name}"
        n = 2
        while name in taken:
            name, n = f"{base}_{n}", n + 1
        taken.add(name)
        found.append(name)
    return found


def _write_wav(path: Path, r: Recording) -> None:
    """RIFF WAVE of 32-bit floats; the comment of its INFO list names channels and units."""
    from scipy.io import wavfile

    require_even(r, "WAV")
    if r.rate_hz != round(r.rate_hz):
        expected = "a whole number of samples/s for WAV; CSV, Parquet, MAT and UFF hold any"
        raise InputError(r.source, "rate_hz", r.rate_hz, expected)
    if 4 * r.values.size + (1 << 16) > _MAX_WAV:
        raise InputError(r.source, "samples", len(r), "under 4 GB for WAV")
    wavfile.write(path, round(r.rate_hz), r.values.astype(np.float32))
    channels = ", ".join(f"{c.name} [{c.unit}]" for c in r.channels)
    about = {"channels": channels, "scale": "1.0 is one unit", **_about(r)}
    text = "; ".join(f"{key}: {value}" for key, value in about.items()).encode()
    text += b"\0" * (2 - len(text) % 2)  # it ends with a zero, and lengths are even
    with path.open("r+b") as stream:
        stream.seek(0, 2)
        stream.write(struct.pack("<4sI4s4sI", b"LIST", 12 + len(text), b"INFO", b"ICMT", len(text)))
        stream.write(text)
        size = stream.tell()
        stream.seek(4)
        stream.write(struct.pack("<I", size - 8))


def _write_uff(path: Path, r: Recording) -> None:
    write_uff(path, recording_sets(r))


WRITERS: dict[str, Callable[[Path, Recording], None]] = {
    ".csv": _write_csv,
    ".parquet": _write_parquet,
    ".mat": _write_mat,
    ".wav": _write_wav,
    ".uff": _write_uff,
    ".unv": _write_uff,
}
