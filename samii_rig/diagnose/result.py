"""What a diagnosis says: the contract of `samii-rig diagnose --json`, as data."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Literal

from samii_rig.diagnose.physics.rows import PHYSICS, SOFT
from samii_rig.display import FORMS, card
from samii_rig.rig.schema import Rig
from samii_rig.types import Complex, Float, FrequencyResponse
from samii_rig.units import pretty

if TYPE_CHECKING:
    from collections.abc import Sequence

    from plotly.graph_objects import Figure

Verdict = Literal["no_mismatch", "named", "ambiguous", "unknown"]

# Physics that a person asks for first: where any of it could hide, and with its size.
HIDING = {row.name: row.hidden for row in PHYSICS.values() if row.hidden}
LIKELY = 0.5  # probability of a site from which it is told as the place
PROBABLE = 0.3  # probability of causes below which they are told for a part of a mismatch at most
REMARKS = 2  # on the console, of what is no physics
FAR_MOVED = 3.0  # tolerances from which a part is worth a look: 0.3 % of good parts are so far off


@dataclass(frozen=True, slots=True)
class Value:
    """A parameter of a cause with its 90 % interval; low or high is None where the data set no
    limit on that side, and the other is then a limit that 95 % keep."""

    value: float
    unit: str
    low: float | None
    high: float | None

    def times(self, factor: float) -> Value:
        """In another unit, factor above 0."""
        low, high = (None if x is None else factor * x for x in (self.low, self.high))
        return Value(factor * self.value, self.unit, low, high)

    def within(self) -> str:
        """The interval in words."""
        if self.low is None:
            return "no limit" if self.high is None else f"at most {self.high:.4g}"
        if self.high is None:
            return f"at least {self.low:.4g}"
        return f"{self.low:.4g} to {self.high:.4g}"

    def plain(self) -> dict[str, Any]:
        """As plain data."""
        return {"value": self.value, "unit": self.unit, "low": self.low, "high": self.high}


@dataclass(frozen=True, slots=True)
class Cause:
    """One effect of an explanation. equivalents : what these data do not tell from it.
    position : m from the site's upstream end, None for what stands at no place along it."""

    physics: str
    site: str
    probability: float
    equivalents: tuple[tuple[str, str], ...]
    parameters: dict[str, Value]
    position: float | None = None

    def plain(self) -> dict[str, Any]:
        """As plain data."""
        return {
            "physics": self.physics,
            "site": self.site,
            "position": self.position,
            "probability": self.probability,
            "equivalent_to": [{"physics": p, "site": s} for p, s in self.equivalents],
            "parameters": {k: v.plain() for k, v in self.parameters.items()},
        }


@dataclass(frozen=True, slots=True)
class Band:
    """What the refitted nominal model leaves of one channel in one band, per degree of freedom."""

    channel: str
    low_hz: float
    high_hz: float
    chi2_per_dof: float

    def plain(self) -> dict[str, Any]:
        """As plain data."""
        return {
            "channel": self.channel,
            "low_hz": self.low_hz,
            "high_hz": self.high_hz,
            "chi2_per_dof": self.chi2_per_dof,
        }


@dataclass(frozen=True, slots=True)
class Gap:
    """Part of the gap between refitted nominal model and noise that the causes close, on lines
    that were used for nothing else, with its 90 % bootstrap interval.

    of_noise : whether the model left no more than noise there: then there is no gap, and these are
        the fall of chi-square in units of the noise.
    """

    value: float
    low: float
    high: float
    of_noise: bool = False

    def words(self) -> str:
        """How much of what the model left beyond noise the causes account for; an interval where
        it says more than the value."""
        if self.of_noise:
            return "there the model had left no more than noise"
        value, low, high = map(percent, (self.value, self.low, self.high))
        between = "" if low == high else f" (90 % interval {low} to {high})"
        return f"they account for {value} of what the model missed{between}"


@dataclass(frozen=True, slots=True)
class Moved:
    """A nominal parameter that the refit moved, by how many of its tolerances."""

    parameter: str
    sigmas: float

    def plain(self) -> dict[str, Any]:
        """As plain data."""
        return {"parameter": self.parameter, "sigmas": self.sigmas}


@dataclass(frozen=True, slots=True)
class Exact:
    """A number of the rig file that is wrong, though stated as exact or with a small tolerance:
    with another it explains the recordings to their noise. stated : its value there, in the unit of
    `value`."""

    parameter: str
    stated: float
    value: Value

    def describe(self) -> str:
        """In words."""
        v, unit = self.value, self.value.unit
        return (
            f"{self.parameter} = {v.value:.4g} {unit} ({v.within()}) in place of the rig file's "
            f"{self.stated:.4g} {unit}"
        )

    def plain(self) -> dict[str, Any]:
        """As plain data."""
        return {"parameter": self.parameter, "stated": self.stated, **self.value.plain()}


