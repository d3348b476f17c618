"""How often a diagnosis is right, on drawn frequency responses: calibrates and scores its core.

python benchmarks/diagnose_study.py null --trials 100 --seed 1
python benchmarks/diagnose_study.py one --trials 100 --seed 2 --out one.jsonl
python benchmarks/diagnose_study.py two --trials 40 --seed 3
python benchmarks/diagnose_study.py joints --trials 10 --seed 4

The truth is the sampled model of the rig with nominal parameters drawn within their
tolerances and an effect of the table, so this tests inference, not whether the table is right.
An effect's size is the root of chi-square that the refitted nominal model leaves on the
noise-free truth. Thresholds are set on some seeds and scored on others.
"""

from __future__ import annotations

import argparse
import json
import math
import time
from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from samii_rig.diagnose.data.measured import measured
from samii_rig.diagnose.diagnose import diagnose, table
from samii_rig.diagnose.fit.refit import Problem, refit
from samii_rig.diagnose.physics.channels import NOT_PHYSICS
from samii_rig.diagnose.physics.effect import Effect
from samii_rig.diagnose.physics.grid import grid
from samii_rig.diagnose.physics.model import Model
from samii_rig.identify.bootstrap import redraw
from samii_rig.rig.load import load_rig
from samii_rig.rig.schema import Rig, parameters
from samii_rig.types import Channel, FrequencyResponse

BAND = (0.5, 40.0)
LINES = 400
DOF = 45.0
SIZES = (3.0, 1000.0)
STIFF = 1e9  # N m/rad: a joint that does not give


def drawn_rig(rig: Rig, rng: np.random.Generator) -> Rig:
    """The rig with its uncertain parameters drawn within their tolerances."""
    elements = []
    for e in rig.element:
        update = {
            s: p.model_copy(
                update={"value": p.value * math.exp(p.tolerance * rng.standard_normal())}
            )
            for s, p in parameters(e).items()
            if p.tolerance > 0
        }
        elements.append(e.model_copy(update=update))
    return rig.model_copy(update={"element": tuple(elements)})


def like(rig: Rig, H: np.ndarray, f: np.ndarray, relative: float) -> FrequencyResponse:
    """A response with `relative` noise, correlated between the outputs."""
    size = np.abs(H)
    sd = relative * (size + np.median(size, axis=0)) / 2
    q = H.shape[1]
    shape = np.full((q, q), 0.3) + 0.7 * np.eye(q)
    return FrequencyResponse(
        frequency=f,
        H=H[:, :, None],
        covariance=sd[:, :, None] * shape * sd[:, None, :] + 0j,
        dof=np.full(f.size, DOF),
        coherence=np.ones((f.size, q)),
        inputs=(Channel(rig.actuator[0].name, rig.actuator[0].unit, "command"),),
        outputs=tuple(Channel(s.name, s.unit) for s in rig.sensor),
        level=1.0,
        level_unit=rig.actuator[0].unit,
        input_rms=np.ones((f.size, 1)),
        rate_hz=rig.rate_hz,
        n_averages=4,
        method="burst (drawn)",
        why="drawn",
    )


class Trial:
    """A truth, its noise and the size of what it conceals."""

    def __init__(self, rig: Rig, seed: int, relative: float) -> None:
        self.rng = np.random.default_rng(seed)
        self.rig, self.truth, self.relative = rig, drawn_rig(rig, self.rng), relative
        self.f = np.geomspace(*BAND, LINES)
        n = len(rig.sensor)
        self.at = grid(self.truth, self.f, np.arange(n), np.zeros(n, dtype=np.int64))

    def response(self, effects: Sequence[Effect], logs: np.ndarray) -> FrequencyResponse:
        model = Model(self.truth, effects)
        H = model.response(np.concatenate([np.zeros(model.n_nominal), logs]), self.at)
        return like(self.rig, H, self.f, self.relative)

    def size(self, response: FrequencyResponse) -> float:
        """Root of chi-square that the refitted nominal model leaves of the noise-free truth."""
        lines = measured([replace(response, dof=np.full(self.f.size, 1e6))], self.rig)
        model = Model(self.rig)
        at = grid(self.rig, lines.frequency, lines.sensor, lines.actuator)
        end = refit(model, Problem.of(lines, at), np.zeros(model.n), steps=25)
        return math.sqrt(end.chi2)

    def sized(self, effect: Effect, target: float) -> tuple[np.ndarray, float] | None:
        """Unknowns of the effect with which it has about the size `target`; None if none has."""
        if not effect.unknowns:
            return np.zeros(0), self.size(self.response([effect], np.zeros(0)))
        rest = [
            self.rng.uniform(*np.log([max(u.low, u.starts[0] / 3), min(u.high, u.starts[-1] * 3)]))
            for u in effect.unknowns[1:]
        ]
        u = effect.unknowns[0]
        logs = np.linspace(math.log(u.low), math.log(u.high), 15)
        best: tuple[float, np.ndarray, float] | None = None
        for _ in range(2):
            for x in logs:
                theta = np.array([x, *rest])
                size = self.size(self.response([effect], theta))
                miss = abs(math.log(max(size, 1e-3) / target))
                if best is None or miss < best[0]:
                    best = (miss, theta, size)
            assert best is not None
            step = logs[1] - logs[0]
            logs = np.linspace(best[1][0] - step, best[1][0] + step, 9)
        return (best[1], best[2]) if best and best[0] < 0.7 else None

    def noisy(self, response: FrequencyResponse) -> FrequencyResponse:
        return redraw(response, response.H, self.rng, shared=15)


