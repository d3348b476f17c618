"""Mistakes of those who record: what the diagnosis makes of each, where nothing else is wrong.

python benchmarks/mistakes_study.py OUT                    # all, then docs/evidence/mistakes.md
python benchmarks/mistakes_study.py OUT --page             # the page, of the answers that are there
python benchmarks/mistakes_study.py OUT --rig sflr --only "another unit" --again

Recordings are of the second plant, nothing concealed in them. One mistake is put into each; which
channel it concerns goes round with the seed. An answer that is there is not asked for again.
OPENBLAS_NUM_THREADS=1; some ten seconds of one core an answer.
"""

from __future__ import annotations

import argparse
import json
import math
import subprocess
import time
from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from samii_rig.diagnose.diagnose import diagnose
from samii_rig.errors import SamiiRigError
from samii_rig.record.reader import read_recording
from samii_rig.rig.load import load_rig, parse
from samii_rig.rig.schema import Rig, SensorBase
from samii_rig.signal.estimate import estimate
from samii_rig.types import Float, Recording
from samii_rig.units import STANDARD_GRAVITY
from sim.assumed_modes.trial import conceal, logged, save

RIGS = ("samii", "sflr", "two_masses", "beam_on_shaker")
SEEDS = (0, 1, 2)
STYLES = ("bursts", "cut", "multisine")
SECONDS = 30.0  # of records: an answer in seconds, and room for two levels
FEWER = 5  # samples of which one is kept
PAGE = Path(__file__).parents[1] / "docs/evidence/mistakes.md"
# What a sensor may be taken for: rows of a rig file in place of its own.
TAKEN_FOR: dict[tuple[str, str], dict[str, Any]] = {
    ("samii", "theta_2"): {"kind": "absolute_angle", "after": "joint_2"},
    ("samii", "a_0"): {"kind": "velocity", "after": "link_0", "unit": "m/s"},
    ("samii", "a_1"): {"kind": "velocity", "after": "link_1", "unit": "m/s"},
    ("samii", "a_2"): {"kind": "velocity", "after": "link_3_6", "unit": "m/s"},
    ("sflr", "theta"): {"kind": "relative_angle", "across": ["motor"]},
    ("sflr", "a"): {"kind": "velocity", "after": "accelerometer_mass", "unit": "m/s"},
    ("two_masses", "x_1"): {"kind": "velocity", "after": "mass_1", "unit": "m/s"},
    ("two_masses", "a_2"): {"kind": "velocity", "after": "mass_2", "unit": "m/s"},
    ("beam_on_shaker", "a_table"): {"kind": "velocity", "after": "table", "unit": "m/s"},
    ("beam_on_shaker", "a_tip"): {"kind": "displacement", "after": "tip_mass", "unit": "m"},
}


@dataclass(frozen=True)
class Bench:
    """What a trial holds. turn : which channel a mistake concerns."""

    name: str
    rig: Rig
    runs: tuple[Recording, ...]
    turn: int

    @property
    def sensor(self) -> str:
        """The channel whose turn it is."""
        return self.rig.sensor[self.turn % len(self.rig.sensor)].name

    def of(self, kinds: Iterable[str]) -> str:
        """The sensor of these kinds whose turn it is."""
        own = [s.name for s in self.rig.sensor if s.kind in kinds]
        return own[self.turn % len(own)] if own else self.sensor

    def each(self, change: Callable[[Recording], Recording]) -> Bench:
        """With every recording changed."""
        return replace(self, runs=tuple(change(run) for run in self.runs))

    def column(self, name: str, change: Callable[[Float], Float]) -> Bench:
        """With one column of every recording changed."""

        def one(run: Recording) -> Recording:
            values = run.values.copy()
            values[:, run.column(name)] = change(values[:, run.column(name)])
            return replace(run, values=values)

        return self.each(one)


def taken_for_another(b: Bench) -> Bench:
    """The rig file says of a sensor that it measures something else; its filter stays."""
    plain = b.rig.model_dump(exclude_none=True)
    (old,) = (s for s in plain["sensor"] if s["name"] == b.sensor)
    shared = {k: v for k, v in old.items() if k in SensorBase.model_fields}
    new = shared | TAKEN_FOR[b.name, b.sensor]
    plain["sensor"] = [new if s["name"] == b.sensor else s for s in plain["sensor"]]
    plain["limit"] = [x for x in plain["limit"] if x["channel"] != b.sensor]
    return replace(b, rig=Rig.model_validate(plain))


def another_unit(b: Bench) -> Bench:
    """Degrees for radians; of a rig without angles thousandths for what is moved."""
    angles = [s.name for s in b.rig.sensor if s.kind.endswith("angle")]
    factor = math.degrees(1.0) if angles else 1e3
    return b.column(angles[0] if angles else b.rig.sensor[0].name, lambda x: factor * x)


