"""Scores of many trials, each a frequency or a quantile with its 90 % interval.

Goals are those of the proof (docs/evidence/proof.md). A frequency's interval is Wilson's, a
median's is that of order statistics, others are from a bootstrap over trials.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from scipy import stats

from samii_rig.prove.trial import REFUSED, Trial

T = TypeVar("T")
Stated = tuple[float, bool]
"""Probability stated of a cause, and whether it was right."""

LEVEL = 0.9
SURE = 0.8  # a wrong answer stated with more than this is confidently wrong
BINS = ((0.0, 3.0), (3.0, 10.0), (10.0, 30.0), (30.0, 100.0), (100.0, math.inf))
"""Effect sizes, sigma."""
CALIBRATION_BINS = 10
RESAMPLES = 200


Goal = tuple[float, float]


def at_least(x: float) -> Goal:
    """x or more."""
    return x, math.inf


def at_most(x: float) -> Goal:
    """x or less."""
    return -math.inf, x


@dataclass(frozen=True, slots=True)
class Score:
    """One figure of merit.

    value, low, high : NaN where no trial tells. n : trials that tell.
    goal : (lowest, highest) value that meets it; None where nothing is aimed at.
    """

    what: str
    value: float
    low: float
    high: float
    n: int
    goal: Goal | None = None

    @property
    def met(self) -> bool | None:
        """None where there is no goal or nothing to judge it by."""
        if self.goal is None or math.isnan(self.value):
            return None
        return self.goal[0] <= self.value <= self.goal[1]


def frequency(what: str, hits: Sequence[bool], goal: Goal | None = None) -> Score:
    """How often, with Wilson's interval."""
    n = len(hits)
    if n == 0:
        return Score(what, math.nan, math.nan, math.nan, 0, goal)
    p, z = sum(hits) / n, float(stats.norm.ppf((1 + LEVEL) / 2))
    middle = (p + z * z / (2 * n)) / (1 + z * z / n)
    half = z / (1 + z * z / n) * math.sqrt(p * (1 - p) / n + z * z / (4 * n * n))
    return Score(what, p, max(0.0, middle - half), min(1.0, middle + half), n, goal)


def median(what: str, values: Sequence[float], goal: Goal | None = None) -> Score:
    """Median with the interval between order statistics (at least 90 %)."""
    x, n = np.sort(np.asarray(values, float)), len(values)
    if n == 0:
        return Score(what, math.nan, math.nan, math.nan, 0, goal)
    k = int(stats.binom.ppf((1 - LEVEL) / 2, n, 0.5))
    low, high = x[max(k - 1, 0)], x[min(n - k, n - 1)]
    return Score(what, float(np.median(x)), float(low), float(high), n, goal)


def bootstrap(
    what: str,
    trials: Sequence[T],
    statistic: Callable[[Sequence[T]], float],
    goal: Goal | None = None,
) -> Score:
    """Any statistic of what each trial yields, with a percentile interval over resampled trials."""
    value = statistic(trials)
    if math.isnan(value):
        return Score(what, math.nan, math.nan, math.nan, len(trials), goal)
    rng = np.random.default_rng(len(trials))
    drawn = [
        statistic([trials[i] for i in rng.integers(len(trials), size=len(trials))])
        for _ in range(RESAMPLES)
    ]
    low, high = np.nanquantile(drawn, [(1 - LEVEL) / 2, (1 + LEVEL) / 2])
    return Score(what, value, float(low), float(high), len(trials), goal)


def auroc(positive: Sequence[float], negative: Sequence[float]) -> float:
    """Chance that a positive scores above a negative, ties half; NaN without both."""
    if not len(positive) or not len(negative):
        return math.nan
    a, b = np.asarray(positive, float)[:, None], np.asarray(negative, float)[None]
    return float(np.mean((a > b) + 0.5 * (a == b)))


def stated(trial: Trial) -> list[Stated]:
    """Every cause named; one is right when it is one of the effects, up to its class."""
    if not trial.answer.speaks:
        return []
    good = {id(cause) for _, cause in trial.matches()}
    return [(cause.probability, id(cause) in good) for cause in trial.answer.causes]


