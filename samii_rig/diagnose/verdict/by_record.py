"""The diagnosis of whole records, by every sample."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

from samii_rig.diagnose.data.findings import Checked
from samii_rig.diagnose.data.measured import DIFFER
from samii_rig.diagnose.fit.agreeing import Given, SeveralStates, several_states
from samii_rig.diagnose.fit.discrepant import DiscrepantSearch
from samii_rig.diagnose.fit.exact import wrong_lengths
from samii_rig.diagnose.fit.explanations import FIVE, Explanation, threshold
from samii_rig.diagnose.fit.own_noise import not_read
from samii_rig.diagnose.fit.ranking import ranking
from samii_rig.diagnose.fit.record_search import RecordSearch
from samii_rig.diagnose.fit.records import TEST_TURN, Whole
from samii_rig.diagnose.fit.rigfile import explained
from samii_rig.diagnose.fit.screen import Screen
from samii_rig.diagnose.forces.fits import of_data
from samii_rig.diagnose.forces.laws import STOPS
from samii_rig.diagnose.forces.search import ForceSearch, compete_on_records
from samii_rig.diagnose.forces.variation import (
    BySpring,
    Variation,
    of_its_own,
    uneven_spring,
    variation,
)
from samii_rig.diagnose.result import Band, Diagnosis, Exact, Gap, Used, percent
from samii_rig.diagnose.verdict import judge as verdict
from samii_rig.diagnose.verdict.judge import Judgement
from samii_rig.diagnose.verdict.odd_sensor import describe, odd_sensor
from samii_rig.diagnose.verdict.stages import Case, Shown, diagnosis_of, of_states
from samii_rig.diagnose.verdict.stated_noise import (
    MoreNoise,
    fits_too_well,
    more_noise,
    unfiltered,
)
from samii_rig.errors import EstimateError, SamiiRigError
from samii_rig.rig.schema import Rig
from samii_rig.signal import welch
from samii_rig.signal.steps import FEW
from samii_rig.types import Recording

EXHAUSTED = (
    "not every force that may act was computed to the end, as the records are long; shorter or "
    "fewer records, or a narrower band, would let it"
)
# Logarithm of the odds of a stiffness that varies, from which that is missing where nothing else
# is: noise alone reaches it in 0.1 % of recordings. Of 309 in which nothing was hidden three had
# 4.9 to 6.6, as these odds say; none of 27 in which one varied had less than 9.
VARIES = 7.0


def whole_of(
    clean: Checked, runs: Sequence[Recording], rig: Rig, band: tuple[float, float] | None
) -> Whole | None:
    """The records, where they can be used as they are."""
    if not runs or clean.mended or clean.refusal:
        return None
    try:
        sensors = clean.sensors(rig)
        return Whole.of(runs, rig, band, sensors, clean.samples, hidden=clean.hidden)
    except EstimateError:
        return None


def on_records(case: Case) -> RecordSearch | None:
    """The search on whole records, where there are any.

    Raises EstimateError where they cannot be searched, and Welch's windows, which leak, are all
    that there is beside them.
    """
    try:
        return None if case.whole is None else RecordSearch(case.whole, case.search)
    except EstimateError:
        if all(r.estimator in welch.METHODS for r in case.responses):
            raise
        return None


def by_records(case: Case, search: RecordSearch) -> Diagnosis:
    """What whole records say."""
    first, bands = _at_first(search)
    search.begin("what is missing")
    # Linear effects bend towards what no linear rig does: a force comes before pairs of them.
    search.run(briefly=True)
    if (wrong := wrong_lengths(search)) is not None:
        return _of_lengths(case, search, first, bands, *wrong)
    search.begin("amplitude levels")
    forces, untried = forces_on(search)
    forced = _winning(forces)
    level_dependent = case.search.lines.depends_on_level()
    in_pairs = forced is None or _may_be_linear(forced, level_dependent=level_dependent)
    varied = _varying(forces, forced, search, len(case.runs)) if in_pairs else None
    if varied is None and (beyond := _beyond(forces, search)) is not None:
        wide = replace(case, whole=beyond)
        if (again := on_records(wide)) is not None:
            return by_records(wide, again)
    if varied is None and in_pairs:
        forces, untried = _beside_pairs(search, forces, forced, untried)
        forced = _winning(forces)
    search.begin("what cannot be distinguished")
    if forced is not None:
        first, bands = _at_first(forced)
    looked = varied or _of_best(forces, forced, search)
    given = Given.of(search, case.runs, case.clean.samples)
    several, doubted = None, False
    if forces is not None and varied is None:
        if _without_force(looked.judged):
            several = _several(search, [given], None)
        search.begin("whether stiffnesses are constant")
        looked = _constant(forces, forced or search, looked, len(case.runs), differ=bool(several))
        said, looked = looked.judged.verdict, _or_uneven(forces, looked)
        doubted = looked.judged.verdict != said
    last = forced or search
    if not doubted and _not_explained(looked.judged, forced, search):
        search.begin("what is missing, beside a discrepancy")
        last = discrepant = DiscrepantSearch(search)
        discrepant.settle()
        looked = _consistent(discrepant, _looked(discrepant))
        if looked.judged.verdict == "no_mismatch":  # beside what no law describes
            looked = _unknown(looked)
    looked = replace(looked, remarks=(*looked.remarks, *untried))
    found = _agreeing(case, last, first, bands, looked, [given], several=several)
    return found if doubted else _of_sensor(case, found)


def _beside_pairs(
    search: RecordSearch,
    forces: ForceSearch | None,
    forced: ForceSearch | None,
    untried: tuple[str, ...],
) -> tuple[ForceSearch | None, tuple[str, ...]]:
    """Pairs of linear effects, and the search among forces beside the best of these, as of
    `forces_on`; the one before where a single effect does as well. forced : as of `_winning`."""
    search.begin("what is missing, in pairs")
    single = search.ranked()[0].key
    search.run()
    search.begin("amplitude levels, beside pairs")
    best = search.ranked()[0]
    more = search.ratio(best.fitted) > threshold(search.spread)
    if best.key == single or (forced is None and not more):
        return forces, untried
    # What a force did beside a single effect competes with what it does beside pairs.
    beside, untried = forces_on(search, forced.ranked()[:1] if forced else ())
    if beside is not None and forces is not None:
        both = [u for u in (beside.uneven, forces.uneven) if u is not None]
        beside.uneven = max(both, key=lambda u: u[1], default=None)
    return beside or forces, untried


def _of_best(
    forces: ForceSearch | None, forced: ForceSearch | None, search: RecordSearch
) -> _Looked:
    """What is judged of the best explanation. forced : as of `_winning`."""
    if forced is None:
        return _even(forces, search, _consistent(search, _looked(search)))
    looked = _looked(forced)
    return replace(looked, remarks=(*looked.remarks, EXHAUSTED)) if forced.exhausted else looked


def _varying(
    forces: ForceSearch | None, forced: ForceSearch | None, search: RecordSearch, files: int
) -> _Looked | None:
    """A stiffness that varies, where no linear response explains all records and it leaves no more
    than noise: nothing is left for a pair of effects, nor to be seen beyond what is excited; None
    else. forced : as of `_winning`. files : as of `_constant`."""
    if forces is None or not _disagree(search):
        return None
    search.begin("whether stiffnesses are constant")
    looked = _constant(forces, forced or search, _of_best(forces, forced, search), files)
    varies = looked.judged.varies
    told = looked.judged.verdict == "named" and isinstance(varies, Variation) and varies.inside
    return looked if told else None


def _of_sensor(case: Case, found: Diagnosis) -> Diagnosis:
    """The same, but what is unknown with the one sensor that it may be the fault of."""
    if found.verdict != "unknown" or found.exact or found.states or not (odd := odd_sensor(case)):
        return found
    why, experiment = describe(odd)
    return replace(found, why=why, experiment=experiment, gain=None)


def _not_explained(judged: Judgement, forced: ForceSearch | None, search: RecordSearch) -> bool:
    """Whether all that was tried leaves much of the mismatch, and more than noise. A force that is
    told all the same keeps its answer: it is told by how levels differ, and no response that is
    the same at all of them does that. So does one beside which only what no response explains is
    left: of that a discrepancy of the response knows nothing."""
    if not judged.partly or judged.varies is not None:
        return False
    linear = search.ratio(search.ranked()[0].fitted) > threshold(search.spread)
    return forced is None or (linear and judged.verdict not in verdict.WITH_CAUSES)


def by_samples(
    case: Case,
    search: RecordSearch,
    first: float,
    bands: tuple[Band, ...],
    given: Sequence[Given],
    left: float | None = None,
) -> Diagnosis:
    """The answer, once all linear explanations of the records were tried. first, bands : what the
    refitted nominal model left before, in all and by band. given : the recordings that are taken
    for those of one state, for each; left : as of `several_states`."""
    search.begin("what cannot be distinguished")
    looked = _consistent(search, _looked(search))
    return _agreeing(case, search, first, bands, looked, given, left)


def _agreeing(
    case: Case,
    search: RecordSearch,
    first: float,
    bands: tuple[Band, ...],
    looked: _Looked,
    given: Sequence[Given],
    left: float | None = None,
    *,
    several: Sequence[SeveralStates] | None = None,
) -> Diagnosis:
    """The answer, with what the recordings of one state differ by, where they are of several.
    several : these, if they are known."""
    # What was found to differ from record to record is what they do not agree in.
    between = looked.judged.verdict in verdict.WITH_CAUSES and looked.judged.between
    if between:
        several = []
    elif several is None:
        several = _several(search, given, left)
    for one in several:
        looked = replace(looked, judged=verdict.of_several_states(looked.judged, one.part))
    return of_states(_answer(case, search, first, bands, looked), several)


def _several(
    search: RecordSearch, given: Sequence[Given], left: float | None
) -> Sequence[SeveralStates]:
    """As of `several_states`."""
    if any(len(one.runs) > 1 for one in given):
        search.begin("whether the recordings agree")
    return several_states(given, left)


@dataclass(frozen=True, slots=True)
class _Looked:
    """What was judged, with chi-square per degree of freedom on the test lines by the nominal
    model and with the causes, the gap closed there, and what else there is to say."""

    judged: Judgement
    plain: float
    after: float
    gap: Gap
    remarks: tuple[str, ...] = ()


def _looked(search: RecordSearch) -> _Looked:
    judged = verdict.judge(search)
    plain, after, gap = search.shown(search.nominal.fitted, judged.best.fitted)
    if not _without_force(judged) and gap.low > 0:
        # Computed in time, and seen on lines that it was not fitted to.
        judged = verdict.confirmed(judged)
    judged = verdict.shown(judged, gap, judged.evidence.drop / (TEST_TURN - 1))
    return _Looked(judged, plain, after, gap)


def _unknown(looked: _Looked) -> _Looked:
    return replace(looked, judged=replace(looked.judged, verdict="unknown"))


def _at_first(search: RecordSearch) -> tuple[float, tuple[Band, ...]]:
    """What the refitted nominal model leaves, in all and by band."""
    return search.ratio(search.nominal.fitted), search.bands(search.nominal.fitted)


def _used(search: RecordSearch) -> Used:
    """As of the search, and sensors of which nothing is read at some lines."""
    used = search.used()
    hardly = [
        (name, f"it moves by {FEW:g} of its steps or less at {percent(part)} of the lines: there "
         "nothing is read of it")
        for name, part in not_read(search).items()
    ]  # fmt: skip
    return replace(used, left_out=(*used.left_out, *hardly))


def _answer(
    case: Case,
    search: RecordSearch,
    first: float,
    bands: tuple[Band, ...],
    looked: _Looked,
) -> Diagnosis:
    nominal, best = search.nominal.fitted, looked.judged.best
    shown = Shown(
        first=first,
        threshold=threshold(search.spread),
        bands=bands,
        nominal=(search.ratio(nominal), looked.plain),
        with_causes=(search.ratio(best.fitted), looked.after),
        gap=looked.gap,
        used=_used(search),
    )
    if isinstance(varies := looked.judged.varies, Variation):
        shown = replace(shown, with_causes=varies.after)
    if noise := more_noise(search):
        looked = _in_noise(looked, noise, shown)
    if why := unfiltered(search, looked.judged.best):
        judged = verdict.limited(looked.judged, "unknown")
        looked = replace(looked, judged=judged, remarks=(why, *looked.remarks))
    if any(e.physics == "kind_error" for e in looked.judged.best.effects):
        # Its other fields were written for another sensor: its place, its filter.
        looked = replace(looked, judged=verdict.limited(looked.judged, "ambiguous"))
    of_lines = case.clean.of_lines
    clean = replace(case.clean, remarks=tuple(w for w in case.clean.remarks if w not in of_lines))
    return diagnosis_of(replace(case, clean=clean), search, looked.judged, shown, looked.remarks)


def _in_noise(looked: _Looked, noise: MoreNoise, shown: Shown) -> _Looked:
    """The same, with a remark on noise that is more than the sensors'. Where it may be anything
    nothing is said to be missing or not, and no cause is sure."""
    looked = replace(looked, remarks=(*looked.remarks, noise.describe()))
    if isinstance(looked.judged.varies, Variation):
        return looked
    nothing = looked.judged.verdict == "no_mismatch"
    if fits_too_well(shown.first, shown.threshold) or (nothing and noise.far_more):
        return _unknown(looked)
    if noise.far_more:
        return replace(looked, judged=verdict.limited(looked.judged, "ambiguous"))
    return looked


def _of_lengths(
    case: Case,
    search: RecordSearch,
    first: float,
    bands: tuple[Band, ...],
    wrong: tuple[Exact, ...],
    freed: RecordSearch,
) -> Diagnosis:
    """The answer where lengths of the rig file are wrong. freed : the search with these free."""
    nominal, fitted = search.nominal.fitted, freed.nominal.fitted
    plain, after, gap = freed.shown(nominal, fitted)
    shown = Shown(
        first=first,
        threshold=threshold(search.spread),
        bands=bands,
        nominal=(search.ratio(nominal), plain),
        with_causes=(freed.ratio(fitted), after),
        gap=gap,
        used=search.used(),
    )
    looked = _Looked(verdict.judge(freed), plain, after, gap)
    found = diagnosis_of(case, freed, looked.judged, shown)
    measured = " and ".join(one.parameter for one in wrong)
    which = "this number does" if len(wrong) == 1 else "these numbers do"
    return replace(
        found,
        verdict="unknown",
        exact=wrong,
        rig=explained(fitted),
        could_hide=(),
        experiment=f"measure {measured}, correct the rig file and diagnose again",
        why=f"no single effect explains the recordings, and {which}",
        gain=None,
    )


def forces_on(
    search: RecordSearch, known: Sequence[Explanation] | None = None
) -> tuple[ForceSearch | None, tuple[str, ...]]:
    """The search among forces; None where the rig has no partial fractions in which they could be
    computed, and that in words. known : as of `compete_on_records`."""
    try:
        return compete_on_records(search, known), ()
    except SamiiRigError as error:
        return None, (f"not all forces that depend on amplitude were searched for: {error}",)


def _beyond(forces: ForceSearch | None, search: RecordSearch) -> Whole | None:
    """The records on lines that nothing excites for long, too, where a linear effect shows there by
    more than any on those that something does: a lightly damped mode rings where a record begins at
    once, far above its band. What is wrong with the data is known from the band, and stays so.
    None where that is not so."""
    whole = search.whole
    if forces is None or forces.won or not isinstance(whole, Whole) or whole.asked:
        return None
    plain, meant = forces.linear_part(of_data(forces))
    screen = Screen.of(plain.problem, meant.fitted)
    ranked = ranking(screen, search.table, meant.effects, plain.model)
    within = of_data(search).fitted.cost - search.ranked()[0].fitted.cost
    shows = any(gain > 2 * within + search.critical_value_of((e,)) for gain, e, _ in ranked)
    return whole.beyond() if shows else None


def _may_be_linear(forced: ForceSearch, *, level_dependent: bool) -> bool:
    """Whether pairs of linear effects may do what the best explanation with a force does: beside a
    linear effect a part that never slips is a spring. level_dependent : no linear response explains
    all."""
    real = [e for e in forced.ranked()[0].effects if e.physical]
    return len(real) > 1 or not (level_dependent or forced.is_enough())


def _winning(forces: ForceSearch | None) -> ForceSearch | None:
    """The same where a force explains the records best."""
    return forces if forces is not None and forces.won else None


def _or_uneven(forces: ForceSearch, looked: _Looked) -> _Looked:
    """The same, but nothing is missing alone where no force explains some lines and not others: one
    that does is another than any in the table, or acts beside what moved the rig unrecorded. Nor is
    another cause told that explains less than such a force."""
    if forces.uneven is None or not _without_force(looked.judged):
        return looked
    effect, fall = forces.uneven
    if looked.judged.verdict == "named" and isinstance(looked.judged.varies, Variation):
        return looked  # it was found again in what it was not fitted to
    if fall < _explained(forces, looked.judged):
        return looked
    name = f"{effect.physics.replace('_', ' ')} at {effect.site}"
    why = (
        f"{name} explains {math.sqrt(fall):.3g} sigma, but not of all lines alike as it would: "
        "a force that no row has, or one beside what disturbed the rig"
    )
    return replace(_unknown(looked), remarks=(why, *looked.remarks))


def _explained(forces: ForceSearch, judged: Judgement) -> float:
    """Of chi-square, what is told explains by the likelihood of the forces, 0 where nothing is."""
    if judged.verdict not in verdict.WITH_CAUSES:
        return 0.0
    if judged.varies is not None:
        return judged.evidence.drop
    meant = verdict.as_meant(forces, judged.best)
    ends = [forces.refitted(e.effects, e, far=False) for e in (meant, judged.best)]
    before, after = (end.chi2 if end is not None else math.nan for end in ends)
    own = before - after
    return own if math.isfinite(own) else judged.evidence.drop


def _constant(
    forces: ForceSearch,
    search: RecordSearch,
    looked: _Looked,
    files: int,
    *,
    differ: bool = False,
) -> _Looked:
    """The same, but where a stiffness varies that is the answer: in the place of another that the
    data make less likely, or in words beside it. What no row explains as well as a spring that is
    not the same to both sides is unknown. search : what was looked at. files : recordings; differ :
    whether they do although the answer leaves no more than noise: it had that for noise.
    """
    judged = looked.judged
    base = verdict.as_meant(forces, judged.best)
    own = verdict.as_meant(search, judged.best)
    # At the noise itself: while a mismatch is large all weights are smaller, a variation's not.
    rival = max(judged.best.weight - own.weight, (own.fitted.cost - judged.best.fitted.cost) / 2)
    seen = None if _is_linear(judged) and not differ else BySpring.of(forces, base)
    sides = uneven_spring(seen) if seen else None
    # What is in no row is not told of less than what is, nor of a spring that a stop is named at.
    stops = {e.site for e in judged.best.effects if e.physics == STOPS.physics}
    if (
        sides is not None
        and sides.site not in stops
        and sides.chi2 > max(2 * rival, judged.evidence.worth)
    ):
        looked = replace(looked, remarks=(*looked.remarks, sides.describe()))
        return looked if sides.bent else _unknown(looked)
    physical = any(e.physical for e in judged.best.effects)
    least = rival if physical else max(rival, VARIES)
    # What leaves more than noise has had that for noise: each is held against its own.
    linear = _without_force(judged) and (differ or (physical and judged.partly))
    found = variation(seen, files) if seen and (linear or seen.evidence > least) else None
    if found is not None and linear:
        ahead = found.likelihood - of_its_own(forces, judged.best)
        least = rival = min(rival, found.evidence - ahead)
    if found is not None and found.evidence > least and found.gain > judged.evidence.worth:
        varies = verdict.varying(judged, own, found, max(rival, 0.0))
        return _Looked(varies, found.before[1], found.after[1], found.gap, looked.remarks)
    more = judged.evidence.left > threshold(forces.spread)
    if more and judged.best.effects and judged.best.key != base.key:
        beside = variation(BySpring.of(forces, judged.best), files)
        if beside is not None and beside.closed >= verdict.PARTLY:
            return replace(looked, remarks=(*looked.remarks, beside.describe()))
    return looked


def _even(forces: ForceSearch | None, search: RecordSearch, looked: _Looked) -> _Looked:
    """The same, but unknown where an effect does not explain at all lines what it says that it
    does: a narrow one takes a few lines of what is in no row."""
    judged = looked.judged
    if forces is None or not judged.best.effects or judged.verdict not in verdict.WITH_CAUSES:
        return looked
    if forces.explains_evenly(verdict.as_meant(search, judged.best), judged.best):
        return looked
    return _unknown(looked)


def _is_linear(judged: Judgement) -> bool:
    """Whether a linear response is told and leaves no more than noise: what varies is then beside
    it. Modulations of any phase in every record would do the work of such a response, too."""
    told = judged.verdict in verdict.WITH_CAUSES and not judged.partly
    return told and _without_force(judged)


def _without_force(judged: Judgement) -> bool:
    """Whether what explains the records best is linear."""
    return all(e.force is None for e in judged.best.effects)


def _disagree(search: RecordSearch) -> bool:
    """Whether no linear response explains all records."""
    left, sd = search.inconsistent()
    return left >= 1 + FIVE * sd


def _consistent(search: RecordSearch, looked: _Looked) -> _Looked:
    """The same, but where no linear response explains all records something is missing; and that in
    words."""
    if not _disagree(search):
        return looked
    left, _ = search.inconsistent()
    remarks = (
        f"the records disagree: chi-square per degree of freedom {left:.3g} of what no linear "
        "model can explain, so something depends on amplitude or changed between runs",
    )
    if looked.judged.verdict == "no_mismatch" or left > DIFFER:
        looked = _unknown(looked)
    return replace(looked, remarks=remarks)
