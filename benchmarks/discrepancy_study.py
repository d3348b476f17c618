"""What is left of the real recordings: one factor on all covariances, or a modelled discrepancy.

python benchmarks/discrepancy_study.py --data FOLDER [nothing clamp tip spring lag motor]

Where the best explanation leaves more than noise, the diagnosis divides chi-square by one factor
(`Search.leftover`). Here what is left is instead a change of the response that no law describes,

    H = (1 + epsilon(f)) M(f),   E epsilon(f) epsilon(f')* = s^2 exp(-(log f/f')^2 / (2 l^2)),

of each sensor by itself. With F d - t the likelihood on its nodes and G G' the covariance of d,
noise 1 becomes 1 + F G G' F'. s and l are the most likely ones for the best explanation; all are
refitted with them, and the search goes on, until both stand still. Linear effects alone; of the
motor, forces, to first order about where each refit ended.
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import sflr_diagnosis as sflr
from scipy import linalg

from samii_rig.diagnose.diagnose import case_of, table
from samii_rig.diagnose.fit.explanations import Explanation, named
from samii_rig.diagnose.fit.records import RecordProblem, RecordSearch
from samii_rig.diagnose.fit.refit import Fitted
from samii_rig.diagnose.forces.search import ForceSearch
from samii_rig.diagnose.verdict.by_record import on_records
from samii_rig.likelihood.reduce import Reduced
from samii_rig.rig.load import load_rig
from samii_rig.rig.schema import Rig
from samii_rig.signal.estimate import estimate
from samii_rig.types import Float, Recording

LENGTHS = (0.05, 0.1, 0.2, 0.4, 0.8, 1.6)  # nepers of frequency, l
SCALES = (0.0, *np.geomspace(1e-4, 0.3, 29).tolist())  # of the response, s
REGULAR = 1e-9  # of a covariance's diagonal, that keeps its root regular
SHOWN = 6  # explanations that are told
KEPT = 12  # that are refitted with another scale and length
ROUNDS, STILL = 3, 0.15  # of scale and search; nepers of the scale that are no change
WIDE = 1.645  # standard deviations of a 90 % interval
MOVED = 3.0  # tolerances by which a nominal parameter is told to be moved

Spectrum = tuple[Float, Float]


def directions(form: Reduced, length: float) -> Float:
    """(m, p) F G of a discrepancy of scale sqrt 2."""
    b, q = form.reference.shape
    f = np.log(np.maximum(form.frequency, form.frequency[1]))
    alike = np.exp(-0.5 * ((f[:, None] - f) / length) ** 2)
    root = np.linalg.cholesky(alike + REGULAR * np.eye(b))
    each = []
    for i in range(q):
        (real, imag), S = form.factor[:, i].swapaxes(0, 1), form.reference[:, i]
        each += [(real * S.real + imag * S.imag) @ root]
        each += [(imag * S.real - real * S.imag) @ root]
    return np.concatenate(each, axis=1)


def spectra(form: Reduced) -> dict[float, Spectrum]:
    """Of each length values and directions of F G G' F' of scale sqrt 2."""
    out = {}
    for length in LENGTHS:
        G = directions(form, length)
        values, turn = np.linalg.eigh(G @ G.T)
        out[length] = np.maximum(values, 0.0), turn
    return out


@dataclass(frozen=True)
class Weighed:
    """An explanation's evidence, length and scale, the vector and its precision."""

    evidence: float
    length: float
    scale: float
    x: Float
    precision: Float


def weighed(form: Reduced, left: Float, fit: Fitted, by: dict[float, Spectrum]) -> Weighed:
    """The most likely scale and length. left : residuals of the fit, without a discrepancy."""
    m, n = len(form.factor), fit.model.n_nominal
    first, rest = fit.jacobian[:m], fit.jacobian[m:]
    prior = fit.precision() - fit.information
    pull = np.zeros(fit.model.n)
    pull[:n] = (prior @ fit.x)[:n]
    size = np.sqrt(np.diagonal(prior))
    found = []
    for length, (values, turn) in by.items():
        J, r = turn.T @ first, turn.T @ left[:m]
        for scale in SCALES:
            counts = 1 / (1 + scale**2 / 2 * values)
            A = J.T @ (counts[:, None] * J) + rest.T @ rest + prior
            g = J.T @ (counts * r) + rest.T @ left[m:] + pull
            d = -np.linalg.solve(A, g)
            cost = float(r @ (counts * r) + left[m:] @ left[m:] + fit.penalty + g @ d)
            free = float(np.linalg.slogdet(A / np.outer(size, size))[1])
            evidence = -0.5 * (cost - float(np.sum(np.log(counts))) + free)
            found.append(Weighed(evidence, length, scale, fit.x + d, A))
    return max(found, key=lambda w: w.evidence)


def discrepant(problem: RecordProblem, scale: float, length: float) -> RecordProblem:
    """The same likelihood with a discrepancy beside the noise."""
    form = problem.reduced
    G = directions(form, length)
    m = len(G)
    root = np.linalg.cholesky(np.eye(m) + scale**2 / 2 * G @ G.T)
    flat = linalg.solve_triangular(root, form.factor.reshape(m, -1), lower=True)
    Q, R = np.linalg.qr(flat)
    goal = Q.T @ linalg.solve_triangular(root, form.target, lower=True)
    made = replace(form, factor=np.ascontiguousarray(R).reshape(form.factor.shape), target=goal)
    return replace(problem, reduced=made)


