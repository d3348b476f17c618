"""The report: one HTML file that holds all it shows and asks no one for anything."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from markupsafe import Markup

from samii_rig.errors import InputError
from samii_rig.record.events import Event
from samii_rig.report import facts, plots, series
from samii_rig.report.compare import Comparison, ModelCurve, compare
from samii_rig.report.drawing import draw
from samii_rig.report.entries import entries
from samii_rig.report.modes import Modes, modes_of_all, rows, sentences
from samii_rig.report.modes_drawing import motions
from samii_rig.report.shell import Plot, check_suffix, page_text, put
from samii_rig.report.verdicts import verdicts
from samii_rig.rig.schema import Rig
from samii_rig.types import FrequencyResponse, Recording
from samii_rig.units import pretty

if TYPE_CHECKING:
    from samii_rig.diagnose.result import Diagnosis
    from samii_rig.report.diagnosis.page import Section


@dataclass(frozen=True, slots=True)
class Subject:
    """What a page is about: recordings, what was estimated from them, and what they are held to.

    responses : one for each amplitude level, all with the same inputs and outputs; they are drawn
        in the order of their levels.
    model : laid over every response. band_hz : where it is compared in numbers.
    events : of the gate and the loop. modes : of `responses`; None to find them.
    """

    recordings: Sequence[Recording]
    responses: Sequence[FrequencyResponse]
    rig: Rig | None = None
    model: ModelCurve | None = None
    band_hz: tuple[float, float] = (0.0, np.inf)
    events: Sequence[Event] = ()
    modes: Sequence[Modes] | None = None

    def comparisons(self) -> list[Comparison]:
        """Of the model with every response; none without a model."""
        if self.model is None:
            return []
        among = len(self.responses)
        return [c for r in self.responses for c in compare(r, self.model, self.band_hz, among)]


def write_report(
    path: Path | str,
    subject: Subject,
    *,
    diagnosis: Diagnosis | None = None,
    title: str = "",
    spectrogram_channel: str = "",
) -> Path:
    """Write the page about `subject` to `path`.

    diagnosis : of the subject's rig by its responses, shown first.
    spectrogram_channel : "" takes the last sensor.

    Raises
    ------
    InputError : a name that does not end in .html, responses of different channels, an unknown
        channel, a diagnosis without its rig, a place that cannot be written to; nothing
        half-written is left.
    """
    path = Path(path)
    check_suffix(path)
    responses = sorted(subject.responses, key=lambda r: (not np.isfinite(r.level), r.level))
    _check(subject.recordings, responses, spectrogram_channel)
    rig, modes = subject.rig, subject.modes
    found: Section | None = None
    if diagnosis is not None:
        if rig is None or not responses:
            raise InputError("report", "diagnosis", "without its data", "its rig and responses")
        from samii_rig.report.diagnosis.page import section  # loads the model and its compiler

        found = section(diagnosis, responses, rig, subject.band_hz)
    modes = modes_of_all(responses, rig) if modes is None else modes
    subject = replace(subject, responses=responses)
    return put(path, _text(subject, modes, found, title, spectrogram_channel))


def _text(
    subject: Subject,
    modes: Sequence[Modes],
    diagnosis: Section | None,
    title: str,
    spectrogram_channel: str,
) -> str:
    """The page as text."""
    recordings, responses, rig = subject.recordings, subject.responses, subject.rig
    comparisons = subject.comparisons()
    bode = _bode(responses, subject.model, comparisons, modes)
    time, spectrum = _recorded(recordings, spectrogram_channel)
    plots_ = [p for p in (bode, time, spectrum) if p]
    return page_text(
        "page.html.j2",
        [*(diagnosis.plots if diagnosis else ()), *plots_],
        diagnosis=diagnosis,
        title=title or facts.title(recordings, rig),
        subtitle=facts.subtitle(recordings, rig),
        verdicts=verdicts(recordings, responses, comparisons),
        bode=bode,
        comparisons=facts.comparison_rows(comparisons),
        command=facts.diagnose_command(recordings, comparisons) if diagnosis is None else "",
        modes=rows(modes),
        modes_said=sentences(modes),
        modes_held=any(m.known for m in modes),
        modes_motions=motions(modes),
        series=time,
        spectrogram=spectrum,
        done=facts.done(recordings, rig),
        events=facts.event_rows(subject.events, recordings),
        chain=Markup(draw(rig)) if rig else "",
        chain_caption=rig.description if rig else "",
        limits=facts.limit_rows(recordings, rig) if rig else [],
        predicted=facts.has_prediction(recordings),
        responses=[facts.method_row(r) for r in responses],
        findings=facts.finding_rows(responses),
        files=facts.files(recordings),
        metadata=facts.metadata(recordings),
    )


BODE, RATIO = "Gain, phase, coherence", "Model over measurement"


def _bode(
    responses: Sequence[FrequencyResponse],
    model: ModelCurve | None,
    comparisons: Sequence[Comparison],
    modes: Sequence[Modes],
) -> Plot | None:
    """One panel for all responses: which of them, and how it is shown, are its switches."""
    if not responses:
        return None
    drawn = plots.curves_of(responses)
    compared = {(c.output, c.input) for c in comparisons}
    views = (BODE, RATIO) if compared else (BODE,)
    names, sets = [], []
    for entry in entries(responses):
        names.append("/".join(entry))
        curves = plots.showing_curves(drawn, entry)
        figures = [plots.bode(curves, entry, model, comparisons, modes)]
        if len(views) > 1:
            held = model is not None and entry in compared
            figures.append(plots.ratio(curves, entry, model) if held and model else figures[0])
        sets += [{"name": names[-1], **f} for f in figures]
    said = ["the bands hold the true value of each line with 90 % probability"]
    said += ["shaded: the model differs by more than noise"] if compared else []
    said += [d] if (d := plots.distortion_caption(responses)) else []
    chosen = ("Response", views)
    return Plot(
        "bode", "Responses", "; ".join(said), {"sets": sets}, tuple(names), *chosen, gain=True
    )


def _recorded(recordings: Sequence[Recording], channel: str) -> tuple[Plot | None, Plot | None]:
    parts = series.pieces(recordings)
    if not parts:
        return None, None
    names = tuple(p.name for p in parts)
    lost = any(np.any(np.diff(p.recording.sequence) > 1) for p in parts)
    said = "All channels, largest and smallest value of each pixel."
    said += " Crosses: samples are missing after these." if lost else ""
    time = Plot("time", "Recorded samples.", said, series.time_series(parts), names)
    loudest = max(parts, key=lambda p: p.recording.segments[0].level if p.recording.segments else 0)
    sensors = loudest.recording.names("sensor") or (loudest.recording.channels[-1].name,)
    shown = channel or sensors[-1]
    unit = loudest.recording.channels[loudest.recording.column(shown)].unit
    figure = series.spectrogram(loudest, shown)
    caption = f"{loudest.name}; dB below the loudest spot"
    return time, Plot("spectrum", f"{shown} [{pretty(unit)}].", caption, figure)


def _check(
    recordings: Sequence[Recording], responses: Sequence[FrequencyResponse], channel: str
) -> None:
    if not recordings and not responses:
        raise InputError("report", "", "nothing", "a recording or a response")
    for r in responses:
        names = [[c.name for c in x.inputs] for x in (r, responses[0])]
        if names[0] != names[1]:
            expected = f"{names[1]}, the same in all responses"
            raise InputError("report", "inputs", names[0], expected)
    for recording in recordings if channel else ():
        names_ = [c.name for c in recording.channels]
        if channel not in names_:
            raise InputError("report", "spectrogram channel", channel, f"one of {names_}")
