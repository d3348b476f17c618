"""SFLR: parts taken out of the author's model, and what the real recordings put in their place.

python benchmarks/sflr_diagnosis.py --data FOLDER [nothing clamp tip spring lag motor levels dates]

All recordings count sample by sample. Each part is looked for twice: alone, at its place, for its
value; and by the whole table, for its name. `levels` and `dates` hold two states of the robot
against each other: 25 counts and 75, and the whole robot of July and its motor alone in August.
OPENBLAS_NUM_THREADS=1; two to five minutes of one core each.
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from samii_rig.diagnose.changed import State, changed
from samii_rig.diagnose.diagnose import case_of, diagnose, table
from samii_rig.diagnose.forces.search import ForceSearch
from samii_rig.diagnose.result import Diagnosis
from samii_rig.diagnose.verdict.by_record import on_records
from samii_rig.errors import SamiiRigError
from samii_rig.record.importer import import_file
from samii_rig.record.maps import load_map
from samii_rig.rig.load import load_rig
from samii_rig.rig.schema import Rig
from samii_rig.signal.estimate import estimate
from samii_rig.types import Recording

BAND = (1.0, 24.0)  # Hz in which the recordings hold more than noise
LEVELS = (25, 50, 75)
MOTOR_LEVELS = (50, 100, 150)
MOTOR_BAND = (1.0, 6.0)  # Hz in which the gain of the motor alone rises with the amplitude
FAST, NONE = 1e5, 1e-6  # rad/s of a lag, and part of a mass, that are not there
MOTOR_RIVALS = ("viscous_damping", "actuator_lag")
TAKEN_OFF = ("clamp", "beam", "accelerometer_mass")  # the motor alone
# The beam of the rig file as it is where it was taken off.
NO_BEAM = {"clamp.k": 0.0, "clamp.c": 1e-9, "beam.mu": 1e-6, "accelerometer_mass.m": 1e-9,
           "accelerometer_mass.I": 1e-12}  # fmt: skip


def without(rig: Rig, *names: str) -> Rig:
    """The rig less some elements."""
    kept = tuple(e for e in rig.element if e.name not in names)
    return rig.model_copy(update={"element": kept})


def with_fields(rig: Rig, element: str, **fields: dict[str, float]) -> Rig:
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


def said(cause: dict[str, Any]) -> str:
    """One cause in a few words."""

    def within(v: dict[str, Any]) -> str:
        low, high = ("" if v[x] is None else f"{v[x]:.3g}" for x in ("low", "high"))
        return f"{v['value']:.3g} ({low} to {high}) {v['unit']}"

    numbers = ", ".join(f"{s} = {within(v)}" for s, v in cause["parameters"].items())
    same = (e["site"] for e in cause["equivalent_to"] if e["physics"] == cause["physics"])
    return f"{cause['physics']} at {' | '.join(sorted({cause['site'], *same}))}, {numbers}"


def show(name: str, author: str, found: Diagnosis, seconds: float) -> None:
    """One row of the table, of the most probable explanation whether it is told or not, and
    remarks of the diagnosis below it."""
    best = "; ".join(said(c) for c in found.evidence["causes"]) or "nothing"
    before, after = found.nominal[0], found.with_causes[0]
    print(
        f"| {name} | {author} | {best} | {before:.3g}, {after:.3g} ({found.threshold:.3g}) | "
        f"{found.verdict} |"
    )
    for causes, p in found.alternatives:
        print(f"    or {p:.3f}: {'; '.join(said(c.plain()) for c in causes) or 'nothing'}")
    moved = [f"{m.parameter} by {m.sigmas:+.1f}" for m in found.moved]
    print(f"    moved: {', '.join(moved) or 'nothing'}")
    for text in found.not_physics:
        print(f"    {text}")
    print(f"    ({seconds:.0f} s)", flush=True)


# What is taken away: of the author's values, and the row of the table that puts it back.
PARTS = {
    "clamp": ("k = 2.50 N m/rad, c = 0.0039 N m s/rad", ("torsional_compliance", "base_mass")),
    "tip": ("m = 0.00606 kg", ("added_mass", "accelerometer_mass")),
    "spring": ("k = 0.108 N m/rad, c = 0.0795 N m s/rad", ("torsional_compliance", "motor")),
    "lag": ("p = 209 rad/s, fitted without the hold's 1 ms", ("actuator_lag", "motor")),
}


def less(rig: Rig, name: str) -> Rig:
    """The rig without a part."""
    if name == "tip":
        return with_fields(rig, "accelerometer_mass", m={"value": NONE, "tolerance": 0.0},
                           I={"value": NONE**2, "tolerance": 0.0})  # fmt: skip
    if name == "lag":
        return with_fields(rig, "motor", p={"value": FAST, "tolerance": 0.0})
    return without(rig, name)


def parts(data: Path, rig: Rig, which: Sequence[str]) -> None:
    """The table of the whole robot, one row at a time."""
    runs = [r for n in LEVELS for r in runs_of(data, f"*full-robot*amp-{n}_*", "sflr")]
    responses = estimate(runs)
    print("| taken away | the author's | found | chi-square per dof, before and after | verdict |")
    print("|---|---|---|---|---|")

    def row(name: str, author: str, own: Rig, only: tuple[str, str] | None = None) -> None:
        start = time.process_time()
        effects = None
        if only is not None:
            effects = [e for e in table(own, *BAND) if only in e.names]
        found = diagnose(responses, own, band=BAND, effects=effects, runs=runs)
        show(name, author, found, time.process_time() - start)

    if "nothing" in which:
        row("nothing", "", rig)
    for name, (author, back) in PARTS.items():
        if name in which:
            row(f"{name}, put back", author, less(rig, name), back)
            row(name, author, less(rig, name))


def levels(data: Path, rig: Rig) -> None:
    """Two states that differ by their level alone."""
    low, high = (runs_of(data, f"*full-robot*amp-{n}_*", "sflr") for n in (25, 75))
    two("25 counts, then 75", rig, low, high, {})


def dates(data: Path, rig: Rig) -> None:
    """The whole robot of July, and its motor alone in August: the beam is known to be gone."""
    july = runs_of(data, "*full-robot*amp-50_*", "sflr")
    august = runs_of(data, "*motor-only_swept*amp-50_*", "sflr_motor")
    two("July, then the motor alone in August", rig, july, august, NO_BEAM)


def two(
    name: str, rig: Rig, before: list[Recording], after: list[Recording], known: dict[str, float]
) -> None:
    """What changed between two states, in lines."""
    start = time.process_time()
    first, second = (State(estimate(x, gaps="exclude"), x) for x in (before, after))
    try:
        found = changed(first, second, rig, known=known, band=BAND)
    except SamiiRigError as error:
        print(f"\n{name}: {error}")
        return
    print()
    show(name, "", found, time.process_time() - start)
    for line in found.lines():
        print(f"    {line}")


def motor(data: Path, rig: Rig) -> None:
    """The motor alone: forces held against every sample of the sweeps."""
    alone = motor_alone(rig)
    sweeps = [
        r for n in MOTOR_LEVELS for r in runs_of(data, f"*motor-only_swept*amp-{n}_*", "sflr_motor")
    ]
    rivals = [e for e in table(alone, *MOTOR_BAND) if e.physics in MOTOR_RIVALS]
    case = case_of(estimate(sweeps, band=MOTOR_BAND), alone, MOTOR_BAND, rivals, sweeps)
    linear = on_records(case)
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
        force = next((x for x in e.effects if x.force is not None), None)
        if force is None or force.physics in tried:
            continue
        tried.add(force.physics)
        found, at = e.fitted, e.fitted.model.own(e.effects.index(force))[0]
        sd = math.sqrt(found.covariance()[at, at] * search.overdispersion)
        names = " and ".join(f"{x.physics} at {x.site}" for x in e.effects)
        print(f"{names}: {math.exp(found.x[at]):.3g} {force.unknowns[0].unit} (sd {sd:.0%}), "
              f"chi-square per dof {search.ratio(found):.3g}")  # fmt: skip


EVERY = ("nothing", *PARTS, "motor", "levels", "dates")


def main() -> None:
    """What is asked for, in this order."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("which", nargs="*", choices=[*EVERY, []])
    parser.add_argument("--data", type=Path, default=Path("../shared/recordings/sflr"))
    given = parser.parse_args()
    which = given.which or EVERY
    rig = load_rig("sflr")[0]
    if {"nothing", *PARTS} & set(which):
        parts(given.data, rig, which)
    for name, ask in (("motor", motor), ("levels", levels), ("dates", dates)):
        if name in which:
            ask(given.data, rig)


if __name__ == "__main__":
    main()
