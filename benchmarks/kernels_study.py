"""Whether an answer depends on the processor: the same recordings with other kernels of OpenBLAS.

    samii-rig prove --out trials --keep --nothing 40 --one 60 --force 30
    python benchmarks/kernels_study.py trials [--kernels Haswell SkylakeX] [--most 130]

Kernels sum in another order, so that last digits differ. Each kernel's process diagnoses every
recording that was kept, those that took least time first; what differs in verdict, causes or, by
more than `SAME`, in a stated probability is printed, and the largest difference of the chi-square
that causes explain.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from samii_rig.prove.outcomes import collected

SAME = 1e-3  # of a stated probability: what is shown of it


def answers(kernel: str, recordings: Sequence[Path]) -> list[dict[str, Any]]:
    """Of each folder of recordings, with one kernel."""
    with tempfile.TemporaryDirectory() as nothing:
        done = subprocess.run(
            [sys.executable, "-m", "samii_rig.prove.reader", nothing],
            input="".join(f"{folder}\n" for folder in recordings),
            env={**os.environ, "OPENBLAS_CORETYPE": kernel, "OPENBLAS_NUM_THREADS": "1"},
            stdout=subprocess.PIPE,
            text=True,
            check=True,
        )
    said = [json.loads(line) for line in done.stdout.splitlines()]
    return [one.get("answer", {"verdict": one.get("error")}) for one in said]


def said(answer: dict[str, Any]) -> tuple[Any, ...]:
    """What a reader of an answer acts on."""
    causes = [(c["physics"], c["site"]) for c in answer.get("causes", [])]
    return answer["verdict"], causes


def probabilities(answer: dict[str, Any]) -> list[float]:
    """Stated, one a cause."""
    return [c["probability"] for c in answer.get("causes", [])]


def explained(answer: dict[str, Any]) -> float:
    """Of chi-square."""
    return float(answer.get("evidence", {}).get("drop", 0.0))


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("trials", type=Path)
    parser.add_argument("--kernels", nargs=2, default=["Haswell", "SkylakeX"])
    parser.add_argument("--most", type=int, default=130, help="recordings")
    given = parser.parse_args()
    recordings, (_, outcomes) = given.trials / "recordings", collected(given.trials)
    kept = [o for o in outcomes if "error" not in o and (recordings / o["trial"]).is_dir()]
    kept.sort(key=lambda o: float(o["seconds"]["diagnosis"]))
    folders = [recordings / o["trial"] for o in kept[: given.most]]
    with ThreadPoolExecutor(2) as pool:
        each = pool.map(lambda kernel: answers(kernel, folders), given.kernels)
    same, most = 0, 0.0
    for folder, one, other in zip(folders, *each, strict=True):
        away = [abs(a - b) for a, b in zip(probabilities(one), probabilities(other), strict=False)]
        if said(one) != said(other) or max(away, default=0.0) > SAME:
            print(folder.name, said(one), probabilities(one), said(other), probabilities(other))
            continue
        same += 1
        most = max(most, abs(explained(one) - explained(other)) / max(explained(one), 1.0))
    print(f"{same} of {len(folders)} the same; chi-square explained to {most:.2g} of it")


if __name__ == "__main__":
    main()
