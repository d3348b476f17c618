"""`diagnose`: from frequency responses and a rig file to what was left out of it.

found = diagnose(estimate(recordings), rig)
found.verdict, found.causes, found.lines(), found.plain()
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from samii_rig.diagnose.data import findings
from samii_rig.diagnose.data.measured import measured, usable
from samii_rig.diagnose.fit.agreeing import Saved
from samii_rig.diagnose.fit.classes import merge_equivalent
from samii_rig.diagnose.fit.records import Whole
from samii_rig.diagnose.fit.search import Search
from samii_rig.diagnose.fit.usual import LINES_TAKE, RECORDS_TAKE, takes
from samii_rig.diagnose.physics.channels import is_stated
from samii_rig.diagnose.physics.effect import Effect
from samii_rig.diagnose.physics.grid import grid
from samii_rig.diagnose.physics.poses import weighty
from samii_rig.diagnose.physics.rows import EVERY_SENSOR
from samii_rig.diagnose.physics.vocabulary import hypotheses
from samii_rig.diagnose.result import Diagnosis
from samii_rig.diagnose.verdict.by_line import by_lines
from samii_rig.diagnose.verdict.by_record import by_records, on_records, whole_of
from samii_rig.diagnose.verdict.stages import Case
from samii_rig.progress import Begun, Progress
from samii_rig.rig.schema import Rig
from samii_rig.signal.columns import is_aligned
from samii_rig.types import FrequencyResponse, Recording

EQUIVALENCE_POINTS = 40  # frequencies at which effects that are one by structure are compared


def table(
    rig: Rig,
    low_hz: float,
    high_hz: float,
    *,
    signed: bool = False,
    poses: Sequence[Rig] = (),
    recorded_hz: float | None = None,
) -> list[Effect]:
    """All effects that the table knows on this rig, structurally equivalent ones as one. signed,
    recorded_hz : as of `vocabulary.hypotheses`. poses : the rig in each of several; equivalent in
    all of them are one."""
    f = np.geomspace(low_hz, high_hz, EQUIVALENCE_POINTS)
    every = hypotheses(rig, low_hz, high_hz, signed=signed, recorded_hz=recorded_hz)
    every = weighty(every, rig, poses=bool(poses))
    return merge_equivalent(rig, every, f, poses)


def diagnose(
    responses: Sequence[FrequencyResponse],
    rig: Rig,
    *,
    band: tuple[float, float] | None = None,
    effects: Sequence[Effect] | None = None,
    progress: Progress = lambda _stage: None,
    runs: Sequence[Recording] = (),
    files: Sequence[Saved] = (),
) -> Diagnosis:
    """What `rig` leaves out, as far as `responses` tell.

    Parameters
    ----------
    responses : from `samii_rig.signal.estimate`, all levels and experiments together.
    band : Hz, where the model is held against them.
    effects : the table of hypotheses; None for the whole vocabulary.
    progress : is told each stage as it begins, and what is tried in it, as
        `samii_rig.progress.Counted`.
    runs : the recordings that the responses come from. With them every sample counts, the start
        and the end of each record too; without them, the responses line by line.
    files : name and responses of each file, where that is all that was kept: files of several
        states of the rig are told.

    Raises InputError and EstimateError as `samii_rig.identify.data.collect` does.
    """
    n = sum(map(len, runs)) if runs else sum(r.frequency.size for r in responses)
    progress(Begun("nominal model", takes=takes(RECORDS_TAKE if runs else LINES_TAKE, n)))
    case = case_of(responses, rig, band, effects, runs, progress=progress)
    case = replace(case, files=files)
    search = on_records(case)
    return by_lines(case) if search is None else by_records(case, search)


def case_of(
    responses: Sequence[FrequencyResponse],
    rig: Rig,
    band: tuple[float, float] | None,
    effects: Sequence[Effect] | None,
    runs: Sequence[Recording],
    *,
    signed: bool = False,
    progress: Progress = lambda _stage: None,
) -> Case:
    """What is to be explained, the nominal model refitted; arguments as of `diagnose`, `signed` as
    of `table`."""
    clean = replace(findings.checked(responses, rig, band), aligned=is_aligned(runs))
    trusted = usable(clean.responses)
    lines = measured(trusted, rig, band)
    seen, decide, show = lines.splits()
    at = grid(rig, lines.frequency, lines.sensor, lines.actuator)
    runs = runs if clean.mend is None else [clean.mend(run) for run in runs]
    whole = whole_of(clean, runs, rig, band)
    if whole is not None and whole.rig.rate_hz != rig.rate_hz:
        clean = replace(clean, remarks=(*clean.remarks, _loop_runs(whole, rig)))
        rig = whole.rig
    if effects is None:
        low, high = float(lines.frequency[0]), float(lines.frequency[-1])
        if whole is not None:  # whole records reach to where no response could be estimated
            first, last = whole.records.band
            low, high = min(low, first or low), max(high, last)  # a band may begin at 0 Hz
        effects = table(rig, low, high, signed=signed, recorded_hz=trusted[0].rate_hz)
    alone = len(clean.sensors(rig)) < 2  # what all sensors have is that one's
    effects = [
        e
        for e in clean.competing(effects)
        if not is_stated(e, rig) and not (alone and e.site == EVERY_SENSOR)
    ]
    by_line = Search(rig, seen, at, effects, progress=progress)
    return Case(clean, trusted, runs, lines, by_line, decide, show, whole=whole)


def _loop_runs(whole: Whole, rig: Rig) -> str:
    """That the loop was found to run at another rate than the rig file has it, in words."""
    commands = " and ".join(x.command for x in whole.wired.inputs)
    were = "were" if len(whole.wired.inputs) > 1 else "was"
    return (
        f"{commands} {were} recorded as a meter sees it, and the loop runs at "
        f"{whole.rig.rate_hz:g} Hz, {whole.every} times for each sample: that is how late its own "
        f"law is shown; the rig file states {rig.rate_hz:g} Hz"
    )
