"""The diagnosis of whole records: linear physics by every sample, forces by the levels' lines."""

from __future__ import annotations

from dataclasses import replace

from samii_rig.diagnose import judge as verdict
from samii_rig.diagnose.by_line import at_first, settled
from samii_rig.diagnose.judge import Judgement
from samii_rig.diagnose.nonlinear import compete
from samii_rig.diagnose.records import TURN, RecordSearch, Whole
from samii_rig.diagnose.result import Band, Diagnosis
from samii_rig.diagnose.stages import Case, Progress, Shown, told
from samii_rig.errors import EstimateError

MORE = 5.0  # standard deviations of chi-square beyond which it is more than noise
RIVALS = 4  # explanations of the records that forces must beat


def on_records(case: Case, band: tuple[float, float] | None) -> RecordSearch | None:
    """The search on whole records, where they can be used as they are."""
    clean = case.clean
    if not case.runs or clean.mended or clean.doubt:
        return None
    try:
        table = case.search.table
        whole = Whole.of(case.runs, case.search.rig, band, table, clean.sensors, clean.samples)
        return RecordSearch(whole, case.search)
    except EstimateError:
        return None


def by_records(case: Case, search: RecordSearch, progress: Progress) -> Diagnosis:
    """What whole records say."""
    nominal = search.nominal.fitted
    first, bands = search.ratio(nominal), search.bands(nominal)
    progress("what is missing")
    search.run()
    progress("amplitude levels")
    before = at_first(case)
    for explanation in search.ranked()[:RIVALS]:
        there = search.at_lines(explanation)
        case.search.keep(there.effects, there.fitted)
    if compete(case.search, case.responses, case.runs) is not None:
        return settled(case, before, progress)
    return by_samples(case, search, first, bands, progress)


def by_samples(
    case: Case,
    search: RecordSearch,
    first: float,
    bands: tuple[Band, ...],
    progress: Progress,
) -> Diagnosis:
    """The answer, once all explanations of the records were tried. first, bands : what the refitted
    nominal model left before, in all and by band."""
    progress("what cannot be told apart")
    judged = verdict.judge(search)
    nominal, best = search.nominal.fitted, judged.best
    plain, after, gap = search.shown(nominal, best.fitted)
    judged = verdict.shown(judged, gap, judged.evidence.drop / (TURN - 1))
    shown = Shown(
        first=first,
        threshold=verdict.threshold(search.spread),
        bands=bands,
        nominal=(search.ratio(nominal), plain),
        with_causes=(search.ratio(best.fitted), after),
        gap=gap,
        used=search.used(),
    )
    of_lines = case.clean.of_lines
    judged, said = _consistent(search, judged)
    clean = replace(case.clean, told=tuple(w for w in case.clean.told if w not in of_lines))
    return told(replace(case, clean=clean), search, judged, shown, said)


def _consistent(search: RecordSearch, judged: Judgement) -> tuple[Judgement, tuple[str, ...]]:
    """The same, but where no linear response explains all records something is missing; and that in
    words."""
    left, sd = search.inconsistent()
    if left < 1 + MORE * sd:
        return judged, ()
    said = (
        f"the records disagree: chi-square per degree of freedom {left:.3g} of what no linear "
        "model can explain, so something depends on amplitude or changed between runs",
    )
    if judged.verdict == "no_mismatch":
        return replace(judged, verdict="unknown"), said
    return judged, said
