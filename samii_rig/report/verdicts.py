"""What a run says, in plain words: the first thing that is read, on paper and terminal."""

from __future__ import annotations

import re
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from samii_rig.diagnose.data.wiring import outputs_of
from samii_rig.progress import duration
from samii_rig.report.compare import Comparison, percent, telling
from samii_rig.signal.statistics import difference, octaves
from samii_rig.types import Finding, Float, FrequencyResponse, Recording
from samii_rig.units import pretty

Mark = Literal["good", "found", "note", "warning", "bad"]

# A line that is known to less than this part of its gain shows little but noise.
_USELESS = 0.3
# Level against level: a change below this part of the gain is not worth a sentence.
_SMALL_CHANGE = 0.02
_P_DIFFERENT = 1e-3
# A gain within this part of 1 and a phase within these degrees pass as agreement by eye.
_GAIN_NEAR = 0.05
_PHASE_NEAR = 5.0

_STATUS: dict[str, tuple[Mark, str]] = {
    "completed": ("good", "The run completed"),
    "stopped": ("warning", "The run was stopped"),
    "tripped": ("bad", "The safety gate ended the run"),
    "failed": ("bad", "The run failed"),
    "unknown": ("note", "How the run ended is not recorded"),
}


@dataclass(frozen=True, slots=True)
class Verdict:
    """One line for the person. `mark` is also said in words, never by colour alone."""

    mark: Mark
    title: str
    text: str


def verdicts(
    recordings: Sequence[Recording],
    responses: Sequence[FrequencyResponse],
    comparisons: Sequence[Comparison],
) -> tuple[Verdict, ...]:
    """The model, the measurement, the levels, the data, the run; a run that went wrong first."""
    run = _run(recordings)
    rest = [
        *_model(comparisons),
        *_measured(recordings, responses),
        *_levels(responses),
        *_data(responses),
    ]
    went_wrong = any(v.mark in ("bad", "warning") for v in run)
    return (*run, *rest) if went_wrong else (*rest, *run)


def _run(recordings: Sequence[Recording]) -> list[Verdict]:
    if not recordings:
        return []
    order = ("failed", "tripped", "stopped", "unknown", "completed")
    worst = min(recordings, key=lambda r: order.index(r.stop.status))
    mark, title = _STATUS[worst.stop.status]
    if all("import_file" in r.metadata for r in recordings):
        title = f"{counted(len(recordings), 'recording')} imported"
    segments = sum(len(r.segments) for r in recordings)
    levels: dict[str, set[float]] = {}  # by unit, in the order of the recordings
    for s in (s for r in recordings for s in r.segments):
        levels.setdefault(s.unit, set()).add(s.level)
    seconds = sum(len(r) / r.rate_hz for r in recordings)
    text = f"{counted(segments, 'segment')}"
    if levels:
        listed = (f"{', '.join(f'{x:g}' for x in sorted(s))} {unit}" for unit, s in levels.items())
        text += f" at {' and '.join(listed)}"
    text += f", {duration(seconds)} at {recordings[0].rate_hz:g} samples/s"
    lost = sum(max(r.stop.missing_samples, _jumped(r)) for r in recordings)
    late = sum(r.stop.late_ticks for r in recordings)
    total = sum(len(r) for r in recordings) + lost
    text += f"; {lost} of {total:,} samples missing" if lost else "; no sample missing"
    text += f", {counted(late, 'late tick')}" if late else ""
    if worst.stop.status not in ("completed", "unknown"):
        text += f". Reason: {pretty(worst.stop.reason)}"
    return [Verdict("warning" if mark == "good" and lost else mark, title, text + ".")]


def _outputs(r: FrequencyResponse, names: Collection[str]) -> FrequencyResponse:
    """The response of these outputs alone, in the order of their names."""
    at = {c.name: i for i, c in enumerate(r.outputs)}
    return outputs_of(r, [at[name] for name in sorted(names)])


def _jumped(r: Recording) -> int:
    """Samples that the sequence numbers leap over."""
    return int(r.sequence[-1] - r.sequence[0]) + 1 - len(r) if len(r) else 0


def _measured(
    recordings: Sequence[Recording], responses: Sequence[FrequencyResponse]
) -> list[Verdict]:
    kinds = {s.kind for r in recordings for s in r.segments}
    if not responses and kinds == {"transient"}:
        return [Verdict("note", "A transient", "Recorded to be looked at in time: no response.")]
    if not responses:
        return [Verdict("bad", "No response was estimated", "Nothing can be said of the rig.")]
    parts = []
    poor = False
    first = responses[0]
    # A level may lack a sensor that was unsound there.
    for y in dict.fromkeys(c.name for r in responses for c in r.outputs):
        columns = [
            _relative_sigma(r)[:, i].ravel()
            for r in responses
            for i, c in enumerate(r.outputs)
            if c.name == y
        ]
        sigma = np.concatenate(columns)
        useful = float(np.mean(sigma < _USELESS))
        poor |= useful < 0.5
        parts.append(
            f"{y} to {100 * np.nanmedian(sigma):.2g} %"
            + ("" if useful > 0.95 else f" (only {percent(useful)} of its lines better than 30 %)")
        )
    low, high = first.frequency[0], first.frequency[-1]
    text = (
        f"Standard deviation of the gain in the median, {low:.3g}\u2013{high:.3g} Hz: "
        f"{'; '.join(parts)}."
    )
    title = "The response is poorly known" if poor else "The response is measured"
    return [Verdict("warning" if poor else "good", title, text)]


