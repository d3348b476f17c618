"""What a result is: numbers beside the published ones, sentences, pictures as data."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from samii_rig.types import Complex, Float

Kind = Literal["line", "dashed", "points", "broad"]
Corner = Literal["upper left", "upper right", "lower left", "lower right", "lower center"]


# What a number beside a published one shows. Computed: it follows from what the papers print, or
# holds whatever they leave out. Calibrated: values that they do not print were chosen or solved for
# so that it comes out. Found again: a method finds in the simulated rig what was put there.
# Does not agree: ours lies where the theory asks for it, the published number does not.
Agreement = Literal["", "computed", "calibrated", "found again", "does not agree"]

PLAIN = (-4, 6)  # powers of ten between which a number is written without one


@dataclass(frozen=True, slots=True)
class Number:
    """A number of ours beside the published one.

    published : as it is printed or said, "" where the paper has none.
    reference : the published value that `deviation` is taken from, NaN where there is none.
    low, high : between which `ours` must lie; infinite for a number that is only shown.
    must : the same in words. digits : significant ones that are shown.
    agreement : kind of it, "" for that of the whole result.
    """

    what: str
    ours: float
    unit: str = ""
    published: str = ""
    reference: float = math.nan
    low: float = -math.inf
    high: float = math.inf
    must: str = ""
    digits: int = 4
    agreement: Agreement = ""

    @property
    def holds(self) -> bool:
        """Whether ours lies where it must."""
        return self.low <= self.ours <= self.high

    @property
    def deviation(self) -> float:
        """ours/reference - 1, NaN without a reference."""
        return self.ours / self.reference - 1 if self.reference else math.nan

    def shown(self) -> str:
        """Ours, rounded, with its unit."""
        if not math.isfinite(self.ours):
            return "none"
        size = math.floor(math.log10(abs(self.ours))) if self.ours else 0
        if PLAIN[0] <= size < PLAIN[1]:
            rounded = float(f"{self.ours:.{self.digits}g}")
            text = f"{rounded:.{max(self.digits - 1 - size, 0)}f}"
        else:
            text = f"{self.ours:.{self.digits - 1}e}"
        return f"{text} {self.unit}".strip()

    def shown_deviation(self) -> str:
        """`+0.14 %`, "" without a reference."""
        return "" if math.isnan(self.deviation) else f"{100 * self.deviation:+.2g} %"


def beside(
    what: str,
    ours: float,
    published: float,
    unit: str,
    within: float,
    agreement: Agreement = "",
) -> Number:
    """A number that must agree with the published one, `within` relative."""
    return Number(
        what,
        float(ours),
        unit,
        f"{published:g} {unit}".strip(),
        published,
        published - within * abs(published),
        published + within * abs(published),
        f"within {100 * within:.2g} %",
        5,
        agreement,
    )


def between(
    what: str,
    ours: float,
    unit: str,
    low: float,
    high: float,
    published: str = "",
    digits: int = 4,
    agreement: Agreement = "",
) -> Number:
    """A number that must lie in an interval; `published` in the paper's terms."""
    if math.isinf(low) or low == 0:
        must = f"at most {high:g}"
    elif math.isinf(high):
        must = f"at least {low:g}"
    else:
        must = f"{low:g}" if low == high else f"{low:g} to {high:g}"
    return Number(what, float(ours), unit, published, math.nan, low, high, must, digits, agreement)


def shown(
    what: str,
    ours: float,
    unit: str = "",
    published: str = "",
    digits: int = 4,
    agreement: Agreement = "",
) -> Number:
    """A number that is only told."""
    return Number(what, float(ours), unit, published, digits=digits, agreement=agreement)


@dataclass(frozen=True, slots=True)
class Curve:
    """One curve. `low`, `high` : a band or error bars around it.

    kind : a `line`, `dashed`, `points`, or `broad` (pale, behind the others).
    colour : index into the palette; curves of one thing have one colour in all panels.
    """

    name: str
    x: Float
    y: Float
    kind: Kind = "line"
    colour: int = 0
    low: Float | None = None
    high: Float | None = None


