"""The measurement chain's errors, and a run through plant, converters and loop."""

from __future__ import annotations

import copy
from dataclasses import dataclass

import numpy as np

from samii_rig.rig.schema import Rig
from samii_rig.types import Float
from sim.concealed.integrate import Loop, Tables, run, tabulate
from sim.concealed.modes import Poles, poles_of
from sim.concealed.parts import Description, Law
from sim.concealed.runs import Design, Run, burst

BAND = (0.5, 40.0)  # Hz, in which the disturbance is sized


@dataclass(frozen=True, slots=True)
class Errors:
    """(m,) each, in the sensors' units. white : rms. offset. drift : rms of a slow wander.
    hum : amplitude at hum_hz. push : N, rms of the disturbing force, held for each sample."""

    white: Float
    offset: Float
    drift: Float
    hum: Float
    hum_hz: float
    push: float


def draw_errors(rig: Rig, poles: Poles, scale: float, rng: np.random.Generator) -> Errors:
    """Errors about as large as the rig file says of its sensors.

    The disturbance moves the sensor that it moves most, against its noise, by 0.3 to 1 times
    that noise within the band.
    """
    white = np.array([s.noise_rms for s in rig.sensor])
    step = np.array([s.resolution for s in rig.sensor])
    analogue = np.array([s.kind == "acceleration" for s in rig.sensor])
    floor = np.sqrt(white**2 + step**2 / 12)
    f = np.linspace(*BAND, 80)
    moved = np.sqrt(np.mean(np.abs(poles.sampled(f, poles.push)) ** 2, axis=0))
    part = 2 * (BAND[1] - BAND[0]) / rig.rate_hz
    push = float(np.min(floor * np.sqrt(part) / np.maximum(moved * np.sqrt(part), 1e-300)))
    m = len(rig.sensor)
    return Errors(
        white=scale * white * rng.uniform(0.8, 1.3, m),
        offset=scale * rng.normal(0, 5, m) * floor,
        drift=scale * rng.uniform(0.5, 2, m) * floor * analogue,
        hum=scale * rng.uniform(0.2, 1.5, m) * floor * analogue,
        hum_hz=50.0 + float(rng.normal(0, 0.03)),
        push=scale * push * float(rng.uniform(0.3, 1.0)),
    )


def loop_of(rig: Rig, plant: Description, *, ideal: bool = False) -> Loop:
    """Converters and centring of a rig file; `ideal` ones do not round or clip."""
    sensors, names = rig.sensor, [s.name for s in rig.sensor]
    loops = [rig.centring_of(a.name) for a in rig.actuator]
    wide = np.full(len(sensors), np.inf)
    return Loop(
        np.array([names.index(c.sensor) if c else 0 for c in loops], dtype=np.int64),
        np.array([c.kp if c else 0.0 for c in loops]),
        np.array([a.low for a in rig.actuator]),
        np.array([a.high for a in rig.actuator]),
        np.array([0.0 if ideal else a.resolution for a in rig.actuator]),
        -wide if ideal else np.array([s.low for s in sensors]),
        wide if ideal else np.array([s.high for s in sensors]),
        np.zeros(len(sensors)) if ideal else np.array([s.resolution for s in sensors]),
        np.array([d.deadband for d in plant.drives]),
        np.array([d.limit for d in plant.drives]),
    )


def measured(
    run_: Run, tables: Tables, loop: Loop, errors: Errors, rate_hz: float, rng: np.random.Generator
) -> tuple[Float, Float]:
    """v (n, d) and the sensors (n, m) of one run with its errors."""
    n, m = len(run_.u), errors.white.size
    t = np.arange(n) / rate_hz
    error = rng.standard_normal((n, m)) * errors.white + errors.offset
    phase = rng.uniform(0, 2 * np.pi, m)
    error += errors.hum * np.sin(2 * np.pi * errors.hum_hz * t[:, None] + phase)
    if errors.drift.any():
        # A few waves slower than the run: a wander that nobody can foresee.
        for k in range(1, 4):
            turn = rng.uniform(0, 2 * np.pi, m)
            error += errors.drift * np.sin(2 * np.pi * 0.5 * k * t[:, None] / t[-1] + turn) / k
    push = errors.push * rng.standard_normal(n)
    v, y, _ = run(tables, loop, run_.u, run_.theta_ref, push, error)
    return v, y


def ideally(run_: Run, tables: Tables, loop: Loop) -> tuple[Float, Float, Float]:
    """v, sensors and the probes' peaks of one run without any error; `loop` an ideal one."""
    n, m = len(run_.u), loop.grain.size
    return run(tables, loop, run_.u, run_.theta_ref, np.zeros(n), np.zeros((n, m)))


def reach(rig: Rig, plant: Description, design: Design, site: str, *, ground: bool) -> float:
    """What the angle across a joint (rad), or a body's end (m), moves by at most in one burst of
    the largest level, of each drive in turn, from rest and without errors."""
    probed = copy.deepcopy(plant)
    # A stop without stiffness: it reads, and pushes with nothing.
    probed.laws = [Law("stop", site, (0.0, 1.0, 1.0, 1.0), ground)]
    tables = tabulate(poles_of(probed), probed, inner=1)
    loop = loop_of(rig, plant, ideal=True)
    wave = max(design.levels) * burst(design, rig.rate_hz)
    none = np.zeros((wave.size, len(rig.sensor)))
    peaks = []
    for k in range(len(plant.drives)):
        u = np.zeros((wave.size, len(plant.drives)))
        u[:, k] = wave
        peaks.append(run(tables, loop, u, 0.0 * u, np.zeros(wave.size), none)[2][0])
    return float(max(peaks))
