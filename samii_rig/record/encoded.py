"""MCAP records as bytes, by the mcap library."""

from __future__ import annotations

from typing import Any, cast

from mcap.data_stream import RecordBuilder
from mcap.records import McapRecord


def encoded(*records: McapRecord) -> bytes:
    """The records as they stand in a file, one after the other."""
    builder = RecordBuilder()
    for record in records:
        record.write(builder)
    return cast(bytes, cast(Any, builder).end())
