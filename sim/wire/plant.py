"""The simulated rig as a node's board sees it: counts out, counts in."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from samii_rig.errors import InputError
from samii_rig.rig.schema import Rig
from sim import kernel
from sim.base import UNRELATED, realised
from sim.contact import check_contact, tables_of
from sim.lanes import sense_all
from sim.settings import SimSettings
from sim.several import plant_of
from sim.wire.protocol import MAX_OUTPUTS, RAILS

MOST_COUNTS = 32_000  # to which the end of an analogue sensor's range is scaled
FINE = 1e-5  # rad, a step of an encoder whose rig file states none
NULLS = 37, -12, 20  # counts at which each output's simulated valve stands still


@dataclass(frozen=True, slots=True)
class Wiring:
    """Where a sensor ends on the node: counts = value counts_per_unit + offset."""

    index: int
    counts_per_unit: float
    offset: int = 0


@dataclass(frozen=True, slots=True)
class Put:
    """Where an actuator begins on the node: counts = null + value counts_per_unit."""

    index: int
    counts_per_unit: float
    null: int


@dataclass(frozen=True, slots=True)
class Board:
    """The wiring of all sensors and outputs. supply : the valves have one only while the node's
    supply line is on."""

    encoder: dict[str, Wiring]
    adc: dict[str, Wiring]
    output: dict[str, Put]
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
        more = {"supply": True} if self.supply else {}
        return {"port": port, **self._outputs(), **tables, **more}

    def _outputs(self) -> dict[str, object]:
        """Of one output as it has always been, of several a table."""
        first, *beside = self.output.values()
        if not beside and first.index == 0:
            return {"output_counts_per_unit": first.counts_per_unit, "null": first.null}
        return {
            "output": {
                name: {"index": o.index, "counts_per_unit": o.counts_per_unit, "null": o.null}
                for name, o in self.output.items()
            }
        }


def board(rig: Rig) -> Board:
    """The wiring that the rig file states for its serial node, or one that fits its sensors."""
    given = rig.device.settings
    if len(rig.actuator) > MAX_OUTPUTS:
        expected = f"at most {MAX_OUTPUTS}, the outputs of a simulated node"
        raise InputError(rig.name, "actuator", len(rig.actuator), expected)
    if rig.device.driver == "serial_node":
        try:
            enc, adc = (
                {str(k): Wiring(**w) for k, w in given.get(kind, {}).items()}
                for kind in ("encoder", "adc")
            )
            return Board(enc, adc, _stated(rig, given), bool(given.get("supply", False)))
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
    outputs = {
        spec.name: Put(i, 1.0 / (spec.resolution or spec.high / MOST_COUNTS), NULLS[i])
        for i, spec in enumerate(rig.actuator)
    }
    return Board(encoder, analogue, outputs)


def _stated(rig: Rig, given: Mapping[str, Any]) -> dict[str, Put]:
    """The outputs of a serial node's settings; KeyError, TypeError or ValueError for none."""
    if "output" not in given:
        (spec,) = rig.actuator
        counts, null = float(given["output_counts_per_unit"]), int(given.get("null", NULLS[0]))
        return {spec.name: Put(0, counts, null)}
    table = {str(name): dict(o) for name, o in given["output"].items()}
    made = {}
    for spec in rig.actuator:
        o = table[spec.name]
        i = int(o["index"])
        if not 0 <= i < MAX_OUTPUTS:
            where = f"device.settings.output.{spec.name}.index"
            expected = f"below {MAX_OUTPUTS}, the outputs of a simulated node"
            raise InputError(rig.name, where, i, expected)
        made[spec.name] = Put(i, float(o["counts_per_unit"]), int(o.get("null", NULLS[i])))
    return made


class Plant:
    """The rig's realised model with its converters, one sample at a time.

    The chain is linear, so each output moves a plant of its own and a sensor reads the sum.
    """

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
        check_contact(rig, settings)
        self._lanes = tuple(plant_of(rig, made, settings, i) for i in range(len(rig.actuator)))
        if len(self._lanes) == 1:
            tables, contact = tables_of(rig, made, settings)
            (lane,) = self._lanes
            self._lanes = (lane._replace(tables=tables, contact=contact),)
        self._outputs = [wired.output[a.name] for a in rig.actuator]
        m = len(rig.sensor)
        self._values, self._quality = np.zeros(m), np.zeros(m, dtype=np.uint8)
        self._still = np.zeros(max(m, settings.inner))
        self._rng = np.random.default_rng(settings.seed)
        self.rest()

    def rest(self) -> None:
        """Everything still, as at the start."""
        self._lanes = tuple(lane._replace(state=kernel.rest(lane.tables)) for lane in self._lanes)
        for lane in self._lanes:
            lane.contact.x[:] = 0.0
            lane.contact.held[:] = 0.0

    def sense(self) -> tuple[tuple[int, ...], tuple[int, ...]]:
        """Counts of the encoders and of the analogue inputs at this sample."""
        s, m = self._settings, len(self._values)
        noise = self._rng.standard_normal(m) if s.noise else self._still
        values = self._values
        if len(self._lanes) == 1:
            (one,) = self._lanes
            kernel.sense(
                one.tables, one.converters, one.contact, one.state, noise, values, self._quality
            )
        else:
            sense_all(self._lanes, noise, values, self._quality)
        counts: dict[bool, dict[int, int]] = {True: {}, False: dict(self._usual)}
        for i, is_encoder, w in self._places:
            n = round(float(values[i]) * w.counts_per_unit + w.offset)
            counts[is_encoder][w.index] = n if is_encoder else min(max(n, RAILS[0]), RAILS[1])
        return _filled(counts[True]), _filled(counts[False])

    def move(self, dac: Sequence[int]) -> None:
        """Put counts out of each of the node's outputs and go on to the next sample."""
        s = self._settings
        pushed = s.disturbance_rms > 0.0
        for lane, o in zip(self._lanes, self._outputs, strict=True):
            disturbance = self._rng.standard_normal(s.inner) if pushed else self._still
            v = (dac[o.index] - o.null) / o.counts_per_unit
            kernel.move(lane.tables, lane.drive, lane.contact, lane.state, v, disturbance)

    def load(self, i: int) -> float:
        """What is at sensor i at the sample to come, without noise and converter."""
        total = 0.0
        for lane in self._lanes:
            t, s = lane.tables, lane.state
            applied, extra = s.number[kernel.APPLIED], s.number[kernel.EXTRA]
            inputs = t.row_old[i] * applied + t.row_extra[i] * extra
            force = kernel.contact_now(lane.contact, s)
            touch = kernel.touched(lane.contact, i, force)
            total += float((t.row[i] * s.x).sum() + inputs + touch)
        return total


def _filled(counts: Mapping[int, int]) -> tuple[int, ...]:
    """In the order of their inputs; one that nothing is wired to reads 0."""
    return tuple(counts.get(i, 0) for i in range(max(counts, default=-1) + 1))