@dataclass(frozen=True, slots=True)
class Mark:
    """What the paper says of a figure: a stretch of x, or a value of x or y, with its words.

    foot : the words stand at the lower end of the line, where a curve crosses the upper one.
    """

    text: str
    low: float
    high: float | None = None
    axis: Literal["x", "y"] = "x"
    foot: bool = False


@dataclass(frozen=True, slots=True)
class Label:
    """Words at a point of a curve."""

    text: str
    x: float
    y: float
    dx: float = 28.0
    dy: float = 0.0


@dataclass(frozen=True, slots=True)
class Panel:
    """Curves over common axes."""

    x: str
    y: str
    curves: tuple[Curve, ...]
    title: str = ""
    marks: tuple[Mark, ...] = ()
    labels: tuple[Label, ...] = ()
    log_x: bool = True
    log_y: bool = False
    x_range: tuple[float, float] | None = None
    y_range: tuple[float, float] | None = None
    y_step: float | None = None
    weight: float = 1.0
    legend: Corner | None = None


@dataclass(frozen=True, slots=True)
class Picture:
    """Panels in `columns`, row by row; panels of one column share their x axis."""

    name: str
    title: str
    panels: tuple[Panel, ...]
    columns: int = 1
    width: float = 6.4  # inches
    height: float = 4.6


@dataclass(frozen=True, slots=True)
class Result:
    """What one entry of the catalogue computes."""

    numbers: tuple[Number, ...]
    sentences: tuple[str, ...] = ()
    pictures: tuple[Picture, ...] = ()

    def of_kind(self, agreement: Agreement) -> Result:
        """The same, every number that must hold beside a published one with a kind of agreement:
        its own or this. A number that is only told need not agree."""
        numbers = (
            replace(n, agreement=n.agreement or agreement) if n.published and n.must else n
            for n in self.numbers
        )
        return replace(self, numbers=tuple(numbers))

    @property
    def holds(self) -> bool:
        """Whether every number lies where it must."""
        return all(n.holds for n in self.numbers)


@dataclass(frozen=True, slots=True)
class Bode:
    """A response for `bode_panels`. `sd` : relative standard deviation, for a 90 % band."""

    name: str
    frequency: Float
    H: Complex
    kind: Kind = "line"
    colour: int = 0
    sd: Float | None = None


TWO_SIDED_90 = 1.645  # standard deviations of a normal distribution


def bode_panels(
    responses: Sequence[Bode],
    unit: str,
    marks: tuple[Mark, ...] = (),
    title: str = "",
    near: float = -90.0,
    legend: Corner = "lower left",
) -> tuple[Panel, Panel]:
    """Gain and phase, the phases on the turn whose value is nearest `near` degrees at the
    lowest frequency."""
    gains: list[Curve] = []
    angles: list[Curve] = []
    # Points last: noise would put them on any turn, so they take that of the first line.
    for r in sorted(responses, key=lambda r: r.kind == "points"):
        if r.kind == "points" and angles:
            guide = np.interp(r.frequency, angles[0].x, angles[0].y)
            angle = guide + np.degrees(np.angle(r.H * np.exp(-1j * np.radians(guide))))
        else:
            angle = np.degrees(np.unwrap(np.angle(r.H)))
            angle = angle + 360 * np.round((near - angle[0]) / 360)
        size = np.abs(r.H)
        half = None if r.sd is None else TWO_SIDED_90 * r.sd / np.sqrt(2)
        for into, y, spread in (
            (gains, size, None if half is None else size * half),
            (angles, angle, None if half is None else np.degrees(half)),
        ):
            low = None if spread is None else y - spread
            high = None if spread is None else y + spread
            into.append(Curve(r.name, r.frequency, y, r.kind, r.colour, low, high))
    bare = tuple(Mark("", m.low, m.high, m.axis) for m in marks if m.axis == "x")
    gain = Panel(
        "frequency [Hz]",
        f"gain [{unit}]",
        tuple(gains),
        title,
        marks,
        log_y=True,
        weight=1.35,
        legend=legend,
    )
    angle_panel = Panel(
        "frequency [Hz]",
        "phase [°]",
        tuple(angles),
        "",
        bare,
        y_step=45.0,
    )
    return gain, angle_panel
