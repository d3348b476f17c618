"""Mode shapes that move: the model's chain between the sensors, the measured points on it.

Scalable vector graphics with their own animation, so that no script is needed. It rests until it
is clicked or reached by keyboard, and ends by itself: a page that moves unasked is not read.
"""

from __future__ import annotations

from collections.abc import Sequence
from html import escape

import numpy as np
from markupsafe import Markup

from samii_rig.modal.match import placed
from samii_rig.report.modes import Modes, best_known, pm
from samii_rig.types import Complex, Float

_WIDTH, _HEIGHT, _EDGE = 360.0, 150.0, 16.0  # user units, about a pixel
_REACH = 0.42  # of the height, that the largest displacement takes
_FRAMES = 24  # of one period
_SECONDS = 2.0  # of one period on the screen, whatever the mode's own
_PERIODS = 10


def motions(all_modes: Sequence[Modes]) -> list[tuple[str, Markup]]:
    """What is said of each mode of the best known level, and its drawing that moves."""
    best = best_known(all_modes)
    if best is None:
        return []
    count = range(len(best.found.modes))
    drawn = [(f"Mode {k + 1} at {best.name}", motion(best, k)) for k in count]
    return [(said, Markup(svg)) for said, svg in drawn if svg]


def motion(m: Modes, i: int) -> str:
    """An SVG of mode i along the chain; "" without a mode of the model to draw between sensors, and
    of a chain that has no length."""
    mode, held = m.found.modes[i], m.of_model(i)
    seen = placed(m.found, mode, held[0]) if held else None
    if held is None or seen is None:
        return ""
    known, (at, w, _) = held[0], seen
    keep = np.concatenate([np.diff(known.x) > 0, [True]])  # elements without length share a place
    x, curve = known.x[keep], known.w[keep]
    if len(x) < 2:  # masses on springs have no length: all of them share one place
        return ""
    size = float(max(np.abs(curve).max(), np.abs(w).max()))
    across = _EDGE + (_WIDTH - 2 * _EDGE) * (x - x[0]) / (x[-1] - x[0])
    places = _EDGE + (_WIDTH - 2 * _EDGE) * (at - x[0]) / (x[-1] - x[0])
    id_ = f"motion{i}"  # a hyphen would be a minus in the animation's begin
    title = f"Mode {i + 1}, {pm(mode.frequency_hz)} Hz, at {m.name}: click to see it move"
    marks = "".join(_mark(id_, px, _heights(np.array([z]), size)) for px, z in
                    zip(places, w, strict=True))  # fmt: skip
    middle = _HEIGHT / 2
    return (
        f'<svg id="{id_}" viewBox="0 0 {_WIDTH:.0f} {_HEIGHT:.0f}" role="img" tabindex="0" '
        f'style="cursor:pointer;max-width:100%"><title>{escape(title)}</title>'
        f'<rect width="{_WIDTH:.0f}" height="{_HEIGHT:.0f}" fill="transparent"/>'
        f'<path d="M{_EDGE} {middle}H{_WIDTH - _EDGE}" stroke="currentColor" opacity="0.4" '
        f'stroke-dasharray="2 4"/>{_line(id_, across, _heights(curve, size))}{marks}</svg>'
    )


def _heights(w: Complex, size: float) -> Float:
    """(n_frame + 1, n) heights over one period, the first frame the shape as it is shown."""
    turn = np.exp(2j * np.pi * np.arange(_FRAMES + 1) / _FRAMES)
    shown = (turn[:, None] * w[None, :]).real / size
    return np.asarray(_HEIGHT * (0.5 - _REACH * shown))


def _line(id_: str, x: Float, y: Float) -> str:
    frames = ["M" + "L".join(f"{a:.1f} {b:.1f}" for a, b in zip(x, row, strict=True)) for row in y]
    return (
        f'<path d="{frames[0]}" fill="none" stroke="currentColor" stroke-width="2">'
        f"{_animated(id_, 'd', frames)}</path>"
    )


def _mark(id_: str, x: float, y: Float) -> str:
    frames = [f"{row[0]:.1f}" for row in y]
    return (
        f'<circle cx="{x:.1f}" cy="{frames[0]}" r="5" fill="#0072B2">'
        f"{_animated(id_, 'cy', frames)}</circle>"
    )


def _animated(id_: str, name: str, frames: list[str]) -> str:
    return (
        f'<animate attributeName="{name}" begin="{id_}.click;{id_}.focusin" dur="{_SECONDS:g}s" '
        f'repeatCount="{_PERIODS}" values="{";".join(frames)}"/>'
    )
