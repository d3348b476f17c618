"""A diagnosis in words: the banner, what each cause is, why the others lost."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from samii_rig.diagnose.physics.rows import PHYSICS
from samii_rig.diagnose.result import (
    HIDING,
    LIKELY,
    Band,
    Before,
    Cause,
    Diagnosis,
    Trace,
    Value,
    percent,
    sentence,
)
from samii_rig.report.diagnosis.laws import Jump, jump_of
from samii_rig.report.verdicts import Mark, without_folders

PLAIN = {row.name: row.words for row in PHYSICS.values()}
WORDS = {
    "no_mismatch": "no mismatch",
    "named": "named",
    "ambiguous": "ambiguous",
    "unknown": "unknown",
}
_PREFIXES = {"N": ((1e9, "G"), (1e6, "M"), (1e3, "k")), "s": ((1.0, ""), (1e-3, "m"), (1e-6, "µ"))}
_POWERS = str.maketrans("0123456789-", "⁰¹²³⁴⁵⁶⁷⁸⁹⁻")
FAINT = 0.02  # probability of a site below which it is not marked
NEVER = 1e-4  # a probability below it is not written in digits


@dataclass(frozen=True, slots=True)
class Named:
    """A cause for a person. parameters : (symbol, value, 90 % interval)."""

    plain: str
    physics: str
    site: str
    probability: str
    parameters: tuple[tuple[str, str, str], ...]
    equivalents: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Banner:
    """What is read in five seconds. word : the verdict. facts : (name, value, explanation)."""

    mark: Mark
    word: str
    title: str
    text: str
    causes: tuple[Named, ...] = ()
    facts: tuple[tuple[str, str, str], ...] = field(default=())


def banner(found: Diagnosis) -> Banner:
    """The verdict, its causes and how good it is."""
    mark, title, text = _verdict(found)
    causes = tuple(named(c) for c in answer(found))
    return Banner(mark, WORDS[found.verdict], title, text, causes, tuple(_facts(found)))


def answer(found: Diagnosis) -> tuple[Cause, ...]:
    """The causes, if the diagnosis believes in them."""
    return found.causes if found.verdict in ("named", "ambiguous") else ()


def models(found: Diagnosis) -> tuple[str, str]:
    """What the model without the causes is called, and that with them."""
    if found.before is not None:
        return "nothing changed", "with the change"
    return "refitted nominal model", "with the causes"


def compared(found: Diagnosis) -> str:
    """What the figures of the fits show."""
    two = found.before is not None
    measured = "Measured with 90 % bands"
    if two:
        measured = "The state after, measured with 90 % bands"
    plain = (
        "the model with parameters that serve both states"
        if two
        else "the nominal model with its uncertain parameters refitted"
    )
    causes = f", and the model {models(found)[1]}" if answer(found) else ""
    return (
        f"{measured}, {plain}{causes}. Lowest panel: how far each is from the measurement, in "
        "standard deviations; 1 is what noise leaves."
    )


def subject(found: Diagnosis) -> str:
    """What a page of it is about."""
    two = found.before is not None
    return "what changed between two states" if two else "what the model leaves out"


def suspects(found: Diagnosis) -> dict[str, float]:
    """Probability of each site, the most suspect first."""
    return {site: p for site, p in found.sites if p >= FAINT}


def named(cause: Cause) -> Named:
    """One cause in words, with its parameters."""
    others: dict[str, list[str]] = {}
    for physics, site in cause.equivalents:
        others.setdefault("" if physics == cause.physics else said(physics), []).append(site)
    same = tuple(f"{what} at {' or '.join(sites)}".strip() for what, sites in others.items())
    numbers = tuple((symbol, *quantity(v)) for symbol, v in cause.parameters.items())
    return Named(
        PLAIN.get(cause.physics, said(cause.physics)),
        said(cause.physics),
        cause.site,
        percent(cause.probability),
        numbers,
        same,
    )


def said(physics: str) -> str:
    """`added_mass` as `added mass`."""
    return physics.replace("_", " ")


def listed(parts: Sequence[str]) -> str:
    """`a, b and c`."""
    return f"{', '.join(parts[:-1])} and {parts[-1]}" if len(parts) > 1 else "".join(parts)


def share(value: float, half: float) -> str:
    """A part of 1, and half its interval where that shows in two decimals."""
    return f"{value:.2f} \u00b1 {half:.2f}" if half >= 0.005 else f"{value:.2f}"


def quantity(v: Value) -> tuple[str, str]:
    """A value with its unit, and its 90 % interval, all three with one prefix."""
    factor, prefix = 1.0, ""
    family = "s" if v.unit == "s" else v.unit[:1]
    size = abs(v.value)
    for f, p in _PREFIXES.get(family, ()):
        if size >= f:
            factor, prefix = f, p
            break
    unit = re.sub(r"\^(-?\d+)", lambda m: m[1].translate(_POWERS), v.unit)
    unit = "" if unit == "1" else f"\u00a0{prefix}{unit}"
    value = f"{_digits(v.value / factor)}{unit}"
    if v.low is None and v.high is None:
        return value, "no limit"
    if v.low is None or v.high is None:
        way, end = ("at most", v.high) if v.low is None else ("at least", v.low)
        return value, f"{way} {_digits((end or 0.0) / factor)}{unit}"
    return value, f"{_digits(v.low / factor)} to {_digits(v.high / factor)}{unit}"


def _digits(x: float) -> str:
    if not np.isfinite(x) or x == 0 or 1e-3 <= abs(x) < 1e4:
        return f"{x:.3g}" if abs(x) < 1e3 or not np.isfinite(x) else f"{x:.0f}"
    mantissa, power = f"{x:.2e}".split("e")
    return f"{mantissa}\u00b710{str(int(power)).translate(_POWERS)}"


def _verdict(found: Diagnosis) -> tuple[Mark, str, str]:
    parts = _together(found.causes)
    if found.before is not None:
        return _verdict_of_two(found, found.before, parts)
    match found.verdict:
        case "no_mismatch":
            if found.not_physics:
                text = findings(found)[0]
                if _mended(found):
                    text += " With that, the model fits to the noise."
                return "warning", "No physics is missing, but the recordings are not right", text
            text = "What model and measurement differ by is no more than the noise."
            return "good", "Nothing is missing from the model", text
        case "named":
            return "found", f"Left out of the model: {parts}", ""
        case "ambiguous":
            text = "The data do not settle it: see what else it may be, and what would tell."
            return "warning", f"Most likely left out of the model: {parts}", text
    if found.states:
        text = f"No one model explains them all. {findings(found)[0]}"
        return "bad", "The recordings are not of one state of the rig", text
    if found.exact:
        title = "A number of the rig file is wrong"
        if len(found.exact) > 1:
            title = "Two numbers of the rig file are wrong"
        return "bad", title, f"{' and '.join(one.describe() for one in found.exact)}."
    if found.beyond:
        return "bad", "Something is missing that is not named for sure", sentence(found.beyond)
    places = suspects(found)
    where = "The data do not tell where it is."
    site, p = next(iter(places.items()), ("", 0.0))
    if p >= LIKELY:
        where = f"It is most likely at {site} ({percent(p)})."
    text = f"No entry of the table of physics explains it. {where}"
    return "bad", "Something is missing that has no name here", text


def _verdict_of_two(found: Diagnosis, before: Before, parts: str) -> tuple[Mark, str, str]:
    """As `_verdict`, of what changed between two states."""
    each = zip(("Before", "after"), before.recordings, strict=True)
    files = [Path(p).name for own in before.recordings for p in own]
    # Files of one name are told by their folders.
    parts_shown = 1 if len(set(files)) == len(files) else 2
    states = "; ".join(
        f"{name}: {listed(['/'.join(Path(p).parts[-parts_shown:]) for p in own])}"
        for name, own in each
    )
    states = f"{states}."
    match found.verdict:
        case "no_mismatch":
            text = "What the two states differ by is no more than the noise."
            return "good", "Nothing changed between the two states", f"{text} {states}"
        case "named":
            return "found", f"Changed: {parts}", states
        case "ambiguous":
            text = "The data do not settle it: see what else it may be, and what would tell."
            return "warning", f"Most likely changed: {parts}", f"{text} {states}"
    if found.states:
        text = f"What changed is not told. {findings(found)[0]} {states}"
        return "bad", "The recordings of one of the two states are of several", text
    places = suspects(found)
    site, p = next(iter(places.items()), ("", 0.0))
    where = f"It is most likely at {site} ({percent(p)})." if p >= LIKELY else ""
    text = f"No entry of the table of physics explains it. {where} {states}"
    return "bad", "Something changed that has no name here", text


def _together(causes: Sequence[Cause]) -> str:
    """All causes; those of one kind with their sites together."""
    sites: dict[str, list[str]] = {}
    for c in causes:
        sites.setdefault(c.physics, []).append(c.site)
    return listed([f"{said(p)} at {listed(where)}" for p, where in sites.items()])


def _facts(found: Diagnosis) -> list[tuple[str, str, str]]:
    before, after = found.nominal[1], found.with_causes[1]
    if _mended(found):
        value = f"{ratio(before)} \u2192 {ratio(after)}"
        return [("Chi-square per degree of freedom", value, "with that set right; noise leaves 1")]
    if not answer(found):
        limit = f"of the refitted model; noise passes {found.threshold:.3g} in 3 of 10,000 cases"
        return [("Chi-square per degree of freedom", ratio(found.chi2_per_dof), limit)]
    sure = min(c.probability for c in found.causes)
    value, low, high = map(percent, (found.gap.value, found.gap.low, found.gap.high))
    between = "" if low == high else f"{low} to {high}, "
    closed = ("Gap closed", value, f"{between}on test lines")
    if found.gap.of_noise:
        closed = ("Gap closed", "\u2013", "on test lines the model had left no more than noise")
    return [
        (
            "Probability",
            percent(sure),
            f"that this is what {'changed' if found.before else 'is missing'}",
        ),
        closed,
        (
            "Chi-square per degree of freedom",
            f"{ratio(before)} \u2192 {ratio(after)}",
            " \u2192 ".join(models(found)) + "; noise leaves 1",
        ),
    ]


def ratio(x: float) -> str:
    """A chi-square per degree of freedom, or its root."""
    return f"{x:.2f}" if x < 10 else f"{x:.3g}" if x < 1000 else f"{x:,.0f}"


def _mended(found: Diagnosis) -> bool:
    """Whether what is not physics explains all that the refitted nominal model leaves."""
    wrong = found.chi2_per_dof > found.threshold
    return wrong and not found.causes and found.with_causes[0] <= found.threshold


def fit_rows(found: Diagnosis) -> list[tuple[str, str, str]]:
    """(model, on lines fitted, on test lines): chi-square per degree of freedom."""
    plain, caused = models(found)
    rows = [(plain, found.nominal)]
    if answer(found):
        rows.append((caused, found.with_causes))
    elif found.causes:
        rows.append(("with the best of the table", found.with_causes))
    elif _mended(found):
        rows.append(("with what is not physics", found.with_causes))
    rows.append(("noise", (found.noise_floor, found.noise_floor)))
    return [(name, ratio(train), ratio(held)) for name, (train, held) in rows]


def rivals(found: Diagnosis) -> list[dict[str, str]]:
    """The chosen explanation and those that lost: what, probability, why."""
    if not found.causes:
        return []
    chosen = min(c.probability for c in found.causes)
    best = {(t.site, (t.jump, t.by)): t for t in found.traces}
    first = "chosen" if answer(found) else "the best of the table, and not good enough"
    rows = [
        {"what": _together(found.causes), "probability": percent(chosen), "why": first},
    ]
    for causes, p in found.alternatives:
        what = _together(causes) or "nothing, or no physics"
        values = "; ".join(
            f"{symbol}\u00a0=\u00a0{quantity(v)[0]}"
            for c in causes
            for symbol, v in c.parameters.items()
        )
        rows.append(
            {
                "what": f"{what} ({values})" if values else what,
                "probability": percent(p),
                "why": _why(causes, p, found, chosen, best),
            }
        )
    if found.outside > NEVER:
        why = "what the chosen one leaves does not look like noise" if found.outside > 0.5 else ""
        row = {"what": "something that the table does not hold", "why": why}
        rows.append(row | {"probability": percent(found.outside)})
    return rows


def _why(
    causes: Sequence[Cause],
    p: float,
    found: Diagnosis,
    chosen: float,
    best: dict[tuple[str, Jump], Trace],
) -> str:
    odds = chosen / max(p, NEVER)
    parts = [f"{odds:.2g} times less probable" if odds > 1.5 else "about as probable"]
    more = len(causes) - len(found.causes)
    if more > 0:
        parts.append(f"{more} more part{'s' if more > 1 else ''} for what it explains")
    elif more < 0:
        parts.append("leaves out a part that the data ask for")
    here = {c.site for c in found.causes}
    for cause in causes if len(causes) == 1 else ():
        jump = jump_of(cause)
        trace = best.get((cause.site, jump)) if jump else None
        if trace is not None and cause.site not in here and trace.chi2_per_dof > found.threshold:
            parts.append(
                f"a part of any law at {cause.site} leaves {ratio(trace.chi2_per_dof)} of "
                "chi-square per degree of freedom"
            )
    return "; ".join(parts)


def findings(found: Diagnosis) -> list[str]:
    """What is wrong with the recordings, as sentences."""
    return [sentence(without_folders(text)) for text in found.not_physics]


@dataclass(frozen=True, slots=True)
class Left:
    """One cell of what the refitted nominal model leaves. weight : 0 to 1, of its colour."""

    text: str
    weight: float


Table = tuple[list[str], list[tuple[str, list[Left]]]]


def band_table(bands: Sequence[Band], threshold: float) -> Table:
    """Columns (frequency bands) and rows (channel, cells) of chi-square per degree of freedom."""
    spans = sorted({(b.low_hz, b.high_hz) for b in bands})
    channels = list(dict.fromkeys(b.channel for b in bands))
    of = {(b.channel, b.low_hz, b.high_hz): b.chi2_per_dof for b in bands}
    worst = max((b.chi2_per_dof for b in bands), default=1.0)
    scale = np.log(max(worst / max(threshold, 1.0), 2.0))
    rows = []
    for channel in channels:
        cells = []
        for span in spans:
            x = of.get((channel, *span))
            if x is None:
                cells.append(Left("", 0.0))
                continue
            weight = float(np.clip(np.log(max(x / max(threshold, 1.0), 1.0)) / scale, 0.0, 1.0))
            cells.append(Left(ratio(x), round(weight, 2)))
        rows.append((channel, cells))
    return [f"{low:.3g}\u2013{high:.3g} Hz" for low, high in spans], rows


def hiding_table(found: Diagnosis) -> tuple[list[str], list[tuple[str, list[str]]]]:
    """Columns (physics) and rows (site, cells): the smallest that would have been seen there."""
    columns = [p for p in HIDING if any(h.physics == p for h in found.could_hide)]
    of = {(h.site, h.physics): h for h in found.could_hide}
    sites = dict.fromkeys(h.site for h in found.could_hide if h.physics in columns)
    rows = []
    for site in sites:
        cells = []
        for physics in columns:
            hiding = of.get((site, physics))
            if hiding is None:
                cells.append("")
            elif hiding.size is None:
                cells.append("any")
            else:
                cells.append(f"{hiding.size:.2g} {hiding.unit}")
        rows.append((site, cells))
    return [said(p) for p in columns], rows
