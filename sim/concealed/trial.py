"""A trial on the disk: recordings that say nothing of the truth, and the truth beside them.

    OUT/recordings/<id>/swept_sine_1.mcap ...      ordinary recordings with the nominal rig file
    OUT/truth/<id>.json, <id>.npz                  what is concealed, noise-free responses

The truth is written first; its SHA-256 stands in every recording. A trial whose recordings have
their final name is whole and is not made again.
"""

from __future__ import annotations

import hashlib
import io
import json
import math
import os
import shutil
from collections.abc import Sequence
from dataclasses import asdict, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from samii_rig.devices.channels import command_channel, reference_channels
from samii_rig.record.writer import Origin, RunWriter
from samii_rig.rig.load import parse
from samii_rig.rig.schema import Rig
from samii_rig.types import Channel, Float, Quality, SampleBlock, StopRecord
from sim.concealed.draw import KINDS, Drawn, Kind, draw, scaled, trial_id
from sim.concealed.integrate import INNER, Tables, tabulate
from sim.concealed.measure import ideally, loop_of, measured
from sim.concealed.parts import Description
from sim.concealed.runs import Design, Run, runs
from sim.concealed.size import in_turn, open_noise, returned
from sim.concealed.stated import Stated

PARTIAL = ".partial"
HEADROOM = 0.9  # of a converter's range that a run may use, else it is turned down
SETTLED = 12  # bursts after which a noise-free run repeats itself, whatever rings
TURNED_DOWN = 0.8  # of the range that it uses then


def make(
    kind: Kind,
    seed: int,
    out: Path,
    rig_toml: str,
    design: Design | None = None,
    stated: Sequence[Stated] = (),
) -> Path:
    """Make one trial, or find it made; returns the folder of its recordings. stated : what it
    conceals, of the kind of this name; the rig file says what is there besides."""
    design = design or Design.usual(parse(Rig, rig_toml, "rig file"))
    name = trial_id(kind, seed, stated)
    folder, truths = out / "recordings" / name, out / "truth"
    if folder.is_dir():
        return folder
    work = folder.with_name(name + PARTIAL)
    shutil.rmtree(work, ignore_errors=True)
    work.mkdir(parents=True)
    truths.mkdir(parents=True, exist_ok=True)
    drawn = draw(kind, seed, rig_toml, design, stated)
    rig = drawn.nominal
    tables = tabulate(drawn.poles, drawn.plant)
    planned = runs(design, rig, seed)
    quiet = quiet_runs(drawn, design, planned, tables)
    y = np.vstack([one[1] for one in loudest(drawn, quiet)])
    if not np.all(np.isfinite(y)):
        raise ArithmeticError(f"the concealed plant of {kind} {seed} is not stable in its loop")
    share = _share(rig, y)
    if share > HEADROOM:
        design = scaled(design, TURNED_DOWN / share)
        planned = runs(design, rig, seed)
        quiet = quiet_runs(drawn, design, planned, tables)
    arrays = responses(drawn, design, planned, quiet)
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **arrays)
    _write(truths / f"{name}.npz", buffer.getvalue())
    digest = hashlib.sha256(buffer.getvalue()).hexdigest()
    peaks = np.max([one[2] for one in loudest(drawn, quiet)], axis=0)
    record = truth(drawn, design, peaks, digest, sized(drawn, arrays))
    text = json.dumps(record, indent=1, allow_nan=False).encode()
    _write(truths / f"{name}.json", text)
    digest = hashlib.sha256(text).hexdigest()
    rng = np.random.default_rng([KINDS.index(kind), seed, 1])
    loop = loop_of(rig, drawn.plant)
    start = 0
    for run in planned:
        v, y = measured(run, tables, loop, drawn.errors, rig.rate_hz, rng)
        start += 10 * round(rig.rate_hz)  # s between runs
        _record(work / f"{run.name}.mcap", run, v, y, drawn, digest, start)
        start += len(v)
    work.rename(folder)
    return folder


