"""SFLR: parts taken out of the author's model, and what the real recordings put in their place.

python benchmarks/sflr_diagnosis.py --data FOLDER [nothing clamp tip spring lag motor]

Even the complete model of the author, refitted, leaves far more than noise of these recordings. A
part is therefore judged against that rest: every covariance is multiplied by what the complete
model leaves, chi-square per degree of freedom times the bins over which it is alike
(`Search.leftover`). Without that the data overrule the tolerances of the rig file and the beam
takes over what the clamp does.
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from samii_rig.diagnose.data.measured import measured
from samii_rig.diagnose.diagnose import case_of, diagnose, table
from samii_rig.diagnose.fit.refit import Fitted, Problem, refit
from samii_rig.diagnose.fit.search import Search
from samii_rig.diagnose.forces.search import ForceSearch
from samii_rig.diagnose.physics.effect import Effect
from samii_rig.diagnose.physics.model import Model, grid
from samii_rig.diagnose.result import Diagnosis
from samii_rig.diagnose.verdict.by_record import on_records
from samii_rig.record.importer import import_file
from samii_rig.record.maps import load_map
from samii_rig.rig.load import load_rig
from samii_rig.rig.schema import Rig
from samii_rig.signal.estimate import estimate
from samii_rig.types import FrequencyResponse, Recording

BAND = (1.0, 24.0)  # Hz in which the recordings hold more than noise
LEVELS = (25, 50, 75)
MOTOR_LEVELS = (50, 100, 150)
MOTOR_BAND = (1.0, 6.0)  # Hz in which the gain of the motor alone rises with the amplitude
FAST, NONE = 1e5, 1e-6  # rad/s of a lag, and part of a mass, that are not there
STIFFNESSES = (0.5, 1.0, 2.5, 6.0, 15.0, 40.0)  # N m/rad, from which the clamp's is looked for
CANDIDATES, SHOWN = 40, 4  # single effects that are refitted, and told
FREE = 3.0  # tolerance of a parameter that the data alone decide
MOTOR_RIVALS = ("viscous_damping", "actuator_lag")
TAKEN_OFF = ("clamp", "beam", "accelerometer_mass")  # the motor alone


def without(rig: Rig, *names: str) -> Rig:
    """The rig less some elements."""
    kept = tuple(e for e in rig.element if e.name not in names)
    return rig.model_copy(update={"element": kept})


def changed(rig: Rig, element: str, **fields: dict[str, float]) -> Rig:
    """The rig with other values or tolerances of some parameters of one element."""

    def change(e: object) -> object:
        update = {s: getattr(e, s).model_copy(update=new) for s, new in fields.items()}
        return e.model_copy(update=update)  # type: ignore[attr-defined]

    return rig.model_copy(
        update={"element": tuple(change(e) if e.name == element else e for e in rig.element)}
    )


def motor_alone(rig: Rig) -> Rig:
    """Motor, spring and base, as they were recorded without the beam."""
    sensors = tuple(s for s in rig.sensor if s.name == "theta")
    return without(rig, *TAKEN_OFF).model_copy(update={"sensor": sensors, "limit": ()})


def runs_of(data: Path, pattern: str, layout: str) -> list[Recording]:
    """All recordings whose name matches."""
    return [import_file(f, *load_map(layout)) for f in sorted(data.glob(pattern))]


def discounted(responses: Sequence[FrequencyResponse], factor: float) -> list[FrequencyResponse]:
    """The responses with larger covariances."""
    return [replace(r, covariance=r.covariance * factor) for r in responses]


def left_by(rig: Rig, responses: Sequence[FrequencyResponse]) -> float:
    """What the refitted rig leaves, in covariances of independent bins."""
    lines = measured(responses, rig, BAND)
    at = grid(rig, lines.frequency, lines.sensor, lines.actuator)
    search = Search(rig, lines, at, [])
    return search.leftover(search.nominal.fitted)


def fitted(
    rig: Rig,
    responses: Sequence[FrequencyResponse],
    effects: Sequence[Effect] = (),
    starts: Sequence[float] = (),
) -> Fitted:
    """The rig with some effects, refitted from `starts`, or from their middle."""
    lines = measured(responses, rig, BAND)
    at = grid(rig, lines.frequency, lines.sensor, lines.actuator)
    model = Model(rig, effects)
    first = starts or [u.starts[len(u.starts) // 2] for e in effects for u in e.unknowns]
    x = np.concatenate([np.zeros(model.n_nominal), np.log(first)])
    return refit(model, Problem.of(lines, at), x, steps=80)


def known(found: Fitted, element: str, symbol: str) -> str:
    """A nominal parameter as refitted, with one standard deviation."""
    i = found.model.keys.index((element, symbol))
    value = found.model.nominal[element, symbol] * math.exp(found.x[i])
    sd = math.sqrt(found.covariance()[i, i])
    return f"{value:.3g} ({value * math.exp(-sd):.3g} to {value * math.exp(sd):.3g})"


def said(cause: dict[str, Any]) -> str:
    """One cause in a few words."""
    numbers = ", ".join(
        f"{s} = {v['value']:.3g} ({v['low']:.3g} to {v['high']:.3g}) {v['unit']}"
        for s, v in cause["parameters"].items()
    )
    same = (e["site"] for e in cause["equivalent_to"] if e["physics"] == cause["physics"])
    return f"{cause['physics']} at {' | '.join(sorted({cause['site'], *same}))}, {numbers}"


def show(name: str, author: str, found: Diagnosis, seconds: float) -> None:
    """One row of the table, of the most probable explanation whether it is told or not, and
    remarks of the diagnosis below it."""
    best = "; ".join(said(c) for c in found.evidence["causes"]) or "nothing"
    before, after = found.nominal[0], found.with_causes[0]
    print(f"| {name} | {author} | {best} | {before:.3g}, {after:.3g} | {found.verdict} |")
    for text in found.not_physics:
        print(f"    {text}")
    print(f"    ({seconds:.0f} s)", flush=True)


def study(data: Path, which: Sequence[str]) -> None:
    """The table, one row at a time."""
    rig = load_rig("sflr")[0]
    runs = {n: runs_of(data, f"*full-robot*amp-{n}_*", "sflr") for n in LEVELS}
    full = [estimate(runs[n])[0] for n in LEVELS]
    factor = left_by(rig, full)
    print(f"covariances times {factor:.0f}: what the complete model leaves\n")
    print("| taken away | the author's | found | chi-square per dof, before and after | verdict |")
    print("|---|---|---|---|---|")
    measured_ = discounted(full, factor)
    rigs = {
        "nothing": (rig, ""),
        "clamp": (without(rig, "clamp"), "k = 2.50 N m/rad, c = 0.0039 N m s/rad"),
        "tip": (changed(rig, "accelerometer_mass", m={"value": NONE, "tolerance": 0.0},
                        I={"value": NONE**2, "tolerance": 0.0}), "m = 0.00606 kg"),
        "spring": (without(rig, "spring"), "k = 0.108 N m/rad, c = 0.0795 N m s/rad"),
        "lag": (changed(rig, "motor", p={"value": FAST, "tolerance": 0.0}),
                "p = 209 rad/s, fitted without the hold's 1 ms"),
    }  # fmt: skip
    for name, (less, author) in rigs.items():
        if name in which:
            start = time.process_time()
            found = diagnose(measured_, less, band=BAND)
            show(name, author, found, time.process_time() - start)
            if name != "nothing":
                singles(less, measured_)
    if "clamp" in which:
        optima(rigs["clamp"][0], full, factor)
    if "tip" in which:
        free = changed(rig, "accelerometer_mass", m={"tolerance": FREE})
        print(f"\ntip mass of the complete model, free: {mass(free, measured_)} kg")
        for r, n in zip(full, LEVELS, strict=True):
            own = discounted([r], factor)
            print(f"    at {n} counts {mass(free, own)} kg")
    if "spring" in which:
        free = changed(rig, "spring", k={"tolerance": FREE}, c={"tolerance": FREE})
        end = fitted(free, measured_)
        print(f"\nspring of the complete model, free: k = {known(end, 'spring', 'k')}, "
              f"c = {known(end, 'spring', 'c')}")  # fmt: skip
    if "lag" in which:
        lags(rigs["lag"][0], measured_)
    if "nothing" in which:
        unused(rig, dict(zip(LEVELS, full, strict=True)), runs, factor)
    if "motor" in which:
        motor(data, rig)


def singles(rig: Rig, responses: Sequence[FrequencyResponse]) -> None:
    """The best explanations by one linear effect alone, and how far each is behind the first."""
    lines = measured(responses, rig, BAND)
    at = grid(rig, lines.frequency, lines.sensor, lines.actuator)
    search = Search(rig, lines, at, table(rig, *BAND))
    search.grow(search.nominal, CANDIDATES)
    ranked = search.ranked()
    for e in ranked[:SHOWN]:
        behind = ranked[0].weight - e.weight
        for effect, theta in zip(e.effects, e.fitted.model.parts(e.fitted.x), strict=True):
            names = " | ".join(" at ".join(n) for n in effect.names)
            values = zip(effect.unknowns, effect.report(theta), strict=True)
            numbers = ", ".join(f"{u.symbol} = {x:.3g} {u.unit}" for u, x in values)
            print(f"    one effect, {behind:.1f} behind: {names}, {numbers}")


def optima(rig: Rig, full: Sequence[FrequencyResponse], factor: float) -> None:
    """Every optimum of the clamp's stiffness, and what the beam must be for it."""
    effect = next(e for e in table(rig, *BAND) if e.name == ("torsional_compliance", "base_mass"))
    beam = ("beam", "EI"), ("beam", "mu"), ("base_mass", "I")
    each = {f"{n} counts": [r] for n, r in zip(LEVELS, full, strict=True)}
    for name, responses in {"all levels": list(full), **each}.items():
        found: dict[str, tuple[float, str]] = {}
        for k in STIFFNESSES:
            end = fitted(rig, discounted(responses, factor), [effect], [k, 0.05])
            moved = ", ".join(
                f"{'.'.join(key)} {math.expm1(end.x[end.model.keys.index(key)]):+.0%}"
                for key in beam
            )
            value = f"{math.exp(end.x[-2]):.2g}"
            if value not in found or end.cost < found[value][0]:
                found[value] = end.cost, moved
        for value, (cost, moved) in sorted(found.items(), key=lambda item: item[1][0])[:3]:
            print(f"    clamp, {name}: k = {value} N m/rad, cost {cost:.0f}; {moved}")


