"""The diagnosis of responses line by line."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from samii_rig.diagnose.fit.agreeing import SeveralStates, several_states_of_lines
from samii_rig.diagnose.fit.explanations import threshold
from samii_rig.diagnose.fit.usual import LINES_TAKE, takes
from samii_rig.diagnose.result import Diagnosis, Used
from samii_rig.diagnose.verdict import answer
from samii_rig.diagnose.verdict import judge as verdict
from samii_rig.diagnose.verdict.force_words import distorted
from samii_rig.diagnose.verdict.stages import Case, Shown, diagnosis_of, of_states

DIFFER = (
    "levels differ; give the recordings: friction, play, hardening and the like are told from "
    "whole records alone"
)


def by_lines(case: Case) -> Diagnosis:
    """What the lines of all responses say; nothing is named where levels differ by more than noise,
    as linear effects bend towards what no linear rig does."""
    search, show = case.search, case.show
    nominal = search.nominal.fitted
    first, bands = search.ratio(nominal), answer.bands(search, nominal)
    level_dependent = search.lines.depends_on_level()
    search.begin("what is missing", takes(LINES_TAKE, case.lines.n) if case.runs else None)
    search.run(briefly=level_dependent)
    search.begin("what cannot be distinguished")
    judged = verdict.judge(search, case.decide)
    nominal, best = search.nominal.fitted, judged.best
    there = search.grid.at(show.frequency, show.level)
    plain, after = (f.model.response(f.x, there) for f in (nominal, best.fitted))
    gap, due = answer.gap(show, plain, after), answer.due_there(show, plain, after)
    judged = verdict.shown(judged, gap, due)
    if level_dependent:
        judged = replace(judged, verdict="unknown")
    several = _states(case)
    for one in several:
        judged = verdict.of_several_states(judged, one.part)
    shown = Shown(
        first=first,
        threshold=threshold(search.spread),
        bands=bands,
        nominal=(search.ratio(nominal), show.per_dof(plain)),
        with_causes=(search.ratio(best.fitted), show.per_dof(after)),
        gap=gap,
        used=Used(case.lines.n, sum(r.frequency.size for r in case.responses)),
    )
    clean = case.clean
    remarks = (DIFFER, *distorted(case.responses)) if level_dependent else ()
    if clean.refusal is None and clean.guessed is not None:
        found = diagnosis_of(
            case, search, judged, shown, (*remarks, clean.guessed.why), clean.guessed
        )
    else:
        found = diagnosis_of(case, search, judged, shown, remarks, clean.refusal)
    return of_states(found, several)


def _states(case: Case) -> list[SeveralStates]:
    """The states that files of responses are of, where they are of more than one."""
    if len(case.files) < 2:
        return []
    search, lines = case.search, case.lines
    search.begin("whether the recordings agree")
    fitted = search.nominal.fitted
    at = search.grid.at(lines.frequency, lines.level)
    chi2 = float(np.sum(lines.chi_square(fitted.model.response(fitted.x, at))))
    left = chi2 - float(np.sum(lines.expected))
    several = several_states_of_lines(case.files, lines, left, search.rig)
    return [] if several is None else [several]
