"""What cannot be distinguished: distances between explanations, in noise units on these data."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from samii_rig.diagnose.fit.explanations import Explanation
from samii_rig.diagnose.fit.refit import Problem, refit
from samii_rig.diagnose.physics.effect import Effect
from samii_rig.diagnose.physics.model import Model
from samii_rig.diagnose.physics.poses import in_pose
from samii_rig.errors import SamiiRigError
from samii_rig.rig.schema import Rig

SAME = 3.0  # noise units below which two explanations are one
RIVAL_NAME = 4.0  # of the logarithm of evidence, below the first, up to which a member is a name
TRUSTED = 0.5  # of the logarithm of evidence between members
AS_PROBABLE = 2.0  # of the logarithm of evidence: a member with less freedom goes first
LEAST_LIKELY = 1e-3  # probability of an explanation that may begin a class of its own
LOOKED_AT = 24  # explanations for which distances are computed
EQUIVALENT = 1e-7  # relative difference of responses below which two effects are one by structure


@dataclass(frozen=True, slots=True)
class Class:
    """Explanations that these data do not distinguish, the most probable first.

    distance : of each from the first, in noise units after its refit to the first's response.
    probability : of the class.
    """

    members: tuple[Explanation, ...]
    distance: tuple[float, ...]
    probability: float

    @property
    def first(self) -> Explanation:
        """The most probable member."""
        return self.members[0]

    @property
    def rivals(self) -> tuple[Explanation, ...]:
        """Members beside the first that the data leave about as probable: one that is near, but
        on the wrong side of the data or for more freedom than they call for, is no other name."""
        return tuple(m for m in self.members[1:] if m.weight > self.first.weight - RIVAL_NAME)

    def parts(self) -> list[tuple[Explanation, float]]:
        """The first and its rivals, each with its part of the class's probability. Their
        evidence counts half: it takes noise and tolerances for exactly what they are said to be."""
        some = (self.first, *self.rivals)
        p = np.exp(TRUSTED * (np.array([m.weight for m in some]) - self.first.weight))
        return list(zip(some, (p / p.sum()).tolist(), strict=True))

    def equivalents(self, effect: Effect) -> list[tuple[str, str]]:
        """Other names for one effect of the first member: its aliases, and what takes its place
        in rivals that differ in nothing else."""
        mine = {e.key for e in self.first.effects}
        out = list(effect.aliases)
        for other in self.rivals:
            new = [e for e in other.effects if e.key not in mine]
            kept = {e.key for e in other.effects} & mine
            if len(new) == 1 and kept == mine - {effect.key}:
                out += new[0].names
        return [n for n in dict.fromkeys(out) if n != effect.name]

    def names(self) -> int:
        """How many different names of one cause the class holds at most; aliases are one.

        A law with more freedom is no further name: it is as near because it holds the first as
        a special case, as a heavy mass on a spring holds a damper.
        """
        mine = {e.key for e in self.first.effects}
        count = 1
        for effect in self.first.effects:
            kept = mine - {effect.key}
            others = {
                e.name
                for m in self.rivals
                for e in m.effects
                if e.key not in mine
                and {x.key for x in m.effects} & mine == kept
                and len(e.unknowns) <= len(effect.unknowns)
            }
            count = max(count, len(others | {effect.name}))
        return count


def distance(a: Explanation, b: Explanation, problem: Problem) -> float:
    """How far b, refitted, stays from what a predicts on the lines of `problem`, noise units."""
    predicted = a.fitted.model.response(a.fitted.x, problem.at)
    there = problem.toward(predicted)
    try:
        end = refit(b.fitted.model, there, b.fitted.x, far=False, steps=12)
    except (SamiiRigError, np.linalg.LinAlgError):
        return math.inf
    return math.sqrt(max(end.cost - a.fitted.penalty, 0.0))


def separation(a: Explanation, b: Explanation, problem: Problem, unit: float = 1.0) -> float:
    """`distance` in noise units of which each is `unit`; inf where b fits worse than a by more
    than a class is wide, so that it cannot be near."""
    if b.fitted.cost - a.fitted.cost > (unit * (SAME + 2.5)) ** 2:
        return math.inf
    return distance(a, b, problem) / unit


def classes(
    ranked: Sequence[Explanation],
    probability: Sequence[float],
    problem: Problem,
    overdispersion: float = 1.0,
) -> list[Class]:
    """Explanations in classes, the most probable class first.

    overdispersion : of `search.Search`; a noise unit is its root where more than noise is left.
    """
    unit = math.sqrt(overdispersion)
    left = list(zip(ranked, probability, strict=True))
    out: list[Class] = []
    while left and len(out) < LOOKED_AT:
        first, p = left.pop(0)
        if out and p < LEAST_LIKELY:
            break
        members, far, total, rest = [first], [0.0], p, []
        for other, q in left[:LOOKED_AT]:
            alike = bool(other.effects) == bool(first.effects)
            d = separation(first, other, problem, unit) if alike else math.inf
            if d < SAME:
                members.append(other)
                far.append(d)
                total += q
            else:
                rest.append((other, q))
        order = _plainest_first(members)
        out.append(
            Class(tuple(members[i] for i in order), tuple(far[i] for i in order), min(total, 1.0))
        )
        left = rest + left[LOOKED_AT:]
    return sorted(out, key=lambda c: -c.probability)


def _plainest_first(members: Sequence[Explanation]) -> list[int]:
    """Indices of the members, first the one with the fewest unknowns of those as probable as the
    first: what a law with more freedom says beyond it the data do not show."""
    near = [i for i, m in enumerate(members) if m.weight > members[0].weight - AS_PROBABLE]
    first = min(near, key=lambda i: (sum(len(e.unknowns) for e in members[i].effects), i))
    return [first, *(i for i in range(len(members)) if i != first)]


def merge_equivalent(
    rig: Rig, table: Sequence[Effect], frequency: np.ndarray, poses: Sequence[Rig] = ()
) -> list[Effect]:
    """The table with effects that are the same by structure as one, its names as aliases. poses :
    the rig in each of several, in all of which they are to be the same."""
    kept: list[tuple[Effect, np.ndarray]] = []
    for effect in table:
        each = [(at, in_pose(effect, at)) for at in poses] or [(rig, effect)]
        try:
            h = np.stack([_at_start(at, own, frequency) for at, own in each])
        except SamiiRigError:
            # What it begins with is no rig, as a link with more mass taken off than it has about
            # its middle: the refit goes elsewhere, and it is equivalent to none.
            h = np.array(np.nan)
        for i, (other, response) in enumerate(kept):
            if len(other.unknowns) == len(effect.unknowns) and _same(h, response):
                names_ = tuple(dict.fromkeys((*other.aliases, *effect.names)))
                names_ = tuple(n for n in names_ if n != other.name)
                kept[i] = (replace(other, aliases=names_), response)
                break
        else:
            kept.append((effect, h))
    return [effect for effect, _ in kept]


def _at_start(rig: Rig, effect: Effect, frequency: np.ndarray) -> np.ndarray:
    """The response of a rig with an effect, from the middle of where its refit starts."""
    trial = Model(rig, (effect,))
    x = np.zeros(trial.n)
    x[trial.n_nominal :] = [math.log(u.middle) for u in effect.unknowns]
    h = trial.chain.with_values(trial.values(x)).response(frequency)
    for factor, theta, _ in trial.passing(x):
        F = factor.value(2j * np.pi * frequency, theta)[0]
        names = [c.name for c in (rig.actuator if factor.kind == "input" else rig.sensor)]
        on = names.index(factor.channel)
        part = (slice(None), slice(None), on) if factor.kind == "input" else (slice(None), on)
        h[part] *= F[:, None]
    return np.asarray(h)


def _same(a: np.ndarray, b: np.ndarray) -> bool:
    return _close(a.flat[-1], b.flat[-1]) and _close(a, b)  # one entry tells most apart


def _close(a: np.ndarray, b: np.ndarray) -> bool:
    size = np.abs(a) + np.abs(b)
    return bool(np.all(np.abs(a - b) <= EQUIVALENT * size + 1e-300))
