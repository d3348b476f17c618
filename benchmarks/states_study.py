"""What changed between two states of the second plant, and what the records after alone tell of it.

python benchmarks/states_study.py make OUT --seeds 0 40    # every sixth without a change
python benchmarks/states_study.py tell OUT                 # answers, one a trial, then the table

Every third trial has an effect in both states that the rig file does not know. Changes have 3 to 30
sigma of what the records of both states hold. A trial whose answer is there is not told again.
OPENBLAS_NUM_THREADS=1; about a minute of one core a trial.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path
from typing import Any

from samii_rig.diagnose.changed import State, changed
from samii_rig.diagnose.diagnose import diagnose
from samii_rig.errors import SamiiRigError
from samii_rig.plain import plain
from samii_rig.record.reader import read_recording
from samii_rig.rig.load import load_rig, parse
from samii_rig.rig.schema import Rig
from samii_rig.signal.estimate import estimate
from sim.assumed_modes import styles
from sim.assumed_modes.states import make_states

STYLE = ("clean", "cut", "bursts", "multisine")
SAMPLES = 30_000  # of a trial's loop: a minute of records, so that a trial is told in a minute
SIZES = ((3.0, 5.0), (5.0, 10.0), (10.0, 30.0))  # sigma
SPOKEN = ("named", "ambiguous")


def made(seed: int, out: Path) -> None:
    """One trial, unless it is there."""
    if (out / str(seed) / "truth.json").exists():
        return
    styles.BUDGET = SAMPLES
    try:
        make_states(
            seed, out, load_rig("samii")[1], STYLE, nothing=seed % 6 == 5, common=seed % 3 == 1
        )
    except (SamiiRigError, ArithmeticError) as error:
        print(f"{seed}: {error}")


def state(folder: Path) -> State:
    """The recordings of one state and their responses."""
    runs = [read_recording(path) for path in sorted(folder.glob("*.mcap"))]
    return State(estimate(runs, gaps="exclude"), runs)


def told(folder: Path) -> dict[str, Any]:
    """Both answers of a trial."""
    rig = parse(Rig, (folder / "rig.toml").read_text("utf-8"), "rig.toml")
    before, after = state(folder / "before"), state(folder / "after")
    out: dict[str, Any] = {}
    for name in ("two", "alone"):
        start = time.process_time()
        try:
            found = (
                changed(before, after, rig)
                if name == "two"
                else diagnose(after.responses, rig, runs=after.runs)
            )
            out[name] = plain(found.plain()) | {"lines": list(found.lines())}
        except SamiiRigError as error:
            out[name] = {"verdict": "refused", "causes": [], "error": str(error)}
        out[name]["seconds"] = time.process_time() - start
    return out


def right(truth: dict[str, Any], said: dict[str, Any]) -> tuple[bool, bool]:
    """Whether the place, and the name up to what the answer calls equivalent, are those of the
    change; what is in both states is not asked for."""
    (effect,) = truth["change"]
    names = {(effect["physics"], effect["site"])}
    names |= {(n["physics"], n["site"]) for n in effect["also"]}
    # A joint of the rig file that gives more is a softer one.
    names |= {("joint_stiffness", s) for p, s in names if p == "torsional_compliance"}
    have: set[tuple[str, str]] = set()
    for c in said["causes"]:
        have |= {(c["physics"], c["site"])}
        have |= {(n["physics"], n["site"]) for n in c["equivalent_to"]}
    spoken = said["verdict"] in SPOKEN
    place = bool({s for _, s in names} & {s for _, s in have})
    return spoken and place, spoken and bool(names & have)


def holds(truth: dict[str, Any], said: dict[str, Any]) -> list[bool]:
    """Of each parameter that is told of the right physics, whether its interval has the truth."""
    (effect,) = truth["change"]
    out = []
    for c in said["causes"]:
        if c["physics"] == effect["physics"] and said["verdict"] in SPOKEN:
            for symbol, v in c["parameters"].items():
                true = effect["parameters"].get(symbol)
                if true is not None:
                    out.append(v["low"] <= true["value"] <= v["high"])
    return out


def table(rows: list[tuple[dict[str, Any], dict[str, Any]]], which: str) -> None:
    """One answer's table, printed as Markdown."""
    print(f"\n{which}\n\n| size, sigma | trials | shown | place | named right | named wrongly |")
    print("|---|---|---|---|---|---|")
    with_change = [(t, a[which]) for t, a in rows if t["change"]]
    for low, high in SIZES:
        own = [(t, a) for t, a in with_change if low <= t["change"][0]["sigma"] < high * 1.1]
        own = [(t, a) for t, a in own if high == SIZES[-1][1] or t["change"][0]["sigma"] < high]
        shown = sum(a["verdict"] not in ("no_mismatch", "refused") for _, a in own)
        place = sum(right(t, a)[0] for t, a in own)
        name = sum(right(t, a)[1] for t, a in own)
        wrong = sum(a["verdict"] == "named" and not right(t, a)[1] for t, a in own)
        print(f"| {low:g} to {high:g} | {len(own)} | {shown} | {place} | {name} | {wrong} |")
    each = [h for t, a in with_change for h in holds(t, a)]
    print(f"\nintervals that hold: {sum(each)} of {len(each)}")
    nothing = [a[which]["verdict"] for t, a in rows if not t["change"]]
    print(f"nothing changed: {', '.join(nothing)}")
    seconds = sorted(a[which]["seconds"] for _, a in rows)
    print(f"s of a core: {seconds[len(seconds) // 2]:.0f} in the median, {seconds[-1]:.0f} at most")


def main() -> None:
    """Make trials, or tell what changed in each and how good that is."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("what", choices=("make", "tell"))
    parser.add_argument("out", type=Path)
    parser.add_argument("--seeds", type=int, nargs=2, default=(0, 40), metavar=("FROM", "TO"))
    given = parser.parse_args()
    if given.what == "make":
        for seed in range(*given.seeds):
            made(seed, given.out)
        return
    rows = []
    paths = given.out.glob("*/truth.json")
    trials = [(json.loads(path.read_text("utf-8")), path) for path in paths]
    for truth, path in sorted(trials, key=lambda t: (len(t[0]["common"]), t[0]["seed"])):
        kept = path.with_name("answer.json")
        if not kept.exists():
            kept.write_text(json.dumps(told(path.parent)), encoding="utf-8")
        answer = json.loads(kept.read_text("utf-8"))
        change = truth["change"][0] if truth["change"] else {"physics": "nothing", "sigma": 0.0}
        for which in ("two", "alone"):
            said = answer[which]
            what = (said.get("lines") or [said.get("error")])[0]
            print(path.parent.name, f"{change['physics']} {change['sigma']:.1f}", which, what)
        print(flush=True)
        rows.append((truth, answer))
    for which in ("two", "alone"):
        table(rows, which)


if __name__ == "__main__":
    main()
