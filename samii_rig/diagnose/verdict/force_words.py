"""What is said of forces: which runs would tell more, and what silent lines show."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from samii_rig.diagnose.verdict.judge import Judgement
from samii_rig.types import FrequencyResponse


def distorted(responses: Sequence[FrequencyResponse]) -> list[str]:
    """What the lines say that a multisine left silent, in words."""
    out = []
    for r in responses:
        for name, level in (("odd", r.odd), ("even", r.even)):
            if level is not None:
                share = 100 * float(np.median(level))
                out.append(f"{name} distortion of {share:.2g} % at {r.level:g} {r.level_unit}")
    return out


def next_levels(judged: Judgement) -> tuple[str, str, None] | None:
    """(why, experiment), of unknown gain, where a force is among the leading explanations."""
    leading = [e for c in judged.classes[:2] for e in c.first.effects if e.force is not None]
    if judged.verdict == "no_mismatch" or not leading:
        return None
    if judged.verdict == "named":
        return "", "", None
    return (
        f"{leading[0].physics.replace('_', ' ')} at {leading[0].site} changes with amplitude",
        "repeat the runs at half the lowest and at twice the highest amplitude, a random-phase "
        "multisine with odd lines among them",
        None,
    )
