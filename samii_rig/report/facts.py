"""What the report states in tables: what was done, limits, method, findings."""

from __future__ import annotations

import json
import math
import shlex
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from samii_rig.progress import duration
from samii_rig.record.events import Event
from samii_rig.report.compare import Comparison, percent
from samii_rig.report.verdicts import counted, without_folders
from samii_rig.rig.schema import Rig
from samii_rig.types import FrequencyResponse, Recording
from samii_rig.units import pretty

# Metadata that have their own place on the page.
_FILES = {"import_map": "Import map"}
_SHOWN = {
    "predicted_peaks",
    "description",
    "experiment",
    "operator",
    "device",
    "loop",
    "centring",
    *_FILES,
}
_CLOSE = 0.8  # of a limit used: worth a look


def title(recordings: Sequence[Recording], rig: Rig | None) -> str:
    """`SAMII: swept_sine`, as far as it is known."""
    maps = sorted({r.metadata.get("import_map_name", "") for r in recordings} - {""})
    name = rig.name if rig else ", ".join(maps)
    experiments = sorted({r.metadata.get("experiment", "") for r in recordings} - {""})
    parts = [p for p in (name, ", ".join(experiments)) if p]
    return ": ".join(parts) or "Frequency responses"


def subtitle(recordings: Sequence[Recording], rig: Rig | None) -> str:
    """Description of the rig and the time of the run."""
    parts = [rig.description] if rig and rig.description else []
    parts += sorted({r.metadata.get("description", "") for r in recordings} - {""})
    times = sorted({_first(r, "start_time", "started") for r in recordings} - {""})
    if times:
        parts.append(" to ".join(dict.fromkeys(_instant(t) for t in (times[0], times[-1]))))
    if recordings:
        parts.append(counted(len(recordings), "recording"))
    return " \u00b7 ".join(parts)


def _instant(stated: str) -> str:
    """`2026-11-24 15:22:38 UTC`; as it is stated where that is no instant."""
    try:
        at = datetime.fromisoformat(stated)
    except ValueError:
        return stated
    if at.tzinfo is None:
        return stated.replace("T", " ")
    return f"{at.astimezone(UTC):%Y-%m-%d %H:%M:%S} UTC"


def comparison_rows(comparisons: Sequence[Comparison]) -> list[dict[str, str]]:
    """Model over measurement, one row for each output, input and level."""
    return [
        {
            "response": f"{c.output}/{c.input}",
            "level": f"{c.level:g} {c.level_unit}",
            "band": f"{c.low_hz:.3g}\u2013{c.high_hz:.3g} Hz",
            "gain": f"{c.gain:.3f}",
            "phase": f"{round(c.phase_deg, 1) + 0.0:+.1f}\u00b0",  # no minus before a zero
            "outside": percent(c.outside),
            "differs": "within the noise" if c.first_hz is None else f"from {c.first_hz:.3g} Hz on",
            "mark": "good" if c.agrees else "warning",
        }
        for c in comparisons
    ]


def diagnose_command(recordings: Sequence[Recording], comparisons: Sequence[Comparison]) -> str:
    """The command that says what the model leaves out, "" where model and measurement agree."""
    sources = [r.source for r in recordings if r.source]
    if not sources or all(c.agrees for c in comparisons):
        return ""
    return f"samii-rig diagnose {shlex.join(sources)}"


def limit_rows(recordings: Sequence[Recording], rig: Rig) -> list[dict[str, object]]:
    """Largest recorded value of each limited channel against its limit; then the rates."""
    predicted = _predictions(recordings)
    rows: list[dict[str, object]] = []
    for limit in rig.limit:
        having = [r for r in recordings if limit.channel in {c.name for c in r.channels}]
        if not having:
            continue
        peak = max(r.largest(limit.channel) for r in having)
        used = peak / limit.max
        said = predicted.get(limit.channel)
        rows.append(
            {
                "channel": limit.channel,
                "limit": f"{limit.max:g} {pretty(limit.unit)}",
                "predicted": f"{said:.3g} {pretty(limit.unit)}" if said is not None else "\u2013",
                "peak": f"{peak:.3g} {pretty(limit.unit)}",
                "margin": f"{percent(1 - used)}" if used <= 1 else f"{percent(used - 1)} over",
                "used": f"{min(used, 1.0):.3f}",
                "mark": "bad" if used > 1 else "warning" if used > _CLOSE else "good",
                "reason": limit.reason,
            }
        )
    return rows


def has_prediction(recordings: Sequence[Recording]) -> bool:
    """Whether a dry run's predicted peaks are in the metadata."""
    return bool(_predictions(recordings))