@dataclass(frozen=True, slots=True)
class Hiding:
    """What these data would not have shown: the smallest effect that would have been found with
    90 %. size : None where none within its range would have been."""

    physics: str
    site: str
    parameter: str
    size: float | None
    unit: str

    def plain(self) -> dict[str, Any]:
        """As plain data."""
        return {
            "physics": self.physics,
            "site": self.site,
            "parameter": self.parameter,
            "size": self.size,
            "unit": self.unit,
        }


@dataclass(frozen=True, slots=True)
class Used:
    """Lines that took part, of all that were excited; records that did not, and why."""

    lines: int
    of: int
    left_out: tuple[tuple[str, str], ...] = ()

    def plain(self) -> dict[str, Any]:
        """As plain data."""
        return {
            "lines": self.lines,
            "of": self.of,
            "left_out": [{"record": r, "why": w} for r, w in self.left_out],
        }


@dataclass(frozen=True, slots=True)
class Before:
    """What is in both of two states, by the state before.

    inputs : what the state before showed of how inputs were recorded, and both were taken to have,
    in words.
    verdict, causes : of its own diagnosis. discrepancy : whether it holds what the table does not
    explain; the state after was then taken to hold the same.
    recordings : of each state, before and after. rig : with the parameters that serve both states
    best if nothing changed.
    """

    verdict: Verdict
    causes: tuple[Cause, ...] = ()
    discrepancy: bool = False
    recordings: tuple[tuple[str, ...], tuple[str, ...]] = ((), ())
    rig: Rig | None = None
    inputs: tuple[str, ...] = ()

    def plain(self) -> dict[str, Any]:
        """As plain data."""
        return {
            "verdict": self.verdict,
            "causes": [c.plain() for c in self.causes],
            "discrepancy": self.discrepancy,
            "recordings": list(self.recordings[0]),
            "after": list(self.recordings[1]),
        }

    def describe(self) -> tuple[str, ...]:
        """In words."""
        return (*self.inputs, *self._in_both())

    def _in_both(self) -> tuple[str, ...]:
        if self.discrepancy:
            return (
                "the state before holds something that the table does not name: it is taken to be "
                "the same in both states, and only what their responses differ by is explained",
            )
        if self.causes:
            named = " and ".join(_in_words(c) for c in self.causes)
            return (f"both states have, beside the rig file: {named}",)
        if self.verdict == "unknown":
            return (
                "both states have something beside the rig file that is not named for sure; what "
                "fits it stands in the model of both",
            )
        return ()


@dataclass(frozen=True, slots=True)
class Trace:
    """x(w) of a place, free of any law: the part that is missing there, by itself.

    x, sd : (n,) complex estimate and its standard deviation, by frequency (n,) Hz.
    chi2_per_dof : of what no x at this place can explain.
    """

    site: str
    jump: str
    by: str
    frequency: Float
    x: Complex
    sd: Float
    chi2_per_dof: float


