"""One concealed trial as the score sees it: what was hidden, what the diagnosis said.

The truth is written by the plant before any diagnosis; the diagnosis is the JSON object of
`samii-rig diagnose --json`. Both are plain data here, so that neither side's code is needed
to score them, and old results can be scored again.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from scipy.optimize import linear_sum_assignment

Name = tuple[str, str]
"""(physics, site), in the words of the vocabulary and of the rig file."""

NAMED = ("named", "ambiguous")
REFUSED = "refused"  # in place of a verdict: the recordings are none that a diagnosis takes
WHOLE = "whole records"  # a truth's `size_is` where its size is of these
# What plants call a part that has a row in the table under another name.
IN_TABLE = {
    "fractional_damper": "fractional_damping",
    "one_sided_stiffness": "end_stop",
    "quadratic_damper": "quadratic_damping",
    "parametric_stiffness": "stiffness_variation",
    "run_to_run_stiffness": "stiffness_variation",
    "time_varying_joint": "stiffness_variation",
}
ALL_BUT_TENTH = 0.9  # probability that a set of sites holds


@dataclass(frozen=True, slots=True)
class Hidden:
    """One concealed effect: its name, its parameters (SI) by symbol. also : other names that mean
    the same here, by the plant's own account."""

    physics: str
    site: str
    parameters: Mapping[str, float] = field(default_factory=dict)
    also: frozenset[Name] = frozenset()

    @property
    def name(self) -> Name:
        """(physics, site)."""
        return self.physics, self.site

    @property
    def names(self) -> frozenset[Name]:
        """All its names."""
        return self.also | {self.name}

    @property
    def sites(self) -> frozenset[str]:
        """All names of its place."""
        return frozenset(site for _, site in self.names)


@dataclass(frozen=True, slots=True)
class Truth:
    """What a trial conceals.

    kind : `nothing`, `one`, `two`, `outside`, `joints` (every joint gives), `force` (one effect
        that depends on the level), or `varying` (a stiffness that is not constant).
    size : sigma that are left when the nearest smaller explanation has been refitted. whole :
        whether that is of whole records, or of the bursts alone. twins : other sites that a single
        effect might as well be told to be at, by structure. styles : how it was recorded, the
        excitation first.
    """

    kind: str
    seed: int
    effects: tuple[Hidden, ...]
    size: float = 0.0
    twins: Sequence[str] = ()
    whole: bool = False
    plant: str = ""
    rig: str = ""
    styles: Sequence[str] = ()

    def places(self, effect: Hidden) -> frozenset[str]:
        """All names of an effect's site."""
        return effect.sites | frozenset(self.twins if len(self.effects) == 1 else ())

    @classmethod
    def of(cls, data: Mapping[str, Any]) -> Truth:
        """From plain data, as `prove.outcomes` keeps it."""
        effects = tuple(_hidden(e) for e in data["effects"])
        return cls(
            data["kind"], data["seed"], effects, data["size"], tuple(data.get("twins", ())),
            data.get("size_is") == WHOLE, data.get("plant", ""), data.get("rig", ""),
            tuple(data.get("styles", ())),
        )  # fmt: skip


def _hidden(data: Mapping[str, Any]) -> Hidden:
    physics = IN_TABLE.get(data["physics"], data["physics"])
    also = frozenset(map(tuple, data.get("also", ())))
    return Hidden(physics, data["site"], data["parameters"], also)


@dataclass(frozen=True, slots=True)
class Cause:
    """One cause that a diagnosis chose, with everything that it calls equivalent."""

    name: Name
    probability: float
    names: frozenset[Name]
    parameters: Mapping[str, tuple[float, float, float]]
    """value, low, high of each parameter."""


