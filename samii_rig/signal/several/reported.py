"""What was estimated of several inputs, as a `FrequencyResponse` with its words and findings."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy import special

from samii_rig.signal.distortion import FALSE_FINDINGS, NOTABLE
from samii_rig.signal.several.experiments import Columns
from samii_rig.signal.several.lines import Lines
from samii_rig.signal.several.polynomial import Fit
from samii_rig.signal.several.sets import Set
from samii_rig.signal.several.welch import Response
from samii_rig.types import Finding, Float, FrequencyResponse

MOST_LOST = 0.1  # of the lines, those that do not distinguish the inputs, that is worth a warning


def closed_loop(inputs: Sequence[str]) -> Finding:
    """What it costs that no reference was recorded."""
    text = (
        f"no reference was recorded, {', '.join(inputs)} take its place: if a loop acts on them, "
        "noise that came through the loop biases the estimate"
    )
    return Finding("closed_loop", "warning", text)


def of_lines(
    own: Set, columns: Columns, found: Lines, amplitude: Float, chosen: tuple[str, str]
) -> FrequencyResponse:
    """From an estimate line by line; chosen : method, and why."""
    method, why = chosen
    n = len(own.experiments)
    findings = [f for e in own.experiments for f in e.group.findings]
    findings += _lost_lines(found)
    noise = _relative(found.noise, found.output)
    distortion, scatter, over = None, found.noise, f"{found.repeats:.3g} repeats each"
    if found.total is not None:
        over = "experiments"
        scatter = found.total
        own_part = np.nan_to_num(found.noise) / found.repeats
        if np.isfinite(found.noise).all():
            distortion = _relative(np.maximum(found.total - own_part, 0.0), found.output)
            names = [c.name for c in columns.outputs]
            findings += _distorted(found, found.total, own_part, names)
    through = ", ".join(c.name for c in columns.references)
    many = f"{n} experiments of {len(columns.inputs)} inputs"
    holds = "the noise and what is not linear" if found.total is not None else "the noise"
    return _response(
        own,
        columns,
        frequency=found.frequency,
        H=found.H,
        covariance=found.covariance,
        dof=found.dof,
        coherence=_coherence(found.output, scatter),
        input_rms=amplitude,
        n_averages=found.n if found.total is None else n,
        method=f"{method} (inputs together, over {over}, through {through})",
        why=f"{why}; {many}, whose scatter holds {holds}; {found.remark}".rstrip("; ,"),
        noise=noise if np.isfinite(noise).all() else None,
        distortion=distortion,
        findings=findings,
    )


def of_local(
    own: Set, columns: Columns, fit: Fit, frequency: Float, why: str, n: int, still: bool
) -> FrequencyResponse:
    """From local polynomials over n records."""
    keep = fit.apart
    step = float(frequency[1] - frequency[0]) if frequency.size > 1 else 0.0
    findings = [f for e in own.experiments for f in e.group.findings]
    if lost := int(np.sum(~keep)):
        text = f"{lost} lines left out, at which the references do not differ"
        findings.append(Finding("leakage", "warning", text))
    through = ", ".join(c.name for c in columns.references)
    rest = "at rest at both ends: no transient" if still else f"{n} transients"
    return _response(
        own,
        columns,
        frequency=frequency[keep],
        H=fit.H[keep],
        covariance=fit.covariance[keep],
        dof=np.full(int(keep.sum()), fit.dof),
        coherence=_coherence(np.maximum(fit.output - fit.noise, 0.0), fit.noise)[keep],
        input_rms=np.full((int(keep.sum()), len(columns.inputs)), np.nan),
        n_averages=n,
        method=f"local (LPM, inputs together, through {through})",
        why=f"{why}; windows of {fit.rows} lines, lines {step:.3g} Hz apart; {rest}",
        noise=None,
        distortion=None,
        findings=findings,
    )


def of_welch(
    own: Set,
    columns: Columns,
    found: Response,
    band: tuple[float, float] | None,
    nperseg: int,
) -> FrequencyResponse:
    """From Welch's windows."""
    f = found.frequency
    keep = np.ones(f.size, bool) if band is None else (f >= band[0]) & (f <= band[1])
    rate = own.experiments[0].group.rate_hz
    text = (
        f"H1 by Welch windows of {nperseg / rate:g} s: for comparison; "
        "leakage biases it, and its covariance does not know"
    )
    n = int(keep.sum())
    return _response(
        own,
        columns,
        frequency=f[keep],
        H=found.H[keep],
        covariance=found.covariance[keep],
        dof=np.full(n, found.dof),
        coherence=found.coherence[keep],
        input_rms=np.full((n, len(columns.inputs)), np.nan),
        n_averages=found.n_frames,
        method=f"h1 (Welch, {nperseg} samples, Hann, inputs together)",
        why="asked for",
        noise=None,
        distortion=None,
        findings=[
            *(x for e in own.experiments for x in e.group.findings),
            Finding("leakage", "warning", text),
        ],
    )


def _response(
    own: Set,
    columns: Columns,
    *,
    dof: Float,
    findings: Sequence[Finding],
    **fields: object,
) -> FrequencyResponse:
    group = own.experiments[0].group
    sources = dict.fromkeys(s for e in own.experiments for s in e.group.sources)
    return FrequencyResponse(
        dof=dof * len(columns.inputs),
        inputs=columns.inputs,
        outputs=columns.outputs,
        level=own.level,
        level_unit=group.unit,
        rate_hz=group.rate_hz,
        findings=tuple(dict.fromkeys(findings)),
        sources=tuple(sources),
        **fields,  # type: ignore[arg-type]
    )


def _relative(power: Float, output: Float) -> Float:
    """(n_freq, n_out) rms relative to the rms of the output at the line."""
    return np.sqrt(np.divide(power, output, out=np.zeros_like(power), where=output > 0))


def _coherence(signal: Float, rest: Float) -> Float:
    """Multiple coherence: part of each output's power that all inputs together explain."""
    total = signal + rest
    return np.divide(signal, total, out=np.zeros_like(signal), where=total > 0)


def _lost_lines(found: Lines) -> list[Finding]:
    if not found.lost:
        return []
    part = found.lost / (found.lost + len(found.at))
    text = f"{found.lost} lines left out, at which the experiments do not tell the inputs apart"
    return [Finding("dof", "warning" if part > MOST_LOST else "note", text)]


def _distorted(found: Lines, total: Float, noise: Float, names: Sequence[str]) -> list[Finding]:
    """A finding for each output whose means scatter by more than their noise, at a chance of
    `FALSE_FINDINGS` for a linear rig: an F test over all lines, each in units of its noise."""
    out = []
    n = len(found.at)
    for i, name in enumerate(names):
        ratio = float(np.mean(total[:, i] / np.maximum(noise[:, i], 1e-300)))
        p = float(special.fdtrc(2 * n * found.nu[1], 2 * n * found.nu[0], ratio))
        if p >= FALSE_FINDINGS / len(names):
            continue
        excess = float(np.sum(total[:, i] - noise[:, i]))
        size = np.sqrt(max(excess, 0.0) / float(np.sum(found.output[:, i])))
        of_noise = np.sqrt(float(np.sum(found.noise[:, i]) / np.sum(found.output[:, i])))
        text = (
            f"what is not linear is {100 * size:.2g} % of {name} in one experiment, the noise of "
            f"one repeat {100 * of_noise:.2g} %: the response holds for this level"
        )
        finding = Finding("distortion", "note", text, channel=name)
        out.append(replace(finding, severity="warning") if size > NOTABLE else finding)
    return out
