"""What the data hold of the free parameters, and what they do not, in words."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from samii_rig.types import Float

# A combination known to no better than this (standard deviation, relative) counts as not
# identified: a stiffness off by more is visible to the eye in a Bode diagram.
WEAK = 0.2
MEMBER = 0.25  # share of a combination, over its largest, from which a parameter is named
SHOWN = 6  # parameters named at most
TIED = 0.95  # correlation from which two parameters that are known are called tied
NOTHING = 1e-12  # singular value over the largest below which the data say nothing at all
STEP = 0.1  # relative change that the words give as the example


@dataclass(frozen=True, slots=True)
class Identifiability:
    """Verdict on a set of parameters, from the data alone (priors left out).

    uncertainty : (n,) relative standard deviation along each combination, largest first.
    combinations : (n, n) row i is the unit vector of that combination in log(parameter).
    weak : how many combinations are not identified.
    sentences : the verdict.
    """

    names: tuple[str, ...]
    uncertainty: Float
    combinations: Float
    weak: int
    sentences: tuple[str, ...]


def identifiability(
    jacobian: Float, names: Sequence[str], outputs: Sequence[str]
) -> Identifiability:
    """Verdict from the Jacobian (n_data, n) of the residuals in noise units by log(parameter).

    outputs : the channels that were used, for the words.
    """
    _, s, vt = np.linalg.svd(jacobian, full_matrices=False)
    uncertainty = np.where(s > NOTHING * s[0], 1 / np.maximum(s, 1e-300), np.inf)[::-1]
    combinations = vt[::-1]
    weak = int(np.count_nonzero(uncertainty > WEAK))
    channels = ", ".join(dict.fromkeys(outputs))
    sentences = [
        _weak(v, float(u), names, channels)
        for v, u in zip(combinations[:weak], uncertainty[:weak], strict=True)
    ]
    if not weak:
        least = f"known to {_percent(float(uncertainty[0]))}."
        if len(names) == 1:
            sentences.append(f"{names[0]} is identified from {channels}; it is {least}")
        else:
            every = "Both" if len(names) == 2 else f"All {len(names)}"
            sentences.append(
                f"{every} parameters are identified from {channels}; the combination known least "
                f"is {least}"
            )
        sentences += _tied(jacobian, names)
    return Identifiability(
        tuple(names), np.asarray(uncertainty), np.asarray(combinations), weak, tuple(sentences)
    )


def _weak(direction: Float, uncertainty: float, names: Sequence[str], channels: str) -> str:
    order = np.argsort(-np.abs(direction))
    largest = direction[order[0]]
    members = [i for i in order if abs(direction[i]) >= MEMBER * abs(largest)][:SHOWN]
    known = "at all" if not np.isfinite(uncertainty) else f"better than {_percent(uncertainty)}"
    first = names[members[0]]
    if len(members) == 1:
        return f"{first} cannot be seen from {channels}: it is not known {known}."
    rest = [names[i] for i in members[1:]]
    step = np.log1p(STEP) / largest
    changes = ", ".join(
        f"{names[i]} by {100 * np.expm1(step * direction[i]):+.0f} %" for i in members
    )
    together = (
        f"{first}, {', '.join(rest[:-1])} and {rest[-1]}"
        if len(rest) > 1
        else (f"{first} and {rest[0]}")
    )
    return (
        f"{together} cannot be told apart from {channels}: changed together ({changes}) they "
        f"leave the responses as they are; that combination is not known {known}."
    )


def _tied(jacobian: Float, names: Sequence[str]) -> list[str]:
    covariance = np.linalg.inv(jacobian.T @ jacobian)
    sd = np.sqrt(np.diag(covariance))
    correlation = covariance / np.outer(sd, sd)
    return [
        f"{names[i]} and {names[j]} are known to {100 * sd[i]:.2g} % and {100 * sd[j]:.2g} %, "
        f"but tied: correlation {correlation[i, j]:+.3f}."
        for i in range(len(names))
        for j in range(i)
        if abs(correlation[i, j]) > TIED
    ]


def _percent(x: float) -> str:
    return f"{100 * x:.0f} %" if x >= 0.1 else f"{100 * x:.2g} %"
