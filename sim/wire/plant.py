"""The simulated rig as a node's board sees it: counts out, counts in."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from samii_rig.errors import InputError
from samii_rig.rig.schema import Rig
from sim import kernel
from sim.base import UNRELATED, realised
from sim.electronics import converters, drive
from sim.guide import check_guide, tables_of
from sim.settings import SimSettings
from sim.wire.protocol import RAILS

MOST_COUNTS = 32_000  # to which the end of an analogue sensor's range is scaled
FINE = 1e-5  # rad, a step of an encoder whose rig file states none
NULL = 37  # counts at which the simulated valve stands still


@dataclass(frozen=True, slots=True)
class Wiring:
    """Where a sensor ends on the node: counts = value counts_per_unit + offset."""

    index: int
    counts_per_unit: float
    offset: int = 0


@dataclass(frozen=True, slots=True)
class Board:
    """The wiring of all sensors and of the output. supply : the valve has one only while the node's
    supply line is on."""

    encoder: dict[str, Wiring]
    adc: dict[str, Wiring]
    output_counts_per_unit: float
    null: int = NULL
    supply: bool = False

    @property
    def names(self) -> set[str]:
        """Of all that is wired to an input."""
        return {*self.encoder, *self.adc}

    def settings(self, port: str) -> dict[str, object]:
        """What the driver of such a node needs in [device.settings]."""
        tables = {
            kind: {
                name: {
                    "index": w.index,
                    "counts_per_unit": w.counts_per_unit,
                    "offset": w.offset,
                }
                for name, w in wired.items()
            }
            for kind, wired in (("encoder", self.encoder), ("adc", self.adc))
        }
        out = self.output_counts_per_unit
        more = {"supply": True} if self.supply else {}
        return {"port": port, "output_counts_per_unit": out, "null": self.null, **tables, **more}


def board(rig: Rig) -> Board:
    """The wiring that the rig file states for its serial node, or one that fits its sensors."""
    given = rig.device.settings
    if rig.device.driver == "serial_node":
        try:
            enc, adc = (
                {str(k): Wiring(**w) for k, w in given.get(kind, {}).items()}
                for kind in ("encoder", "adc")
            )
            out = float(given["output_counts_per_unit"])
            null, supply = int(given.get("null", NULL)), bool(given.get("supply", False))
            return Board(enc, adc, out, null, supply)
        except (KeyError, TypeError, ValueError) as error:
            where = "device.settings"
            raise InputError.saying(rig.name, where, f"not a serial node's: {error}") from error
    encoder: dict[str, Wiring] = {}
    analogue: dict[str, Wiring] = {}
    for s in rig.sensor:
        if s.unit == "rad":
            encoder[s.name] = Wiring(len(encoder), 1.0 / (s.resolution or FINE), 1000)
        else:
            end = max(abs(s.low), abs(s.high))
            analogue[s.name] = Wiring(
                len(analogue), MOST_COUNTS // end if end < MOST_COUNTS else 1.0
            )
    for m in rig.monitor:
        end = max((abs(x) for x in (m.low, m.high) if math.isfinite(x)), default=2 * abs(m.usual))
        analogue[m.name] = Wiring(len(analogue), MOST_COUNTS / (end or 1.0))
    spec = rig.actuator[0]
    return Board(encoder, analogue, 1.0 / (spec.resolution or spec.high / MOST_COUNTS))


class Plant:
    """The rig's realised model with its converters, one sample at a time."""

    def __init__(self, rig: Rig, wired: Board, settings: SimSettings) -> None:
        self._wired, self._settings = wired, settings
        inputs = wired.encoder | wired.adc
        self._places = [
            (i, s.name in wired.encoder, inputs[s.name])
            for i, s in enumerate(rig.sensor)
            if s.name in inputs
        ]
        # The steps are the node's converters', not those of the rig file.
        stepless = [s.model_copy(update={"resolution": 0.0}) for s in rig.sensor]
        rig = rig.model_copy(update={"sensor": tuple(stepless)})
        made = realised(rig.model_dump_json(exclude=UNRELATED), settings.band_hz)
        self._usual = {
            wired.adc[m.name].index: round(
                m.usual * wired.adc[m.name].counts_per_unit + wired.adc[m.name].offset
            )
            for m in rig.monitor
        }
        check_guide(rig, settings)
        self._tables, self._guide = tables_of(rig, made, settings)
        self._converters = converters(rig, settings)
        self._drive = drive(rig, settings)
        m = len(rig.sensor)
        self._values, self._quality = np.zeros(m), np.zeros(m, dtype=np.uint8)
        self._still = np.zeros(max(m, settings.inner))
        self._rng = np.random.default_rng(settings.seed)
        self.rest()

    def rest(self) -> None:
        """Everything still, as at the start."""
        self._state = kernel.rest(self._tables)
        self._guide.x[:] = 0.0
        self._guide.held[:] = 0.0

    def sense(self) -> tuple[tuple[int, ...], tuple[int, ...]]:
        """Counts of the encoders and of the analogue inputs at this sample."""
        s, m = self._settings, len(self._values)
        noise = self._rng.standard_normal(m) if s.noise else self._still
        t, c, values = self._tables, self._converters, self._values
        kernel.sense(t, c, self._guide, self._state, noise, values, self._quality)
        counts: dict[bool, dict[int, int]] = {True: {}, False: dict(self._usual)}
        for i, is_encoder, w in self._places:
            n = round(float(values[i]) * w.counts_per_unit + w.offset)
            counts[is_encoder][w.index] = n if is_encoder else min(max(n, RAILS[0]), RAILS[1])
        return _filled(counts[True]), _filled(counts[False])

    def move(self, dac: int) -> None:
        """Put counts out and go on to the next sample."""
        s, out = self._settings, self._wired.output_counts_per_unit
        pushed = s.disturbance_rms > 0.0
        disturbance = self._rng.standard_normal(s.inner) if pushed else self._still
        v = (dac - self._wired.null) / out
        kernel.move(self._tables, self._drive, self._guide, self._state, v, disturbance)

    def load(self, i: int) -> float:
        """What is at sensor i at the sample to come, without noise and converter."""
        t, s = self._tables, self._state
        applied, extra = s.number[kernel.APPLIED], s.number[kernel.EXTRA]
        inputs = t.row_old[i] * applied + t.row_extra[i] * extra
        return float((t.row[i] * s.x).sum() + inputs + kernel.rubbed(self._guide, i))


def _filled(counts: Mapping[int, int]) -> tuple[int, ...]:
    """In the order of their inputs; one that nothing is wired to reads 0."""
    return tuple(counts.get(i, 0) for i in range(max(counts, default=-1) + 1))
