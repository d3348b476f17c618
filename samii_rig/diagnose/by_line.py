"""The diagnosis of responses line by line, amplitude levels apart where a force is among them."""

from __future__ import annotations

from samii_rig.diagnose import answer
from samii_rig.diagnose import judge as verdict
from samii_rig.diagnose.nonlinear import compete, settle
from samii_rig.diagnose.result import Band, Diagnosis, Used
from samii_rig.diagnose.stages import Case, Progress, Shown, told


def by_lines(case: Case, progress: Progress) -> Diagnosis:
    """What the lines of all responses say."""
    search = case.search
    before = at_first(case)
    progress("what is missing")
    # Linear effects bend towards what no linear rig does: a force comes first where levels differ.
    gross = search.lines.torn()
    search.run(briefly=gross)
    progress("amplitude levels")
    if compete(search, case.responses, case.runs) is None and gross:
        search.run()
    return settled(case, before, progress)


def at_first(case: Case) -> tuple[float, tuple[Band, ...]]:
    """What the refitted nominal model leaves before anything was tried, in all and by band."""
    nominal = case.search.nominal.fitted
    return case.search.ratio(nominal), answer.bands(case.search, nominal)


def settled(case: Case, before: tuple[float, tuple[Band, ...]], progress: Progress) -> Diagnosis:
    """The answer, once all explanations were tried on the lines."""
    search, show = case.search, case.show
    progress("what cannot be told apart")
    judged = verdict.judge(search, case.decide)
    nominal, best = search.nominal.fitted, judged.best
    there = search.grid.at(show.frequency, show.level)
    plain, after = (f.model.response(f.x, there) for f in (nominal, best.fitted))
    gap, due = answer.gap(show, plain, after), answer.due_there(show, plain, after)
    holds, said = settle(judged, search, case.responses, case.runs)
    judged = verdict.shown(verdict.confirmed(judged) if holds else judged, gap, due)
    shown = Shown(
        first=before[0],
        threshold=verdict.threshold(search.spread),
        bands=before[1],
        nominal=(search.ratio(nominal), show.per_dof(plain)),
        with_causes=(search.ratio(best.fitted), show.per_dof(after)),
        gap=gap,
        used=Used(case.lines.n, sum(r.frequency.size for r in case.responses)),
    )
    clean = case.clean
    if clean.doubt is None and clean.guessed is not None:
        return told(case, search, judged, shown, (*said, clean.guessed.why), clean.guessed)
    return told(case, search, judged, shown, said, clean.doubt)
