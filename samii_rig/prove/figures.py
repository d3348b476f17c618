"""Pictures of the proof, as SVG text that stands inside a page."""

from __future__ import annotations

import io
from collections.abc import Sequence

import matplotlib
import matplotlib.patches
import numpy as np
from matplotlib.figure import Figure

from samii_rig.prove.score import Score, reliability, stated
from samii_rig.prove.trial import Trial

GOOD, BAD, INK = "#0072B2", "#D55E00", "#3c4650"
CELL = 0.27  # inch, a cell of the confusion matrix


def _svg(figure: Figure) -> str:
    out = io.StringIO()
    # A fixed salt: the same trials give the same bytes.
    with matplotlib.rc_context({"svg.hashsalt": "samii-rig", "svg.fonttype": "none"}):
        figure.savefig(out, format="svg", metadata={"Date": None, "Creator": None})
    return out.getvalue()[out.getvalue().index("<svg") :]


def calibration(trials: Sequence[Trial]) -> str:
    """Frequency of being right against the probability stated; the area of a dot is its count."""
    figure = Figure(figsize=(4.2, 3.6), layout="constrained")
    axes = figure.subplots()
    axes.plot([0, 1], [0, 1], color="0.6", lw=1, ls="--", label="honest")
    rows = reliability([stated(t) for t in trials])
    if rows:
        p, f, n = np.array(rows).T
        axes.plot(p, f, color=GOOD, lw=1)
        axes.scatter(p, f, s=12 + 200 * n / n.max(), color=GOOD, alpha=0.7, lw=0)
        for x, y, count in rows:
            axes.annotate(f"{count}", (x, y), (6, -9), textcoords="offset points", fontsize=7)
    axes.set(xlim=(0, 1.03), ylim=(0, 1.05), xlabel="probability stated", ylabel="frequency right")
    axes.grid(color="0.9", lw=0.5)
    axes.spines[["top", "right"]].set_visible(False)
    return _svg(figure)


def sizes(rows: Sequence[tuple[str, Sequence[Score]]]) -> str:
    """How often detected, placed and named, against the size of the effect."""
    figure = Figure(figsize=(5.2, 3.6), layout="constrained")
    axes = figure.subplots()
    at = np.arange(len(rows))
    colours = ("0.45", "#009E73", GOOD, BAD)
    for i, colour in enumerate(colours):
        some = [scores[i] for _, scores in rows]
        value = np.array([s.value for s in some])
        error = np.array([[s.value - s.low, s.high - s.value] for s in some]).T
        x = at + 0.07 * (i - 1.5)
        axes.errorbar(
            x, value, np.maximum(error, 0.0), fmt="o-", ms=4, lw=1, capsize=2, color=colour,
            label=some[0].what,
        )  # fmt: skip
    axes.set_xticks(at, [f"{label}\nn = {scores[0].n}" for label, scores in rows], fontsize=8)
    axes.set(ylim=(-0.03, 1.05), xlabel="size of the effect, sigma", ylabel="frequency")
    axes.legend(fontsize=8, frameon=False, loc="center right")
    axes.grid(color="0.9", lw=0.5)
    axes.spines[["top", "right"]].set_visible(False)
    return _svg(figure)


def confusion_matrix(counts: dict[tuple[str, str], int]) -> str:
    """Rows: what was hidden; columns: what was said; blue on the diagonal, orange beside it."""
    hidden = sorted({h for h, _ in counts})
    beside = sorted({s for _, s in counts} - set(hidden))
    said = [*hidden, *beside]
    figure = Figure(
        figsize=(2.6 + CELL * len(said), 2.2 + CELL * max(len(hidden), 1)), layout="constrained"
    )
    axes = figure.subplots()
    for (h, s), n in counts.items():
        total = sum(m for (other, _), m in counts.items() if other == h)
        x, y = said.index(s), hidden.index(h)
        colour = GOOD if h == s else BAD
        axes.add_patch(
            matplotlib.patches.Rectangle((x - 0.5, y - 0.5), 1, 1, color=colour, alpha=n / total)
        )
        axes.text(
            x, y, str(n), ha="center", va="center", fontsize=7,
            color="white" if n / total > 0.5 else INK,
        )  # fmt: skip
    axes.set_xticks(range(len(said)), said, rotation=90, fontsize=7.5)
    axes.set_yticks(range(len(hidden)), hidden, fontsize=7.5)
    axes.set(xlim=(-0.5, len(said) - 0.5), ylim=(len(hidden) - 0.5, -0.5))
    axes.set(xlabel="said", ylabel="hidden")
    axes.set_xticks(np.arange(len(said)) - 0.5, minor=True)
    axes.set_yticks(np.arange(len(hidden)) - 0.5, minor=True)
    axes.grid(which="minor", color="0.85", lw=0.5)
    axes.tick_params(which="both", length=0)
    axes.spines[:].set_visible(False)
    return _svg(figure)
