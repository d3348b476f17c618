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

from samii_rig.devices.channels import reference_names
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
from samii_rig.rig.schema import Rig
from samii_rig.serve.live import LiveReader
from samii_rig.types import Channel, Quality, Role

HOST = "127.0.0.1"
BODE = "/bode"
SENT_AGAIN = 5.0  # s after which /bode is sent once more, for who came meanwhile
VIEWER_BACKLOG = 8192  # messages that wait for one viewer; a slow one loses the oldest
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

    Channels are made before the server listens: of one made later the SDK tells those who are
    there before it takes their subscription. So those of the rig stay from run to run, and a run
    with others gets a server of its own at the same port, to which viewers connect anew.

    InputError without the SDK, or for a port that is taken.
    """

    def __init__(self, port: int, rig: Rig) -> None:
        try:
            import foxglove
        except ModuleNotFoundError as error:
            expected = "it to be installed: pip install samii-rig[foxglove]"
            raise InputError("--foxglove", "", error.name, expected) from error
        self._sdk = foxglove
        self._name, self.port = rig.name, port
        self._channels = usual_channels(rig)
        self._server: Any = None
        self._reader: LiveReader | None = None
        self._row, self._zero = 0, 0
        self._seen, self._due = 0, 0.0
        try:
            self._listen()
        except (RuntimeError, OverflowError) as error:
            raise InputError("--foxglove", "", port, f"a free port ({error})") from error

    def show(self, reader: LiveReader | None, responses: Path | None) -> None:
        """Send what is new. responses : the analyst's file of the run that goes on."""
        if reader is not self._reader:
            self._reader = reader
            self._begin(reader)
        if self._server is None:
            # Its port is free only a moment after the one before has stopped.
            with suppress(RuntimeError):
                self._listen()
        if reader is not None:
            self._send(reader)
        if responses is not None and self._bode.has_sinks():
            self._respond(responses)

    def close(self) -> None:
        """Everybody is let go."""
        if self._server is not None:
            self._server.stop()
        self._server = None

    def _listen(self) -> None:
        # Kept: its channels go with it.
        self._context = context = self._sdk.Context()
        fields = field_names(self._channels)
        n = len(fields)
        self._columns = np.dtype(
            [("head", "V4"), ("sequence", "<i8"), ("values", "<f8", n), ("quality", "u1", n)]
        )
        text = SampleLayout(self._channels, 1.0).schema_text().encode()  # which has no rate in it
        self._samples = self._sdk.Channel(
            SAMPLES,
            schema=self._sdk.Schema(name=SAMPLES_SCHEMA, encoding=SCHEMA_ENCODING, data=text),
            message_encoding=MESSAGE_ENCODING,
            metadata={f"unit.{f}": c.unit for f, c in zip(fields, self._channels, strict=True)},
            context=context,
        )
        self._bode = self._sdk.Channel(BODE, schema=_BODE_SCHEMA, context=context)
        self._server = self._sdk.start_server(
            name=self._name,
            host=HOST,
            port=self.port,
            capabilities=[],
            context=context,
            message_backlog_size=VIEWER_BACKLOG,
        )
        self.port = self._server.port

    def _begin(self, reader: LiveReader | None) -> None:
        """Another run."""
        if reader is None:
            return
        channels = tuple(
            Channel(c["name"], c["unit"], cast(Role, c["role"])) for c in reader.channels
        )
        if channels != self._channels:
            self._channels = channels
            self.close()
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
            self._seen, self._due = written, now + SENT_AGAIN


def usual_channels(rig: Rig) -> tuple[Channel, ...]:
    """What most devices report of a rig; names, units and roles alone."""
    units = rig.units()
    references, commands = list[Channel](), list[Channel]()
    for actuator in rig.actuator:
        u, theta_ref = reference_names(rig, actuator.name)
        loop = rig.centring_of(actuator.name)
        angle = units[loop.sensor if loop else rig.sensor[0].name]
        references += [
            Channel(u, actuator.unit, "reference"),
            Channel(theta_ref, angle, "reference"),
        ]
        commands.append(Channel(actuator.name, actuator.unit, "command"))
    sensors = (Channel(s.name, s.unit) for s in rig.sensor)
    monitors = (Channel(m.name, m.unit, "monitor") for m in rig.monitor)
    return (*references, *commands, *sensors, *monitors)


def _plottable(told: dict[str, Any]) -> dict[str, Any]:
    """A response with its curves by the name of the output, for the path of a plot."""
    kept = ("gain", "low", "high", "phase")
    curves = {c["output"]: {k: c[k] for k in kept} for c in told["curves"]}
    return {k: told[k] for k in ("level", "unit", "frequency")} | curves
