"""The proof on one page: scores against goals, calibration, sizes, confusion, failures."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from importlib import resources
from pathlib import Path

import jinja2
from markupsafe import Markup

from samii_rig.prove import figures
from samii_rig.prove.score import SURE, Score, by_physics, by_size, confusion, scores
from samii_rig.prove.trial import Trial
from samii_rig.record.export import replacing

FAILURES = 60  # shown at most; the largest effects first


def write_page(
    path: Path, trials: Sequence[Trial], title: str = "The proof", failed: int = 0
) -> Path:
    """Write the page about `trials` to `path`; nothing half-written is left. failed : diagnoses
    that ended without an answer."""
    with replacing(path) as part:
        part.write_text(render(trials, title, failed), encoding="utf-8")
    return path


def render(trials: Sequence[Trial], title: str, failed: int = 0) -> str:
    """The page as text."""
    kinds = Counter(t.truth.kind for t in trials)
    wrong = sorted((t for t in trials if not acceptable(t)), key=lambda t: -t.truth.size)
    sizes = by_size(trials)
    style = (resources.files("samii_rig.report") / "assets" / "page.css").read_text("utf-8")
    return _template().render(
        title=title,
        subtitle=f"{len(trials)} concealed trials: {kinds['nothing']} hide nothing, "
        f"{kinds['one']} one effect, {kinds['two']} two, "
        f"{kinds['joints']} the give of every joint, {kinds['force']} a force, "
        f"{kinds['varying']} a stiffness that is not constant, {kinds['outside']} "
        "something outside the vocabulary. Every interval holds 90 %.",
        style=Markup(style),
        scores=[cells(s) for s in scores(trials, failed)],
        calibration=Markup(figures.calibration(trials)),
        sizes=Markup(figures.sizes(sizes)),
        confusion=Markup(figures.confusion_matrix(confusion(trials))),
        physics=[(name, [_cell(s) for s in some], some[0].n) for name, some in by_physics(trials)],
        failures=[failure(t) for t in wrong[:FAILURES]],
        hidden_failures=max(0, len(wrong) - FAILURES),
    )


def acceptable(trial: Trial) -> bool:
    """Right; or, of what lies outside the vocabulary, not named with confidence. What older trials
    had no word for may have a row of the table now."""
    if trial.right or trial.truth.kind != "outside":
        return trial.right
    return trial.answer.verdict != "named" or trial.confidence <= SURE


# Beginnings of the figures that are no frequencies.
PLAIN = ("AUROC", "expected", "parameter", "sigma", "s of", "calibration")


def cells(s: Score) -> dict[str, str]:
    """A score in words, for a row of a table."""
    share = not s.what.startswith(PLAIN)
    goal = _goal(s, share)
    word = {None: "", True: "met", False: "missed"}[s.met]
    mark = {None: "note", True: "good", False: "bad"}[s.met]
    return {
        "what": s.what,
        "value": _say(s.value, share),
        "interval": "" if math.isnan(s.low) else f"{_say(s.low, share)} to {_say(s.high, share)}",
        "n": str(s.n),
        "goal": goal,
        "word": word,
        "mark": mark,
    }


def _goal(s: Score, share: bool) -> str:
    if s.goal is None:
        return ""
    low, high = s.goal
    if math.isinf(low):
        return f"at most {_say(high, share)}"
    if math.isinf(high):
        return f"at least {_say(low, share)}"
    return f"{_say(low, share)} to {_say(high, share)}"


def _say(x: float, share: bool) -> str:
    if math.isnan(x):
        return "no trial tells"
    return f"{100 * x:.1f} %" if share else f"{x:.3f}"


def _cell(s: Score) -> str:
    return "" if math.isnan(s.value) else f"{100 * s.value:.0f} %"


def failure(t: Trial) -> dict[str, str]:
    """A trial that failed, for a row of a table."""
    hidden = ", ".join(f"{e.physics} at {e.site}" for e in t.truth.effects) or "nothing"
    said = ", ".join(f"{c.name[0]} at {c.name[1]} ({c.probability:.2f})" for c in t.answer.causes)
    return {
        "trial": f"{t.truth.kind} {t.truth.seed}",
        "where": f"{t.truth.plant}, {t.truth.rig}",
        "size": f"{t.truth.size:.1f}",
        "hidden": hidden,
        "said": f"{t.answer.verdict}: {said}" if said else t.answer.verdict,
    }


def _template() -> jinja2.Template:
    text = (resources.files("samii_rig.prove") / "page.html.j2").read_text("utf-8")
    environment = jinja2.Environment(
        autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    return environment.from_string(text)