def confidently_wrong(trial: Trial) -> bool:
    """Whether it states a cause with more than `SURE` that is none. An effect that was not found
    beside one that was is missed, not wrong."""
    return any(p > SURE and not good for p, good in stated(trial))


def reliability(rows: Sequence[Sequence[Stated]]) -> list[tuple[float, float, int]]:
    """(mean stated probability, frequency of being right, n) by tenths of the probability.

    rows : of each trial, what `stated` gives.
    """
    pairs = np.array([pair for row in rows for pair in row], float).reshape(-1, 2)
    place = np.minimum((pairs[:, 0] * CALIBRATION_BINS).astype(int), CALIBRATION_BINS - 1)
    inside = [pairs[place == b] for b in range(CALIBRATION_BINS)]
    return [(float(x[:, 0].mean()), float(x[:, 1].mean()), len(x)) for x in inside if len(x)]


def calibration_error(rows: Sequence[Sequence[Stated]]) -> float:
    """Expected calibration error: mean |stated - frequency| over the bins, by their counts."""
    bins = reliability(rows)
    total = sum(n for _, _, n in bins)
    return sum(abs(p - f) * n for p, f, n in bins) / total if total else math.nan


def parameter_errors(trials: Sequence[Trial]) -> tuple[list[float], list[bool]]:
    """Relative error and coverage by the interval, of every parameter named as it is hidden.

    A parameter of a cause that is right only up to its class has no truth to hold against it.
    """
    errors, covered = [], []
    for trial in trials:
        for effect, cause in trial.matches():
            if effect.name != cause.name:
                continue
            known = {_symbol(s): x for s, x in effect.parameters.items()}
            for symbol, (value, low, high) in cause.parameters.items():
                true = known.get(_symbol(symbol))
                if true:
                    errors.append(abs(value - true) / abs(true))
                    covered.append(low <= true <= high)
    return errors, covered


def _symbol(name: str) -> str:
    """A parameter's symbol; that of a ratio is the beam's own, whoever writes it."""
    return name.replace("_", " ").removesuffix(" ratio")


def above(trials: Sequence[Trial], sigma: float, *kinds: str) -> list[Trial]:
    """Trials of these kinds whose effect has `sigma` or more."""
    return [t for t in trials if t.truth.kind in kinds and t.truth.size >= sigma]


def scores(trials: Sequence[Trial], failed: int = 0) -> list[Score]:
    """Every figure of the proof over all trials, in the order of its table. failed : diagnoses that
    ended without an answer."""
    return [
        *_size_scores(trials),
        *_name_scores(trials),
        *_outside_scores(trials),
        *_honest_scores(trials),
        *_force_scores(trials),
        *_time_scores(trials),
        frequency(
            "refused, with a reason in one line", [t.answer.verdict == REFUSED for t in trials]
        ),
        frequency(
            "no answer, the diagnosis broke",
            [True] * failed + [False] * len(trials),
            at_most(0.0),
        ),
    ]


def kept(trials: Sequence[Trial]) -> list[float]:
    """Sigma that the causes explain over what whole records hold, of single effects that were named
    right, from 10 sigma."""
    some = above(trials, 10.0, "one", "force")
    return [t.answer.sigma / t.truth.size for t in some if t.right and t.truth.whole]


def false_alarms(trials: Sequence[Trial]) -> list[bool]:
    """Of each trial that conceals nothing whether it was told otherwise."""
    some = [t for t in trials if t.truth.kind == "nothing"]
    return [detected(t) for t in some]


def detected(t: Trial) -> bool:
    """Whether it says that something is missing."""
    return t.answer.verdict not in ("no_mismatch", REFUSED)


