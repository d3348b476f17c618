"""Whether the likelihood of whole records is right: the drawn nominal parameters against a refit.

samii-rig prove --out OUT --keep --one 0 --two 0 --force 0 --varying 0 --outside 0 --joints 0
python benchmarks/truth_study.py OUT

Of trials of the second plant that conceal nothing and whose recordings are what the rig file says:
no voltmeter in the place of the output, no shifted columns. With the noise told about the truth,
the cost there less the cost of the refit has the number of parameters as its mean, and 90 %
intervals of what the data tell hold 90 %.
OPENBLAS_NUM_THREADS=1; some seconds of one core a trial.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy import stats

from samii_rig.diagnose.diagnose import case_of
from samii_rig.diagnose.fit.record_search import RecordSearch
from samii_rig.diagnose.fit.refit import refit
from samii_rig.diagnose.verdict.by_record import on_records
from samii_rig.errors import SamiiRigError
from samii_rig.record.reader import read_recording
from samii_rig.rig.load import parse
from samii_rig.rig.schema import Rig
from samii_rig.signal.estimate import estimate
from samii_rig.types import Float

TOLD = 0.5  # of its tolerance, standard deviation below which the data tell a parameter
MISTAKEN = {"measured", "shifted"}  # styles whose recordings are not what the rig file says
INSIDE = float(stats.norm.ppf(0.95))  # standard deviations, half an interval of 90 %


@dataclass(frozen=True)
class Found:
    """rises : cost at the truth less that of the refit. off : (n,) of each parameter, in its
    standard deviations; told : (n,) whether the data tell it."""

    rises: float
    off: Float
    told: Float


def found(folder: Path, truth: dict[str, Any]) -> Found | None:
    """Of one trial; None where whole records say nothing."""
    runs = [read_recording(path) for path in sorted(folder.glob("*.mcap"))]
    rig = parse(Rig, runs[0].rig_toml, "rig file")
    case = case_of(estimate(runs, gaps="model"), rig, None, None, runs)
    search = on_records(case)
    if not isinstance(search, RecordSearch):
        return None
    model = search.model(())
    assert model is not None
    drawn = {x["parameter"]: np.log(x["drawn"] / x["file"]) for x in truth["nominal"]}
    x = np.array([drawn.get(".".join(key), 0.0) for key in model.keys])
    search._about(refit(model, search.problem, x, far=False, steps=0))
    there = refit(model, search.problem, x, far=False, steps=0)
    best = refit(model, search.problem, x, far=False)
    sd = np.sqrt(np.diag(best.covariance()))
    told = np.asarray(sd < TOLD * model.prior[: x.size], np.float64)
    return Found(there.cost - best.cost, np.abs(x - best.x) / sd, told)


def main() -> None:
    """Print a line a trial, then all together."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("campaign", type=Path)
    out = parser.parse_args().campaign
    each = []
    for path in sorted((out / "truth").glob("*.json")):
        truth = json.loads(path.read_text(encoding="utf-8"))
        if truth["kind"] != "nothing" or MISTAKEN & set(truth.get("styles", MISTAKEN)):
            continue
        try:
            one = found(out / "recordings" / path.stem, truth)
        except SamiiRigError as error:
            print(f"{path.stem}: {error}")
            continue
        if one is not None:
            each.append(one)
            print(f"{path.stem} {truth['rig']}: {one.rises:.1f} of {one.off.size} parameters")
    off, told = (np.concatenate([getattr(x, name) for x in each]) for name in ("off", "told"))
    inside = off[told > 0] < INSIDE
    rises = sum(x.rises for x in each)
    print(
        f"{len(each)} trials: cost at the truth {rises:.0f} above the refit's, for {off.size} "
        f"parameters; 90 % intervals hold {100 * np.mean(inside):.1f} % of {inside.size}"
    )


if __name__ == "__main__":
    main()
