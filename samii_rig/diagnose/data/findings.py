"""What is no physics, looked for before anything is fitted, and taken out of the responses.

What is found is mended where it is exactly known (unit, sign, order of the channels: `wiring`)
and left out where it is not, so that what is named afterwards does not rest on it.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from samii_rig.diagnose.data.measured import repeated, whole_part
from samii_rig.diagnose.data.pace import paced
from samii_rig.diagnose.data.wiring import FEW_LINES, Mend, lines_of, named, outputs_of, wired
from samii_rig.diagnose.physics.effect import Effect
from samii_rig.diagnose.physics.faults import SHIFTED
from samii_rig.diagnose.result import Verdict
from samii_rig.errors import EstimateError, InputError
from samii_rig.rig.schema import Rig, parameters
from samii_rig.types import Finding, FrequencyResponse

LOST_GAIN = 0.02  # relative change of one channel's gain between levels that is told
A_CONSTANT = 2.0  # chi-square per degree of freedom up to which a change is a constant
ELSE = 5.0  # chi-square per degree of freedom from which two levels differ
NOT_CHANGED = 4.0  # standard deviations by which another channel's gain is not the changed one
FEW_REPEATS = 3  # of fewer, one that is wrong cannot be told from the others
SAID_PER_KIND = 3  # findings of one kind that are told; the rest is counted


OF_LINES = ("leakage", "dof")  # kinds of findings that whole records do not know
NO_REPEATS = (
    "nothing was repeated: the noise is guessed from neighbouring lines, and what local models "
    "leave of a transient may look like physics; three repeats would show it"
)


@dataclass(frozen=True, slots=True)
class Checked:
    """responses : as they may be trusted. remarks : what was found, in words; lacks : what these
    recordings cannot tell, in words. refusal : why nothing may be named, or None; guessed : the
    same of responses line by line, whole records have it not.
    units : channels whose unit was mended. mended : whether anything was, in the responses alone;
    mend : of all recordings' columns, the same as in the responses.
    of_lines : of `remarks`, what concerns responses alone. samples : why segments or channels were
    left out for what their samples are. hidden : sensors that loops are closed around, of which
    rounding hides the response, or follows the motion, in most of what was recorded; whole records
    do without them.
    aligned : whether a loop's law tells that what was sent and measured stand at one time."""

    responses: tuple[FrequencyResponse, ...]
    remarks: tuple[str, ...]
    lacks: tuple[str, ...]
    refusal: Refusal | None
    units: frozenset[str]
    mended: bool = False
    guessed: Refusal | None = None
    of_lines: frozenset[str] = frozenset()
    samples: tuple[Finding, ...] = ()
    hidden: frozenset[str] = frozenset()
    mend: Mend | None = None
    aligned: bool = False

    def sensors(self, rig: Rig) -> tuple[str, ...]:
        """Outputs that half of the responses hold, or more: it costs less to leave out the records
        of the others; and those that a loop of the rig is closed around, but for `hidden`."""
        held = Counter(c.name for r in self.responses for c in r.outputs)
        closed = rig.centred
        often = [n for n, k in held.items() if n in closed or 2 * k >= len(self.responses)]
        return tuple(n for n in often if n not in self.hidden)

    def competing(self, effects: Sequence[Effect]) -> list[Effect]:
        """The table, with what is left of a wrong unit as no physics, as 9.81 is not 9.80665; and
        without what a sensor would do of which rounding hides the response, and a logger's shift
        that a loop's law refutes."""
        return [
            replace(e, physics="unit_rest")
            if e.physics == "sensor_gain" and e.site in self.units
            else e
            for e in effects
            if not self._refuted(e)
        ]

    def _refuted(self, effect: Effect) -> bool:
        if effect.physics == SHIFTED:
            return self.aligned
        on = effect.factor
        return on is not None and on.kind == "sensor" and on.channel in self.hidden


@dataclass(frozen=True, slots=True)
class Refusal:
    """Something wrong with all of the recordings that may pass for physics: why, what to do,
    and the most that may be said all the same."""

    why: str
    experiment: str
    most: Verdict


