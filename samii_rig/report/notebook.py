"""The page's figures as plotly figures, for a notebook: what `plot()` of the data returns."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from plotly import graph_objects

from samii_rig.diagnose.result import Diagnosis
from samii_rig.errors import InputError
from samii_rig.report import canvas, plots
from samii_rig.report.diagnosis import plots as diagnosis_plots
from samii_rig.report.diagnosis.laws import QUANTITY, seen
from samii_rig.report.diagnosis.models import curve, refitted_nominal
from samii_rig.report.entries import Entry, entries
from samii_rig.report.series import pieces, time_series
from samii_rig.rig.schema import Rig
from samii_rig.types import FrequencyResponse, Recording

# The light scheme of the page (assets/page.js).
COLOURS = {
    "ink": "#16191d",
    "muted": "#7b8590",
    "grid": "#e3e7ec",
    "panel": "#ffffff",
    "bad": "#b3261e",
    "differs": "rgba(179,38,30,0.07)",
    **{
        f"level{k}": colour
        for k, colour in enumerate(
            ("#0b6bcb", "#c2571a", "#1a8a5a", "#8b4bb0", "#8f7300", "#3f7f90")
        )
    },
}
_SOFT = "38"  # opacity of a band


def series(recording: Recording) -> graph_objects.Figure:
    """Every channel of every segment over time; a menu chooses the segment."""
    parts = pieces([recording])
    if not parts:
        raise InputError("plot", "recording", "no sample", "at least one")
    made = time_series(parts)
    sets, layout = made["sets"], dict(made["layout"])
    data = [t | {"visible": k == 0} for k, one in enumerate(sets) for t in one["data"]]
    if len(sets) > 1:
        owner = [k for k, one in enumerate(sets) for _ in one["data"]]
        buttons = [
            {
                "label": one["name"],
                "method": "update",
                "args": [{"visible": [k == at for k in owner]}],
            }
            for at, one in enumerate(sets)
        ]
        layout["updatemenus"] = [{"buttons": buttons, "x": 0, "xanchor": "left", "y": 1.0,
                                  "yanchor": "bottom"}]  # fmt: skip
        layout["margin"] = layout["margin"] | {"t": 62}
    return figure({"data": data, "layout": layout})


def bode(
    responses: Sequence[FrequencyResponse],
    output: str = "",
    input: str = "",
    rig: Rig | None = None,
) -> graph_objects.Figure:
    """Gain, phase and coherence of one entry, each response with its 90 % band; model of `rig`.

    output, input : names of channels, "" for the first. InputError for a name that there is not.
    """
    entry = _entry(responses, output, input)
    model = curve(rig, rig.name, responses) if rig else None
    curves = plots.showing_curves(plots.curves_of(responses), entry)
    return figure(plots.bode(curves, entry, model))


def before_after(
    found: Diagnosis,
    responses: Sequence[FrequencyResponse],
    rig: Rig,
    output: str = "",
    input: str = "",
) -> graph_objects.Figure:
    """One entry with the refitted nominal model and with the causes found in it, and how far each
    is from the measurement in units of its noise."""
    entry = _entry(responses, output, input)
    before = curve(refitted_nominal(rig, responses, None), "refitted nominal model", responses)
    named = found.rig if found.causes else None
    after = curve(named, "with the causes", responses) if named else None
    curves = plots.showing_curves(plots.curves_of(responses), entry)
    return figure(diagnosis_plots.before_after(curves, entry, before, after))


def place(found: Diagnosis) -> graph_objects.Figure:
    """x(w) at the most probable place, free of any law: the part that is missing there."""
    if not found.traces:
        expected = "responses and rig, as no place stands out"
        raise InputError("plot", "diagnosis", found.verdict, expected)
    t = found.traces[0]
    quantity, unit = QUANTITY[t.jump, t.by]
    made = diagnosis_plots.free(t.frequency, seen(t), t.sd, quantity, unit)
    for trace in made["data"]:
        trace["name"] = t.site
    return figure(made)


def figure(description: canvas.Figure) -> graph_objects.Figure:
    """A plotly figure of one of the page's, in the light scheme."""
    layout = _coloured(description["layout"])
    colour = COLOURS["panel"]
    return graph_objects.Figure(
        data=_coloured(description["data"]),
        layout=layout | {"paper_bgcolor": colour, "plot_bgcolor": colour, "template": "none"},
    )


def _coloured(node: Any) -> Any:
    match node:
        case str() if node.startswith("@"):
            name = node[1:]
            return COLOURS[name.removesuffix("soft")] + (_SOFT if name.endswith("soft") else "")
        case dict():
            return {k: _coloured(v) for k, v in node.items()}
        case list():
            return [_coloured(v) for v in node]
    return node


def _entry(responses: Sequence[FrequencyResponse], output: str, input: str) -> Entry:
    if not responses:
        raise InputError("plot", "responses", "none", "at least one")
    found = entries(responses)
    y = _named([y for y, _ in found], "output", output)
    return y, _named([u for of, u in found if of == y], "input", input)


def _named(names: Sequence[str], what: str, name: str) -> str:
    if name and name not in names:
        raise InputError("plot", what, name, f"one of {', '.join(dict.fromkeys(names))}")
    return name or names[0]
