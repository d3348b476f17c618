"""What a run's samples say before it is over.

The project's estimator is asked, of what is whole: segments that are done, of each level together;
and where a level has none yet, of the one that goes on: whole periods, or the part of a sweep that
has been passed. Levels of which nothing new is whole are not estimated again. With several inputs
a level is estimated once each of them was driven at it.
"""

from __future__ import annotations

from collections.abc import Hashable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from samii_rig.errors import EstimateError, InputError
from samii_rig.run.plan import Plan, PlannedSegment
from samii_rig.signal.choose import Method
from samii_rig.signal.estimate import estimate
from samii_rig.signal.spectra import period
from samii_rig.types import Float, FrequencyResponse, Recording, Segment

# Of a sweep that goes on: less than this ratio of frequencies says nothing yet.
LEAST_PASSED = 1.5


@dataclass(frozen=True, slots=True)
class Part:
    """What is estimated together. segments : of the recording. going_on : not whole yet.

    band : Hz that a sweep which goes on has passed, None for all.
    """

    key: Hashable
    segments: tuple[Segment, ...]
    going_on: bool = False
    band: tuple[float, float] | None = None


class SoFar:
    """The responses of a run that goes on; ask `take` once in a while.

    trouble : why the newest part gave no response, "" if all did.
    """

    def __init__(self, plan: Plan) -> None:
        self._plan = plan
        self._known: dict[Hashable, tuple[Part, tuple[FrequencyResponse, ...]]] = {}
        self.trouble = ""
        self.done = 0

    @property
    def growing(self) -> bool:
        """Whether the next segment's samples tell something before it is whole."""
        if len(driven(self._plan)) > 1:
            return False  # nothing is known of one input while the others are not
        if self.done >= len(self._plan.segments):
            return False
        s = self._plan.segments[self.done]
        seen = {_key(x) for x in self._plan.segments[: self.done]}
        return s.dwell is None and s.kind != "transient" and _key(s) not in seen

    def take(self, recording: Recording, start: int) -> bool:
        """Estimate what is new; whether anything was.

        recording : all samples until now. start : number of the plan's first sample.
        """
        parts = list(self._parts(recording, start))
        changed = False
        for part in parts:
            known = self._known.get(part.key)
            if known is not None and known[0] == part:
                continue
            changed = True
            method: Method = "local" if part.band else "auto"
            try:
                found = estimate(
                    [replace(recording, segments=part.segments)], method=method, band=part.band
                )
                self._known[part.key], self.trouble = (part, found), ""
            except (EstimateError, InputError) as error:
                # What was known before stays the best that there is.
                self._known[part.key] = (part, known[1] if known else ())
                self.trouble = str(error)
        return changed

    def responses(self) -> list[tuple[FrequencyResponse, bool]]:
        """All that is known, in the order of the plan, and whether each still goes on."""
        return [(r, part.going_on) for part, found in self._known.values() for r in found]

    @property
    def sound(self) -> list[FrequencyResponse]:
        """Those of levels of which repeats are whole, so that their noise is known from them."""
        return [r for r, going_on in self.responses() if not going_on and r.n_averages > 1]

    @property
    def levels(self) -> tuple[int, int]:
        """Of how many levels there is a sound response, and how many the plan has. A level counts
        once, whatever is driven at it."""
        planned = {(s.level, s.unit) for s in self._plan.segments if s.kind != "transient"}
        return len({(r.level, r.level_unit) for r in self.sound} & planned), len(planned)

    def _parts(self, recording: Recording, start: int) -> Iterator[Part]:
        newest = int(recording.sequence[-1]) + 1 if len(recording) else start
        # A segment may be written down before the last of its samples is on the disk.
        done = [s for s in recording.segments if s.stop <= newest]
        self.done = len(done)
        levels: dict[Hashable, list[Segment]] = {}
        for s in done:
            if s.kind != "transient":
                levels.setdefault(_key(s), []).append(s)
        for key, segments in levels.items():
            if _all_driven(self._plan, key, segments):
                yield Part(key, tuple(segments))
        if self.growing:
            planned = self._plan.segments[self.done]
            before = sum(len(s.u) for s in self._plan.segments[: self.done])
            part = self._going_on(planned, start + before, newest)
            if part is not None:
                yield part

    def _going_on(self, s: PlannedSegment, begin: int, newest: int) -> Part | None:
        first, last = s.recorded or (0, len(s.u))
        n = min(newest - begin, last)

        def part(stop: int, kind: str, band: tuple[float, float] | None) -> Part:
            about = (begin + first, begin + stop, s.level, s.unit, s.repeat)
            segment = Segment(s.name, kind, *about)  # type: ignore[arg-type]
            return Part(_key(s), (segment,), going_on=True, band=band)

        if s.kind == "periodic":
            length = period(_reference(self._plan, s)[first:last])
            whole = max(0, n - first) // length
            return part(first + whole * length, "periodic", None) if whole >= 2 else None
        passed = s.frequency[: max(n, 0)]
        passed = passed[np.isfinite(passed)]
        if not passed.size:
            return None
        low, high = float(passed.min()), float(passed.max())
        return part(n, "single", (low, high)) if high > LEAST_PASSED * low else None


def first(plan: Plan) -> int | None:
    """Samples of the plan after which the first response can be estimated; None where none ever
    can."""
    before, done = 0, dict[Hashable, list[PlannedSegment]]()
    several = len(driven(plan)) > 1
    for s in plan.segments:
        if s.kind != "transient":
            own = done.setdefault(_key(s), [])
            own.append(s)
            if not several:
                return before + _first_of(plan, s)
            if _all_driven(plan, _key(s), own):
                return before + len(s.u)
        before += len(s.u)
    return None


def driven(plan: Plan) -> tuple[str, ...]:
    """The actuators that a plan drives, in its order; those that rest throughout are none."""
    named = {name for s in plan.segments for name in s.excited} or {plan.actuator}
    return tuple(o.actuator for o in plan.outputs if o.actuator in named)


def _all_driven(
    plan: Plan, key: Hashable, done: Sequence[Segment] | Sequence[PlannedSegment]
) -> bool:
    """Whether each input that the plan drives at a level was driven, in as many experiments as
    there are inputs: two that are driven together are not told apart by one."""
    wanted = {name for s in plan.segments if _key(s) == key for name in s.excited}
    return wanted <= {name for s in done for name in s.excited} and len(done) >= len(wanted)


def _reference(plan: Plan, s: PlannedSegment) -> Float:
    """(n,) what drives a segment: u + kp theta_ref, of several outputs of the one driven."""
    if s.u.ndim == 1:
        return s.u + plan.kp * s.theta_ref
    kp = np.array([o.kp for o in plan.outputs])
    return np.asarray((s.u + kp * s.theta_ref).sum(axis=1))


def _first_of(plan: Plan, s: PlannedSegment) -> int:
    begin, last = s.recorded or (0, len(s.u))
    if s.dwell is not None:
        return len(s.u)
    if s.kind == "periodic":
        return min(begin + 2 * period(_reference(plan, s)[begin:last]), last)
    f = s.frequency[:last]
    high = np.fmax.accumulate(f)
    passed = np.flatnonzero(high > LEAST_PASSED * np.fmin.accumulate(f))
    return int(passed[0]) + 1 if passed.size else len(s.u)


def _key(s: Segment | PlannedSegment) -> Hashable:
    return s.kind, s.level, s.unit