def checked(
    responses: Sequence[FrequencyResponse], rig: Rig, band: tuple[float, float] | None = None
) -> Checked:
    """The responses without what is no physics, and what that was.

    Raises InputError where recordings, rig and band (Hz) do not belong together, EstimateError
    where nothing is left.
    """
    # That a reference would have served is what recordings lack: the last to be said, and not of
    # an input that a sensor measured, which has none.
    unreferenced = estimated(responses, ("closed_loop",))
    remarks = [words for words in estimated(responses) if words not in unreferenced]
    if not any(a.held for a in rig.actuator):
        unreferenced = []
    for r in responses:
        _belongs(r, rig)
    if responses:
        _covered(responses, band)
    given = responses
    responses, refusal = _timed(given, remarks)
    finite, lost = _finite(_fine(responses))
    paced(finite, rig)
    found = wired(finite, rig)
    steady, changed = _steady(found.responses)
    rounded = {f.channel for r in given for f in r.findings if f.kind == "resolution"}
    hidden = frozenset(n for n in rig.centred & rounded if _is_hidden(n, steady))
    guessed = None
    if not any(repeated(r) for r in steady):
        guessed = Refusal(NO_REPEATS, "repeat each run three times, each from rest", "ambiguous")
    return Checked(
        tuple(steady),
        tuple([_direct(n) for n in sorted(hidden)] + remarks + lost + found.remarks + changed),
        (*lacks(steady, rig), *unreferenced),
        refusal,
        found.units,
        mended=bool(lost or changed or (found.remarks and found.mend is None)),
        mend=found.mend if found.remarks else None,
        guessed=guessed,
        of_lines=frozenset(estimated(responses, OF_LINES)),
        samples=tuple(
            f
            for r in given
            for f in r.findings
            if (f.severity == "error" and f.kind not in (*OF_LINES, "gap"))
            or (f.severity == "warning" and f.kind in ("clock", "resolution"))
        ),
        hidden=hidden,
    )


def _is_hidden(sensor: str, responses: Sequence[FrequencyResponse]) -> bool:
    """Whether less than half of what was recorded shows a sensor."""
    read = sum(r.n_averages for r in responses if any(c.name == sensor for c in r.outputs))
    return 2 * read < sum(r.n_averages for r in responses)


def _direct(sensor: str) -> str:
    """How whole records do without a sensor that a loop is closed around, in words."""
    return (
        f"{sensor} is left out: its rounding hides most of its motion; what its loop made of that "
        "stands in the command, which is taken as it was recorded"
    )


def estimated(
    responses: Iterable[FrequencyResponse], kinds: Sequence[str] | None = None
) -> list[str]:
    """What the estimates found wrong with the recordings; many of one kind are counted.

    kinds : of findings, all if None.
    """
    every = (f for r in responses for f in r.findings if f.severity != "note")
    found = list(dict.fromkeys(f for f in every if kinds is None or f.kind in kinds))
    # What was left out comes before what weakens.
    found.sort(key=lambda f: f.severity != "error")
    out: list[str] = []
    for kind in dict.fromkeys(f.kind for f in found):
        same = list(dict.fromkeys(f.message for f in found if f.kind == kind))
        out += same[:SAID_PER_KIND]
        if (more := len(same) - SAID_PER_KIND) > 0:
            out.append(f"and {more} more of this kind ({kind})")
    return out


def lacks(responses: Sequence[FrequencyResponse], rig: Rig) -> tuple[str, ...]:
    """What recordings and rig file do not let anyone know, and what would."""
    out = []
    outputs = {c.name for r in responses for c in r.outputs}
    if len(outputs) == 1:
        out.append(
            f"only {next(iter(outputs))} was recorded: a place is told from another by the shape "
            "of one curve alone; a second sensor would show where"
        )
    if max((r.n_averages for r in responses if repeated(r)), default=FEW_REPEATS) < FEW_REPEATS:
        out.append(
            "only two repeats of a level could be used: were one of them wrong, it could not be "
            "told which; one more would tell"
        )
    if not any(p.tolerance > 0 for e in rig.element for p in parameters(e).values()):
        out.append(
            "the rig file gives no tolerance: every number in it is taken for exact, and one that "
            "is a little off will look like missing physics"
        )
    return tuple(out)


