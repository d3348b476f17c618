"""The rig's chain as a small drawing: base, elements, tip, sensors where they sit.

Colours come from the page's style sheet through the classes of the shapes.
"""

from __future__ import annotations

from html import escape

from samii_rig.report.compare import pretty
from samii_rig.rig.schema import (
    AbsoluteAngle,
    Acceleration,
    AngularVelocitySource,
    Beam,
    Element,
    Moment,
    RelativeAngle,
    Rig,
    RigidLink,
    TorsionalSpring,
)

# All in user units of the drawing, about a pixel.
_WIDTHS = {
    "beam": 190.0,
    "rigid_link": 96.0,
    "torsional_spring": 44.0,
    "angular_velocity_source": 56.0,
}
_MARGIN = 64.0
_AXIS = 118.0  # height of the chain's line
_LABEL_ROWS = (176.0, 222.0)  # names stand in two rows by turns, so that none touch
_SENSOR_ROWS = (22.0, 52.0)
_HEIGHT = 262.0
_HALF = 13.0  # half height of a link


def draw(rig: Rig) -> str:
    """An SVG drawing of `rig`, from base (left) to tip (right)."""
    x = _MARGIN
    spans: dict[str, tuple[float, float]] = {}
    shapes: list[str] = []
    for number, element in enumerate(rig.element):
        end = x + _WIDTHS[element.kind]
        spans[element.name] = (x, end)
        shapes.append(_element(element, x, end))
        shapes.append(_label(element, (x + end) / 2, _LABEL_ROWS[number % 2]))
        x = end
    width = x + _MARGIN
    shapes.append(_end(rig.base, _MARGIN, -1))
    shapes.append(_end(rig.tip, x, +1))
    shapes += _sensors(rig, spans)
    title = f"Chain of {rig.name}: {', '.join(e.name for e in rig.element)}"
    return (
        f'<svg class="chain" viewBox="0 0 {width:.0f} {_HEIGHT:.0f}" role="img" '
        f'style="max-width:{1.35 * width:.0f}px">'
        f"<title>{escape(title)}</title>{''.join(shapes)}</svg>"
    )


def _element(element: Element, a: float, b: float) -> str:
    y, middle = _AXIS, (a + b) / 2
    match element:
        case Beam():
            return f'<rect class="beam" x="{a:.1f}" y="{y - 4}" width="{b - a:.1f}" height="8"/>'
        case RigidLink():
            span = element.L.value
            at = a + (b - a) * (min(element.r.value / span, 1.0) if span > 0 else 0.5)
            return (
                f'<rect class="link" x="{a:.1f}" y="{y - _HALF}" width="{b - a:.1f}" '
                f'height="{2 * _HALF}" rx="7"/>'
                f'<circle class="centre" cx="{at:.1f}" cy="{y}" r="3.5"/>'
            )
        case TorsionalSpring():
            steps = 6
            w = (b - a - 12) / steps
            path = f"M{a:.1f} {y}h6" + "".join(
                f"l{w / 2:.1f} {-9 if k % 2 == 0 else 9}l{w / 2:.1f} {9 if k % 2 == 0 else -9}"
                for k in range(steps)
            )
            return f'<path class="spring" d="{path}h6"/>'
        case AngularVelocitySource():
            up = y + 17
            return (
                f'<path class="spring" d="M{a:.1f} {y}H{b:.1f}"/>'
                f'<circle class="source" cx="{middle:.1f}" cy="{y}" r="17"/>'
                f'<path class="arrow" d="M{middle - 8:.1f} {up - 12:.1f}a10 10 0 1 1 15 0'
                f'm-5 -1l5 1l1 -6"/>'
            )
    raise TypeError(type(element))


def _label(element: Element, x: float, y: float) -> str:
    match element:
        case Beam():
            detail = f"EI {_si(element.EI.value, pretty('N m^2'))}, {element.L.value:.3g} m"
        case RigidLink():
            detail = f"{element.m.value:.3g} kg, {element.L.value:.3g} m"
        case TorsionalSpring():
            detail = f"k {_si(element.k.value, 'N m/rad')}"
        case AngularVelocitySource():
            detail = f"input {element.input}"
    return (
        f'<path class="leader" d="M{x:.1f} {_AXIS + 22}V{y - 15:.1f}"/>'
        f'<text class="name" x="{x:.1f}" y="{y:.1f}">{escape(element.name)}</text>'
        f'<text class="detail" x="{x:.1f}" y="{y + 15:.1f}">{escape(detail)}</text>'
    )


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


def _sensors(rig: Rig, spans: dict[str, tuple[float, float]]) -> list[str]:
    places = []
    for sensor in rig.sensor:
        match sensor:
            case RelativeAngle():
                span = spans[sensor.across[0]][0], spans[sensor.across[-1]][1]
            case AbsoluteAngle() | Moment():
                span = (spans[sensor.after][1],) * 2
            case Acceleration():
                a, b = spans[sensor.on]
                host = next(e for e in rig.element if e.name == sensor.on)
                length = host.L.value if isinstance(host, Beam | RigidLink) else 0.0
                at = a + (b - a) * (sensor.position / length if length > 0 else 0.5)
                span = (at, at)
        places.append((sum(span) / 2, span, sensor))
    out = []
    for number, (x, (a, b), sensor) in enumerate(sorted(places, key=lambda p: p[0])):
        row = _SENSOR_ROWS[number % 2]
        foot = _AXIS - 20
        mark = f"M{a:.1f} {foot}v-8H{b:.1f}v8M{x:.1f} {foot - 8}" if b > a else f"M{x:.1f} {foot}"
        out.append(
            f'<path class="sensor" d="{mark}V{row + 6:.1f}"/>'
            f'<text class="sensorname" x="{x:.1f}" y="{row:.1f}">{escape(sensor.name)} '
            f"[{escape(pretty(sensor.unit))}]</text>"
        )
    return out


def _si(value: float, unit: str) -> str:
    """`267 kN m`: three digits with a prefix of thousands."""
    for factor, prefix in ((1e9, "G"), (1e6, "M"), (1e3, "k")):
        if abs(value) >= factor:
            return f"{value / factor:.3g} {prefix}{unit}"
    return f"{value:.3g} {unit}"
