"""`diagnose`: from frequency responses and a rig file to what was left out of it.

found = diagnose(estimate(recordings), rig)
found.verdict, found.causes, found.lines(), found.plain()
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from samii_rig.diagnose import answer, findings
from samii_rig.diagnose import judge as verdict
from samii_rig.diagnose.classes import without_twins
from samii_rig.diagnose.effect import Effect
from samii_rig.diagnose.locate import traces
from samii_rig.diagnose.measured import measured, usable
from samii_rig.diagnose.model import grid
from samii_rig.diagnose.nonlinear import compete, next_levels, settle
from samii_rig.diagnose.plan import next_experiment
from samii_rig.diagnose.result import Diagnosis
from samii_rig.diagnose.rigfile import explained
from samii_rig.diagnose.search import Search
from samii_rig.diagnose.vocabulary import hypotheses
from samii_rig.rig.schema import Rig
from samii_rig.types import FrequencyResponse, Recording

ALTERNATIVES = 6
TWIN_POINTS = 40

Progress = Callable[[str], None]


def table(rig: Rig, low_hz: float, high_hz: float) -> list[Effect]:
    """All effects that the table knows on this rig, structural twins as one."""
    f = np.geomspace(low_hz, high_hz, TWIN_POINTS)
    return without_twins(rig, hypotheses(rig, low_hz, high_hz), f)


def diagnose(
    responses: Sequence[FrequencyResponse],
    rig: Rig,
    *,
    band: tuple[float, float] | None = None,
    effects: Sequence[Effect] | None = None,
    progress: Progress = lambda _stage: None,
    runs: Sequence[Recording] = (),
) -> Diagnosis:
    """What `rig` leaves out, as far as `responses` tell.

    Parameters
    ----------
    responses : from `samii_rig.signal.estimate`, all levels and experiments together.
    band : Hz, where the model is held against them.
    effects : the table of hypotheses; None for the whole vocabulary.
    progress : is told each stage as it begins.
    runs : recordings on whose inputs a nonlinear force is confirmed by simulation.

    Raises InputError and EstimateError as `samii_rig.identify.data.collect` does.
    """
    progress("nominal model")
    clean = findings.sound(responses, rig, band)
    sound = usable(clean.responses)
    whole = measured(sound, rig, band)
    seen, decide, show = whole.splits()
    at = grid(rig, whole.frequency, whole.sensor, whole.actuator)
    low, high = float(whole.frequency[0]), float(whole.frequency[-1])
    if effects is None:
        effects = table(rig, low, high)
    search = Search(rig, seen, at, clean.competing(effects))
    nominal = search.nominal.fitted
    first = search.ratio(nominal)
    bands = answer.bands(search, nominal)
    progress("what is missing")
    # Linear effects bend towards what no linear rig does: a force comes first where levels differ.
    gross = seen.torn()
    search.run(briefly=gross)
    progress("amplitude levels")
    if compete(search, sound, runs) is None and gross:
        search.run()
    progress("what cannot be told apart")
    judged = verdict.judge(search, decide)
    nominal = search.nominal.fitted
    best = judged.best
    there = search.grid.at(show.frequency, show.level)
    before, after = (f.model.response(f.x, there) for f in (nominal, best.fitted))
    gap, due = answer.gap(show, before, after), answer.due_there(show, before, after)
    holds, said = settle(judged, search, sound, runs)
    judged = verdict.shown(verdict.confirmed(judged) if holds else judged, gap, due)
    if clean.doubt:
        judged = verdict.doubted(judged, clean.doubt.most)
    if len(set(whole.outputs)) == 1 and len(best.effects) > 1:
        # Trials of four channels say nothing of how often one curve tells several places apart.
        judged = verdict.doubted(judged, "ambiguous")
    shown = answer.causes_of(judged.classes[0], judged) if judged.verdict in verdict.SAID else ()
    told = list(clean.told)
    if judged.verdict != "no_mismatch" or best.effects:
        told += answer.told(judged)
    told += (*said, *clean.lacks)
    why, experiment = next_levels(judged) or next_experiment(search, judged)
    if clean.doubt and judged.verdict != "no_mismatch":
        why, experiment = clean.doubt.why, clean.doubt.experiment
    ranked = list(zip(judged.classes, judged.shares, strict=True))[len(shown) > 0 :]
    alternatives = tuple(
        (answer.causes_of(c, judged, share), share)
        for c, share in ranked[:ALTERNATIVES]
        if share >= answer.SHOWN and judged.verdict != "no_mismatch"
    )
    return Diagnosis(
        verdict=judged.verdict,
        chi2_per_dof=first,
        threshold=verdict.threshold(seen),
        bands=bands,
        sites=tuple(answer.sites(judged)) if judged.verdict != "no_mismatch" else (),
        causes=shown,
        alternatives=alternatives,
        nominal=(search.ratio(nominal), show.per_dof(before)),
        with_causes=(search.ratio(best.fitted), show.per_dof(after)),
        noise_floor=1.0,
        gap=gap,
        not_physics=tuple(dict.fromkeys(told)),
        why=why,
        experiment=experiment,
        outside=judged.outside,
        rig=explained(best.fitted) if best.effects else None,
        traces=traces(search, judged) if judged.verdict != "no_mismatch" else (),
        evidence={
            **judged.evidence.plain(),
            "beyond": judged.beyond is not None,
            "causes": [c.plain() for c in answer.causes_of(judged.classes[0], judged)],
        },
    )