def _belongs(response: FrequencyResponse, rig: Rig) -> None:
    measured = [c.name for c in response.outputs]
    sensors = [s.name for s in rig.sensor]
    foreign = [n for n in measured if n not in sensors]
    if foreign:
        raise InputError(
            "recording",
            "sensors",
            ", ".join(measured),
            f"those of {rig.name}: {', '.join(sensors)}; recordings of another rig, or of sensors "
            "that the rig file does not have (leave them out with --output)",
        )
    whole_part(response.rate_hz, rig)


def _covered(responses: Sequence[FrequencyResponse], band: tuple[float, float] | None) -> None:
    low, high = band or (0.0, math.inf)
    lowest = min(float(r.frequency[0]) for r in responses)
    highest = max(float(r.frequency[-1]) for r in responses)
    inside = {f for r in responses for f in r.frequency if low <= f <= high}
    if len(inside) < FEW_LINES:
        span = f"{FEW_LINES} lines or more; {lowest:.4g} to {highest:.4g} Hz was measured"
        raise InputError("diagnose", "band", band, f"a band of {span}")


def _timed(
    responses: Sequence[FrequencyResponse], remarks: list[str]
) -> tuple[list[FrequencyResponse], Refusal | None]:
    """Without responses whose clock and rate disagree, as long as there are others."""
    doubtful = [
        any(f.kind == "clock" and f.severity != "note" for f in r.findings) for r in responses
    ]
    if not any(doubtful):
        return list(responses), None
    if not all(doubtful):
        out = [r for r, bad in zip(responses, doubtful, strict=True) if not bad]
        names = [named(r) for r, bad in zip(responses, doubtful, strict=True) if bad]
        remarks.append(f"the runs {', '.join(dict.fromkeys(names))} are left out for their clock")
        return out, None
    return list(responses), Refusal(
        "every frequency is off by as much as the clock is, which looks like other stiffnesses",
        "set rate_hz to what the clock says, or mend the clock, and estimate again",
        "unknown",
    )


def _fine(responses: Sequence[FrequencyResponse]) -> list[FrequencyResponse]:
    """Without outputs whose rounding hides the response, which the estimate has told."""
    out = []
    for r in responses:
        hidden = {f.channel for f in r.findings if f.kind == "resolution"}
        keep = [i for i, c in enumerate(r.outputs) if c.name not in hidden]
        if keep:
            out.append(outputs_of(r, keep) if hidden else r)
    if responses and not out:
        raise EstimateError(
            "no sensor moves by as much as one step of its converter; drive the rig harder"
        )
    return out


def _finite(
    responses: Sequence[FrequencyResponse],
) -> tuple[list[FrequencyResponse], list[str]]:
    out, remarks = [], []
    for r in responses:
        p = r.H.shape[1] * r.H.shape[2]
        entries = np.concatenate([r.H.reshape(-1, p), r.covariance.reshape(-1, p * p)], axis=1)
        good = np.asarray(np.isfinite(entries).all(axis=1))
        if not good.all():
            remarks.append(
                f"{named(r)}: {int((~good).sum())} lines hold no number and are left out"
            )
        if good.sum() >= FEW_LINES or good.all():
            out.append(r if good.all() else lines_of(r, good))
    if not out and responses:
        raise EstimateError("no response has lines that hold numbers")
    return out, remarks


# Levels


