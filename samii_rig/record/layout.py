"""What stands where in a recording: topics, schemas, metadata and the sample record.

A recording is an MCAP file. `/samples` carries one message a sample, whose fields are the
channels by name; every message has the same size, so a chunk's bytes are a numpy structured
array. Messages are stamped with the wall clock; the metadata `samii_rig.clock` say how far it
was ahead of the device's own. `docs/decisions/0003-recording-layout.md` says why.
"""

from __future__ import annotations

import json
import re
import zlib
from dataclasses import dataclass
from typing import Any, cast, get_args

import numpy as np
from mcap.opcode import Opcode

from samii_rig.errors import RecordingError
from samii_rig.record.cdr import ENCAPSULATION
from samii_rig.types import Channel, Kind, Role, Segment, StopRecord

FORMAT = "samii-rig recording 1"

SAMPLES = "/samples"
EVENTS = "/events"
RESPONSES = "/frequency_response"

SAMPLES_SCHEMA = "samii_rig/msg/Samples"
PROFILE = "ros2"  # of MCAP's registry: CDR messages, ros2msg schemas
QUALITY_OF_SERVICE = {"offered_qos_profiles": ""}  # the profile wants it on every channel
MESSAGE_ENCODING = "cdr"
SCHEMA_ENCODING = "ros2msg"

RUN = "samii_rig.run"  # metadata record: format, rate; written first
NOTES = "samii_rig.notes"  # metadata record: seed, versions, operator, calibration, hashes
CLOCK = "samii_rig.clock"  # metadata record: offset_ns, log time minus device's time
SEGMENT = "samii_rig.segment"
STOP = "samii_rig.stop"
RESPONSE = "samii_rig.frequency_response"
MAPS = (RUN, NOTES, SEGMENT, STOP, RESPONSE)
RIG_FILE = "rig.toml"  # attachments
EXPERIMENT_FILE = "experiment.toml"

SEAL = "crc32"  # key under which `sealed` stores its check
MAX_CHANNELS = 4096  # more columns than any rig has; bounds what a hostile file may claim

_FIELD = re.compile(r"[^a-z0-9]+")
MAX_OFFSET = 1 << 62  # ns, 146 years: the year 2116; no sum with a device's time overflows
_HEAD = 9  # opcode u8 and record length u64 before every MCAP record's content


def sealed(data: dict[str, str]) -> dict[str, str]:
    """`data` with a checksum of itself: MCAP has none of its own on a metadata map."""
    return {**data, SEAL: _check(data)}


def unsealed(data: dict[str, str], what: str) -> dict[str, str]:
    """`data` without its checksum; RecordingError if they do not belong together."""
    content = {k: v for k, v in data.items() if k != SEAL}
    if data.get(SEAL) != _check(content):
        raise RecordingError(f"{what} is damaged: its checksum does not fit")
    return content


def _check(data: dict[str, str]) -> str:
    return f"{zlib.crc32(json.dumps(data, sort_keys=True).encode()):08x}"


def field_names(channels: tuple[Channel, ...]) -> tuple[str, ...]:
    """A field name for every channel: its own where ROS 2 allows it, else the nearest.

    ROS 2 allows lower case letters, digits and single underscores, a letter first.
    """
    taken = {"sequence", "quality"}
    names = []
    for channel in channels:
        base = _FIELD.sub("_", channel.name.lower()).strip("_")
        if not base or not base[0].isalpha():
            base = f"c_{base}".rstrip("_")
        name, n = base, 2
        while name in taken:
            name, n = f"{base}_{n}", n + 1
        taken.add(name)
        names.append(name)
    return tuple(names)


@dataclass(frozen=True)
class SampleLayout:
    """The messages of `/samples`: int64 sequence, a float64 a channel, a uint8 a quality.

    record : dtype of one whole MCAP message record, its head and time stamps included;
        `values` and `quality` are opaque bytes, which numpy moves fastest.
    """

    channels: tuple[Channel, ...]
    rate_hz: float

    @property
    def record(self) -> np.dtype[np.void]:
        """dtype of a message record: MCAP's fields, then the CDR payload."""
        n = len(self.channels)
        return np.dtype(
            [
                ("opcode", "u1"),
                ("length", "<u8"),
                ("channel", "<u2"),
                ("counter", "<u4"),
                ("log_time", "<u8"),
                ("publish_time", "<u8"),
                ("encapsulation", "V4"),
                ("sequence", "<i8"),
                ("values", f"V{8 * n}"),
                ("quality", f"V{n}"),
            ]
        )

    def blank(self, rows: int, channel_id: int) -> np.ndarray[Any, np.dtype[np.void]]:
        """(rows,) message records in which all is set but time, sequence, values, quality."""
        records = np.zeros(rows, self.record)
        records["opcode"] = Opcode.MESSAGE
        records["length"] = self.record.itemsize - _HEAD
        records["channel"] = channel_id
        records["encapsulation"] = np.void(ENCAPSULATION)
        return records

    def schema_text(self) -> str:
        """The `ros2msg` definition; units stand in the comments."""
        lines = ["int64 sequence  # counts every sample that the device took"]
        for field, channel in zip(field_names(self.channels), self.channels, strict=True):
            comment = " ".join(f"{channel.unit}, {channel.role} {channel.name}".split())
            lines.append(f"float64 {field}  # {comment}")
        n = len(self.channels)
        lines.append(f"uint8[{n}] quality  # 1 missing, 2 clipped, 4 stale, 8 limited")
        return "\n".join(lines) + "\n"

    def metadata(self) -> dict[str, str]:
        """Metadata of the MCAP channel: a unit a field for people, `channels` for us."""
        fields = field_names(self.channels)
        units = {f"unit.{f}": c.unit for f, c in zip(fields, self.channels, strict=True)}
        return sealed(
            {
                **QUALITY_OF_SERVICE,
                **units,
                "rate_hz": repr(self.rate_hz),
                "channels": json.dumps([channel_to_json(c) for c in self.channels]),
            }
        )

    @classmethod
    def from_metadata(cls, data: dict[str, str]) -> SampleLayout:
        """The layout that `metadata` describes; RecordingError if it does not."""
        content = unsealed(data, f"the description of {SAMPLES}")
        try:
            items = json.loads(content["channels"])
            rate_hz = float(content["rate_hz"])
            channels = tuple(channel_from_json(item) for item in items)
        except (KeyError, ValueError, TypeError, RecursionError) as error:
            raise RecordingError(f"the description of {SAMPLES} cannot be read") from error
        if not 0 < len(channels) <= MAX_CHANNELS or not 0 < rate_hz < np.inf:
            raise RecordingError(
                f"{SAMPLES} has {len(channels)} channels at {rate_hz:g} samples/s; "
                f"expected 1 to {MAX_CHANNELS} channels and a positive rate"
            )
        return cls(channels, rate_hz)


