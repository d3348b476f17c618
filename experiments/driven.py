"""What all experiments share that drive an actuator: levels, and how they act on the loop."""

from __future__ import annotations

from typing import Annotated, Literal

import numpy as np
from pydantic import Field, field_validator

from samii_rig.errors import InputError
from samii_rig.rig.schema import Finite, Name, Rig, Strict
from samii_rig.run.plan import Plan, PlannedSegment
from samii_rig.safety.limits import find_actuator
from samii_rig.signal.excitation import Interpolation
from samii_rig.types import Float

# Above this part of the rate a sampled sine looks like another one for the hold and the
# sensors' filters, and the anti-alias filters cut.
HIGHEST = 0.45
# Longer plans are better run one after another: the prediction holds the spectrum of the
# whole plan in memory. 2.8 hours at 500 samples/s.
MOST_SAMPLES = 5_000_000

# Of any unit. No rig has levels beyond; inside, no product with another number of a plan overflows.
Level = Annotated[float, Field(gt=0, le=1e9)]


class Driven(Strict):
    """An experiment file that drives one actuator at several levels.

    drive : `output` adds the excitation to the output, u in v = u + kp (theta_ref - theta),
        with theta_ref = 0; `reference` gives it to theta_ref with u = 0, as the recordings of
        the SFLR robot were made.
    unit : of the levels; the actuator's for `output`, the centring sensor's for `reference`.
    amplitudes : peak of the excitation at each level, in `unit`.
    interpolation : of the schedule's factor between its points.
    kp : of the centring loop; absent for the rig's own.
    """

    name: Name
    description: str = ""
    actuator: Name
    unit: str
    drive: Literal["output", "reference"] = "output"
    amplitudes: Annotated[tuple[Level, ...], Field(min_length=1, max_length=100)]
    interpolation: Interpolation = "logarithmic"
    kp: Finite | None = None
    seed: Annotated[int, Field(ge=0)] = 0

    @field_validator("amplitudes")
    @classmethod
    def _distinct(cls, amplitudes: tuple[float, ...]) -> tuple[float, ...]:
        if len(set(amplitudes)) != len(amplitudes):
            raise ValueError("each level once; it is measured longer by repeating it")
        return amplitudes

    @field_validator("kp")
    @classmethod
    def _kp(cls, kp: float | None) -> float | None:
        if kp is not None and kp < 0:
            raise ValueError("0 or more; a negative kp drives the joint off centre")
        return kp

    def loop(self, rig: Rig, where: str) -> tuple[float, str]:
        """kp and the sensor that centres, checked against the rig.

        Without centring kp is 0, and the device reads the sensor to no effect. InputError if
        the rig has no such actuator, another unit, or no centring where it is needed.
        """
        return self._loop_on(self.actuator, rig, where)

    def _loop_on(self, name: str, rig: Rig, where: str) -> tuple[float, str]:
        actuator = find_actuator(rig, name, where)
        centring = rig.centring_of(name)
        first = len(rig.actuator) == 1 or name == rig.actuator[0].name
        table = "[centring]" if first else f"centring of {name}"
        unit, what = actuator.unit, f"actuator {actuator.name}"
        if self.drive == "reference":
            if centring is None:
                raise InputError(
                    where, "drive", "reference", f"a rig that centres; {rig.name} has no {table}"
                )
            unit, what = rig.units()[centring.sensor], f"sensor {centring.sensor}"
        if self.unit != unit:
            raise InputError(where, "unit", self.unit, f"{unit!r}, the unit of {what}")
        kp = self.kp if self.kp is not None else (centring.kp if centring else 0.0)
        if kp > 0 and centring is None:
            raise InputError(where, "kp", kp, f"0; {rig.name} has no {table}")
        if kp == 0 and self.drive == "reference":
            raise InputError(where, "kp", kp, "above 0: the reference acts through kp alone")
        return kp, centring.sensor if centring else rig.sensor[0].name

    def check_band(
        self, rig: Rig, where: str, low: tuple[str, float], high: tuple[str, float]
    ) -> None:
        """InputError unless the rig can be driven at both (field, Hz) of this experiment."""
        most, least = HIGHEST * rig.rate_hz, rig.rate_hz / MOST_SAMPLES
        for field, hz in (low, high):
            if hz > most:
                expected = f"at most {most:g} Hz, {HIGHEST:g} of the rate"
                raise InputError(where, field, hz, expected)
            if hz < least:
                expected = f"at least {least:g} Hz, a period of the longest plan"
                raise InputError(where, field, hz, expected)

    def check_length(self, rig: Rig, where: str, field: str, samples: float) -> None:
        """InputError, which blames `field`, if a plan of so many samples is too long."""
        # A float, which may be infinite, until it is known to fit.
        if not samples <= MOST_SAMPLES:
            longest = f"a plan of at most {MOST_SAMPLES / rig.rate_hz / 3600:.0f} hours"
            raise InputError(where, field, getattr(self, field), longest)

    def references(self, wave: Float) -> tuple[Float, Float]:
        """u and theta_ref, (n,) each, that drive with `wave` (n,); the other one rests."""
        rest = np.zeros_like(wave)
        return (wave, rest) if self.drive == "output" else (rest, wave)

    def planned(
        self, rig: Rig, kp: float, sensor: str, segments: tuple[PlannedSegment, ...]
    ) -> Plan:
        """The plan of these segments, with the loop that `loop` gave."""
        return Plan(
            experiment=self.name,
            rate_hz=rig.rate_hz,
            actuator=self.actuator,
            kp=kp,
            centring_sensor=sensor,
            segments=segments,
            seed=self.seed,
        )