def done(recordings: Sequence[Recording], rig: Rig | None) -> list[tuple[str, str]]:
    """Name and value of what was done."""
    rows: list[tuple[str, str]] = []
    if rig:
        rows.append(("Rig", rig.name))
    for name, key in (
        ("Experiment", "experiment"),
        ("Operator", "operator"),
        ("Device", "device"),
        ("Imported with", "import_map_name"),
        ("Loop", "loop"),
        ("Centring", "centring"),
    ):
        found = list(dict.fromkeys(r.metadata.get(key, "") for r in recordings if r.metadata))
        if text := "; ".join(f for f in found if f):
            rows.append((name, text))
    for (kind, of, amplitude), repeats in sorted(_plan(recordings).items()):
        rows.append((f"{kind.capitalize()} at {amplitude:g} {of}", counted(repeats, "repeat")))
    if not recordings:
        return rows
    seconds = sum(len(r) / r.rate_hz for r in recordings)
    total = sum(len(r) for r in recordings)
    rates = ", ".join(f"{rate:g}" for rate in sorted({r.rate_hz for r in recordings}))
    rows.append(("Recorded", f"{duration(seconds)}, {total:,} samples at {rates} samples/s"))
    for channel in recordings[0].channels:
        text = f"[{pretty(channel.unit)}] {channel.role}"
        text += f", step {channel.resolution:.3g}" if channel.resolution else ""
        text += f"; {channel.description}" if channel.description else ""
        rows.append((f"Channel {channel.name}", text))
    for status, reason in dict.fromkeys((r.stop.status, r.stop.reason) for r in recordings):
        rows.append(("End", f"{status}: {reason}"))
    return rows


def event_rows(events: Sequence[Event], recordings: Sequence[Recording]) -> list[dict[str, str]]:
    """What the gate and the loop noted, in s since the first sample."""
    first = min((int(r.time[0]) for r in recordings if len(r)), default=0)
    return [
        {
            "time": f"{(e.time - first) * 1e-9:.3f} s",
            "name": e.name,
            "what": ", ".join(f"{k.replace('_', ' ')}: {v}" for k, v in e.payload.items()),
        }
        for e in events
    ]


def method_row(r: FrequencyResponse) -> dict[str, str]:
    """How one response was obtained."""
    low, high = float(np.min(r.dof)), float(np.max(r.dof))
    return {
        "level": level(r),
        "method": r.method,
        "why": r.why,
        "averages": f"{r.n_averages}",
        "lines": f"{len(r.frequency):,}",
        "dof": f"{low:.3g}" if math.isclose(low, high) else f"{low:.3g}\u2013{high:.3g}",
    }


def finding_rows(responses: Sequence[FrequencyResponse]) -> list[dict[str, str]]:
    """Each finding once, the worst first."""
    order = ("error", "warning", "note")
    found = dict.fromkeys(f for r in responses for f in r.findings)
    return [
        {
            "severity": f.severity,
            "kind": f.kind.replace("_", " "),
            "where": " \u00b7 ".join(p for p in (f.channel, f.segment) if p) or "all",
            "message": pretty(without_folders(f.message)),
        }
        for f in sorted(found, key=lambda f: order.index(f.severity))
    ]


def files(recordings: Sequence[Recording]) -> list[tuple[str, str]]:
    """The files that are part of the recordings, each once."""
    texts: dict[str, str] = {}
    for r in recordings:
        pairs = [("Rig file", r.rig_toml), ("Experiment file", r.experiment_toml)]
        pairs += [(name, r.metadata.get(key, "")) for key, name in _FILES.items()]
        texts |= {text: name for name, text in pairs if text and text not in texts}
    return [(name, text) for text, name in texts.items()]


def metadata(recordings: Sequence[Recording]) -> list[tuple[str, str]]:
    """All other metadata; a value that all recordings share stands once."""
    keys = dict.fromkeys(k for r in recordings for k in r.metadata if k not in _SHOWN)
    rows = []
    for key in keys:
        values = dict.fromkeys(r.metadata[key] for r in recordings if r.metadata.get(key))
        if values:
            rows.append((key.replace("_", " "), "; ".join(values)))
    sources = [r.source for r in recordings if r.source]
    if sources:
        rows.append(
            ("sources", "; ".join(s.replace("\\", "/").rsplit("/", 1)[-1] for s in sources))
        )
    return rows


def level(r: FrequencyResponse) -> str:
    """`75 count`, or that levels are mixed."""
    return f"{r.level:g} {r.level_unit}" if math.isfinite(r.level) else "mixed"


def names(responses: Sequence[FrequencyResponse]) -> list[str]:
    """A name for each, by which a person tells it from the others: its level, and where two
    have the same, how it was measured; then what it was measured from."""
    first = [level(r) for r in responses]
    more = [f"{name}, {r.method}" for name, r in zip(first, responses, strict=True)]
    whence = [
        f"{name}, {' '.join(Path(s).stem for s in r.sources)}"
        for name, r in zip(more, responses, strict=True)
    ]
    for better in (more, whence):
        first = [
            b if first.count(name) > 1 else name for name, b in zip(first, better, strict=True)
        ]
    return first


def _plan(recordings: Sequence[Recording]) -> dict[tuple[str, str, float], int]:
    plan: dict[tuple[str, str, float], int] = {}
    for r in recordings:
        for s in r.segments:
            key = (s.kind, s.unit, s.level)
            plan[key] = plan.get(key, 0) + 1
    return plan


def _first(r: Recording, *keys: str) -> str:
    return next((r.metadata[k] for k in keys if r.metadata.get(k)), "")


def _predictions(recordings: Sequence[Recording]) -> dict[str, float]:
    """Predicted peak by channel, from the dry run that a runner leaves as JSON in the metadata
    under `predicted_peaks`; the largest of all recordings."""
    found: dict[str, float] = {}
    for r in recordings:
        try:
            peaks_ = json.loads(r.metadata.get("predicted_peaks", "{}"))
        except json.JSONDecodeError:
            continue
        for name, value in peaks_.items() if isinstance(peaks_, dict) else ():
            if isinstance(value, int | float) and math.isfinite(value):
                found[name] = max(found.get(name, 0.0), float(value))
    return found
