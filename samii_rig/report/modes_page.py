"""The page about modes: tables, stabilisation diagrams to pick from, shapes on the chain."""

from __future__ import annotations

from collections.abc import Sequence

from markupsafe import Markup

from samii_rig.modal.selection import FALSE_ALARM
from samii_rig.report import facts
from samii_rig.report.drawing import draw
from samii_rig.report.modes import Modes, best_known, pm, rows, sentences
from samii_rig.report.modes_drawing import motions
from samii_rig.report.modes_plots import shape, stabilisation
from samii_rig.report.shell import Plot, page_text
from samii_rig.rig.schema import Rig
from samii_rig.types import Recording


def modes_page(
    recordings: Sequence[Recording],
    all_modes: Sequence[Modes],
    lost: Sequence[str],
    rig: Rig | None,
) -> str:
    """The page as text."""
    diagrams: list[Plot] = []
    shapes: list[Plot] = []
    for k, m in enumerate(all_modes):
        said = f"{m.name}; dotted lines are the modes, grey is the sum of the responses."
        diagrams.append(Plot(f"poles-{k}", "Poles", said, stabilisation(m.response, m.found)))
    best = best_known(all_modes)
    if best is not None:
        shapes = [_shape(best, i) for i in range(len(best.found.modes))]
    return page_text(
        "modes_page.html.j2",
        [*diagrams, *shapes],
        title=f"Modes: {facts.title(recordings, rig)}",
        subtitle=facts.subtitle(recordings, rig),
        said=sentences(all_modes, lost),
        rows=rows(all_modes),
        held=any(m.known for m in all_modes),
        against=any(m.other for m in all_modes),
        false_alarm=f"{FALSE_ALARM:g}",
        diagrams=diagrams,
        shapes=shapes,
        motions=motions(all_modes),
        chain=Markup(draw(rig)) if rig else "",
        chain_caption=rig.description if rig else "",
    )


def _shape(m: Modes, i: int) -> Plot:
    mode = m.found.modes[i]
    said = f"{pm(mode.frequency_hz)} Hz, damping {pm(mode.damping, 100)} %"
    return Plot(f"shape-{i}", f"Mode {i + 1} at {m.name}.", said, shape(m, i))