def sized(drawn: Drawn, arrays: dict[str, Any]) -> tuple[float, str]:
    """Sigma of what is concealed, and how it was found."""
    how = "nominal refitted linearly"
    if drawn.yard is None or drawn.believed is None:
        return 0.0, "nothing is concealed"
    if len(drawn.sizes) > 1:
        return min(drawn.sizes), f"the smaller one by itself, {how}"
    if "settled" not in arrays:
        return drawn.sizes[0], how
    every = arrays["frequency"]
    near = [int(np.argmin(np.abs(every - f))) for f in drawn.yard.f]
    change = arrays["settled"][:, near] - drawn.believed.response(every[near])
    return drawn.yard(change), f"noise-free runs, {how}"


def truth(
    drawn: Drawn, design: Design, peaks: Float, arrays_sha256: str, size: tuple[float, str]
) -> dict[str, Any]:
    """The truth as JSON: `kind`, `seed`, `effects` and `size` as `samii_rig.prove` reads them."""
    each = zip(drawn.effects, drawn.multiples, drawn.sizes, strict=True)
    return {
        "kind": drawn.kind,
        "seed": drawn.seed,
        "size": size[0],
        "size_is": size[1],
        "effects": [
            {
                "physics": e.physics,
                "site": e.site,
                "position": e.position,
                "parameters": e.parameters,
                "where": e.where,
                "multiple": x,
                "size": sigma,
            }
            for e, x, sigma in each
        ],
        "nominal_edits": {
            f"{name}.{symbol}": value
            for e in drawn.effects
            for (name, symbol), (value, _) in e.edits.items()
        },
        "values": drawn.values,
        "laws": [
            {"kind": law.kind, "site": law.site, "peaks": peaks[2 * i : 2 * i + 2].tolist()}
            for i, law in enumerate(drawn.plant.laws)
        ],
        "inner_steps": INNER,
        "design": asdict(design),
        "errors": {k: np.asarray(v).tolist() for k, v in asdict(drawn.errors).items()},
        "arrays_sha256": arrays_sha256,
    }


def not_linear(plant: Description) -> bool:
    """Whether its response depends on the level or on time."""
    cut = any(d.deadband > 0 or math.isfinite(d.limit) for d in plant.drives)
    return bool(plant.laws) or cut


def quiet_runs(
    drawn: Drawn, design: Design, planned: tuple[Run, ...], tables: Tables
) -> list[tuple[Float, Float, Float]]:
    """v, sensors and probes' peaks of the swept sines' bursts without errors, repeated until the
    rig repeats itself, one for each input: of all levels where the plant is not linear, else of
    the loudest alone, which comes last."""
    plant, n = drawn.plant, round(design.burst * drawn.nominal.rate_hz)
    d = len(plant.drives)
    swept = sorted(planned[: d * len(design.levels)], key=lambda run: run.level)
    loop = loop_of(drawn.nominal, plant, ideal=True)
    out = []
    for run in swept if not_linear(plant) else swept[-d:]:
        u, reference = (np.tile(x[:n], (SETTLED, 1)) for x in (run.u, run.theta_ref))
        out.append(ideally(replace(run, u=u, theta_ref=reference), tables, loop))
    return out


def loudest(
    drawn: Drawn, quiet: list[tuple[Float, Float, Float]]
) -> list[tuple[Float, Float, Float]]:
    """Of `quiet_runs` those of the highest level, one for each input."""
    return quiet[-len(drawn.plant.drives) :]


