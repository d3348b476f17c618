"""Diagnosis of the second plant's recordings, by style: what is kept of sigma, found, named.

python -m sim.assumed_modes one 7 --out trials --style clean,cut      # for each seed
python benchmarks/records_study.py trials

sigma kept is the root of the chi-square that the named causes explain, over what whole records
hold of them in the data by the truth (`sigma_data`, noise known). OPENBLAS_NUM_THREADS=1.
"""

from __future__ import annotations

import argparse
import json
import statistics
import time
from collections import defaultdict
from pathlib import Path
from typing import Any

from samii_rig.diagnose.diagnose import diagnose
from samii_rig.diagnose.result import Diagnosis
from samii_rig.errors import SamiiRigError
from samii_rig.record.reader import read_recording
from samii_rig.rig.load import parse
from samii_rig.rig.schema import Rig
from samii_rig.signal.estimate import estimate

SPOKEN = ("named", "ambiguous")
SIZES = ((3.0, 10.0), (10.0, 30.0), (30.0, 1e9))  # sigma in the data


def answered(folder: Path) -> Diagnosis:
    """The diagnosis of all recordings in a folder with the rig file that they carry."""
    runs = [read_recording(path) for path in sorted(folder.glob("*.mcap"))]
    rig = parse(Rig, runs[0].rig_toml, "the recording's rig file")
    return diagnose(estimate(runs, gaps="model"), rig, runs=runs)


def scored(truth: dict[str, Any], found: Diagnosis) -> tuple[bool, bool]:
    """Whether all places, and all names up to what the answer calls equivalent, are right."""
    also = [tuple(n) for n in truth.get("also", [])]
    said = [{(c.physics, c.site), *c.equivalents} for c in found.causes]
    name = place = found.verdict in SPOKEN
    for effect in truth["effects"]:
        names = {(effect["physics"], effect["site"]), *also}
        name = name and any(names & s for s in said)
        place = place and any(effect["site"] in {site for _, site in s} for s in said)
    return place or name, name


def row(truth: dict[str, Any], folder: Path) -> dict[str, Any] | None:
    """One trial's figures."""
    start = time.perf_counter()
    try:
        found = answered(folder)
    except SamiiRigError as error:
        print(f"{folder.name}: {error}")
        return None
    place, name = scored(truth, found)
    sizes = [e.get("sigma_data", e["sigma"]) for e in truth["effects"]]
    return {
        "style": truth["style"]["excitation"],
        "verdict": found.verdict,
        "size": min(sizes, default=0.0),
        "kept": found.sigma / min(sizes) if len(sizes) == 1 and name and sizes[0] > 0 else None,
        "place": place,
        "name": name,
        "wrong": found.verdict == "named" and not name,
        "seconds": time.perf_counter() - start,
    }


def table(title: str, rows: list[dict[str, Any]]) -> None:
    """One table by style, printed as Markdown."""
    styles: dict[str, list[dict[str, Any]]] = defaultdict(list)
    for r in rows:
        styles[r["style"]].append(r)
    styles["all"] = rows
    print(f"\n{title}\n\n| style | trials | named, by sigma | wrongly named | sigma kept | s |")
    print("|---|---|---|---|---|---|")
    for style, own in styles.items():
        cells = []
        for low, high in SIZES:
            sized = [r for r in own if low <= r["size"] < high]
            right = sum(r["name"] for r in sized)
            cells.append(f"{low:g} to {high:g}: {right} of {len(sized)}" if sized else "")
        kept = [r["kept"] for r in own if r["kept"]]
        median = f"{statistics.median(kept):.2f}" if kept else ""
        seconds = statistics.median(r["seconds"] for r in own)
        sizes = "; ".join(c.replace(" to 1e+09", " up") for c in cells if c)
        wrong = sum(r["wrong"] for r in own)
        print(f"| {style} | {len(own)} | {sizes} | {wrong} | {median} | {seconds:.1f} |")


def main() -> None:
    """Every trial of a folder that the second plant filled."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("trials", type=Path)
    folder = parser.parse_args().trials
    rows = defaultdict(list)
    for path in sorted((folder / "truth").glob("*.json")):
        truth = json.loads(path.read_text("utf-8"))
        made = row(truth, folder / path.stem)
        if made is not None:
            rows[truth["kind"]].append(made)
            print(path.stem, made, flush=True)
    for kind, own in rows.items():
        if kind == "nothing":
            said = [r["verdict"] for r in own]
            spoken = sum(v in SPOKEN for v in said)
            print(f"\nnothing: {len(own)} trials, {spoken} named, {said.count('unknown')} unknown")
        else:
            table(kind, own)


if __name__ == "__main__":
    main()
