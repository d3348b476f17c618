"""Weights of `diagnose.stated` from trials whose truth is known.

Logistic regression of whether all that the most probable explanation names is concealed there, up
to its class, on its evidence; every weight is held by a normal prior, so that few trials do not
make it certain. What tells against an answer never speaks for it, whatever few trials say.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy import optimize, special

from samii_rig.diagnose.fit.stated import ANSWER, IN_DATA, PLACE, Evidence
from samii_rig.errors import InputError
from samii_rig.prove.trial import Answer, Trial, Truth
from samii_rig.record.export import replacing

WIDE = 4.0  # standard deviation of a weight before the trials
# Features that tell against an answer: no weight of theirs is above this, also where the trials
# hardly have them.
AGAINST, LEAST = ("left", "held", "two", "more", "unconfirmed"), -0.2
FEWEST = 40  # trials below which a regression says nothing


def row(truth: Truth, answer: Mapping[str, Any]) -> tuple[Evidence, bool] | None:
    """Evidence of the most probable explanation, and whether every cause in it is right; None where
    it was that nothing is missing, or too little to be told, or where something beyond the table
    was found instead."""
    told = answer["evidence"]
    if not _asked(told) or not told["causes"]:
        return None
    said = replace(Answer.of({**answer, "causes": told["causes"]}), verdict="named")
    known = {f.name: told[f.name] for f in fields(Evidence) if f.name in told}
    return Evidence(**known), len(Trial(truth, said).matches()) == len(said.causes)


def _asked(told: Mapping[str, Any]) -> bool:
    """Whether the answer rests on the probability of its evidence."""
    return bool(told["drop"] > told.get("worth", IN_DATA) and not told["beyond"])


def places(truth: Truth, answer: Mapping[str, Any]) -> list[tuple[Evidence, bool]]:
    """Evidence of the most probable explanation, once for each of its causes, and whether
    something is concealed at that cause's site, or at one it is not distinguished from."""
    told = answer["evidence"]
    if not _asked(told):
        return []
    known = Evidence(**{f.name: told[f.name] for f in fields(Evidence) if f.name in told})
    causes = Answer.of({**answer, "causes": told["causes"]}).causes
    hidden = {site for e in truth.effects for site in e.sites}
    return [(known, bool(hidden & {site for _, site in c.names})) for c in causes]


def balanced(groups: Sequence[str]) -> np.ndarray:
    """(n,) the weight of each row, so that every group counts as any other; 1 in the mean."""
    names, of, count = np.unique(np.asarray(groups), return_inverse=True, return_counts=True)
    return np.asarray(len(groups) / (len(names) * count[of]), dtype=np.float64)


def fit(
    rows: Sequence[tuple[Evidence, bool]], groups: Sequence[str] | None = None
) -> dict[str, float]:
    """The weights. groups : of each row, such as plant and style; each counts alike.

    Raises InputError for fewer than `FEWEST` rows.
    """
    if len(rows) < FEWEST:
        raise InputError("--calibrate", "trials", len(rows), f"at least {FEWEST} that find effects")
    names = list(rows[0][0].features())
    X = np.array([list(e.features().values()) for e, _ in rows])
    y = np.array([2.0 * right - 1 for _, right in rows])
    each = balanced(groups) if groups else np.ones(len(rows))

    def loss(w: np.ndarray) -> tuple[float, np.ndarray]:
        score = y * (X @ w)
        gradient = -(X.T @ (each * y * special.expit(-score))) + w / WIDE**2
        return float(-np.sum(each * special.log_expit(score)) + 0.5 * w @ w / WIDE**2), gradient

    bounds = [(None, LEAST if name in AGAINST else None) for name in names]
    start = np.array([LEAST if name in AGAINST else 0.0 for name in names])
    found = optimize.minimize(loss, start, jac=True, method="L-BFGS-B", bounds=bounds)
    return dict(zip(names, found.x.tolist(), strict=True))


def write(
    path: Path, weights: Mapping[str, float], trials: str, place: Mapping[str, float] | None = None
) -> None:
    """The file that `diagnose.stated` reads; `trials` says where the weights come from.

    place : weights of what is said of places, from `places`; without them, those of the answer.
    """
    lines = [f"# {trials}"]
    for table, found in ((ANSWER, weights), (PLACE, place or {})):
        if found:
            lines += [f"[{table}]", *(f"{k} = {v:.4g}" for k, v in found.items())]
    with replacing(path) as part:
        part.write_text("\n".join(lines) + "\n", encoding="utf-8")