def responses(
    drawn: Drawn,
    design: Design,
    planned: tuple[Run, ...],
    quiet: list[tuple[Float, Float, Float]],
) -> dict[str, Any]:
    """Noise-free responses of the truth at the lines of the swept sine.

    q = m d entries, for each sensor the drives side by side: sensor (q,), actuator (q,).

    frequency (n_freq,) Hz; linear (n_freq, q): of the finite element plant without its laws, held
    and sampled, v to sensors. level (n_level,); settled (n_level, n_freq, q): of the last burst
    of each noise-free run, where the plant has laws or a dead zone. noise (n_freq, q, q): power a
    sample of the noise of a response to reference 1, from inputs in turn, the loops closed.
    reference (n_freq,): |DFT| of a burst of level 1. The noise of one response from r settled
    repeats has the covariance n noise/(r |level reference|^2), n samples a burst.
    """
    rig = drawn.nominal
    n = round(design.burst * rig.rate_hz)
    at = np.asarray(np.arange(n // 2 + 1) * (rig.rate_hz / n), np.float64)
    band = (at >= design.low_hz) & (at <= design.high_hz)
    f: Float = at[band]
    H = drawn.poles.response(f)
    m, d = len(rig.sensor), len(rig.actuator)
    step = np.array([s.resolution for s in rig.sensor])
    first = planned[0]
    wave = first.u[:n, 0] / design.levels[0]
    noise = in_turn(open_noise(drawn.poles, drawn.errors, step, f), returned(rig, drawn.poles, f))
    out: dict[str, Any] = {
        "frequency": f,
        "linear": H,
        "level": np.sort(design.levels),
        "reference": np.abs(np.fft.rfft(wave))[band],
        "noise": noise.astype(np.complex64),
        "sensor": np.repeat(np.arange(m), d),
        "actuator": np.tile(np.arange(d), m),
    }
    if not_linear(drawn.plant):
        # Of each level Y = H V, a column an input that was driven.
        V, Y = (np.array([np.fft.rfft(one[k][-n:], axis=0)[band] for one in quiet]) for k in (0, 1))
        V, Y = (np.moveaxis(x.reshape(-1, d, *x.shape[1:]), 1, 3) for x in (V, Y))
        settled = Y @ np.linalg.inv(V)
        out["settled"] = settled.reshape(*settled.shape[:2], m * d)
    return out


def _share(rig: Rig, y: Float) -> float:
    """Part of the sensors' ranges that a run uses."""
    reach = np.array([min(s.high, -s.low) for s in rig.sensor])
    return float(np.max(np.abs(y).max(axis=0) / reach))


def channels(rig: Rig, sensors: tuple[str, ...]) -> tuple[Channel, ...]:
    """Columns as a device reports them: references, commands, then the sensors."""
    held = "output as held by the converter"
    return (
        *reference_channels(rig),
        *(command_channel(a, a.resolution, held) for a in rig.actuator),
        *(
            Channel(s.name, s.unit, "sensor", s.low, s.high, s.resolution, s.calibration)
            for s in rig.sensor
            if not sensors or s.name in sensors
        ),
    )


def _record(
    path: Path, run: Run, v: Float, y: Float, drawn: Drawn, digest: str, start: int
) -> None:
    rig, wanted = drawn.nominal, drawn.design.sensors
    columns = channels(rig, wanted)
    kept = [i for i, s in enumerate(rig.sensor) if not wanted or s.name in wanted]
    references = np.stack([run.u, run.theta_ref], axis=2).reshape(len(v), -1)
    values = np.column_stack([references, v, y[:, kept]])
    low = np.array([c.low for c in columns])
    high = np.array([c.high for c in columns])
    quality = np.where((values <= low) | (values >= high), Quality.CLIPPED, 0).astype(np.uint8)
    sent = slice(references.shape[1], references.shape[1] + v.shape[1])
    quality[:, sent] = np.where(quality[:, sent] > 0, Quality.LIMITED, 0)
    n = values.shape[0]
    time = np.rint((start + np.arange(n)) * (1e9 / rig.rate_hz)).astype(np.int64)
    block = SampleBlock(columns, time, np.arange(n, dtype=np.int64), values, quality)
    metadata = {
        "device": "concealed plant",
        "experiment": run.name,
        "samii_rig": version("samii-rig"),
        "truth_sha256": digest,
    }
    with RunWriter(
        path,
        columns,
        rig.rate_hz,
        Origin(drawn.nominal_toml, metadata=metadata),
        compression="zstd",
    ) as writer:
        writer.write(block)
        for segment in run.segments:
            writer.segment(segment)
        writer.close(StopRecord("completed", f"all {len(run.segments)} segments done"))


def _write(path: Path, data: bytes) -> None:
    """A file that is whole or not there."""
    work = path.with_name(path.name + PARTIAL)
    with work.open("wb") as file:
        file.write(data)
        file.flush()
        os.fsync(file.fileno())
    work.replace(path)