def _steady(
    responses: Sequence[FrequencyResponse],
) -> tuple[list[FrequencyResponse], list[str]]:
    """Without channels whose gain was changed between levels, and without a level between two
    that agree and that it does not agree with."""
    out, remarks = list(responses), []
    families: dict[tuple[object, ...], list[int]] = {}
    for i, r in enumerate(out):
        names = tuple(c.name for c in (*r.inputs, *r.outputs))
        key = (r.estimator, r.frequency.tobytes(), names)
        families.setdefault(key, []).append(i)
    dropped: set[int] = set()
    for members in families.values():
        members.sort(key=lambda i: out[i].level)
        for k, words in _changed([out[i] for i in members]):
            remarks.append(words)
            keep = [j for j in range(len(out[members[0]].outputs)) if j != k]
            for i in members:
                out[i] = outputs_of(out[i], keep)
        odd = _foreign([out[i] for i in members])
        if odd is not None:
            r = out[members[odd]]
            remarks.append(
                f"the runs {named(r)} do not fit between the lower and the higher level, which "
                "agree with each other: another state of the rig; left out"
            )
            dropped.add(members[odd])
    return [r for i, r in enumerate(out) if i not in dropped], remarks


def _changed(levels: Sequence[FrequencyResponse]) -> list[tuple[int, str]]:
    """Outputs, the last first, of which one level is a constant times another while all other
    outputs agree, and that in words."""
    found: dict[int, str] = {}
    for a, b in combinations(levels, 2):
        n = len(a.outputs)
        if n < 2:
            continue
        gain, flat, same, sd = np.array([_change(a, b, k) for k in range(n)]).T
        moved = [k for k in range(n) if abs(gain[k] - 1) > LOST_GAIN and same[k] > ELSE]
        if len(moved) != 1:
            continue
        (k,) = moved
        others = np.arange(n) != k
        # A command that was clipped changes all of them, which noise may hide in the others.
        off = np.abs(gain - gain[k])[others]
        alone = np.all(off > np.abs(gain - 1)[others]) and np.any(off > NOT_CHANGED * sd[others])
        if flat[k] < A_CONSTANT and max(same[others]) < A_CONSTANT and alone:
            found.setdefault(
                k,
                f"{a.outputs[k].name} reads {gain[k]:.4g} times as much {named(b)} as "
                f"{named(a)}, at all frequencies, and no other channel does: its gain was "
                "changed between the runs; left out",
            )
    return [(k, found[k]) for k in sorted(found, reverse=True)]


def _change(
    a: FrequencyResponse, b: FrequencyResponse, k: int
) -> tuple[float, float, float, float]:
    """Output k of b over that of a: the best constant, chi-square per degree of freedom about it
    and about 1, and the standard deviation of the constant."""
    x, y = a.H[:, k, 0], b.H[:, k, 0]
    at = k * len(a.inputs)
    var = (a.covariance[:, at, at] + b.covariance[:, at, at]).real
    weight = np.where(var > 0, 1 / np.where(var > 0, var, 1.0), 0.0)
    known = float(np.sum(weight * np.abs(x) ** 2))
    if not known > 0:  # nothing is told without noise, or of a channel that shows nothing
        return 1.0, 0.0, 0.0, math.inf
    gain = float(np.sum(weight * (x.conj() * y).real)) / known
    # The noise of what is multiplied grows with it.
    variance = (a.covariance[:, at, at] * gain**2 + b.covariance[:, at, at]).real
    flat = float(np.mean(np.abs(y - gain * x) ** 2 / np.where(variance > 0, variance, np.inf)))
    # Half of the noise is along what is multiplied.
    return gain, flat, float(np.mean(weight * np.abs(y - x) ** 2)), (2 * known) ** -0.5


def _foreign(levels: Sequence[FrequencyResponse]) -> int | None:
    """A level, neither lowest nor highest, that differs from all while they agree."""
    if len(levels) < 3:
        return None
    n = len(levels)
    distance = np.zeros((n, n))
    for i, j in combinations(range(n), 2):
        worst = max(_change(levels[i], levels[j], k)[2] for k in range(len(levels[i].outputs)))
        distance[i, j] = distance[j, i] = worst
    for i in range(1, n - 1):
        rest = [j for j in range(n) if j != i]
        agree = max(distance[j, k] for j, k in combinations(rest, 2))
        if agree < A_CONSTANT and min(distance[i, j] for j in rest) > ELSE:
            return i
    return None