@dataclass(frozen=True, slots=True)
class Answer:
    """The parts of a diagnosis that are scored."""

    verdict: str
    causes: tuple[Cause, ...]
    sites: tuple[tuple[str, float], ...]
    gap_closed: float | None
    sigma: float = 0.0
    """Root of the chi-square of the data that the causes explain."""

    @classmethod
    def of(cls, data: Mapping[str, Any]) -> Answer:
        """From the JSON object of `samii-rig diagnose --json`."""
        causes = tuple(_cause(c) for c in data["causes"])
        sites = sorted(((s["site"], s["probability"]) for s in data["sites"]), key=lambda s: -s[1])
        gap = data["fit"].get("gap_closed")
        sigma = float((data.get("evidence") or {}).get("sigma") or 0.0)
        return cls(data["verdict"], causes, tuple(sites), gap["value"] if gap else None, sigma)

    @property
    def speaks(self) -> bool:
        """Whether it names physics at all, be it up to a class."""
        return self.verdict in NAMED and bool(self.causes)

    def site_set(self) -> tuple[str, ...]:
        """The likeliest sites that hold 90 % together: of one where one thing is missing, of all
        that is stated where several are, each at a site of its own."""
        enough = ALL_BUT_TENTH * max(1.0, sum(p for _, p in self.sites))
        total, out = 0.0, []
        for site, probability in self.sites:
            out.append(site)
            total += probability
            if total >= enough:
                break
        return tuple(out)


def _cause(data: Mapping[str, Any]) -> Cause:
    name = (data["physics"], data["site"])
    twins = [(t["physics"], t["site"]) for t in data.get("equivalent_to", ())]
    values = {
        k: (
            p["value"],
            -math.inf if p["low"] is None else p["low"],
            math.inf if p["high"] is None else p["high"],
        )
        for k, p in data.get("parameters", {}).items()
    }
    return Cause(name, data["probability"], frozenset([name, *twins]), values)


@dataclass(frozen=True, slots=True)
class Trial:
    """A truth and the answer to it. seconds : process time of the diagnosis, 0 if not measured."""

    truth: Truth
    answer: Answer
    seconds: float = 0.0

    def matches(self) -> tuple[tuple[Hidden, Cause], ...]:
        """The pairing of effects and causes in which most names are right, right ones only."""
        return _best(
            self.truth.effects, self.answer.causes if self.answer.speaks else (), _same_name
        )

    @property
    def right(self) -> bool:
        """All effects named up to their declared classes, and nothing beside them."""
        effects, causes = self.truth.effects, self.answer.causes
        if not effects:
            return self.answer.verdict == "no_mismatch"
        found = len(self.matches())
        return self.answer.speaks and found == len(effects) == len(causes)

    @property
    def place_right(self) -> bool:
        """Every effect has a cause of its own at its site, or at one declared equivalent."""
        effects, causes = self.truth.effects, self.answer.causes
        if not causes:  # an unknown may still know the place
            first = {site for site, _ in self.answer.sites[:1]}
            return len(effects) == 1 and bool(first & self.truth.places(effects[0]))
        return len(_best(effects, causes, _same_place)) == len(effects)

    @property
    def place_in_set(self) -> bool:
        """Every effect's site is in the 90 % set, or equivalent to a cause that is."""
        inside = set(self.answer.site_set())
        for cause in self.answer.causes:
            if cause.name[1] in inside:
                inside |= {site for _, site in cause.names}
        return all(inside & self.truth.places(e) for e in self.truth.effects)

    @property
    def confidence(self) -> float:
        """Probability that the answer states for what it says (0 where it abstains)."""
        if not self.answer.speaks:
            return 0.0
        return min(c.probability for c in self.answer.causes)


def _same_name(effect: Hidden, cause: Cause) -> bool:
    return bool(effect.names & cause.names)


def _same_place(effect: Hidden, cause: Cause) -> bool:
    return any(site in effect.sites for _, site in cause.names)


def _best(
    effects: Sequence[Hidden], causes: Sequence[Cause], same: Callable[[Hidden, Cause], bool]
) -> tuple[tuple[Hidden, Cause], ...]:
    if not effects or not causes:
        return ()
    fits = np.array([[same(effect, cause) for cause in causes] for effect in effects], float)
    rows, columns = linear_sum_assignment(fits, maximize=True)
    pairs = zip(rows.tolist(), columns.tolist(), strict=True)
    return tuple((effects[i], causes[j]) for i, j in pairs if fits[i, j])