def scored(found: object, names: set[tuple[str, str]]) -> tuple[bool, bool]:
    """(place right, name right up to the class) of one concealed effect."""
    place = name = False
    for cause in found.causes:  # type: ignore[attr-defined]
        said = {(cause.physics, cause.site), *cause.equivalents}
        name |= bool(said & names)
        place |= bool({s for _, s in said} & {s for _, s in names})
    return place, name


def concealed(
    kind: str, rig: Rig, effects: Sequence[Effect], trial: Trial
) -> tuple[list[Effect], FrequencyResponse, float] | None:
    rng = trial.rng
    if kind == "null":
        return [], trial.response([], np.zeros(0)), 0.0
    rows = sorted({e.physics for e in effects if e.physics not in NOT_PHYSICS})
    chosen, logs, size = [], [], 0.0
    for _ in range(2 if kind == "two" else 1):
        physics = rows[rng.integers(len(rows))]
        effect = [e for e in effects if e.physics == physics]
        one = effect[rng.integers(len(effect))]
        target = math.exp(rng.uniform(*np.log(SIZES if kind == "one" else (15.0, 300.0))))
        found = trial.sized(one, target)
        if found is None or one in chosen:
            return None
        chosen.append(one)
        logs.append(found[0])
        size = found[1]
    return chosen, trial.response(chosen, np.concatenate(logs)), size


def trials(
    kind: str, rig: Rig, count: int, seed: int, relative: float
) -> Iterator[dict[str, object]]:
    effects = table(rig, *BAND)
    number = done = 0
    while done < count:
        number += 1
        trial = Trial(rig, 100_000 * seed + number, relative)
        drawn = concealed(kind, rig, effects, trial)
        if drawn is None:
            continue
        done += 1
        chosen, exact, size = drawn
        start = time.perf_counter()
        found = diagnose([trial.noisy(exact)], rig, effects=effects)
        spent = time.perf_counter() - start
        marks = [scored(found, set(e.names)) for e in chosen]
        yield {
            "trial": number,
            "truth": [e.name for e in chosen],
            "size": round(size, 2),
            "verdict": found.verdict,
            "found": [
                (c.physics, c.site, round(c.probability, 3), len(c.equivalents))
                for c in found.causes
            ],
            "place": all(m[0] for m in marks),
            "name": all(m[1] for m in marks),
            "probability": min([c.probability for c in found.causes], default=0.0),
            "outside": round(found.outside, 3),
            "gap": round(found.gap.value, 3),
            "seconds": round(spent, 2),
        }


def joints(count: int, seed: int) -> None:
    """Four joint compliances concealed from a rig file with joints that do not give."""
    rig = load_rig("samii")[0]
    springs = ("clamp", "joint_1", "joint_2", "joint_3")

    def stiff(e: object) -> object:
        if getattr(e, "name", "") not in springs:
            return e
        k = e.k.model_copy(update={"value": STIFF, "tolerance": 0.0})  # type: ignore[attr-defined]
        c = e.c.model_copy(update={"value": 0.0, "tolerance": 0.0})  # type: ignore[attr-defined]
        return e.model_copy(update={"k": k, "c": c})  # type: ignore[attr-defined]

    nominal = rig.model_copy(update={"element": tuple(stiff(e) for e in rig.element)})
    effects = table(nominal, *BAND)
    all_found = 0
    for number in range(count):
        trial = Trial(rig, 100_000 * seed + number, 0.02)
        start = time.perf_counter()
        found = diagnose([trial.noisy(trial.response([], np.zeros(0)))], nominal, effects=effects)
        spent = time.perf_counter() - start
        hits = [scored(found, {("torsional_compliance", s)})[1] for s in springs]
        all_found += all(hits) and len(found.causes) == 4
        said = [
            (c.physics, c.site, *(f"{v.value:.4g}" for v in c.parameters.values()))
            for c in found.causes
        ]
        print(found.verdict, hits, said, f"{spent:.1f} s", flush=True)
    print(f"all four and nothing else: {all_found} of {count}")


def summary(rows: Sequence[dict[str, object]]) -> None:
    groups: dict[str, list[dict[str, object]]] = defaultdict(list)
    for row in rows:
        size = float(str(row["size"]))
        edge = next((e for e in (3, 10, 30, 100, 1e9) if size < e), 1e9)
        groups[f"size below {edge:g}"].append(row)
        for name, _ in row["truth"]:  # type: ignore[attr-defined]
            if size >= 30:
                groups[f"{name} from 30"].append(row)
    for key in sorted(groups):
        part = groups[key]
        n = len(part)
        said = [sum(bool(r[k]) for r in part) for k in ("place", "name")]
        wrong = sum(
            float(str(r["probability"])) > 0.8 and not r["name"] and r["found"] != [] for r in part
        )
        named = sum(r["verdict"] != "no_mismatch" for r in part)
        print(
            f"{key:40s} n {n:3d}  alarmed {named:3d}  place {said[0]:3d}  name {said[1]:3d}  "
            f"confidently wrong {wrong}"
        )
    spent = [float(str(r["seconds"])) for r in rows]
    print(f"seconds: median {np.median(spent):.1f}, most {max(spent):.1f}")


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("kind", choices=("null", "one", "two", "joints"))
    parser.add_argument("--trials", type=int, default=20)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--rig", default="samii")
    parser.add_argument("--noise", type=float, default=0.01)
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    if options.kind == "joints":
        joints(options.trials, options.seed)
        return
    rig = load_rig(options.rig)[0]
    rows = []
    for row in trials(options.kind, rig, options.trials, options.seed, options.noise):
        rows.append(row)
        print(json.dumps(row), flush=True)
    if options.out:
        options.out.write_text("\n".join(json.dumps(r) for r in rows), encoding="utf-8")
    summary(rows)


if __name__ == "__main__":
    main()
