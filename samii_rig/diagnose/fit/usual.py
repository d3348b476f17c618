"""How long a diagnosis and the rest of it usually take: nobody knows how many rounds there will be.

Of each stage the tenth and the ninetieth percentile of the time left, over the time spent since the
first of them began; and of all of it, for each thousand samples or lines, in s of a processor.
`benchmarks/pace_study.py` counts them.
"""

from __future__ import annotations

from collections.abc import Mapping

from samii_rig.progress import START

Usual = Mapping[str, tuple[float, float]]

# s for each thousand samples, or lines: the quickest and the slowest of
RECORDS_TAKE = (0.08, 0.7)  # 31 concealed trials of 9,000 to 339,000 samples
LINES_TAKE = (0.25, 9.5)  # 33 of 150 to 5,200 lines
STATES_TAKE = (0.2, 0.75)  # 18 of two states of 20,000 samples
POSES_TAKE = (0.16, 1.1)  # 8 arms in two poses
LEAST_WORK = 0.5  # s: the work that every diagnosis has


def takes(each: tuple[float, float], n: int) -> tuple[float, float]:
    """s from its start to the end of a diagnosis of n samples or lines."""
    low, high = (max(LEAST_WORK, 1e-3 * n * s) for s in each)
    return low, max(high, 2 * LEAST_WORK)


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
    "what cannot be distinguished": (0.07, 0.69),
    "whether the recordings agree": (0.13, 0.85),
}
# Of the responses of 39 such trials alone, 7 s in the median.
LINES: Usual = {
    "what is missing": START,
    "what is missing, round 2": (1.1, 19.0),
    "what is missing, round 4": (0.84, 6.7),
    "what is missing, round 8": (0.42, 2.5),
    "what is missing, round 16": (0.06, 0.54),
    "what cannot be distinguished": (0.02, 0.46),
}
# Of 18 trials of two states on four rigs, from the state before on: 9 s in the median.
STATES: Usual = {
    "before: what is missing": START,
    "before: what is missing, round 2": (17.0, 27.0),
    "before: amplitude levels": (11.0, 19.0),
    "before: amplitude levels, round 1": (3.6, 8.7),
    "before: what is missing, in pairs": (3.0, 6.2),
    "before: what is missing, in pairs, round 4": (2.4, 3.4),
    "before: what cannot be distinguished": (1.7, 4.4),
    "both states": (1.3, 3.5),
    "what changed": (0.39, 1.0),
    "what changed, round 2": (0.34, 0.69),
    "what changed, round 4": (0.28, 0.53),
    "what cannot be distinguished": (0.07, 0.15),
}
# Of 12 arms of two links in two poses, 7 s in the median.
POSES: Usual = {
    "what is missing": START,
    "what is missing, round 2": (1.6, 7.3),
    "what is missing, round 4": (0.45, 1.1),
    "what cannot be distinguished": (0.09, 1.3),
    "whether the recordings agree": (0.08, 1.2),
}
