"""How sure an answer is: evidence turned into a probability that means its frequency.

The evidence of an explanation among those that were looked at says nothing of those that were not,
nor of what the models of noise and force lack. How often an answer with such evidence is right was
counted on concealed trials; a logistic regression on it (`prove.calibrate`) gives the probability
that is stated, but never more than the evidence leaves it among those that were looked at. The
weights are data, in `calibration.toml`, with the trials that they come from.
"""

from __future__ import annotations

import math
import tomllib
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from functools import cache
from importlib import resources
from typing import Any

FILE = "calibration.toml"
ANSWER, PLACE = "weights", "place"  # tables of it
ODDS = 8.0  # of a logarithm: beyond, evidence says no more
LEFT = 3.0  # the same of what is left, chi-square per degree of freedom
TINY = 1e-300  # a probability whose logarithm there still is
IN_DATA = 45.0  # of chi-square, that an effect must explain of responses to be called missing


@dataclass(frozen=True, slots=True)
class Evidence:
    """What speaks for the best explanation, and against it.

    odds : logarithm of its class's odds among all explanations that were looked at.
    left, held : chi-square per degree of freedom that it leaves on lines that were fitted, and on
        lines that were kept to decide (1 where there are none).
    effects : how many of physics; a fault of the recording is no cause. forced : whether one is a
        nonlinear force; confirmed : in time.
    gain : logarithm of evidence over that nothing is missing. drop : of chi-square, what it
        explains. names : how many names its class has. pair : whether it is two of one physics,
        which can pass for one that is in no table. closed : part of what the nominal model leaves
        over the noise that it explains, on lines that were fitted. worth : of chi-square, that an
        effect must explain to be called missing.
    """

    odds: float
    left: float
    held: float
    effects: int
    forced: bool
    confirmed: bool
    gain: float
    drop: float
    names: int
    pair: bool
    closed: float
    worth: float = IN_DATA

    def features(self) -> dict[str, float]:
        """What the regression looks at."""
        drop = max(self.drop, 1.0)
        left, held = (min(math.log(max(x, 1.0)), LEFT) for x in (self.left, self.held))
        return {
            "one": 1.0,
            "odds": min(max(self.odds, -ODDS), ODDS) / ODDS,
            "left": left,
            "held": held,
            "size": math.log10(drop) / 2,
            "two": float(self.effects >= 2),
            "more": float(self.effects >= 3),
            "forced": float(self.forced),
            "unconfirmed": float(self.forced and not self.confirmed),
            "names": float(self.names > 1),
            "pair": float(self.pair),
        }

    def plain(self) -> dict[str, Any]:
        """As plain data."""
        return asdict(self)


@cache
def weights(of: str = ANSWER) -> Mapping[str, float]:
    """Of each feature, from a table of `calibration.toml`; a file without a table for places says
    of a place what it says of the answer."""
    text = resources.files("samii_rig.diagnose").joinpath(FILE).read_text("utf-8")
    tables = tomllib.loads(text)
    return {k: float(v) for k, v in tables.get(of, tables[ANSWER]).items()}


def probability(evidence: Evidence, of: str = ANSWER) -> float:
    """That the explanation is right, up to its class; of `PLACE`, that one of its causes is where
    something is missing, whatever it is called."""
    w = weights(of)
    known = _logistic(sum(w[k] * x for k, x in evidence.features().items()))
    return min(known, _logistic(evidence.odds)) if of == ANSWER else known


def _logistic(score: float) -> float:
    return 1 / (1 + math.exp(-min(max(score, -30.0), 30.0)))