def in_g(b: Bench) -> Bench:
    """An accelerometer in g."""
    return b.column(b.of(("acceleration",)), lambda x: x / STANDARD_GRAVITY)


def swapped(b: Bench) -> Bench:
    """Two neighbouring columns in each other's place."""
    first = b.turn % (len(b.rig.sensor) - 1)
    names = [s.name for s in b.rig.sensor[first : first + 2]]

    def one(run: Recording) -> Recording:
        at = [run.column(n) for n in names]
        values = run.values.copy()
        values[:, at] = values[:, at[::-1]]
        return replace(run, values=values)

    return b.each(one)


def fewer(b: Bench, *, told: bool) -> Bench:
    """One sample of five, without a filter; the file says so or not."""

    def one(run: Recording) -> Recording:
        kept = slice(None, None, FEWER)
        n = len(run.values[kept])
        rate = run.rate_hz / FEWER if told else run.rate_hz
        segments = tuple(
            replace(s, start=-(-s.start // FEWER), stop=-(-s.stop // FEWER)) for s in run.segments
        )
        sequence = np.arange(n, dtype=np.int64)
        return replace(
            run, rate_hz=rate, time=np.rint(sequence * (1e9 / rate)).astype(np.int64),
            sequence=sequence, values=run.values[kept], quality=run.quality[kept],
            segments=segments,
        )  # fmt: skip

    return b.each(one)


def twice(b: Bench) -> Bench:
    """A recording beside its own copy."""
    return replace(b, runs=(*b.runs, replace(b.runs[0], source="copy.mcap")))


def no_reference(b: Bench) -> Bench:
    """The reference was not recorded."""

    def one(run: Recording) -> Recording:
        kept = [i for i, c in enumerate(run.channels) if c.role != "reference"]
        return replace(
            run, channels=tuple(run.channels[i] for i in kept), values=run.values[:, kept],
            quality=run.quality[:, kept],
        )  # fmt: skip

    return b.each(one)


def later(b: Bench) -> Bench:
    """One column stands one to three samples late."""
    by = 1 + b.turn % 3
    return b.column(b.sensor, lambda x: np.concatenate([np.full(by, x[0]), x[:-by]]))


MISTAKES: dict[str, Callable[[Bench], Bench]] = {
    "none": lambda b: b,
    "taken for another kind": taken_for_another,
    "another unit": another_unit,
    "in g": in_g,
    "swapped": swapped,
    "wrong sign": lambda b: b.column(b.sensor, np.negative),
    "one of five, told": lambda b: fewer(b, told=True),
    "one of five, not told": lambda b: fewer(b, told=False),
    "the same file twice": twice,
    "no reference": no_reference,
    "command in mV": lambda b: b.column(b.rig.actuator[0].name, lambda x: 1e3 * x),
    "a constant column": lambda b: b.column(b.sensor, lambda x: np.full_like(x, x[0])),
    "shifted 1 to 3 samples": later,
}
# What has a name in the table: an encoder that the rig file has across other parts.
RIGHT = {"taken for another kind": "noncollocated_encoder"}
HARMLESS = ("none", "no reference", "one of five, told")  # where "nothing is missing" is right


def made(name: str, seed: int, out: Path) -> Bench:
    """The recordings of a rig and seed, made unless they are there."""
    folder = out / f"{name}_{seed}"
    if not folder.exists():
        style = (STYLES[seed % len(STYLES)], "clean")
        trial = conceal("nothing", seed, load_rig(name)[0], style, seconds=SECONDS)
        work = folder.with_suffix(".partial")
        work.mkdir(parents=True, exist_ok=True)
        for i in range(len(trial.scene.style.files)):
            log = logged(i, trial.scene, [], trial.rngs[3], trial.rngs[4])
            save(work, i, trial.scene, log)
        work.rename(folder)
    runs = [read_recording(path) for path in sorted(folder.glob("*.mcap"))]
    rig = parse(Rig, runs[0].rig_toml, "rig file")
    return Bench(name, rig, tuple(replace(r, source=Path(r.source).name) for r in runs), seed)


def asked(mistake: str, bench: Bench) -> dict[str, Any]:
    """The answer."""
    start = time.process_time()
    wrong = MISTAKES[mistake](bench)
    try:
        runs = list(wrong.runs)
        found = diagnose(estimate(runs, gaps="exclude"), wrong.rig, runs=runs)
        said = {
            "verdict": found.verdict,
            "line": found.lines()[0],
            "causes": [f"{c.physics} at {c.site}" for c in found.causes],
            "not_physics": list(found.not_physics),
        }
    except SamiiRigError as error:
        said = {"verdict": "refused", "line": str(error), "causes": [], "not_physics": []}
    return said | {"channel": wrong.sensor, "seconds": time.process_time() - start}


def outcome(mistake: str, said: dict[str, Any], sound: dict[str, Any]) -> str:
    """In one word what became of a mistake. sound : the answer without it."""
    if said["causes"] and RIGHT.get(mistake) == said["causes"][0].split(" at ")[0]:
        return "told"
    if said["causes"]:
        return "NAMED"
    if said["verdict"] == "refused":
        return "refused"
    if set(said["not_physics"]) - set(sound["not_physics"]):
        return "told" if said["verdict"] == "no_mismatch" else "told, unknown"
    if said["verdict"] == "unknown":
        return "unknown"
    return "right" if mistake in HARMLESS else "MISSED"


def page(rows: dict[tuple[str, str], list[tuple[str, dict[str, Any]]]]) -> str:
    """The table, and a line of each answer."""
    git = ["git", "-C", str(PAGE.parent), "describe", "--always", "--dirty"]
    commit = subprocess.run(git, capture_output=True, text=True, check=False).stdout.strip()
    rigs = list(dict.fromkeys(rig for _, rig in rows))
    mistakes = list(dict.fromkeys(m for m, _ in rows))
    count = Counter(word for own in rows.values() for word, _ in own)
    out = [
        "# What becomes of mistakes\n",
        f"Made at commit {commit} by `python benchmarks/mistakes_study.py OUT`. Recordings of the",
        f"[second plant](second-plant.md), {SECONDS:g} s a trial, nothing concealed in them.",
        "One mistake is put into each. Of each rig and mistake: how often it was\n",
        "- told: what is wrong stands in `not_physics`, and nothing else is missing;",
        "- told, unknown: something stands in `not_physics`, and more than noise is left;",
        "- refused in one line; right: nothing is missing, and that is so;",
        "- unknown: nothing is named, nothing is told;",
        "- NAMED: as physics; MISSED: nothing is said of it.\n",
        f"{sum(count.values())} answers of {len(MISTAKES) * len(RIGS) * len(SEEDS)}: "
        + ", ".join(f"{n} {word}" for word, n in count.most_common())
        + ".\n",
        "| mistake | " + " | ".join(rigs) + " |",
        "|---|" + "---|" * len(rigs),
    ]
    for mistake in mistakes:

        def of(rig: str, mistake: str = mistake) -> list[tuple[str, dict[str, Any]]]:
            return rows.get((mistake, rig), [])

        cells = [
            ", ".join(f"{n} {w}" for w, n in Counter(w for w, _ in of(r)).most_common()) or "-"
            for r in rigs
        ]
        out.append(f"| {mistake} | " + " | ".join(cells) + " |")
    out += ["\n## Answers that leave something open\n"]
    for (mistake, rig), own in rows.items():
        for word, said in own:
            if word not in ("told", "refused", "right"):
                more = "; ".join(said["not_physics"][:2])
                line = f"- {mistake}, {rig}, {said['channel']}: {word}. {said['line']}"
                out.append(line + (f" *{more}*" if more else ""))
    return "\n".join(out) + "\n"


def main() -> None:
    """Ask, and write the page where everything was asked."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("out", type=Path)
    parser.add_argument("--rig", action="append", choices=RIGS)
    parser.add_argument("--only", action="append", choices=list(MISTAKES))
    parser.add_argument("--page", action="store_true", help="of the answers that are there")
    parser.add_argument("--again", action="store_true", help="ask anew what was answered")
    given = parser.parse_args()
    rows: dict[tuple[str, str], list[tuple[str, dict[str, Any]]]] = {}
    for rig in given.rig or RIGS:
        for seed in SEEDS:
            bench = None if given.page else made(rig, seed, given.out)
            sound: dict[str, Any] = {}
            for mistake in MISTAKES:
                kept = given.out / "answers" / f"{rig}_{seed}_{mistake}.json"
                wanted = mistake in (given.only or MISTAKES) and not given.page
                if bench and wanted and (given.again or not kept.exists()):
                    kept.parent.mkdir(exist_ok=True)
                    kept.write_text(json.dumps(asked(mistake, bench)), encoding="utf-8")
                if not kept.exists():
                    continue
                said = json.loads(kept.read_text("utf-8"))
                sound = sound or said
                word = outcome(mistake, said, sound)
                rows.setdefault((mistake, rig), []).append((word, said))
                if wanted:
                    who = f"{rig} {seed} {mistake} ({said['channel']}, {said['seconds']:.0f} s)"
                    more = [x for x in said["not_physics"] if x not in sound["not_physics"]]
                    what = ", ".join(said["causes"]) or said["line"]
                    print(f"{who}: {word} | {what[:150]} | {'; '.join(more)[:200]}", flush=True)
    if given.page or not (given.rig or given.only):
        PAGE.write_text(page(rows), encoding="utf-8")


if __name__ == "__main__":
    main()