def _model(comparisons: Sequence[Comparison]) -> list[Verdict]:
    if not comparisons:
        return []
    if all(c.agrees for c in comparisons):
        text = "In every output at every level the difference is within the noise."
        return [Verdict("good", "The model agrees with the measurement", text)]
    near = all(abs(c.gain - 1) < _GAIN_NEAR and abs(c.phase_deg) < _PHASE_NEAR for c in comparisons)
    title = "The model is close, but differs" if near else "The model differs from the measurement"
    shown = list(telling(comparisons).values())
    # The one that is furthest off; every one is in the table.
    text = max(shown, key=lambda c: (not c.agrees, c.outside, abs(np.log(c.gain)))).sentence()
    differ = sum(not c.agrees for c in shown)
    if len(shown) > 1:
        text += f" {differ} of {len(shown)} responses differ."
    return [Verdict("warning" if near else "bad", title, text)]


def _levels(responses: Sequence[FrequencyResponse]) -> list[Verdict]:
    """Lowest against highest level; with one level nothing can be said of linearity."""
    kinds: dict[tuple[str, str], list[FrequencyResponse]] = {}
    for r in responses:
        if np.isfinite(r.level):
            kinds.setdefault((r.level_unit, r.method), []).append(r)
    # Levels of one unit and one kind of experiment: of those with the most.
    known = max(kinds.values(), key=len, default=[])
    known = sorted(known, key=lambda r: r.level)
    if len({r.level for r in known}) < 2:
        return []
    low, high = known[0], known[-1]
    shared = np.intersect1d(low.frequency, high.frequency)
    # A level may lack a sensor that was unsound there.
    both = {c.name for c in low.outputs} & {c.name for c in high.outputs}
    if not shared.size or not both:
        return []
    low, high = (_outputs(r, both) for r in (low, high))
    found = difference(low, high, octaves(shared))
    unequal = [
        d for d in found if d.p_value * len(found) < _P_DIFFERENT and d.change > _SMALL_CHANGE
    ]
    between = f"{low.level:g} and {high.level:g} {high.level_unit}"
    if not unequal:
        text = f"Between {between} no octave changes by more than its noise and 2 %."
        return [Verdict("good", "The response does not depend on the amplitude", text)]
    worst = max(unequal, key=lambda d: d.ratio)
    end = min(worst.high_hz, float(shared[-1]))
    text = (
        f"Between {between} it changes by {percent(worst.change)} in the median at "
        f"{worst.low_hz:.3g}\u2013{end:.3g} Hz, where this is clearest: the rig is "
        f"not linear there, so each level stands for itself."
    )
    return [Verdict("warning", "The response changes with the amplitude", text)]


def _data(responses: Sequence[FrequencyResponse]) -> list[Verdict]:
    findings = {f.message: f for r in responses for f in r.findings}.values()
    bad = [f for f in findings if f.severity == "error"]
    weak = [f for f in findings if f.severity == "warning"]
    if not responses:
        return []
    if not bad and not weak:
        notes = f"{counted(len(findings), 'note')} below." if findings else "No findings at all."
        return [Verdict("good", "Nothing wrong was found in the data", notes)]
    kinds: dict[str, list[Finding]] = {}
    for f in bad + weak:
        kinds.setdefault(f.kind, []).append(f)
    text = " ".join(_of_a_kind(found) for found in kinds.values())
    title = "Data were left out" if bad else "The data have weak points"
    return [Verdict("bad" if bad else "warning", title, text)]


def _of_a_kind(found: list[Finding]) -> str:
    more = len(found) - 1
    text = pretty(without_folders(found[0].message)).rstrip(".")
    return f"{text} (and {more} more of this kind)." if more else f"{text}."


def without_folders(message: str) -> str:
    """A message in which files stand by their names alone."""
    return re.sub(r"(?<!\S)\S*[/\\](?=[^/\\\s]+\.\w+)", "", message)


def counted(number: int, what: str) -> str:
    """`3 sweeps`, `1 sweep`."""
    return f"{number} {what}" if number == 1 else f"{number} {what}s"


def _relative_sigma(response: FrequencyResponse) -> Float:
    """(n_freq, n_out, n_in) standard deviation of |H| over |H|, to first order."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.sqrt(response.variance() / 2) / np.abs(response.H)