@dataclass(frozen=True, slots=True)
class Diagnosis:
    """Everything that a diagnosis found; `plain()` is the contract.

    chi2_per_dof, threshold : of the refitted nominal model, and what noise would reach in
        three of ten thousand cases.
    nominal, with_causes : chi-square per degree of freedom of the refitted nominal model and with
        the causes, each on the lines fitted and on those shown.
    rig : the nominal rig with the causes; traces : the best places, law-free.
    evidence : what the probability of the answer rests on (`stated.Evidence`), whether something
        is told in `beyond` instead, and the causes of the most probable explanation,
        whether they are told or not.
    before : of two states, what both have; the causes are then what changed between them.
    moved : the largest first. sigma : root of the chi-square that the causes explain. gain : noise
        units by which the next experiment would distinguish the rivals; None where none was found.
    states : the recordings of each state of the rig, where they are of more than one. exact : what
        is no missing physics, but one or two wrong numbers of the rig file. beyond : a
        stiffness that is not constant, where it is not sure enough for a cause, in words.
    """

    verdict: Verdict
    chi2_per_dof: float
    threshold: float
    bands: tuple[Band, ...]
    sites: tuple[tuple[str, float], ...]
    causes: tuple[Cause, ...]
    alternatives: tuple[tuple[tuple[Cause, ...], float], ...]
    nominal: tuple[float, float]
    with_causes: tuple[float, float]
    noise_floor: float
    gap: Gap
    not_physics: tuple[str, ...]
    why: str
    experiment: str
    outside: float
    rig: Rig | None
    traces: tuple[Trace, ...]
    evidence: dict[str, Any] = field(default_factory=dict)
    model: str = ""
    moved: tuple[Moved, ...] = ()
    could_hide: tuple[Hiding, ...] = ()
    used: Used = Used(0, 0)
    sigma: float = 0.0
    gain: float | None = None
    before: Before | None = None
    states: tuple[tuple[str, ...], ...] = ()
    exact: tuple[Exact, ...] = ()
    beyond: str = ""

    def plain(self) -> dict[str, Any]:
        """The contract of `samii-rig diagnose --json`."""
        return {
            "verdict": self.verdict,
            "mismatch": {
                "chi2_per_dof": self.chi2_per_dof,
                "threshold": self.threshold,
                "bands": [b.plain() for b in self.bands],
            },
            "sites": [{"site": s, "probability": p} for s, p in self.sites],
            "causes": [c.plain() for c in self.causes],
            "alternatives": [
                {"causes": [c.plain() for c in causes], "probability": p}
                for causes, p in self.alternatives
            ],
            "fit": {
                "refitted_nominal": {"train": self.nominal[0], "held_out": self.nominal[1]},
                "with_causes": {"train": self.with_causes[0], "held_out": self.with_causes[1]},
                "noise_floor": self.noise_floor,
                "gap_closed": {
                    "value": self.gap.value,
                    "low": self.gap.low,
                    "high": self.gap.high,
                    "of_noise": self.gap.of_noise,
                },
            },
            "moved": [m.plain() for m in self.moved],
            "could_hide": [h.plain() for h in self.could_hide],
            "used": self.used.plain(),
            "evidence": {"sigma": self.sigma},
            "not_physics": list(self.not_physics),
            "next_experiment": {
                "why": self.why,
                "experiment": self.experiment,
                "gain": self.gain,
            },
            "model": self.model,
            **({"before": self.before.plain()} if self.before else {}),
            **({"exact": [one.plain() for one in self.exact]} if self.exact else {}),
            **({"beyond": self.beyond} if self.beyond else {}),
            **({"states": [list(names) for names in self.states]} if self.states else {}),
        }

    def lines(self) -> tuple[str, ...]:
        """Three lines for a person: what, how sure and how much better, what next."""
        return (self._what(), self._how_well(), self._next())

    def plot(
        self,
        responses: Sequence[FrequencyResponse] = (),
        rig: Rig | None = None,
        output: str = "",
        input: str = "",
    ) -> Figure:
        """With the responses and the rig that were diagnosed, one entry before and after; with
        none, what is missing at the most probable place, free of any law."""
        made: Figure = (
            FORMS["before_after"](self, responses, rig, output, input)
            if rig
            else FORMS["place"](self)
        )
        return made

    def _repr_html_(self) -> str:
        rows = [
            (
                c.physics.replace("_", " "),
                c.site,
                f"{c.probability:.0%}",
                ", ".join(
                    f"{k} = {v.value:.4g}{_unit(v)} ({v.within()})" for k, v in c.parameters.items()
                ),
                ", ".join(f"{p.replace('_', ' ')} at {s}" for p, s in c.equivalents),
            )
            for c in self.causes
        ]
        what, how_well, next_ = self.lines()
        sites = ", ".join(f"{s} {p:.0%}" for s, p in self.sites[:4])
        facts = {"found": what, "fit": how_well, "next": next_, "places": sites}
        head = ("left out", "at", "probability", "parameters (90 %)", "not distinguished from")
        return card("Diagnosis", facts, head, rows)

    def _what(self) -> str:
        two = self.before is not None
        match self.verdict:
            case "no_mismatch":
                what = (
                    "Nothing changed: one set of parameters fits both states"
                    if two
                    else "Nothing is missing: the model fits"
                )
                return (
                    f"{what} to the noise (chi-square per degree of "
                    f"freedom {self.chi2_per_dof:.3f}, threshold {self.threshold:.3f})."
                )
            case "unknown" if self.states and two:
                return (
                    "The recordings of one of the two states are themselves of several: what "
                    "changed is not told."
                )
            case "unknown" if self.states:
                return (
                    "The recordings are not of one state of the rig: no one model explains them "
                    "all, and no cause is named."
                )
            case "unknown" if self.exact:
                what = ("A number", "Two numbers", "Three numbers")[len(self.exact) - 1]
                are = "is" if len(self.exact) == 1 else "are"
                words = " and ".join(one.describe() for one in self.exact)
                return f"{what} of the rig file {are} wrong: {words}."
            case "unknown":
                site, p = self.sites[0] if self.sites else ("", 0.0)
                place = f" It is most likely at {site} ({percent(p)})." if p >= LIKELY else ""
                what = "Something changed" if two else "Something is missing"
                if self.beyond:
                    return f"{what} that is not named for sure: {self.beyond}."
                return f"{what} that the table does not name for sure.{place}"
        named = " and ".join(_in_words(c) for c in self.causes)
        what = "Changed" if two else "Left out"
        if self.verdict == "named":
            return f"{what}: {named}."
        if self._in_part:
            return f"Much of what is missing goes as this would: {named}; more is missing."
        return f"Most likely {what.lower()}: {named}; the data do not settle it."

    @property
    def _in_part(self) -> bool:
        """Whether the causes are told for the part of the mismatch that they explain, and as the
        whole of it are improbable."""
        return min((c.probability for c in self.causes), default=1.0) < PROBABLE

    def _how_well(self) -> str:
        before, after = self.nominal[1], self.with_causes[1]
        on = "on test lines"
        if self.before is not None:
            what = (
                "lines that were fitted"
                if self.before.discrepancy
                else "test lines of the state after"
            )
            on = f"on {what}"
        if self.exact and self.chi2_per_dof <= self.threshold:
            return f"{sentence(on)[:-1]} the model with it has {after:.3g} of the noise's power."
        if self.exact:
            return (
                f"{sentence(on)[:-1]} chi-square per degree of freedom falls from {before:.3g} to "
                f"{after:.3g} (noise alone: 1); {self.gap.words()}."
            )
        if not self.causes:
            counted = "; what the recordings differ by counts as noise" if self.states else ""
            has = f"the refitted model has {before:.3g} of the noise's power{counted}."
            return f"{sentence(on)[:-1]} {has}"
        sure = min(c.probability for c in self.causes)
        how = f"As the whole it is improbable ({percent(sure)})"
        if not self._in_part:
            how = f"Probability {percent(sure)}"
        return (
            f"{how}; {on} chi-square per degree of freedom "
            f"falls from {before:.3g} to {after:.3g} (noise alone: 1); {self.gap.words()}."
        )

    def _next(self) -> str:
        parts = [sentence(remark) for remark in self.not_physics[:REMARKS]]
        if self.verdict == "no_mismatch" and self.moved and abs(self.moved[0].sigmas) > FAR_MOVED:
            far = self.moved[0]
            parts.insert(
                0, f"The fit moved {far.parameter} by {far.sigmas:.1f} of its tolerances: check it."
            )
        if self.experiment:
            parts.append(f"Next: {self.experiment} ({self.why}).")
        if self.could_hide and (not self.experiment or self.verdict == "no_mismatch"):
            parts.append(f"What could hide: {'; '.join(_hides(self.could_hide))}.")
        return " ".join(parts) or "No further experiment is needed."