def mass(rig: Rig, responses: Sequence[FrequencyResponse]) -> str:
    """The accelerometer's mass that the responses ask for."""
    return known(fitted(rig, responses), "accelerometer_mass", "m")


def lags(rig: Rig, responses: Sequence[FrequencyResponse]) -> None:
    """A lag and a dead time in the place of the lag that was taken away."""
    every = table(rig, *BAND)
    for physics in ("actuator_lag", "transport_delay"):
        effect = next(e for e in every if e.physics == physics)
        end = fitted(rig, responses, [effect])
        value = math.exp(end.x[-1])
        print(f"\n{physics}: {value:.4g} {effect.unknowns[0].unit}, cost {end.cost:.1f}")


def unused(
    rig: Rig,
    full: dict[int, FrequencyResponse],
    runs: dict[int, list[Recording]],
    factor: float,
) -> None:
    """Nothing taken away: what 25 and 75 counts say is missing, held against 50 counts."""
    found = diagnose(discounted([full[25], full[75]], factor), rig, band=BAND, runs=runs[50][:1])
    print("\nfrom 25 and 75 counts, confirmed on a run at 50 counts, which took no part:")
    show("nothing", "", found, 0.0)


def motor(data: Path, rig: Rig) -> None:
    """The motor alone: forces held against every sample of the sweeps."""
    alone = motor_alone(rig)
    sweeps = [
        r for n in MOTOR_LEVELS for r in runs_of(data, f"*motor-only_swept*amp-{n}_*", "sflr_motor")
    ]
    rivals = [e for e in table(alone, *MOTOR_BAND) if e.physics in MOTOR_RIVALS]
    case = case_of(estimate(sweeps, band=MOTOR_BAND), alone, MOTOR_BAND, rivals, sweeps)
    linear = on_records(case, MOTOR_BAND)
    if linear is None:
        print("\nmotor alone: the recordings cannot be used sample by sample")
        return
    linear.run(briefly=True)
    search = ForceSearch(linear)
    search.settle()
    left = search.ratio(search.nominal.fitted)
    print(f"\nmotor alone, chi-square per dof of the refitted model {left:.3g}")
    tried: set[str] = set()
    for e in search.ranked():
        force = next((x for x in e.effects if x.quasi is not None), None)
        if force is None or force.physics in tried:
            continue
        tried.add(force.physics)
        found, at = e.fitted, e.fitted.model.own(e.effects.index(force))[0]
        sd = math.sqrt(found.covariance()[at, at] * search.temperature)
        names = " and ".join(f"{x.physics} at {x.site}" for x in e.effects)
        print(f"{names}: {math.exp(found.x[at]):.3g} {force.unknowns[0].unit} (sd {sd:.0%}), "
              f"chi-square per dof {search.ratio(found):.3g}")  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("which", nargs="*", default=[])
    parser.add_argument("--data", type=Path, default=Path("../shared/recordings/sflr"))
    given = parser.parse_args()
    every = ("nothing", "clamp", "tip", "spring", "lag", "motor")
    study(given.data, given.which or every)


if __name__ == "__main__":
    main()
