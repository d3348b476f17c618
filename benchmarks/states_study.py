"""What changed between two states of the second plant, and what the records after alone tell of it.

python benchmarks/states_study.py make OUT --rig samii --seeds 0 40    # every sixth: no change
python benchmarks/states_study.py tell OUT [--alone]                   # answers, then the tables
python benchmarks/states_study.py page OUT                             # docs/evidence/states.md

Every third trial has an effect in both states that the rig file does not know. Changes have 3 to 30
sigma of what the records of both states hold. A trial whose answer is there is not told again.
--alone asks what the state after tells by itself, too. OPENBLAS_NUM_THREADS=1; about half a minute
of one core a trial.
"""

from __future__ import annotations

import argparse
import json
import math
import subprocess
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
SAMPLES = 10_000  # of a trial's loop: 20 s of records at 500 samples/s, told as fast
PAGE = Path(__file__).parents[1] / "docs/evidence/states.md"
SIZES = ((3.0, 5.0), (5.0, 10.0), (10.0, 30.0))  # sigma
SPOKEN = ("named", "ambiguous")


def made(rig: str, seed: int, out: Path) -> None:
    """One trial, unless it is there."""
    if (out / rig / str(seed) / "truth.json").exists():
        return
    styles.BUDGET = SAMPLES
    text = load_rig(rig)[1]
    try:
        make_states(seed, out / rig, text, STYLE, nothing=seed % 6 == 5, common=seed % 3 == 1)
    except (SamiiRigError, ArithmeticError) as error:
        print(f"{rig} {seed}: {error}")


def state(folder: Path) -> State:
    """The recordings of one state and their responses."""
    runs = [read_recording(path) for path in sorted(folder.glob("*.mcap"))]
    return State(estimate(runs, gaps="exclude"), runs)


def told(folder: Path, which: tuple[str, ...]) -> dict[str, Any]:
    """The answers of a trial."""
    rig = parse(Rig, (folder / "rig.toml").read_text("utf-8"), "rig.toml")
    before, after = state(folder / "before"), state(folder / "after")
    out: dict[str, Any] = {}
    for name in which:
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
                    low = -math.inf if v["low"] is None else v["low"]
                    high = math.inf if v["high"] is None else v["high"]
                    out.append(low <= true["value"] <= high)
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


def worded(effect: dict[str, Any]) -> str:
    """Physics, place and values of a concealed effect or of a cause."""
    values = ", ".join(
        f"{symbol} = {v['value']:.3g} {v['unit']}".removesuffix(" 1")
        for symbol, v in effect["parameters"].items()
    )
    return f"{effect['physics']} at {effect['site']}: {values}"


def within(cause: dict[str, Any]) -> str:
    """The intervals of a cause."""
    out = []
    for symbol, v in cause["parameters"].items():
        low, high = ("" if x is None else f"{x:.3g}" for x in (v["low"], v["high"]))
        out.append(f"{symbol} {low} to {high} {v['unit']}".removesuffix(" 1"))
    return ", ".join(out)


def page(rows: list[tuple[str, dict[str, Any], dict[str, Any]]]) -> str:
    """Every pair in one line."""
    git = ["git", "-C", str(PAGE.parent), "describe", "--always", "--dirty"]
    commit = subprocess.run(git, capture_output=True, text=True, check=False).stdout.strip()
    changes = [(t, a["two"]) for _, t, a in rows if t["change"]]
    named = sum(right(t, a)[1] for t, a in changes)
    place = sum(right(t, a)[0] for t, a in changes)
    wrong = sum(a["verdict"] == "named" and not right(t, a)[1] for t, a in changes)
    kept = [h for t, a in changes for h in holds(t, a)]
    large = [right(t, a)[1] for t, a in changes if t["change"][0]["sigma"] >= SIZES[-1][0]]
    still = [a["two"]["verdict"] for _, t, a in rows if not t["change"]]
    answers = ", ".join(still)
    out = [
        "# What changed between two states\n",
        f"Made at commit {commit} by `python benchmarks/states_study.py page OUT`.",
        f"{len(rows)} pairs of the [second plant](second-plant.md), 20 s or less of records a",
        "state. Every third pair has an effect in both states that the rig file does not know.",
        "Sigma is what the records of both states hold of the change.\n",
        f"Of {len(changes)} changes {place} were told at the right place and {named} by the right",
        f"name, up to what the answer calls equivalent; {wrong} were named wrongly. From",
        f"{SIZES[-1][0]:g} sigma on it is {sum(large)} of {len(large)} by name. Of {len(kept)}",
        f"intervals {sum(kept)} hold. Where nothing changed the answers were: {answers}.\n",
        "| rig | what changed | sigma | answer | told | 90 % interval |",
        "|---|---|---|---|---|---|",
    ]
    for rig, truth, answer in rows:
        said = answer["two"]
        causes = said["causes"] if said["verdict"] in SPOKEN else []
        change = truth["change"][0] if truth["change"] else None
        ok = "" if change is None else (", right" if right(truth, said)[1] else ", not right")
        out.append(
            f"| {rig} | {worded(change) if change else 'nothing'} | "
            f"{change['sigma'] if change else 0:.1f} | {said['verdict']}{ok if causes else ''} | "
            f"{'; '.join(worded(c) for c in causes)} | {'; '.join(within(c) for c in causes)} |"
        )
    return "\n".join(out) + "\n"


def main() -> None:
    """Make trials, or tell what changed in each and how good that is."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("what", choices=("make", "tell", "page"))
    parser.add_argument("out", type=Path)
    parser.add_argument("--rig", default="samii")
    parser.add_argument("--seeds", type=int, nargs=2, default=(0, 40), metavar=("FROM", "TO"))
    parser.add_argument("--alone", action="store_true")
    given = parser.parse_args()
    if given.what == "make":
        for seed in range(*given.seeds):
            made(given.rig, seed, given.out)
        return
    rows = []
    asked = ("two", "alone") if given.alone else ("two",)
    paths = given.out.glob("*/*/truth.json")
    trials = [(json.loads(path.read_text("utf-8")), path) for path in paths]
    for truth, path in sorted(trials, key=lambda t: (t[0]["seed"], t[1].parts[-3])):
        kept = path.with_name("answer.json")
        answer = json.loads(kept.read_text("utf-8")) if kept.exists() else {}
        more = tuple(name for name in asked if name not in answer)
        if more and given.what == "tell":
            answer |= told(path.parent, more)
            kept.write_text(json.dumps(answer), encoding="utf-8")
            change = truth["change"][0] if truth["change"] else {"physics": "nothing", "sigma": 0.0}
            for which in more:
                said = answer[which]
                what = (said.get("lines") or [said.get("error")])[0]
                name = f"{path.parts[-3]} {truth['seed']}"
                print(name, f"{change['physics']} {change['sigma']:.1f}", which, what, flush=True)
        if "two" in answer:
            rows.append((path.parts[-3], truth, answer))
    if given.what == "page":
        PAGE.write_text(page(rows), encoding="utf-8")
        return
    for which in asked:
        table([(truth, answer) for _, truth, answer in rows], which)


if __name__ == "__main__":
    main()
