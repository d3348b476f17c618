"""Files of results estimated later from recordings, which they name by SHA-256."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Sequence
from pathlib import Path

from samii_rig.errors import RecordingError
from samii_rig.files import open_file, reason
from samii_rig.record.writer import Origin, RunWriter
from samii_rig.types import FrequencyResponse, StopRecord

_PREFIX = "source."  # metadata key `source.NAME` holds the SHA-256 of the recording NAME


def sha256_of(path: Path) -> str:
    """SHA-256 of a file's bytes, in hexadecimal."""
    try:
        with open_file(path) as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError as error:
        raise RecordingError(f"{path} cannot be read: {reason(error)}") from error


def save_frequency_responses(
    path: Path,
    responses: Sequence[FrequencyResponse],
    sources: Iterable[Path],
    metadata: dict[str, str] | None = None,
    rig_toml: str = "",
) -> None:
    """Write results into an MCAP file of their own, without samples.

    sources : the recordings that they were estimated from; their names and hashes go in.
    rig_toml : the rig file that these carry.
    RecordingError if there is nothing to write, a source cannot be read, or `path` exists.
    """
    if not responses:
        raise RecordingError(f"there is no frequency response to write to {path}")
    hashes = {f"{_PREFIX}{source.name}": sha256_of(source) for source in sources}
    with RunWriter(
        # No device's clock is behind it: zero is the moment at which it is written.
        path,
        (),
        responses[0].rate_hz,
        Origin(rig_toml, metadata={**(metadata or {}), **hashes}),
        keep_partial=False,
    ) as writer:
        for item in responses:
            writer.frequency_response(item)
        writer.close(StopRecord("completed", f"{len(responses)} frequency responses saved"))


def sources_of(notes: dict[str, str]) -> dict[str, str]:
    """SHA-256 by name of the recordings that a file's metadata (`read_notes`) name."""
    return {k.removeprefix(_PREFIX): v for k, v in notes.items() if k.startswith(_PREFIX)}
