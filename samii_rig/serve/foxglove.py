"""Live to Foxglove, and to what else speaks its protocol: samples as in a recording, and `/bode`.

It listens to this machine alone and takes nothing from those who look. `/samples` carries the
messages of a recording's `/samples` with the same definition, so that one layout shows both;
`/bode` carries as JSON what the page shows of the frequency responses so far.
"""

from __future__ import annotations

import json
import time
from contextlib import suppress
from pathlib import Path
from typing import Any, cast

import numpy as np

from samii_rig.errors import InputError
from samii_rig.record.cdr import ENCAPSULATION
from samii_rig.record.layout import (
    MESSAGE_ENCODING,
    SAMPLES,
    SAMPLES_SCHEMA,
    SCHEMA_ENCODING,
    SampleLayout,
    field_names,
)
from samii_rig.serve.live import LiveReader
from samii_rig.types import Channel, Quality, Role

HOST = "127.0.0.1"
BODE = "/bode"
AGAIN = 5.0  # s after which /bode is sent once more, for who came meanwhile
BACKLOG = 8192  # messages that wait for one viewer; a slow one loses the oldest
_ARRAY = {"type": "array", "items": {"type": "number"}}
_BODE_SCHEMA = {
    "title": "samii_rig.Bode",
    "type": "object",
    "properties": {
        "responses": {
            "type": "array",
            "items": {
                "type": "object",
                "description": "by output: gain, low, high (90 %), phase in degrees",
                "properties": {
                    "level": {"type": "number"},
                    "unit": {"type": "string"},
                    "frequency": _ARRAY,
                },
            },
        }
    },
}


class Foxglove:
    """A server that shows a run. port : 0 for any that is free; `port` says which.

    InputError without the SDK, or for a port that is taken.
    """

    def __init__(self, port: int, name: str) -> None:
        try:
            import foxglove
        except ModuleNotFoundError as error:
            expected = "it to be installed: pip install samii-rig[foxglove]"
            raise InputError("--foxglove", "", error.name, expected) from error
        self._sdk = foxglove
        self._context = foxglove.Context()
        try:
            self._server = foxglove.start_server(
                name=name,
                host=HOST,
                port=port,
                capabilities=[],
                context=self._context,
                message_backlog_size=BACKLOG,
            )
        except (RuntimeError, OverflowError) as error:
            raise InputError("--foxglove", "", port, f"a free port ({error})") from error
        self.port = self._server.port
        self._reader: LiveReader | None = None
        self._samples: Any = None
        self._bode = foxglove.Channel(BODE, schema=_BODE_SCHEMA, context=self._context)
        self._row, self._zero = 0, 0
        self._seen, self._due = 0, 0.0
        self._columns = np.dtype([])

    def show(self, reader: LiveReader | None, responses: Path | None) -> None:
        """Send what is new. responses : the analyst's file of the run that goes on."""
        if reader is not self._reader:
            self._reader = reader
            self._begin(reader)
        if reader is not None:
            self._send(reader)
        if responses is not None and self._bode.has_sinks():
            self._respond(responses)

    def close(self) -> None:
        """Everybody is let go."""
        self._server.stop()

    def _begin(self, reader: LiveReader | None) -> None:
        """Another run: its channels instead of the last one's."""
        if self._samples is not None:
            self._samples.close()
            self._samples = None
        if reader is None:
            return
        channels = tuple(
            Channel(c["name"], c["unit"], cast(Role, c["role"])) for c in reader.channels
        )
        layout = SampleLayout(channels, reader.rate_hz)
        text = layout.schema_text().encode()
        schema = self._sdk.Schema(name=SAMPLES_SCHEMA, encoding=SCHEMA_ENCODING, data=text)
        units = {f"unit.{f}": c.unit for f, c in zip(field_names(channels), channels, strict=True)}
        self._samples = self._sdk.Channel(
            SAMPLES,
            schema=schema,
            message_encoding=MESSAGE_ENCODING,
            metadata=units,
            context=self._context,
        )
        n = len(channels)
        self._columns = np.dtype(
            [("head", "V4"), ("sequence", "<i8"), ("values", "<f8", n), ("quality", "u1", n)]
        )
        self._row = reader.whole
        self._zero = time.time_ns() - round(reader.whole / reader.rate_hz * 1e9)

    def _send(self, reader: LiveReader) -> None:
        if not self._samples.has_sinks():
            self._row = reader.whole
            return
        new = reader.since(self._row)
        first = self._row + new.lost
        self._row = first + len(new.sequence)
        rows = np.zeros(len(new.sequence), self._columns)
        rows["head"] = np.void(ENCAPSULATION)
        rows["sequence"] = new.sequence
        rows["values"] = new.values
        # The live data say of a value no more than that it is missing.
        rows["quality"] = np.where(np.isnan(new.values), int(Quality.MISSING), 0)
        since = np.round((first + np.arange(len(rows))) / reader.rate_hz * 1e9).astype(np.int64)
        for row, when in zip(rows, (self._zero + since).tolist(), strict=True):
            self._samples.log(row.tobytes(), log_time=when)

    def _respond(self, path: Path) -> None:
        with suppress(OSError, ValueError):
            written = path.stat().st_mtime_ns
            now = time.monotonic()
            if written == self._seen and now < self._due:
                return
            told = json.loads(path.read_text(encoding="utf-8"))["responses"]
            self._bode.log({"responses": [_plottable(r) for r in told]})
            self._seen, self._due = written, now + AGAIN


def _plottable(told: dict[str, Any]) -> dict[str, Any]:
    """A response with its curves by the name of the output, for the path of a plot."""
    kept = ("gain", "low", "high", "phase")
    curves = {c["output"]: {k: c[k] for k in kept} for c in told["curves"]}
    return {k: told[k] for k in ("level", "unit", "frequency")} | curves
