"""How well a plan will measure: the expected error of its frequency responses, by band."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from samii_rig.rig.schema import Rig
from samii_rig.run.plan import Plan, PlannedSegment
from samii_rig.signal.groups import Piece
from samii_rig.signal.periodic import first_used
from samii_rig.signal.spectra import comb, spectrum
from samii_rig.types import Float, Int


@dataclass(frozen=True, slots=True)
class BandError:
    """Predicted standard deviation of sensor/command in one band at one level.

    std : sqrt(E|dH|^2) in sensor unit per actuator unit, median over the lines of the band,
        each 1/duration of a segment wide (of a periodic reference, the lines that it drives;
        of stepped sines, their frequencies, each dwell in full),
        all repeats averaged. Averaging n neighbouring lines divides it by sqrt(n).
    relative : std/|H|, median. input : the actuator, "" where the rig has but one.
    """

    channel: str
    level: float
    level_unit: str
    low_hz: float
    high_hz: float
    std: float
    relative: float
    input: str = ""


def exciting_only(plan: Plan, parts: list[slice]) -> tuple[Plan, list[slice]]:
    """The segments of a plan with one output that excite it, and where they are.

    Several inputs that are driven together by references that are orthogonal over the segments
    are as well known as each would be by itself in all of them.
    """
    kept = [
        i for i, s in enumerate(plan.segments) if plan.actuator in (s.excited or (plan.actuator,))
    ]
    segments = tuple(plan.segments[i] for i in kept)
    return replace(plan, segments=segments), [parts[i] for i in kept]


def expected_errors(
    plan: Plan, rig: Rig, v: Float, parts: list[slice], hz: Float, size: Float
) -> list[BandError]:
    """Noise over command: dY = N - H dV vanishes but for the sensor's own noise, because the
    command is read back; a sensor's noise is spread evenly over the n lines of a segment."""
    out = _stepped(plan, rig, v, parts, hz, size)
    levels: dict[tuple[float, str], list[tuple[PlannedSegment, slice]]] = {}
    for s, part in zip(plan.segments, parts, strict=True):
        if s.dwell is None and s.kind != "transient":
            levels.setdefault((s.level, s.unit), []).append((s, part))
    for (level, unit), members in levels.items():
        s, part = members[0]
        part, driven = _used(s, part, plan)
        n = part.stop - part.start
        V = np.abs(np.fft.rfft(v[part]))[driven]
        f = np.fft.rfftfreq(n, 1 / plan.rate_hz)[driven]
        for low, high in _octaves(*s.band_hz):
            inside = (f >= low) & (f < high)
            if not inside.any():
                continue
            for i, sensor in enumerate(rig.sensor):
                std = sensor.own_noise * math.sqrt(n / len(members)) / V[inside]
                H = np.interp(f[inside], hz, size[:, i])
                if not H.all():
                    continue  # this input does not move it at all
                out.append(
                    BandError(
                        sensor.name,
                        level,
                        unit,
                        low,
                        high,
                        float(np.median(std)),
                        float(np.median(std / H)),
                    )
                )
    return out


def _stepped(
    plan: Plan, rig: Rig, v: Float, parts: list[slice], hz: Float, size: Float
) -> list[BandError]:
    """Of dwells at one frequency each, in full; the median over the frequencies of a band."""
    levels: dict[tuple[float, str], list[tuple[float, float, int]]] = {}
    for s, part in zip(plan.segments, parts, strict=True):
        if s.dwell is not None:
            n = s.dwell.blocks * s.dwell.block
            f = s.dwell.cycles * plan.rate_hz / s.dwell.block
            x = v[part][s.dwell.last - n : s.dwell.last]
            V = abs(np.exp(-2j * np.pi * f * np.arange(n) / plan.rate_hz) @ x)
            levels.setdefault((s.level, s.unit), []).append((f, float(V), n))
    out: list[BandError] = []
    for (level, unit), points in levels.items():
        at, drive, length = np.array(sorted(points)).T
        for low, high in _octaves(float(at[0]), float(at[-1])):
            inside = (at >= low) & (at <= high)
            if not inside.any():
                continue
            for i, sensor in enumerate(rig.sensor):
                std = sensor.own_noise * np.sqrt(length[inside]) / drive[inside]
                H = np.interp(at[inside], hz, size[:, i])
                if not H.all():
                    continue
                relative = std / H
                middle = float(np.median(std)), float(np.median(relative))
                out.append(BandError(sensor.name, level, unit, low, high, *middle))
    return out


def _used(s: PlannedSegment, part: slice, plan: Plan) -> tuple[slice, Int]:
    """The samples of a segment that an estimate uses, and the lines that it has: of a periodic
    reference all but the first period, and the lines that the reference drives."""
    n = part.stop - part.start
    if s.kind != "periodic":
        return part, np.arange(n // 2 + 1)
    first, last = s.recorded or (0, n)
    r = (s.u + plan.kp * s.theta_ref)[first:last]
    first += first_used(r)
    r = r[first_used(r) :]
    # A spectrum leaves line 0 out.
    lines = 1 + comb([spectrum(Piece(s.name, r, r[:, None]), plan.rate_hz)], None)
    return slice(part.start + first, part.start + last), lines


def _octaves(low: float, high: float) -> list[tuple[float, float]]:
    """The band in equal parts on a logarithmic axis, each as near to an octave as fits."""
    n = max(1, round(math.log2(high / low))) if high > low else 1
    edges = low * (high / low) ** (np.arange(n + 1) / n)
    return [(float(a), float(b)) for a, b in pairwise(edges)]
