"""The rig's chain as a small drawing: base, elements, tip, sensors where they sit.

Colours come from the page's style sheet through the classes of the shapes.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from html import escape
from typing import assert_never

from samii_rig.rig.schema import (
    AbsoluteAngle,
    Acceleration,
    Current,
    Displacement,
    Force,
    Moment,
    Pressure,
    RelativeAngle,
    Rig,
    Strain,
    Velocity,
)
from samii_rig.rig.schema.elements import (
    MOTION_SOURCES,
    SOURCES,
    Beam,
    Cylinder,
    Element,
    ForceSource,
    Gear,
    GravityStiffness,
    LumpedMass,
    Parameter,
    RigidLink,
    Rod,
    Spindle,
    TimoshenkoBeam,
    TorsionalGroundSpring,
    TorsionalSpring,
    TranslationalGroundSpring,
    TranslationalSpring,
    parameters,
)
from samii_rig.units import pretty

# All in user units of the drawing, about a pixel.
_BEAM, _LINK, _SPRING, _SOURCE, _OTHER = 190.0, 96.0, 44.0, 56.0, 70.0  # widths
_DROP = 34.0  # from the chain down to the ground beside it
_POT = "v9m-6 0h12m-16 -4v14h20v-14m-10 14"  # a dashpot, 24 high, as a spring's turns are
_SERIES = (TorsionalSpring, TranslationalSpring)
_TO_GROUND = (TorsionalGroundSpring, TranslationalGroundSpring, GravityStiffness)
_MARGIN = 64.0
_AXIS = 118.0  # height of the chain's line
_LABEL_ROWS = (176.0, 222.0)  # names stand in two rows by turns, so that none touch
_SENSOR_ROWS = (22.0, 52.0)
_DRAWN_HEIGHT = 262.0
_HALF = 13.0  # half height of a link
_HALO = 25.0  # half height of the field behind a suspect


@dataclass(frozen=True, slots=True)
class Suspect:
    """How an element or sensor is marked. label : said beside its name. weight : 0 to 1, of its
    colour. chosen : whether it is drawn as found rather than as possible."""

    label: str
    weight: float
    chosen: bool


def draw(rig: Rig, suspects: Mapping[str, Suspect] | None = None) -> str:
    """An SVG drawing of `rig`, from base (left) to tip (right), `suspects` marked by name."""
    suspects = suspects or {}
    x = _MARGIN
    spans: dict[str, tuple[float, float]] = {}
    shapes: list[str] = []
    for number, element in enumerate(rig.element):
        end = x + _width(element)
        spans[element.name] = (x, end)
        row = _LABEL_ROWS[number % 2]
        if element.name in suspects:
            shapes.insert(0, _halo(suspects[element.name], x, end))
            shapes.append(_suspicion(suspects[element.name], (x + end) / 2, row))
        shapes.append(_element(element, x, end, rig.motion == "axial"))
        shapes.append(_label(element, (x + end) / 2, row))
        x = end
    width = x + _MARGIN
    shapes.append(_end(rig.base, _MARGIN, -1))
    shapes.append(_end(rig.tip, x, +1))
    shapes += _sensors(rig, spans, suspects)
    title = f"Chain of {rig.name}: {', '.join(e.name for e in rig.element)}"
    if suspects:
        marked = (f"{name} {suspect.label}" for name, suspect in suspects.items())
        title += f". Suspect: {', '.join(marked)}"
    return (
        f'<svg class="chain" viewBox="0 0 {width:.0f} {_DRAWN_HEIGHT:.0f}" role="img" '
        f'style="max-width:{1.35 * width:.0f}px">'
        f"<title>{escape(title)}</title>{''.join(shapes)}</svg>"
    )


def _width(element: Element) -> float:
    match element:
        case Beam() | TimoshenkoBeam() | Rod():
            return _BEAM
        case RigidLink():
            return _LINK
    if isinstance(element, _SERIES + _TO_GROUND):
        return _SPRING
    return _SOURCE if isinstance(element, SOURCES) else _OTHER


def _element(element: Element, a: float, b: float, along: bool) -> str:
    """What stands between a and b, pixels; along : the chain slides."""
    y, middle = _AXIS, (a + b) / 2
    line = f'<path class="spring" d="M{a:.1f} {y}H{b:.1f}"/>'
    box = (
        f'<rect class="link" x="{a + 6:.1f}" y="{y - _HALF}" width="{b - a - 12:.1f}" '
        f'height="{2 * _HALF}"/>'
    )
    match element:
        case Beam() | TimoshenkoBeam() | Rod():
            return f'<rect class="beam" x="{a:.1f}" y="{y - 4}" width="{b - a:.1f}" height="8"/>'
        case RigidLink():
            return _link(element, a, b)
        case TranslationalSpring() if element.k.value == 0:
            return _dashpot(a, b)
        case TorsionalSpring() | TranslationalSpring():
            return _zigzag(a, b)
        case Gear():
            return (
                f'{line}<circle class="link" cx="{middle - 11:.1f}" cy="{y}" r="10"/>'
                f'<circle class="link" cx="{middle + 16:.1f}" cy="{y}" r="17"/>'
            )
        case Cylinder():
            return _piston(a, b)
        case Spindle():
            thread = "".join(f"M{a + 10 + 8 * k:.1f} {y + _HALF}l8 {-2 * _HALF}" for k in range(6))
            return f'{line}{box}<path class="spring" d="{thread}"/>'
    if isinstance(element, SOURCES):
        slides = isinstance(element, (ForceSource, *MOTION_SOURCES))
        return line + _source(middle, "along" if along and slides else "across" if slides else "")
    if isinstance(element, _TO_GROUND):
        damps = not isinstance(element, GravityStiffness) and element.k.value == 0
        return line + _grounded(middle, damps)
    return line + box


def _link(link: RigidLink, a: float, b: float) -> str:
    """A body with its centre of mass."""
    span = link.L.value
    at = a + (b - a) * (min(link.r.value / span, 1.0) if span > 0 else 0.5)
    return (
        f'<rect class="link" x="{a:.1f}" y="{_AXIS - _HALF}" width="{b - a:.1f}" '
        f'height="{2 * _HALF}" rx="7"/>'
        f'<circle class="centre" cx="{at:.1f}" cy="{_AXIS}" r="3.5"/>'
    )


def _zigzag(a: float, b: float) -> str:
    """A spring in the chain."""
    steps = 6
    w = (b - a - 12) / steps
    path = f"M{a:.1f} {_AXIS}h6" + "".join(
        f"l{w / 2:.1f} {-9 if k % 2 == 0 else 9}l{w / 2:.1f} {9 if k % 2 == 0 else -9}"
        for k in range(steps)
    )
    return f'<path class="spring" d="{path}h6"/>'


def _source(middle: float, slides: str) -> str:
    """What drives the chain. slides : "along" or "across" it; "" for one that turns."""
    y = _AXIS
    arrow = {
        "along": f"M{middle - 9:.1f} {y}h18m-5 -5l5 5l-5 5",
        "across": f"M{middle:.1f} {y + 9}v-18m-5 5l5 -5l5 5",
        "": f"M{middle - 8:.1f} {y + 5:.1f}a10 10 0 1 1 15 0m-5 -1l5 1l1 -6",
    }[slides]
    return (
        f'<circle class="source" cx="{middle:.1f}" cy="{y}" r="17"/>'
        f'<path class="arrow" d="{arrow}"/>'
    )


def _grounded(middle: float, damps: bool) -> str:
    """A spring or a damper to the ground."""
    y = _AXIS
    turns = "".join(f"l{7 if k % 2 == 0 else -7} 3l{-7 if k % 2 == 0 else 7} 3" for k in range(4))
    hatch = "".join(f"M{middle - 14 + 7 * k:.1f} {y + _DROP}l-5 5" for k in range(5))
    return (
        f'<path class="spring" d="M{middle:.1f} {y}v5{_POT if damps else turns}v5"/>'
        f'<path class="ground" d="M{middle - 16:.1f} {y + _DROP}h32{hatch}"/>'
    )


def _piston(a: float, b: float) -> str:
    """A cylinder with its rod."""
    y, middle = _AXIS, (a + b) / 2
    piston = f"M{middle - 6:.1f} {y - _HALF}v{2 * _HALF}m5 0v{-2 * _HALF}"
    return (
        f'<rect class="link" x="{a + 4:.1f}" y="{y - _HALF}" width="{b - a - 18:.1f}" '
        f'height="{2 * _HALF}"/><path class="spring" d="M{a:.1f} {y}h4{piston}'
        f'M{middle - 1:.1f} {y}H{b:.1f}"/>'
    )


def _label(element: Element, x: float, y: float) -> str:
    match element:
        case Beam() | TimoshenkoBeam():
            detail = f"EI {_value(element.EI)}, {_value(element.L)}"
        case Rod():
            detail = f"EA {_value(element.EA)}, {_value(element.L)}"
        case RigidLink():
            detail = f"{_value(element.m)}, {_value(element.L)}"
        case LumpedMass():
            told = [p for p in (element.m, element.I) if p.value > 0]
            detail = ", ".join(_value(p) for p in told)
        case _ if isinstance(element, SOURCES):
            detail = f"input {element.input}"
        case _:
            found = parameters(element)
            detail = element.kind.replace("_", " ")
            first = next(((symbol, p) for symbol, p in found.items() if p.value != 0), None)
            if first:
                symbol, p = first
                detail = f"{symbol} {_value(p)}"
    top = _AXIS + (_DROP + 8 if isinstance(element, _TO_GROUND) else 22)
    leader = f'<path class="leader" d="M{x:.1f} {top}V{y - 15:.1f}"/>' if top < y - 15 else ""
    return (
        f"{leader}"
        f'<text class="name" x="{x:.1f}" y="{y:.1f}">{escape(element.name)}</text>'
        f'<text class="detail" x="{x:.1f}" y="{y + 15:.1f}">{escape(detail)}</text>'
    )


def _halo(suspect: Suspect, a: float, b: float) -> str:
    """A field behind an element, the darker the more suspect; dashed where it is only possible."""
    style = "halo chosen" if suspect.chosen else "halo"
    fill = 0.10 + 0.35 * suspect.weight
    return (
        f'<rect class="{style}" x="{a - 7:.1f}" y="{_AXIS - _HALO:.1f}" width="{b - a + 14:.1f}" '
        f'height="{2 * _HALO:.1f}" rx="10" style="fill-opacity:{fill:.2f}"/>'
    )


def _suspicion(suspect: Suspect, x: float, y: float) -> str:
    """What is said of a suspect, below its name and value."""
    return f'<text class="suspicion" x="{x:.1f}" y="{y + 30:.1f}">{escape(suspect.label)}</text>'


def _end(boundary: str, x: float, side: int) -> str:
    """Hatching for a clamp, a triangle for a pin, nothing for a free end; named above."""
    y = _AXIS
    text = f'<text class="detail" x="{x + side * 30:.1f}" y="{y - 40}">{escape(boundary)}</text>'
    if boundary == "clamped":
        lines = "".join(f"M{x} {y - 30 + 12 * k}l{side * 10} 10" for k in range(6))
        return f'<path class="ground" d="M{x} {y - 32}v64{lines}"/>{text}'
    if boundary == "pinned":
        return f'<path class="ground" d="M{x} {y}l-12 22h24z"/>{text}'
    return text


def _sensors(
    rig: Rig, spans: dict[str, tuple[float, float]], suspects: Mapping[str, Suspect]
) -> list[str]:
    places = []
    for sensor in rig.sensor:
        match sensor:
            case RelativeAngle():
                span = spans[sensor.across[0]][0], spans[sensor.across[-1]][1]
            case Displacement() | Velocity() if sensor.against is not None:
                one, other = spans[sensor.against][1], spans[sensor.after][1]
                span = min(one, other), max(one, other)
            case AbsoluteAngle() | Moment() | Displacement() | Velocity() | Force() | Pressure():
                span = (spans[sensor.after][1],) * 2
            case Current():
                span = spans[sensor.of]
            case Acceleration() | Strain():
                a, b = spans[sensor.on]
                host = next(e for e in rig.element if e.name == sensor.on)
                length = (
                    host.L.value if isinstance(host, Beam | TimoshenkoBeam | RigidLink) else 0.0
                )
                at = a + (b - a) * (sensor.position / length if length > 0 else 0.5)
                span = (at, at)
            case _:
                assert_never(sensor)
        places.append((sum(span) / 2, span, sensor))
    out = []
    for number, (x, (a, b), sensor) in enumerate(sorted(places, key=lambda p: p[0])):
        row = _SENSOR_ROWS[number % 2]
        foot = _AXIS - 20
        mark = f"M{a:.1f} {foot}v-8H{b:.1f}v8M{x:.1f} {foot - 8}" if b > a else f"M{x:.1f} {foot}"
        text, style = f"{sensor.name} [{pretty(sensor.unit)}]", ""
        if sensor.name in suspects:
            text, style = f"{text} {suspects[sensor.name].label}", " marked"
        out.append(
            f'<path class="sensor{style}" d="{mark}V{row + 6:.1f}"/>'
            f'<text class="sensorname{style}" x="{x:.1f}" y="{row:.1f}">{escape(text)}</text>'
        )
    return out


def _dashpot(a: float, b: float) -> str:
    """A pot open to the left and the piston in it."""
    y, m = _AXIS, (a + b) / 2
    return (
        f'<path class="spring" d="M{a:.1f} {y}H{m:.1f}m0 -7v14'
        f'M{m - 8:.1f} {y - 10}H{m + 9:.1f}v20H{m - 8:.1f}M{m + 9:.1f} {y}H{b:.1f}"/>'
    )


def _value(p: Parameter) -> str:
    """A parameter as the file writes it; in the SI with a prefix of thousands."""
    value, unit = p.shown()
    if unit == "1":
        return f"{value:.4g}"
    return f"{value:.4g} {pretty(unit)}" if p.written else _si(value, pretty(unit))


def _si(value: float, unit: str) -> str:
    """`267 kN m`: three digits with a prefix of thousands."""
    for factor, prefix in ((1e9, "G"), (1e6, "M"), (1e3, "k")):
        if abs(value) >= factor:
            return f"{value / factor:.3g} {prefix}{unit}"
    return f"{value:.3g} {unit}"
