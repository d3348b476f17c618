"""How long the rest of a diagnosis usually takes, where nobody knows how many rounds there will be.

Of each stage the tenth and the ninetieth percentile of the time left, over the time spent since the
first of them began. `benchmarks/pace_study.py` counts them.
"""

from __future__ import annotations

from collections.abc import Mapping

from samii_rig.progress import START

Usual = Mapping[str, tuple[float, float]]

# Of 33 concealed trials of two plants and thirteen rigs, 11 s in the median.
RECORDS: Usual = {
    "what is missing": START,
    "what is missing, round 2": (5.7, 54.0),
    "amplitude levels": (2.3, 37.0),
    "amplitude levels, round 1": (0.64, 5.8),
    "amplitude levels, round 2": (0.53, 5.1),
    "what is missing, in pairs": (0.21, 2.0),
    "what is missing, in pairs, round 4": (0.23, 1.1),
    "amplitude levels, beside pairs": (0.1, 0.93),
    "what cannot be told apart": (0.07, 0.69),
    "whether the recordings agree": (0.13, 0.85),
}
# Of the responses of 39 such trials alone, 7 s in the median.
LINES: Usual = {
    "what is missing": START,
    "what is missing, round 2": (1.1, 19.0),
    "what is missing, round 4": (0.84, 6.7),
    "what is missing, round 8": (0.42, 2.5),
    "what is missing, round 16": (0.06, 0.54),
    "what cannot be told apart": (0.02, 0.46),
}
# Of 18 trials of two states on three rigs, from what changed on: 2 s in the median.
STATES: Usual = {
    "what changed": START,
    "what changed, round 2": (3.4, 5.6),
    "what changed, round 4": (1.5, 3.3),
    "what cannot be told apart": (0.28, 0.62),
}
# Of 12 arms of two links in two poses, 7 s in the median.
POSES: Usual = {
    "what is missing": START,
    "what is missing, round 2": (1.6, 7.3),
    "what is missing, round 4": (0.45, 1.1),
    "what cannot be told apart": (0.09, 1.3),
    "whether the recordings agree": (0.08, 1.2),
}