def _size_scores(trials: Sequence[Trial]) -> list[Score]:
    alarms = frequency(
        "false alarms where nothing is missing", false_alarms(trials), at_most(0.005)
    )
    upper = Score(
        "upper bound of those", alarms.high, alarms.low, alarms.high, alarms.n, at_most(0.01)
    )
    nothing = [t for t in trials if t.truth.kind == "nothing"]
    small = [t for t in above(trials, 3.0, "one") if t.truth.size < 10.0]
    return [
        median("sigma kept, from 10 sigma", kept(trials), at_least(0.9)),
        alarms,
        upper,
        frequency(
            "physics told where nothing is missing",
            [t.answer.speaks for t in nothing],
            at_most(0.005),
        ),
        frequency("found, 3 to 10 sigma", [detected(t) for t in small], at_least(0.5)),
    ]


def _name_scores(trials: Sequence[Trial]) -> list[Score]:
    out = []
    for sigma, place, name in ((10.0, 0.95, 0.92), (30.0, 0.98, 0.97)):
        big, text = above(trials, sigma, "one"), f"from {sigma:g} sigma"
        out += [
            frequency(f"place right, {text}", [t.place_right for t in big], at_least(place)),
            frequency(f"place in the 90 % set, {text}", [t.place_in_set for t in big]),
            frequency(
                f"name right up to its class, {text}", [t.right for t in big], at_least(name)
            ),
        ]
    two = [t.right for t in above(trials, 10.0, "two")]
    joints = [t.right for t in trials if t.truth.kind == "joints"]
    return [
        *out,
        frequency("two effects: both found", two, at_least(0.85)),
        frequency("every joint gives: all found", joints, at_least(0.95)),
    ]


def _outside_scores(trials: Sequence[Trial]) -> list[Score]:
    # A fractional damper and hysteresis have rows of their own now; so had a stiffness that is not
    # constant in older trials.
    strange, familiar = above(trials, 30.0, "outside"), above(trials, 30.0, "one")
    unknown = [t for t in strange if not t.right]
    return [
        frequency(
            "outside, from 30 sigma: not named, or by its name",
            [t.answer.verdict != "named" or t.right for t in strange],
            at_least(0.95),
        ),
        bootstrap(
            "AUROC of 1 - best probability, from 30 sigma",
            [*unknown, *familiar],
            lambda some: auroc(
                [1 - t.confidence for t in some if t.truth.kind == "outside"],
                [1 - t.confidence for t in some if t.truth.kind == "one"],
            ),
            at_least(0.97),
        ),
    ]


def _honest_scores(trials: Sequence[Trial]) -> list[Score]:
    known = above(trials, 10.0, "one", "two", "force", "joints", "varying")
    errors, covered = parameter_errors(known)
    gaps = [
        t.answer.gap_closed
        for t in trials
        if t.truth.size >= 30.0 and t.answer.speaks and t.answer.gap_closed is not None
    ]
    return [
        frequency("confidently wrong", [confidently_wrong(t) for t in trials], at_most(0.007)),
        frequency(
            "named though the gap did not close, from 30 sigma", [g < 0 for g in gaps], at_most(0.0)
        ),
        frequency("90 % intervals of parameters cover, from 10 sigma", covered, (0.88, 0.92)),
        median("parameter error, from 10 sigma", errors),
        bootstrap(
            "expected calibration error",
            [stated(t) for t in trials],
            calibration_error,
            at_most(0.02),
        ),
    ]


FORCES = (
    "cubic_stiffness", "backlash", "coulomb_friction", "end_stop", "output_saturation",
    "stiffness_variation",
)  # fmt: skip


def _force_scores(trials: Sequence[Trial]) -> list[Score]:
    big = above(trials, 10.0, "one", "force", "varying")
    return [
        frequency(
            f"{name} by name, from 10 sigma",
            [t.right for t in big if t.truth.effects[0].physics == name],
            at_least(0.9),
        )
        for name in FORCES
    ]


