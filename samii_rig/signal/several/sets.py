"""Which experiments are solved together: those of one level, or in turn those of each input."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from samii_rig.signal.several.experiments import Columns, Experiment
from samii_rig.types import Finding

# Part of its largest rms in any experiment above which an input without a reference is driven.
DRIVEN = 0.5


@dataclass(frozen=True, slots=True)
class Set:
    """Experiments that give one response. labels : of each, what drives it, by name."""

    experiments: list[Experiment]
    labels: list[tuple[str, ...]]

    @property
    def classes(self) -> list[list[int]]:
        """Experiments of one label, by index: their noise and distortion are alike."""
        kinds = list(dict.fromkeys(self.labels))
        return [[k for k, x in enumerate(self.labels) if x == kind] for kind in kinds]

    @property
    def level(self) -> float:
        """That of all experiments; NaN where they differ."""
        levels = {e.group.level for e in self.experiments}
        return levels.pop() if len(levels) == 1 else float("nan")


def sets_of(
    experiments: Sequence[Experiment], columns: Columns, *, referenced: bool
) -> tuple[list[Set], list[Finding]]:
    """Sets by level, and what belongs to none.

    Where the experiments of one level drive all inputs they are one set. What is left goes
    together by its order of level, where each input has as many.
    """
    labels = _labels(experiments, columns, referenced=referenced)
    n_in = len(columns.inputs)
    by_level: dict[tuple[object, ...], list[int]] = {}
    for k, e in enumerate(experiments):
        g = e.group
        by_level.setdefault((g.kind, g.unit, f"{g.level:g}", len(g.pieces[0])), []).append(k)
    chosen = [own for own in by_level.values() if _spans([labels[k] for k in own], n_in)]
    rest = [k for own in by_level.values() if own not in chosen for k in own]
    by_label: dict[tuple[str, ...], list[int]] = {}
    for k in sorted(rest, key=lambda k: experiments[k].group.level):
        by_label.setdefault(labels[k], []).append(k)
    even = len({len(own) for own in by_label.values()}) == 1
    if even and _spans(list(by_label), n_in):
        chosen += [list(own) for own in zip(*by_label.values(), strict=True)]
        rest = []
    if not chosen:  # solving them says what is missing
        chosen, rest = [list(range(len(experiments)))], []
    lost = [
        Finding(
            "repeat",
            "warning",
            f"{experiments[k].group.pieces[0].name} left out: at "
            f"{experiments[k].group.level:g} {experiments[k].group.unit} not every input is driven",
        )
        for k in rest
    ]
    return [Set([experiments[k] for k in own], [labels[k] for k in own]) for own in chosen], lost


def _spans(labels: Sequence[tuple[str, ...]], n_in: int) -> bool:
    """Whether experiments of these labels can distinguish n_in inputs."""
    together = any(len(label) > 1 for label in labels)
    return len(labels) >= n_in and (together or len(set(labels)) >= n_in)


def _labels(
    experiments: Sequence[Experiment], columns: Columns, *, referenced: bool
) -> list[tuple[str, ...]]:
    """References in use; with fewer of them than inputs, the input that each drives; without
    any, the inputs that move by more than loops and noise."""
    inputs = columns.part("inputs")
    names = [c.name for c in columns.inputs]
    rms = np.array([_rms(e, inputs) for e in experiments])
    size = rms / np.maximum(rms.max(axis=0), 1e-300)
    if referenced and len(columns.references) >= len(names):
        return [e.used for e in experiments]
    if referenced:
        return [(names[int(np.argmax(own))],) for own in size]
    return [tuple(n for n, x in zip(names, own, strict=True) if x > DRIVEN) for own in size]


def _rms(e: Experiment, columns: slice) -> np.ndarray:
    return np.asarray(np.mean([p.z[:, columns].std(axis=0) for p in e.group.pieces], axis=0))
