"""The page of the proof for the documentation, in Markdown: every figure with its goal, by size, by
plant, rig and style, and what failed."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from importlib import resources
from pathlib import Path
from typing import Any

import jinja2
import numpy as np

from samii_rig.prove.outcomes import Outcome, trials
from samii_rig.prove.page import FAILURES, acceptable, cells, failure
from samii_rig.prove.score import Score, by_group, by_physics, by_size, scores
from samii_rig.record.export import replacing

PARTS = ("plant", "size", "diagnosis")


def write(path: Path, made: Mapping[str, Any], outcomes: Sequence[Outcome], kept: str) -> None:
    """Write the page; `kept` is the name of the file of outcomes beside it."""
    with replacing(path) as part:
        part.write_text(render(made, outcomes, kept), encoding="utf-8")


def render(made: Mapping[str, Any], outcomes: Sequence[Outcome], kept: str) -> str:
    """The page as text. made : of the campaign, as `campaign.claim` noted it."""
    all_trials = trials(outcomes)
    broken = [o for o in outcomes if "error" in o]
    failed = sum(o.get("at") == "diagnosis" for o in broken)
    wrong = sorted((t for t in all_trials if not acceptable(t)), key=lambda t: -t.truth.size)
    ranked = [t for t in wrong if t.truth.size >= 10.0 or not t.truth.effects]
    return _template().render(
        made=made,
        kept=kept,
        n=len(all_trials),
        kinds=Counter(t.truth.kind for t in all_trials),
        plants=Counter(t.truth.plant for t in all_trials),
        scores=[cells(s) for s in scores(all_trials, failed)],
        sizes=_table(by_size(all_trials)),
        groups=[
            ("plant", _table(by_group(all_trials, lambda t: [t.truth.plant]))),
            ("rig", _table(by_group(all_trials, lambda t: [t.truth.rig]))),
            ("excitation", _table(by_group(all_trials, lambda t: t.truth.styles[:1]))),
            ("what the recording has", _table(by_group(all_trials, lambda t: t.truth.styles[1:]))),
        ],
        physics=_table(by_physics(all_trials)),
        seconds=_seconds(outcomes),
        failures=[failure(t) for t in ranked[:FAILURES]],
        hidden_failures=max(0, len(ranked) - FAILURES),
        broken=[_broken(o) for o in broken],
    )


def _table(rows: Sequence[tuple[str, Sequence[Score]]]) -> list[tuple[str, list[str]]]:
    return [(name, [_cell(s) for s in some]) for name, some in rows]


def _cell(s: Score) -> str:
    """Value and number of trials; bold where a goal is missed."""
    if math.isnan(s.value):
        return ""
    said = f"{cells(s)['value']} of {s.n}"
    return f"**{said}**" if s.met is False else said


def _seconds(outcomes: Sequence[Outcome]) -> list[tuple[str, str]]:
    """Of each part of a trial, process time in s: mean, median, 95 %, longest."""
    out = []
    for part in PARTS:
        x = [o["seconds"][part] for o in outcomes if part in o["seconds"]]
        if x:
            q = np.quantile(x, [0.5, 0.95, 1.0])
            out.append((part, " | ".join(f"{v:.1f}" for v in (np.mean(x), *q))))
    return out


def _broken(o: Outcome) -> dict[str, str]:
    what = " ".join(str(o["error"]).split())
    return {"trial": f"{o['kind']} {o['seed']}", "where": f"{o['plant']}, {o['rig']}, {o['at']}",
            "error": what[:200].replace("|", "/")}  # fmt: skip


def _template() -> jinja2.Template:
    text = (resources.files("samii_rig.prove") / "evidence.md.j2").read_text("utf-8")
    environment = jinja2.Environment(
        autoescape=False,  # Markdown of our own words and names
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    return environment.from_string(text)
