"""What is left of the real recordings: one factor on all covariances, or a modelled discrepancy.

python benchmarks/discrepancy_study.py --data FOLDER [nothing clamp tip spring lag motor]

The whole robot without a part, among linear single effects: first where chi-square is divided by
one factor (`Explanations.overdispersion_of`), then with a discrepancy beside the noise, as
`diagnose` ends (`fit/discrepant.py`), and which explanations do not hold. Of the motor, forces, to
first order about where each refit ended.
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import sflr_diagnosis as sflr
from scipy import linalg

from samii_rig.diagnose.diagnose import case_of, table
from samii_rig.diagnose.fit.discrepancy import Discrepancy, _directions, weighed
from samii_rig.diagnose.fit.discrepant import DiscrepantSearch
from samii_rig.diagnose.fit.explanations import Explanation, named
from samii_rig.diagnose.fit.record_search import RecordSearch
from samii_rig.diagnose.fit.refit import Fitted
from samii_rig.diagnose.forces.search import ForceSearch
from samii_rig.diagnose.verdict.by_record import on_records
from samii_rig.likelihood.form import Reduced
from samii_rig.rig.load import load_rig
from samii_rig.rig.schema import Rig
from samii_rig.signal.estimate import estimate
from samii_rig.types import Float, Recording

SHOWN = 6  # explanations that are told
WIDE = 1.645  # standard deviations of a 90 % interval
MOVED = 3.0  # tolerances by which a nominal parameter is told to be moved


def told(search: RecordSearch, e: Explanation) -> str:
    """An explanation with its values, and the nominal parameters that it moves far."""
    fit = e.fitted
    sd = np.sqrt(np.diagonal(fit.covariance()) * search.overdispersion)
    values = []
    for i, effect in enumerate(e.effects):
        for k, (u, at) in enumerate(zip(effect.unknowns, fit.model.own(i), strict=True)):
            ends = []
            for far in (0.0, -WIDE, WIDE):
                x = fit.x.copy()
                x[at] += far * sd[at]
                ends.append(float(effect.report(fit.model.parts(x)[i])[k]))
            values.append("{} {:.3g} ({:.3g} to {:.3g}) {}".format(u.symbol, *ends, u.unit))
    keys, n = fit.model.keys, fit.model.n_nominal
    by = fit.x[:n] / fit.model.prior[:n]
    moved = [f"{'.'.join(k)} {s:+.1f}" for k, s in zip(keys, by, strict=False) if abs(s) > MOVED]
    return f"{named(e.effects)}: {', '.join(values) or '-'} | {', '.join(moved) or '-'}"


def refused(search: RecordSearch, e: Explanation) -> str:
    """Why an explanation does not hold."""
    if not isinstance(search, DiscrepantSearch) or search.holds(e):
        return "-"
    why = ["unlikely"] if search.unlikely(e.fitted) else []
    return ", ".join([*why, *search.worse(e)])


def row(how: str, search: RecordSearch) -> None:
    """The first explanations of a search, and the first that holds."""
    ranked = search.ranked()
    some = ranked[:SHOWN]
    holding = next(e for e in ranked if search.holds(e))
    for e in [*some, *([holding] if holding not in some else [])]:
        behind = ranked[0].weight - e.weight
        print(f"| {how} | {behind:.1f} | {told(search, e)} | {refused(search, e)} |", flush=True)


def whole(name: str, rig: Rig, runs: Sequence[Recording]) -> None:
    """The whole robot without a part: both ways."""
    own = rig if name == "nothing" else sflr.less(rig, name)
    case = case_of(estimate(runs), own, sflr.BAND, table(own, *sflr.BAND), runs)
    linear = on_records(case)
    assert linear is not None
    print(f"\n{name}: the refitted model leaves {linear.ratio(linear.nominal.fitted):.3g}\n")
    print(
        "| what is left | behind | explanation and values | moved, tolerances | does not hold |\n"
        "|---|---|---|---|---|"
    )
    linear.run(briefly=True)
    row(f"factor {linear.overdispersion:.0f}", linear)
    search = DiscrepantSearch(linear)
    search.settle()
    row(f"discrepancy {search.discrepancy.scale:.1%}, {search.discrepancy.length:g}", search)


def motor(rig: Rig, data: Path) -> None:
    """The motor alone, by forces."""
    own, band = sflr.motor_alone(rig), sflr.MOTOR_BAND
    runs = [
        r
        for n in sflr.MOTOR_LEVELS
        for r in sflr.runs_of(data, f"*motor-only_swept*amp-{n}_*", "sflr_motor")
    ]
    effects = [e for e in table(own, *band) if e.physics in sflr.MOTOR_RIVALS]
    linear = on_records(case_of(estimate(runs, band=band), own, band, effects, runs))
    assert linear is not None
    linear.run(briefly=True)
    search = ForceSearch(linear)
    search.settle()
    rows = []
    for e in search.ranked():
        fit = e.fitted
        left = search.problem.residual(fit.model.response(fit.x, search.problem.at))
        found = weighed(search.reduced, search.reduced.reference, fit, left)
        rows.append((found.evidence + search.log_prior(e.effects), e, found, left))
    best = max(weight for weight, _, _, _ in rows)
    print(f"\nmotor: factor {search.overdispersion:.1f}\n")
    print(
        "| explanation | chi-square per dof | behind, factor | behind, discrepancy | scale, length "
        f"| value, factor | value, discrepancy |\n{'|---' * 7}|"
    )
    for weight, e, found, left in sorted(rows, key=lambda r: -r[0]):
        forced = (k for k, x in enumerate(e.effects) if x.force)
        at = [i for k in forced for i in e.fitted.model.own(k)][:1]
        values = []
        for x, C, times in (
            (e.fitted.x, e.fitted.covariance(), search.overdispersion),
            (*moved(search.reduced, found.discrepancy, e.fitted, left), 1.0),
        ):
            values.append(
                ", ".join(f"{math.exp(x[i]):.3g} ({math.sqrt(C[i, i] * times):.0%})" for i in at)
            )
        behind = search.ranked()[0].weight - e.weight
        print(
            f"| {named(e.effects)} | {search.ratio(e.fitted):.3g} | {behind:.1f} | "
            f"{best - weight:.1f} | {found.discrepancy.scale:.2%}, "
            f"{found.discrepancy.length:g} | {' | '.join(values)} |"
        )


def moved(form: Reduced, beside: Discrepancy, fit: Fitted, left: Float) -> tuple[Float, Float]:
    """The vector of a fit (n,), moved to first order by a discrepancy beside the noise, and its
    covariance (n, n). left : residual (m + r,) of the noise alone, in whose units the fit is."""
    m, n = len(form.factor), fit.model.n_nominal
    G = _directions(form, form.reference, beside.length)
    root = np.linalg.cholesky(np.eye(m) + beside.scale**2 / 2 * G @ G.T)
    J, r = (
        np.concatenate([linalg.solve_triangular(root, rows[:m], lower=True), rows[m:]])
        for rows in (fit.jacobian, left)
    )
    prior = fit.precision() - fit.information
    pull = np.zeros(fit.x.size)
    pull[:n] = (prior @ fit.x)[:n]
    covariance = np.linalg.inv(J.T @ J + prior)
    return fit.x - covariance @ (J.T @ r + pull), covariance


def main() -> None:
    """Each of the recordings that are asked for."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("which", nargs="*")
    parser.add_argument("--data", type=Path, default=Path("../shared/recordings/sflr"))
    given = parser.parse_args()
    rig = load_rig("sflr")[0]
    runs = [
        r for n in sflr.LEVELS for r in sflr.runs_of(given.data, f"*full-robot*amp-{n}_*", "sflr")
    ]
    for name in given.which or ("nothing", *sflr.PARTS, "motor"):
        start = time.process_time()
        if name == "motor":
            motor(rig, given.data)
        else:
            whole(name, rig, runs)
        print(f"({time.process_time() - start:.0f} s)", flush=True)


if __name__ == "__main__":
    main()
