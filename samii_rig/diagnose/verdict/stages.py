"""What the stages of a diagnosis hand on: the case, and the answer from what was judged."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

from samii_rig.diagnose.data.findings import Checked, Refusal
from samii_rig.diagnose.data.measured import Measured
from samii_rig.diagnose.fit.agreeing import Saved, SeveralStates
from samii_rig.diagnose.fit.exact import off_the_file, wrong_numbers
from samii_rig.diagnose.fit.own_noise import not_read
from samii_rig.diagnose.fit.poses import Posed
from samii_rig.diagnose.fit.records import Whole
from samii_rig.diagnose.fit.refit import Fitted
from samii_rig.diagnose.fit.rigfile import explained
from samii_rig.diagnose.fit.search import Search
from samii_rig.diagnose.fit.states import States
from samii_rig.diagnose.result import Band, Cause, Diagnosis, Exact, Gap, Used
from samii_rig.diagnose.verdict import answer
from samii_rig.diagnose.verdict import judge as verdict
from samii_rig.diagnose.verdict.force_words import next_levels
from samii_rig.diagnose.verdict.hiding import could_hide
from samii_rig.diagnose.verdict.judge import Judgement
from samii_rig.diagnose.verdict.locate import traces
from samii_rig.diagnose.verdict.plan import harder, next_experiment
from samii_rig.types import FrequencyResponse, Recording

ALTERNATIVES = 6  # that are listed at most
MOSTLY = 0.5  # of the lines, at which a sensor is not read, from which driving harder is proposed
REPEAT = (
    "a stiffness that changes is distinguished from a force by when it does",
    "repeat one recording at once, and again after a pause",
)


@dataclass(frozen=True)
class Case:
    """What is to be explained.

    clean : the responses without what is no physics. responses : those that intervals can rest on.
    runs : the recordings. lines : of all responses; search : on those that are fitted; decide,
    show : those that decide, and those that show on what was found. files : the responses of each
    file, where they were kept without their recordings. whole : the records, where they can be used
    as they are.
    """

    clean: Checked
    responses: Sequence[FrequencyResponse]
    runs: Sequence[Recording]
    lines: Measured
    search: Search
    decide: Measured | None
    show: Measured
    files: Sequence[Saved] = ()
    whole: Whole | None = None

    @property
    def levels(self) -> int:
        """How many levels the responses are of."""
        return len({r.level for r in self.responses})

    @property
    def sensors(self) -> tuple[str, ...]:
        """As of `Checked`."""
        return self.clean.sensors(self.search.rig)

    def not_whole(self) -> str:
        """Why these records cannot be held sample by sample against others of one linear rig; ""
        where they can."""
        clean = self.clean
        if not (self.search.lines.depends_on_level() or clean.mended or clean.refusal):
            return ""
        return (*clean.remarks, "they depend on the level as no linear rig does")[0]


@dataclass(frozen=True)
class Shown:
    """How well each model does. first : chi-square per degree of freedom of the nominal one before
    anything was tried; nominal, with_causes : on the lines fitted and on those shown."""

    first: float
    threshold: float
    bands: tuple[Band, ...]
    nominal: tuple[float, float]
    with_causes: tuple[float, float]
    gap: Gap
    used: Used


def of_states(found: Diagnosis, several: Sequence[SeveralStates]) -> Diagnosis:
    """The same, with what recordings of one state differ by, if they do; where that leaves no
    answer, what to do."""
    if not several:
        return found
    words = (*(one.describe() for one in several), *found.not_physics)
    found = replace(found, states=several[0].states, not_physics=words)
    if found.verdict != "unknown":
        return found
    why = "what one model makes of several states is of none of them"
    return replace(found, sites=(), why=why, experiment=several[0].experiment(), gain=None)


def _next(
    case: Case,
    search: Search,
    judged: Judgement,
    refusal: Refusal | None,
    exact: tuple[Exact, ...],
    off: tuple[str, str] | None,
) -> tuple[str, str, float | None]:
    """Why no more may be said, the experiment that would tell, and what it would gain. exact : the
    number of the rig file that is wrong, if one is. off : as of `_beyond_the_file`."""
    if off is not None:
        return *off, None
    if exact:
        them = "it" if len(exact) == 1 else "them"
        why = f"with {them} the model explains the recordings; or something there adds to it"
        names = " and ".join(one.parameter for one in exact)
        return why, f"measure {names}, correct the rig file and diagnose again", None
    if refusal:
        return refusal.why, refusal.experiment, None
    if judged.varies is not None:
        return ("", "", None) if judged.verdict == "named" else (*REPEAT, None)
    found = next_levels(judged) or next_experiment(search, judged, case.levels)
    if found[1] or judged.verdict == "named":
        return found
    few = {name for name, part in not_read(search).items() if part > MOSTLY}
    return *harder(case.runs, search.rig, case.clean.hidden | few), None


def _alternatives(
    judged: Judgement, causes: Sequence[Cause]
) -> tuple[tuple[tuple[Cause, ...], float], ...]:
    """What else is probable beside the causes, with its probability."""
    ranked = list(zip(judged.classes, judged.probabilities, strict=True))[len(causes) > 0 :]
    return tuple(
        (answer.causes_of(c, judged, share), share)
        for c, share in ranked[:ALTERNATIVES]
        if share >= answer.LISTED
    )


def _wrong(search: Search, fitted: Fitted) -> tuple[tuple[Exact, ...], Fitted]:
    """As `wrong_numbers`; none between two states or in several poses, where what is wrong in all
    of them cancels."""
    if isinstance(fitted.model, States | Posed):
        return (), fitted
    return wrong_numbers(search, fitted)


def _beyond_the_file(judged: Judgement) -> tuple[Judgement, tuple[str, str] | None]:
    """The same, not sure where the model with the causes needs numbers far from where the rig file
    states them: it is no whole explanation; and why, and what to do, in words. The numbers of a
    model in which a stiffness that varies does not are bent for that."""
    fitted = judged.best.fitted
    told = judged.verdict in verdict.WITH_CAUSES and judged.varies is None
    if not told or isinstance(fitted.model, States | Posed):
        return judged, None
    if not (off := off_the_file(fitted, fitted.model)):
        return judged, None
    (key, away), *more = off.items()
    others = f", and {len(more)} more numbers are off like it" if more else ""
    why = (
        f"{'.'.join(key)} is {away:.2g} tolerances off the rig file in the model with the causes"
        f"{others}: the file or the causes are wrong"
    )
    what = f"measure {'.'.join(key)}, correct the rig file and diagnose again"
    return verdict.limited(judged, "ambiguous"), (why, what)


def _of_nothing(shown: Shown, *, mended: bool) -> Shown:
    """The same where nothing is missing. mended : whether something is wrong with the data: the
    model is held against what was meant to be recorded."""
    if mended:
        return replace(shown, first=shown.with_causes[0], nominal=shown.with_causes)
    # By the likelihood that the verdict is of, made anew since.
    return replace(shown, first=min(shown.first, shown.nominal[0]))


def _allowed(case: Case, judged: Judgement, refusal: Refusal | None) -> Judgement:
    """The same, no more said than the recordings allow."""
    if refusal:
        judged = verdict.limited(judged, refusal.most)
    if len(set(case.lines.outputs)) == 1 and len(judged.best.effects) > 1:
        # Trials of four channels say nothing of how often one curve distinguishes several places.
        judged = verdict.limited(judged, "ambiguous")
    return judged


def diagnosis_of(
    case: Case,
    search: Search,
    judged: Judgement,
    shown: Shown,
    remarks: Sequence[str] = (),
    refusal: Refusal | None = None,
) -> Diagnosis:
    """The answer. remarks : what else there is to say, in words. refusal : why less may be said."""
    clean, best = case.clean, judged.best
    judged = _allowed(case, judged, refusal)
    own = answer.varying(judged) or answer.causes_of(judged.classes[0], judged)
    judged, off = _beyond_the_file(judged) if own else (judged, None)
    causes = own if judged.verdict in verdict.WITH_CAUSES else ()
    if not causes:
        judged = verdict.without_causes(judged)
    missing = judged.verdict != "no_mismatch"
    if not missing:  # an effect that no more than spares a nominal parameter its move is none
        best = verdict.as_meant(search, best)
        shown = _of_nothing(shown, mended=bool(best.effects and not own))
    found = answer.not_physics_of(judged) if missing or best.effects else []
    words = (*found, *remarks, *clean.remarks, *clean.lacks)
    exact, told = ((), best.fitted) if missing else _wrong(search, best.fitted)
    refused = refusal if missing else None
    why, experiment, gain = _next(case, search, judged, refused, exact, off)
    if exact:
        judged = replace(judged, verdict="unknown")
    untold = judged.varies.describe() if judged.varies is not None and not causes else ""
    return Diagnosis(
        verdict=judged.verdict,
        chi2_per_dof=shown.first,
        threshold=shown.threshold,
        bands=shown.bands,
        sites=tuple(answer.sites(judged)) if missing else (),
        causes=causes,
        alternatives=_alternatives(judged, causes) if missing else (),
        nominal=shown.nominal,
        with_causes=shown.with_causes,
        noise_floor=1.0,
        gap=shown.gap,
        not_physics=tuple(dict.fromkeys(words)),
        why=why,
        experiment=experiment,
        outside=judged.outside,
        rig=explained(told) if best.effects or exact else None,
        traces=traces(search, judged) if missing and judged.varies is None else (),
        moved=answer.moved(told, best.fitted.model),
        could_hide=could_hide(*search.linear_part(best)),
        used=shown.used,
        exact=exact,
        sigma=math.sqrt(max(judged.evidence.drop, 0.0)) if best.effects or judged.varies else 0.0,
        gain=gain,
        evidence={
            **judged.evidence.plain(),
            "beyond": bool(untold),
            "causes": [c.plain() for c in own],
        },
        beyond=untold,
    )
