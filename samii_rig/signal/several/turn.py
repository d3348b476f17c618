"""Inputs one after the other while all others rest: each column by itself, then side by side.

Experiments of different inputs share no noise, so the covariance of all entries has one block for
each input, and a column is the response that the recordings of its input alone would give.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from samii_rig.errors import EstimateError
from samii_rig.types import Finding, Float, FrequencyResponse, Recording, Segment

SAME_HZ = 1e-6  # Hz, within which two lines are one


def by_input(
    recordings: Sequence[Recording], inputs: Sequence[str]
) -> dict[str, list[Recording]] | None:
    """For each input the segments in which it moves; None where two move in one segment."""
    out: dict[str, list[Recording]] = {name: [] for name in inputs}
    for recording in recordings:
        segments = [s for s in recording.segments if s.kind != "transient"]
        own: dict[str, list[Segment]] = {}
        for cut in [recording.cut(s) for s in segments] or [recording]:
            moving = [n for n in inputs if _moves(cut, n)]
            if len(moving) > 1:
                return None
            if moving:
                own.setdefault(moving[0], []).extend(cut.segments)
        for name, found in own.items():
            out[name].append(replace(recording, segments=tuple(found)))
    return out


def _moves(cut: Recording, name: str) -> bool:
    x = cut.values_of(name)
    x = x[np.isfinite(x)]
    return bool(x.size) and bool(np.ptp(x) > 0)


def side_by_side(
    found: Sequence[Sequence[FrequencyResponse]],
) -> tuple[list[FrequencyResponse], list[Finding]]:
    """One response for each level that all inputs share, and what has no fellow.

    found : of each input, its responses. Those of equal level go together; what is left, where
        each input has as many, in order of level. EstimateError where nothing goes together.
    """
    left = [sorted(own, key=lambda r: r.level) for own in found]
    out: list[FrequencyResponse] = []
    for first in list(left[0]):
        fellows = [next((r for r in own if _fellows(first, r)), None) for own in left]
        chosen = [r for r in fellows if r is not None]
        if len(chosen) == len(left):
            out.append(columns_of(chosen))
            left = [
                [r for r in own if r is not used] for own, used in zip(left, chosen, strict=True)
            ]
    if len({len(own) for own in left}) == 1:
        out += [columns_of(chosen) for chosen in zip(*left, strict=True)]
        left = [[] for _ in left]
    alone = [r for own in left for r in own]
    if not out:
        levels = "; ".join(
            f"{own[0].inputs[0].name} at {', '.join(f'{r.level:g} {r.level_unit}' for r in own)}"
            for own in left
            if own
        )
        raise EstimateError(f"no level is common to the inputs: {levels}; expected one of each")
    lost = [
        Finding(
            "repeat",
            "warning",
            f"{r.inputs[0].name} at {r.level:g} {r.level_unit} left out: no other input was "
            f"driven at that level; input={r.inputs[0].name!r} estimates it alone",
            r.inputs[0].name,
        )
        for r in alone
    ]
    return out, lost


def _fellows(a: FrequencyResponse, b: FrequencyResponse) -> bool:
    level = bool(np.isclose(a.level, b.level, rtol=1e-6, equal_nan=True))
    return level and a.level_unit == b.level_unit and a.estimator == b.estimator


def columns_of(responses: Sequence[FrequencyResponse]) -> FrequencyResponse:
    """One response from those to one input each, on the lines and outputs that all have.

    covariance : one block an input. dof : n_in times the smallest of a column.

    Raises EstimateError if they have no line or no output in common.
    """
    lines = _common_lines(responses)
    names = [[c.name for c in r.outputs] for r in responses]
    kept = [n for n in names[0] if all(n in other for other in names)]
    if not kept or not lines[0].size:
        what = "outputs" if not kept else "lines"
        of = ", ".join(r.inputs[0].name for r in responses)
        raise EstimateError(f"the responses to {of} share no {what}; expected sweeps of one length")
    rows = [[own.index(n) for n in kept] for own in names]
    n_in, n_out, n_freq = len(responses), len(kept), lines[0].size
    first = responses[0]
    covariance = np.zeros((n_freq, n_out, n_in, n_out, n_in), complex)
    for i, (r, at, own) in enumerate(zip(responses, lines, rows, strict=True)):
        covariance[:, :, i, :, i] = r.covariance[at][:, own][:, :, own]
    levels = {r.level for r in responses}
    findings = tuple(dict.fromkeys(f for r in responses for f in r.findings))
    p = n_out * n_in
    return replace(
        first,
        frequency=first.frequency[lines[0]],
        H=_stacked([r.H[at][:, own, 0] for r, at, own in zip(responses, lines, rows, strict=True)]),
        covariance=covariance.reshape(n_freq, p, p),
        dof=n_in * np.min([r.dof[at] for r, at in zip(responses, lines, strict=True)], axis=0),
        coherence=_coherence(responses, lines, rows),
        inputs=tuple(r.inputs[0] for r in responses),
        outputs=tuple(first.outputs[k] for k in rows[0]),
        level=first.level if len(levels) == 1 else float("nan"),
        input_rms=_stacked([r.input_rms[at][:, 0] for r, at in zip(responses, lines, strict=True)]),
        n_averages=sum(r.n_averages for r in responses),
        method="; ".join((*dict.fromkeys(r.method for r in responses), "inputs in turn")),
        why=_why(responses),
        even=_largest([r.even for r in responses], lines, rows),
        odd=_largest([r.odd for r in responses], lines, rows),
        findings=(*findings, *_narrowed(responses, lines)),
        sources=tuple(dict.fromkeys(s for r in responses for s in r.sources)),
    )


def _why(responses: Sequence[FrequencyResponse]) -> str:
    if len({r.why for r in responses}) == 1:
        return responses[0].why
    return "; ".join(f"{r.inputs[0].name}: {r.why}" for r in responses)


def _common_lines(responses: Sequence[FrequencyResponse]) -> list[np.ndarray]:
    rounded = [np.round(r.frequency / SAME_HZ).astype(np.int64) for r in responses]
    common = rounded[0]
    for other in rounded[1:]:
        common = common[np.isin(common, other)]
    return [np.flatnonzero(np.isin(own, common)) for own in rounded]


def _stacked(columns: Sequence[np.ndarray]) -> np.ndarray:
    return np.stack(columns, axis=-1)


def _coherence(
    responses: Sequence[FrequencyResponse],
    lines: Sequence[np.ndarray],
    rows: Sequence[Sequence[int]],
) -> Float:
    """Part of the power over all experiments that the inputs explain: multiple coherence."""
    signal, total = 0.0, 0.0
    for r, at, own in zip(responses, lines, rows, strict=True):
        size = np.where(np.isfinite(r.input_rms[at]), r.input_rms[at], 1.0)
        power = np.abs(r.H[at][:, own, 0] * size) ** 2
        gamma = np.clip(r.coherence[at][:, own], 1e-12, 1.0)
        signal, total = signal + power, total + power / gamma
    return np.asarray(np.divide(signal, total, out=np.zeros_like(total), where=total > 0))


def _largest(
    levels: Sequence[Float | None],
    lines: Sequence[np.ndarray],
    rows: Sequence[Sequence[int]],
) -> Float | None:
    own = [x[at][:, k] for x, at, k in zip(levels, lines, rows, strict=True) if x is not None]
    return np.max(own, axis=0) if len(own) == len(levels) else None


def _narrowed(responses: Sequence[FrequencyResponse], lines: Sequence[np.ndarray]) -> list[Finding]:
    lost = [r for r, at in zip(responses, lines, strict=True) if at.size < r.frequency.size]
    if not lost:
        return []
    names = ", ".join(r.inputs[0].name for r in lost)
    f = responses[0].frequency[lines[0]]
    text = f"{names}: lines that not all inputs have left out; {f[0]:.4g} to {f[-1]:.4g} Hz remain"
    return [Finding("leakage", "note", text)]