def _hides(every: Sequence[Hiding]) -> list[str]:
    """Of the physics that people ask for first, where the most of it could hide."""
    out = []
    for physics, words in HIDING.items():
        own = [h for h in every if h.physics == physics]
        if not own:
            continue
        unseen = [h for h in own if h.size is None]
        worst = unseen[0] if unseen else max(own, key=lambda h: h.size or 0.0)
        if physics in SOFT and not unseen:
            worst = min(own, key=lambda h: h.size or 0.0)
        if worst.size is None:
            out.append(f"{words[0]} at {worst.site}, however large")
        else:
            out.append(f"{words[1]} {worst.size:.2g} {pretty(worst.unit)} at {worst.site}")
    return out


def sentence(text: str) -> str:
    """With a capital and a full stop; the name of a channel stays as it is."""
    text = pretty(text.strip())
    first = text.partition(" ")[0]
    if text[:1].islower() and " " in text and first.isalpha() and (len(first) > 1 or first == "a"):
        text = text[0].upper() + text[1:]
    return text if text.endswith((".", "!", "?")) else f"{text}."


def percent(p: float) -> str:
    """A probability: never 0 %% or 100 %%, which no data give."""
    if p > 0.999:
        return "over 99.9 %"
    if p < 0.001:
        return "under 0.1 %"
    if p > 0.99 or p < 0.01:
        return f"{100 * p:.1f} %"
    return f"{100 * p:.0f} %"


def _in_words(cause: Cause) -> str:
    every = cause.parameters.items()
    numbers = ", ".join(f"{k} = {v.value:.3g}{_unit(v)}" for k, v in every)
    words = f"{cause.physics.replace('_', ' ')} at {cause.site}"
    return f"{words} ({numbers})" if numbers else words


def _unit(value: Value) -> str:
    """Behind a number; a ratio has none."""
    return "" if value.unit == "1" else f" {pretty(value.unit)}"
