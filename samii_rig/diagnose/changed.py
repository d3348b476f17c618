"""`changed`: what differs between two states of a rig, a part added, worn, taken off or moved.

found = changed(State(estimate(a), a), State(estimate(b), b), rig)
found.verdict, found.causes, found.before, found.lines()
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from samii_rig.diagnose.diagnose import case_of, diagnose
from samii_rig.diagnose.fit.agreeing import Given
from samii_rig.diagnose.fit.explanations import threshold
from samii_rig.diagnose.fit.known import with_known
from samii_rig.diagnose.fit.record_search import RecordSearch
from samii_rig.diagnose.fit.records import Whole
from samii_rig.diagnose.fit.rigfile import explained
from samii_rig.diagnose.fit.states import Both, StatesSearch
from samii_rig.diagnose.fit.usual import STATES, STATES_TAKE, takes
from samii_rig.diagnose.physics.effect import Effect
from samii_rig.diagnose.physics.insert import PREFIX
from samii_rig.diagnose.result import Before, Cause, Diagnosis
from samii_rig.diagnose.verdict.by_record import by_samples
from samii_rig.diagnose.verdict.stages import Case
from samii_rig.errors import EstimateError
from samii_rig.likelihood.excited import within
from samii_rig.progress import Begun, Progress, ahead
from samii_rig.rig.schema import RelativeAngle, Rig
from samii_rig.rig.schema.elements import Branch, flattened, parameters
from samii_rig.types import FrequencyResponse, Recording

WHERE = (" after", " before")  # which recordings are not of one state
COMMON = "common_"  # of the names of what both states have beside the rig file
# Tolerance of what the state before was found to have: a factor of e, as good as none.
FREE_EFFECT = 1.0

Band = tuple[float, float]


@dataclass(frozen=True, slots=True)
class State:
    """One state of a rig: its recordings and their responses, by `samii_rig.signal.estimate`."""

    responses: Sequence[FrequencyResponse]
    runs: Sequence[Recording]


def changed(
    before: State,
    after: State,
    rig: Rig,
    *,
    known: Mapping[str, float] | None = None,
    known_before: Mapping[str, float] | None = None,
    band: Band | None = None,
    effects: Sequence[Effect] | None = None,
    progress: Progress = lambda _stage: None,
) -> Diagnosis:
    """What changed from `before` to `after`, nominal parameters the same in both.

    Parameters
    ----------
    known, known_before : parameters of the rig file, by "element.parameter" and in its units, that
        are known to have these values after, or before.
    band : Hz, where the model is held against both.
    effects : the table of hypotheses, of what both states have and of what changed; None for the
        whole vocabulary.
    progress : is told each stage as it begins.

    Raises InputError as `known.with_known` does; InputError and EstimateError as `diagnose` does;
    EstimateError where the recordings of a state cannot be used whole.
    """
    with_known(rig, known or {})  # what is wrong is said before the work
    first_rig = with_known(rig, known_before or {}, "--known-before")
    n = sum(map(len, [*before.runs, *after.runs]))
    progress(Begun("two states", takes=takes(STATES_TAKE, n)))

    def say(stage: str) -> None:
        progress(ahead("before: ", stage, usual=STATES))

    found = diagnose(
        before.responses, first_rig, band=band, effects=effects, runs=before.runs, progress=say
    )
    common, causes, inputs = _in_both(first_rig, found)
    progress(Begun("both states", STATES["both states"]))
    first = case_of(before.responses, common, band, effects, before.runs, progress=progress)
    # What is known of the state before alone is as the rig file has it after.
    own = with_known(_as_in(common, rig, known_before or {}), known or {})
    second = case_of(
        after.responses, own, band, effects, after.runs, signed=True, progress=progress
    )
    both, start = _both(first, second, band)
    search = StatesSearch(both, second.search, start.nominal.fitted)
    nominal = search.nominal.fitted
    at_first, bands = search.ratio(nominal), search.bands(nominal)
    search.begin("what changed")
    search.run()
    # What both have and no model explains is no part of what changed.
    left = max(nominal.chi2 - search.problem.expected, 0.0) if both.alike else None
    given = _given(search, second, first)
    answer = by_samples(second, search, at_first, bands, given, left)
    names = _named(before), _named(after)
    rig_of_both = explained(search.nominal.fitted)
    before_ = Before(found.verdict, causes, both.alike, names, rig_of_both, inputs)
    return _beside(answer, before_)


def _in_both(rig: Rig, found: Diagnosis) -> tuple[Rig, tuple[Cause, ...], tuple[str, ...]]:
    """The rig of both states by what was found before, which causes are in it, and which inputs
    were not recorded as the rig file states, in words."""
    if found.rig is None:
        return rig, (), ()
    held = {a.name: a.held for a in found.rig.actuator}
    inputs = tuple(
        f"{a.name} was {'' if held[a.name] else 'not '}held between samples in the state before: "
        f"both states are taken so, as held = {str(held[a.name]).lower()} in the rig file states it"
        for a in rig.actuator
        if held[a.name] != a.held
    )
    if found.verdict != "no_mismatch":
        return common_rig(rig, found.rig), found.causes, inputs
    # How an input was recorded is no physics: it is found where nothing is missing, too.
    each = tuple(a.model_copy(update={"held": held[a.name]}) for a in rig.actuator)
    return rig.model_copy(update={"actuator": each}), (), inputs


def _given(search: StatesSearch, second: Case, first: Case) -> list[Given]:
    """The recordings of each state, with what explains them."""
    return [
        Given(case.runs, *of, case.clean.samples, where)
        for case, of, where in zip((second, first), search.by_state(), WHERE, strict=True)
    ]


def _beside(answer: Diagnosis, before: Before) -> Diagnosis:
    """The answer, with what was found before."""
    words = (before.describe(), answer.not_physics)
    # That one side is of several states is said first.
    first_words, others = words[::-1] if answer.states else words
    return replace(answer, before=before, not_physics=(*first_words, *others))


def _as_in(common: Rig, rig: Rig, names: Mapping[str, float]) -> Rig:
    """`common` with these parameters, by "element.parameter", as `rig` has them."""
    own = {e.name: parameters(e) for e in flattened(rig.element)}

    def element(e: Any) -> Any:
        asked = [n.rpartition(".")[2] for n in names if n.rpartition(".")[0] == e.name]
        update: dict[str, Any] = {s: own[e.name][s] for s in asked}
        if isinstance(e, Branch):
            update["element"] = tuple(element(x) for x in e.element)
        return e.model_copy(update=update)

    return common.model_copy(update={"element": tuple(map(element, common.element))})


def _named(state: State) -> tuple[str, ...]:
    return tuple(r.source for r in state.runs if r.source)


def _both(first: Case, second: Case, band: Band | None) -> tuple[Both, RecordSearch]:
    """The records of both states, and the search on those before."""
    common = [name for name in first.sensors if name in second.sensors]
    hidden = first.clean.hidden | second.clean.hidden
    wholes = []
    for name, case in (("before", first), ("after", second)):
        if why := case.not_whole():
            raise EstimateError(f"the recordings {name} cannot be compared sample by sample: {why}")
        rig, samples = case.search.rig, case.clean.samples
        wholes.append(Whole.of(case.runs, rig, band, common, samples, hidden=hidden))
    if wholes[0].wired != wholes[1].wired:
        raise EstimateError("the two states have no command and no sensor in common")
    longest = max(w.records.longest for w in wholes)
    before, after = (replace(w, records=replace(w.records, least=longest)) for w in wholes)
    start = RecordSearch(before, first.search)
    alike = start.ratio(start.nominal.fitted) > threshold(start.spread)
    if alike:
        after = replace(after, records=within(after.records, before.records.band))
    return Both(after, before, alike), start


def common_rig(rig: Rig, found: Rig) -> Rig:
    """The rig with what the state before was found to have: its parameters are free, those of the
    rig file keep their tolerances."""
    own = {e.name: e for e in flattened(rig.element)}

    def renamed(name: str) -> str:
        return name if name in own else name.replace(PREFIX, COMMON, 1)

    def freed(element: Any) -> Any:
        old = parameters(own[element.name]) if element.name in own else {}
        update: dict[str, Any] = {
            symbol: p.model_copy(
                update={"tolerance": old[symbol].tolerance if symbol in old else FREE_EFFECT}
            )
            for symbol, p in parameters(element).items()
        }
        update["name"] = renamed(element.name)
        if isinstance(element, Branch):
            update["element"] = tuple(freed(e) for e in element.element)
        return element.model_copy(update=update)

    sensors = tuple(
        s.model_copy(update={"across": tuple(renamed(n) for n in s.across)})
        if isinstance(s, RelativeAngle)
        else s
        for s in found.sensor
    )
    return found.model_copy(
        update={"element": tuple(freed(e) for e in found.element), "sensor": sensors}
    )
