"""A diagnosis on a page: the verdict in plain words, the suspect part, its law, before and after.

write_diagnosis("diagnosis.html", diagnose(responses, rig), responses, rig)
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from markupsafe import Markup

from samii_rig.diagnose.result import Cause, Diagnosis, Trace, percent
from samii_rig.errors import InputError
from samii_rig.report import facts
from samii_rig.report.compare import ModelCurve
from samii_rig.report.diagnosis import plots as figures
from samii_rig.report.diagnosis import words as words
from samii_rig.report.diagnosis.laws import QUANTITY, jump_of, seen
from samii_rig.report.diagnosis.models import curve, refitted_nominal, strengths
from samii_rig.report.drawing import Suspect, draw
from samii_rig.report.entries import Entry, entries
from samii_rig.report.plots import curves_of, showing_curves
from samii_rig.report.shell import Plot, check_suffix, page_text, put
from samii_rig.rig.schema import Rig
from samii_rig.rig.schema.elements import SOURCES, TorsionalSpring, TranslationalSpring
from samii_rig.types import FrequencyResponse, Recording

Band = tuple[float, float]
OR_HERE = "or here"
MASSLESS = (*SOURCES, TorsionalSpring, TranslationalSpring)


@dataclass(frozen=True, slots=True)
class Section:
    """All that the page shows of a diagnosis, in its order."""

    banner: words.Banner
    chain: Markup
    chain_caption: str
    places: tuple[Plot, ...]
    no_places: str
    fits: tuple[Plot, ...]
    compared: str
    rivals: list[dict[str, str]]
    fit_rows: list[tuple[str, str, str]]
    bands: words.Table
    hiding: tuple[list[str], list[tuple[str, list[str]]]]
    findings: list[str]
    why: str
    experiment: str
    model: str
    two: bool = False

    @property
    def plots(self) -> tuple[Plot, ...]:
        """Every figure."""
        return self.places + self.fits


def write_diagnosis(
    path: Path | str,
    diagnosis: Diagnosis,
    responses: Sequence[FrequencyResponse],
    rig: Rig,
    *,
    recordings: Sequence[Recording] = (),
    title: str = "",
    band_hz: Band = (0.0, np.inf),
) -> Path:
    """Write a page of `diagnosis` alone to `path`.

    responses, rig, band_hz : those that were diagnosed. recordings : that they came from.

    Raises InputError: a name that does not end in .html, no response, a place that cannot be
    written to; nothing half-written is left.
    """
    path = Path(path)
    check_suffix(path)
    if not responses:
        raise InputError("diagnosis", "responses", "none", "those that were diagnosed")
    found = section(diagnosis, responses, rig, band_hz)
    page = page_text(
        "diagnosis_page.html.j2",
        found.plots,
        title=title or f"{rig.name}: {words.subject(diagnosis)}",
        subtitle=facts.subtitle(recordings, rig),
        diagnosis=found,
    )
    return put(path, page)


def section(
    diagnosis: Diagnosis,
    responses: Sequence[FrequencyResponse],
    rig: Rig,
    band_hz: Band = (0.0, np.inf),
) -> Section:
    """What a page shows of a diagnosis of `rig` by `responses`."""
    responses = sorted(responses, key=lambda r: (not np.isfinite(r.level), r.level))
    places = _places(diagnosis, responses, band_hz)
    return Section(
        banner=words.banner(diagnosis),
        chain=Markup(draw(rig, _marked(diagnosis, rig))),
        chain_caption=_chain_caption(diagnosis, _marked(diagnosis, rig)),
        places=places,
        no_places=_no_places(diagnosis, places),
        fits=_fits(diagnosis, responses, rig, band_hz),
        compared=words.compared(diagnosis),
        rivals=words.rivals(diagnosis),
        fit_rows=words.fit_rows(diagnosis),
        bands=words.band_table(diagnosis.bands, diagnosis.threshold),
        hiding=words.hiding_table(diagnosis),
        findings=words.findings(diagnosis),
        why=diagnosis.why,
        experiment=diagnosis.experiment,
        model=Path(diagnosis.model).name,
        two=diagnosis.before is not None,
    )


def _marked(found: Diagnosis, rig: Rig) -> dict[str, Suspect]:
    """Sites by probability, and the other places that the chosen causes may have.

    Of one kind of cause the neighbour of a site is no other place: it is the port between them.
    """
    causes = words.answer(found)
    chosen = {c.site for c in causes}
    marked = {
        site: Suspect(percent(p), p, site in chosen) for site, p in words.suspects(found).items()
    }
    for cause in causes:
        port = _port(rig, cause.site)
        for physics, site in cause.equivalents:
            if physics != cause.physics or site not in port:
                marked.setdefault(site, Suspect(OR_HERE, 0.0, False))
    drawn = {*(e.name for e in rig.element), *(s.name for s in rig.sensor)}
    return {name: suspect for name, suspect in marked.items() if name in drawn}


def _port(rig: Rig, site: str) -> set[str]:
    """Names of the elements from `site` to the next body on either side."""
    order = [e.name for e in rig.element]
    if site not in order:
        return set()
    found = {site}
    for step in (-1, 1):
        at = order.index(site) + step
        while 0 <= at < len(order):
            found.add(order[at])
            if not isinstance(rig.element[at], MASSLESS):
                break
            at += step
    return found


def _chain_caption(found: Diagnosis, marked: dict[str, Suspect]) -> str:
    if found.verdict == "no_mismatch":
        return "No part of the chain is suspect."
    if found.exact:
        return "What is wrong is a number of the rig file."
    if not marked:
        return "The data do not tell which part is suspect."
    what = "changed" if found.before else "is missing"
    text = f"Marked: how probable it is that something {what} at each part."
    if any(s.label == OR_HERE for s in marked.values()):
        text += " \u201cOr here\u201d: another place of the same cause to these data."
    return text


def _places(
    found: Diagnosis, responses: Sequence[FrequencyResponse], band_hz: Band
) -> tuple[Plot, ...]:
    causes = words.answer(found)
    if causes and found.rig is not None:
        made = [_at_cause(k, c, found.rig, responses, band_hz) for k, c in enumerate(causes)]
        return tuple(p for p in made if p is not None)
    return tuple(_at_trace(k, t) for k, t in enumerate(found.traces))


def _at_cause(
    k: int, cause: Cause, rig: Rig, responses: Sequence[FrequencyResponse], band_hz: Band
) -> Plot | None:
    seen_there = strengths(cause, rig, responses, band_hz)
    if not seen_there:
        return None
    jump = jump_of(cause)
    quantity, unit = QUANTITY[jump] if jump else ("factor", "")
    figure = figures.strength(seen_there, quantity, unit)
    what = words.said(cause.physics)
    caption = (
        f"{what}: what is missing, each frequency by itself with all else as fitted (points, "
        "90 % band), and the law (dashed)"
    )
    if len(seen_there) > 1:
        by_level = [f"\u00d7 {words.share(*s.strength)} at {s.level}" for s in seen_there]
        caption += f"; by level, of the law: {', '.join(by_level)}"
    return Plot(f"place-{k}", cause.site, caption, figure)


def _at_trace(k: int, trace: Trace) -> Plot:
    quantity, unit = QUANTITY[trace.jump, trace.by]
    figure = figures.free(trace.frequency, seen(trace), trace.sd, quantity, unit)
    caption = (
        f"if it is here: a part of any law, found at each frequency by itself, leaves "
        f"{trace.chi2_per_dof:.3g} of chi-square per degree of freedom (noise: 1)"
    )
    return Plot(f"place-{k}", trace.site, caption, figure)


def _no_places(found: Diagnosis, places: tuple[Plot, ...]) -> str:
    """Why the part of the page is empty, "" if it is not."""
    causes = words.answer(found)
    if places or not causes:
        return ""
    names = words.listed([f"{words.said(c.physics)} at {c.site}" for c in causes])
    return (
        f"No response of a single part can be drawn for {names}: it is no linear part at one place."
    )


def _fits(
    found: Diagnosis, responses: Sequence[FrequencyResponse], rig: Rig, band_hz: Band
) -> tuple[Plot, ...]:
    limits = None if band_hz == (0.0, np.inf) else band_hz
    plain, caused = words.models(found)
    if found.before is not None and found.before.rig is not None:
        before = curve(found.before.rig, plain, responses)
    else:
        before = curve(refitted_nominal(rig, responses, limits), plain, responses)
    causes = words.answer(found)
    after = curve(found.rig, caused, responses) if causes and found.rig else None
    drawn = curves_of(responses)
    names, sets, said = [], [], []
    for entry in entries(responses):
        if entry[0] not in before.outputs or entry[1] not in before.inputs:
            continue
        names.append("/".join(entry))
        curves = showing_curves(drawn, entry)
        sets.append({"name": names[-1], **figures.before_after(curves, entry, before, after)})
        said.append(f"{names[-1]} {_improved(responses, before, after, entry)}".strip())
    if not sets:
        return ()
    caption = "; ".join(said)
    return (Plot("fit", "Responses", caption, {"sets": sets}, tuple(names), "Response"),)


def _improved(
    responses: Sequence[FrequencyResponse],
    before: ModelCurve,
    after: ModelCurve | None,
    entry: Entry,
) -> str:
    far = [figures.distance(responses, m, entry)[1] for m in (before, after) if m is not None]
    typical = [words.ratio(float(np.sqrt(np.mean(x**2)))) for x in far if x.size]
    if not typical:
        return ""
    return " \u2192 ".join(typical) + " times the noise away from the measurement"