def _time_scores(trials: Sequence[Trial]) -> list[Score]:
    timed = [t for t in trials if t.seconds > 0]
    quick = [t.seconds for t in timed if t.truth.kind == "nothing"]
    every = [t.seconds for t in timed]

    def quantile(q: float) -> Callable[[Sequence[float]], float]:
        return lambda some: float(np.quantile(some, q)) if len(some) else math.nan

    longest = max(every, default=math.nan)
    return [
        median("s of a core where nothing is missing, median", quick, at_most(1.0)),
        median("s of a core, median", every),
        bootstrap("s of a core, 95 of 100 within", every, quantile(0.95), at_most(10.0)),
        Score("s of a core, longest", longest, longest, longest, len(every), at_most(30.0)),
    ]


def by_size(trials: Sequence[Trial]) -> list[tuple[str, list[Score]]]:
    """Place, name and confident errors of single effects by their size in sigma."""
    out = []
    for low, high in BINS:
        inside = [t for t in trials if t.truth.kind == "one" and low <= t.truth.size < high]
        label = f"{low:g}-{high:g}" if math.isfinite(high) else f"over {low:g}"
        out.append((label, _short(inside)))
    return out


def by_physics(trials: Sequence[Trial], sigma: float = 10.0) -> list[tuple[str, list[Score]]]:
    """The same by row of the vocabulary, single effects from `sigma`."""
    big = above(trials, sigma, "one", "force", "varying")
    names = sorted({t.truth.effects[0].physics for t in big})
    return [
        (name, _short([t for t in big if t.truth.effects[0].physics == name])) for name in names
    ]


def by_group(
    trials: Sequence[Trial], groups: Callable[[Trial], Sequence[str]]
) -> list[tuple[str, list[Score]]]:
    """What must hold in each group by itself: of a plant, a rig, a style. groups : those that a
    trial belongs to."""
    members: dict[str, list[Trial]] = {}
    for t in trials:
        for name in groups(t):
            members.setdefault(name, []).append(t)
    return [(name, _within(some)) for name, some in sorted(members.items())]


def _within(trials: Sequence[Trial]) -> list[Score]:
    """The figures of one group, with the goals that hold for each group."""
    ten, thirty = above(trials, 10.0, "one"), above(trials, 30.0, "one")
    return [
        frequency("false alarms", false_alarms(trials)),
        median("sigma kept", kept(trials), at_least(0.8)),
        frequency("place, 10", [t.place_right for t in ten], at_least(0.95)),
        frequency("name, 10", [t.right for t in ten], at_least(0.92)),
        frequency("place, 30", [t.place_right for t in thirty], at_least(0.98)),
        frequency("name, 30", [t.right for t in thirty], at_least(0.97)),
        frequency("confidently wrong", [confidently_wrong(t) for t in trials], at_most(0.007)),
        bootstrap(
            "calibration error", [stated(t) for t in trials], calibration_error, at_most(0.05)
        ),
    ]


def _short(trials: Sequence[Trial]) -> list[Score]:
    return [
        frequency("detected", [detected(t) for t in trials]),
        frequency("place right", [t.place_right for t in trials]),
        frequency("name right", [t.right for t in trials]),
        frequency("confidently wrong", [confidently_wrong(t) for t in trials]),
    ]


def confusion(trials: Sequence[Trial], sigma: float = 10.0) -> dict[tuple[str, str], int]:
    """(hidden physics, said) -> trials; single and no effects; one from `sigma` on.

    An answer that holds the truth in its class counts as the truth's own name.
    """
    out: dict[tuple[str, str], int] = {}
    for t in trials:
        if t.truth.kind == "one" and t.truth.size >= sigma:
            hidden = t.truth.effects[0].physics
        elif t.truth.kind == "nothing":
            hidden = "nothing"
        else:
            continue
        if t.right:
            said = hidden
        elif t.answer.speaks:
            said = " + ".join(sorted({c.name[0] for c in t.answer.causes}))
            # Right physics at a wrong place is no right answer.
            said = f"{said}, elsewhere" if said == hidden else said
        else:
            words = {"no_mismatch": "nothing", REFUSED: REFUSED}
            said = words.get(t.answer.verdict, "unknown")
        out[hidden, said] = out.get((hidden, said), 0) + 1
    return out
