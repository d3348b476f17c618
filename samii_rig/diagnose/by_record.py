"""The diagnosis of whole records: linear physics by every sample, forces by the levels' lines."""

from __future__ import annotations

from dataclasses import replace

from samii_rig.diagnose import judge as verdict
from samii_rig.diagnose.by_line import at_first, settled
from samii_rig.diagnose.judge import Judgement
from samii_rig.diagnose.nonlinear import compete
from samii_rig.diagnose.nonlinear_search import ForceSearch, compete_on_records
from samii_rig.diagnose.records import TURN, RecordSearch, Whole
from samii_rig.diagnose.result import Diagnosis
from samii_rig.diagnose.stages import Case, Progress, Shown, told
from samii_rig.errors import EstimateError, SamiiRigError

RIVALS = 4  # explanations of the records that forces must beat
MORE = 5.0  # standard deviations of chi-square beyond which it is more than noise


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


def by_records(case: Case, search: RecordSearch, progress: Progress) -> Diagnosis | None:
    """What whole records say; None where levels differ grossly and no force is found by which."""
    nominal = search.nominal.fitted
    first, bands = search.ratio(nominal), search.bands(nominal)
    progress("what is missing")
    # Linear effects bend towards what no linear rig does: a force comes before pairs of them.
    search.run(briefly=True)
    progress("amplitude levels")
    linear, forced = search, forces_on(search)
    if case.search.lines.torn():
        if forced is None:
            return None
    elif forced is None or not forced.is_enough():
        search.run()
        forced = None if forced is None else forces_on(search)
    progress("what cannot be told apart")
    if forced is not None:
        search = forced
        first, bands = search.ratio(search.nominal.fitted), search.bands(search.nominal.fitted)
    judged = verdict.judge(search)
    nominal, best = search.nominal.fitted, judged.best
    plain, after, gap = search.shown(nominal, best.fitted)
    if any(e.quasi is not None for e in best.effects) and gap.low > 0:
        # Computed in time, and seen on lines that it was not fitted to.
        judged = verdict.confirmed(judged)
    judged = verdict.shown(judged, gap, judged.evidence.drop / (TURN - 1))
    judged, said = (judged, ()) if forced is not None else _consistent(search, judged)
    if judged.verdict == "unknown":
        if case.search.lines.torn():
            return None
        if (found := on_levels(case, linear, progress)) is not None:
            return found
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
    clean = replace(case.clean, told=tuple(w for w in case.clean.told if w not in of_lines))
    return told(replace(case, clean=clean), search, judged, shown, said)


def forces_on(search: RecordSearch) -> ForceSearch | None:
    """The search among forces, where one explains the records best; None where none does, or where
    the rig has no partial fractions in which it could be computed."""
    try:
        return compete_on_records(search)
    except SamiiRigError:
        return None


def on_levels(case: Case, search: RecordSearch, progress: Progress) -> Diagnosis | None:
    """What the lines of each level say, if a force among them wins, alone or beside linear effects:
    of whole records nothing is known of both together."""
    before = at_first(case)
    for explanation in search.ranked()[:RIVALS]:
        there = search.at_lines(explanation)
        case.search.keep(there.effects, there.fitted)
    if compete(case.search, case.responses, case.runs) is None:
        return None
    return settled(case, before, progress)


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
