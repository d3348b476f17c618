"""Diagnoses and trials made up for the tests of the proof's score and page."""

from __future__ import annotations

from typing import Any

from samii_rig.prove.trial import Answer, Hidden, Trial, Truth


def diagnosis(
    verdict: str, *causes: tuple[str, str, float], twins: tuple[tuple[str, str], ...] = ()
) -> dict[str, Any]:
    return {
        "verdict": verdict,
        "sites": [{"site": site, "probability": p} for _, site, p in causes],
        "causes": [
            {
                "physics": physics,
                "site": site,
                "probability": p,
                "equivalent_to": [{"physics": a, "site": b} for a, b in twins],
                "parameters": {"k": {"value": 1.02, "unit": "N m/rad", "low": 0.9, "high": 1.1}},
            }
            for physics, site, p in causes
        ],
        "fit": {"gap_closed": {"value": 0.95, "low": 0.9, "high": 1.0}},
    }


def trial(kind: str, data: dict[str, Any], *effects: tuple[str, str], size: float = 50.0) -> Trial:
    hidden = tuple(Hidden(p, s, {"k": 1.0}) for p, s in effects)
    return Trial(Truth(kind, 1, hidden, size), Answer.of(data))


SPRING = ("torsional_compliance", "joint_1")
MASS = ("added_mass", "link_2")
NOTHING = {"verdict": "no_mismatch", "sites": [], "causes": [], "fit": {}}
UNKNOWN = {
    "verdict": "unknown",
    "sites": [{"site": "joint_1", "probability": 0.7}],
    "causes": [],
    "fit": {},
}