def channel_to_json(channel: Channel) -> dict[str, object]:
    """A channel as JSON; infinite ends of the range as null, which JSON can say."""
    return {
        "name": channel.name,
        "unit": channel.unit,
        "role": channel.role,
        "low": channel.low if np.isfinite(channel.low) else None,
        "high": channel.high if np.isfinite(channel.high) else None,
        "resolution": channel.resolution,
        "description": channel.description,
    }


def channel_from_json(item: dict[str, Any]) -> Channel:
    """The inverse; KeyError, TypeError or ValueError on anything else."""
    role = item["role"]
    if role not in get_args(Role):
        raise ValueError(role)
    low, high = item["low"], item["high"]
    return Channel(
        name=str(item["name"]),
        unit=str(item["unit"]),
        role=cast(Role, role),
        low=-np.inf if low is None else float(low),
        high=np.inf if high is None else float(high),
        resolution=float(item["resolution"]),
        description=str(item["description"]),
    )


def segment_to_map(segment: Segment) -> dict[str, str]:
    """A segment as a metadata map."""
    return {
        "name": segment.name,
        "kind": segment.kind,
        "start": str(segment.start),
        "stop": str(segment.stop),
        "level": repr(float(segment.level)),
        "unit": segment.unit,
        "repeat": str(segment.repeat),
        **({"excited": " ".join(segment.excited)} if segment.excited else {}),
    }


def segment_from_map(data: dict[str, str]) -> Segment:
    """The inverse; RecordingError on anything else."""
    try:
        kind = data["kind"]
        if kind not in get_args(Kind):
            raise ValueError(kind)
        return Segment(
            name=data["name"],
            kind=cast(Any, kind),
            start=int(data["start"]),
            stop=int(data["stop"]),
            level=float(data["level"]),
            unit=data["unit"],
            repeat=int(data["repeat"]),
            excited=tuple(data.get("excited", "").split()),
        )
    except (KeyError, ValueError) as error:
        raise RecordingError("a segment of the recording cannot be read") from error


def checked_offset(offset: int) -> int:
    """What the wall clock is ahead of the device's, ns; RecordingError beyond `MAX_OFFSET`."""
    if abs(offset) > MAX_OFFSET:
        raise RecordingError(
            f"the wall clock is {offset} ns ahead of the device's; expected within {MAX_OFFSET}"
        )
    return offset


def clock_to_map(offset: int) -> dict[str, str]:
    """That offset as a metadata map."""
    return {"offset_ns": str(offset)}


def clock_from_map(data: dict[str, str]) -> int:
    """The inverse; RecordingError on anything else."""
    try:
        return checked_offset(int(data["offset_ns"]))
    except (KeyError, ValueError) as error:
        raise RecordingError("the offset of the device's clock cannot be read") from error


def stop_to_map(stop: StopRecord, samples: int) -> dict[str, str]:
    """A stop record as a metadata map, with the number of samples that were written."""
    return {
        "status": stop.status,
        "reason": stop.reason,
        "late_ticks": str(stop.late_ticks),
        "missing_samples": str(stop.missing_samples),
        "samples": str(samples),
    }


def stop_from_map(data: dict[str, str]) -> tuple[StopRecord, int]:
    """The stop record and the number of samples; RecordingError on anything else."""
    try:
        status = data["status"]
        if status not in ("completed", "stopped", "tripped", "failed", "unknown"):
            raise ValueError(status)
        stop = StopRecord(
            status=cast(Any, status),
            reason=data["reason"],
            late_ticks=int(data["late_ticks"]),
            missing_samples=int(data["missing_samples"]),
        )
        return stop, int(data["samples"])
    except (KeyError, ValueError) as error:
        raise RecordingError("the stop record cannot be read") from error