class Discrepant(RecordSearch):
    """As `RecordSearch`, more than noise taken for a discrepancy."""

    scale, length = 0.0, LENGTHS[0]
    plain: RecordProblem

    @classmethod
    def of(cls, linear: RecordSearch) -> Discrepant:
        """The same search."""
        made = cls.__new__(cls)
        made.__dict__.update(linear.__dict__)
        assert isinstance(linear.problem, RecordProblem)
        made.plain = linear.problem
        return made

    def _about(self, fitted: Fitted) -> None:
        super()._about(fitted)
        assert isinstance(self.problem, RecordProblem)
        self.plain = self.problem
        self.problem = discrepant(self.plain, self.scale, self.length)

    def leftover(self, fitted: Fitted) -> float:
        """As of `Explanations`: nothing but noise and discrepancy."""
        return 1.0

    def learned(self) -> bool:
        """Scale and length anew, and what was found refitted; whether they stood still."""
        fit, old = self.ranked()[0].fitted, (self.scale, self.length)
        h, dh = fit.model.gradient(fit.x, self.plain.at)
        there = replace(fit, jacobian=(J := self.plain.whiten(dh)), information=J.T @ J)
        own = weighed(
            self.plain.reduced, self.plain.residual(h), there, spectra(self.plain.reduced)
        )
        self.scale, self.length = own.scale, own.length
        self.problem = discrepant(self.plain, self.scale, self.length)
        ranked = self.ranked()
        self.found = {}
        for e in [*ranked[:KEPT], *(e for e in ranked[KEPT:] if not e.effects)]:
            end = self.refitted(e.effects, e, far=False)
            if end is not None:
                self.keep(e.effects, end)
        same = abs(math.log((self.scale + REGULAR) / (old[0] + REGULAR))) < STILL
        return same and self.length == old[1]


def told(search: RecordSearch, e: Explanation) -> str:
    """An explanation with its values, and the nominal parameters that it moves far."""
    fit = e.fitted
    sd = np.sqrt(np.diagonal(fit.covariance()) * search.temperature)
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


def row(how: str, search: RecordSearch) -> None:
    """The first explanations of a search."""
    best = search.ranked()[0].weight
    for e in search.ranked()[:SHOWN]:
        print(f"| {how} | {best - e.weight:.1f} | {told(search, e)} |", flush=True)


def whole(name: str, rig: Rig, runs: Sequence[Recording]) -> None:
    """The whole robot without a part: both ways."""
    own = rig if name == "nothing" else sflr.less(rig, name)
    case = case_of(estimate(runs), own, sflr.BAND, table(own, *sflr.BAND), runs)
    linear = on_records(case, sflr.BAND)
    assert linear is not None
    print(f"\n{name}: the refitted model leaves {linear.ratio(linear.nominal.fitted):.3g}\n")
    print(
        "| what is left | behind | explanation and values | moved, tolerances |\n|---|---|---|---|"
    )
    search = Discrepant.of(linear)
    search.found = dict(linear.found)
    search.learned()
    for _ in range(ROUNDS):
        search.run(briefly=True)
        if search.learned():
            break
    linear.run(briefly=True)
    row(f"factor {linear.temperature:.0f}", linear)
    row(f"discrepancy {search.scale:.1%}, {search.length:g}", search)


def motor(rig: Rig, data: Path) -> None:
    """The motor alone, by forces."""
    own, band = sflr.motor_alone(rig), sflr.MOTOR_BAND
    runs = [
        r
        for n in sflr.MOTOR_LEVELS
        for r in sflr.runs_of(data, f"*motor-only_swept*amp-{n}_*", "sflr_motor")
    ]
    effects = [e for e in table(own, *band) if e.physics in sflr.MOTOR_RIVALS]
    linear = on_records(case_of(estimate(runs, band=band), own, band, effects, runs), band)
    assert linear is not None
    linear.run(briefly=True)
    search = ForceSearch(linear)
    search.settle()
    by, rows = spectra(search.reduced), []
    for e in search.ranked():
        fit = e.fitted
        left = search.problem.residual(fit.model.response(fit.x, search.problem.at))
        found = weighed(search.reduced, left, fit, by)
        rows.append((found.evidence + search.log_prior(e.effects), e, found))
    best = max(weight for weight, _, _ in rows)
    print(f"\nmotor: factor {search.temperature:.1f}\n")
    print(
        "| explanation | chi-square per dof | behind, factor | behind, discrepancy | scale, length "
        f"| value, factor | value, discrepancy |\n{'|---' * 7}|"
    )
    for weight, e, found in sorted(rows, key=lambda r: -r[0]):
        forced = (k for k, x in enumerate(e.effects) if x.quasi)
        at = [i for k in forced for i in e.fitted.model.own(k)][:1]
        values = []
        for x, C, times in (
            (e.fitted.x, e.fitted.covariance(), search.temperature),
            (found.x, np.linalg.inv(found.precision), 1.0),
        ):
            values.append(
                ", ".join(f"{math.exp(x[i]):.3g} ({math.sqrt(C[i, i] * times):.0%})" for i in at)
            )
        behind = search.ranked()[0].weight - e.weight
        print(
            f"| {named(e.effects)} | {search.ratio(e.fitted):.3g} | {behind:.1f} | "
            f"{best - weight:.1f} | {found.scale:.2%}, {found.length:g} | {' | '.join(values)} |"
        )


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
