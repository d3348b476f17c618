"""Responses to several inputs at once: which experiments, which method, and what is said of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from samii_rig.errors import EstimateError, InputError, one_of
from samii_rig.signal import spectra
from samii_rig.signal.choose import Method, at_rest, choose
from samii_rig.signal.gather import Gaps
from samii_rig.signal.groups import Piece
from samii_rig.signal.several import lines, polynomial, reported, solve, welch
from samii_rig.signal.several.experiments import (
    Columns,
    Gathered,
    gather,
    outputs_of,
    references_in_use,
)
from samii_rig.signal.several.sets import Set, sets_of
from samii_rig.signal.several.undriven import driven_of
from samii_rig.signal.stepped import is_stepped
from samii_rig.types import Complex, Finding, Float, FrequencyResponse, Int, Recording

# Of the longest record of a set, what the shortest must have: loggers differ by some samples, and
# local models need no whole period; of a record half as long, half of the others would be lost.
CUT = 0.9
LOCAL_LINES = 2000  # of a local estimate at most; neighbours share their data anyhow


@dataclass(frozen=True, slots=True)
class How:
    """What was asked for; see `samii_rig.signal.estimate.estimate`."""

    outputs: Sequence[str] | None
    method: Method
    gaps: Gaps
    band: tuple[float, float] | None
    nperseg: int


def inputs_of(
    recordings: Sequence[Recording], input: str | Sequence[str] | None
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Names of the inputs, and of commands that move beside them and that nothing drives.

    The inputs are those asked for, else the commands that are driven in any recording; none where
    a single one moves or none does, which the estimate of one input finds by itself.

    Raises InputError for an `input` that is no command.
    """
    moving = [n for r in recordings for n in r.names("command") if r.largest(n) > 0]
    driven, undriven = driven_of(recordings, tuple(dict.fromkeys(moving)))
    if input is not None:
        given = (input,) if isinstance(input, str) else tuple(dict.fromkeys(input))
        for r in recordings if len(given) > 1 else ():
            known = [c.name for c in r.channels]
            for name in given:
                if name not in known:
                    where = r.source or "recording"
                    raise InputError(where, "input", name, one_of(name, known))
        sent = all(name in moving for name in given)
        return given, tuple(n for n in undriven if sent and n not in given)
    return driven if len(driven) > 1 or undriven else (), undriven


def together(
    recordings: Sequence[Recording],
    inputs: Sequence[str],
    references: Sequence[str] | None,
    how: How,
) -> list[FrequencyResponse]:
    """Responses to all `inputs`, one a level, where more than one moves in an experiment.

    Raises InputError for a method that serves one input alone, EstimateError where there are fewer
    independent experiments than inputs or stepped sines move several.
    """
    if how.method in ("h2", "hv"):
        expected = "auto, burst, periodic, local or h1 with several inputs"
        raise InputError("estimate", "method", how.method, expected)
    if any(is_stepped(r, s) for r in recordings for s in r.segments):
        raise EstimateError(
            "stepped sines are estimated for inputs in turn, while the others rest; here several "
            "move at once: expected sweeps or multisines, or a single input"
        )
    recorded = references is not None or any(references_in_use(r) for r in recordings)
    gathered = gather(recordings, inputs, how.outputs, references, how.gaps)
    gathered = _without_still(gathered, chosen=how.outputs is not None)
    sets, lost = sets_of(gathered.experiments, gathered.columns, referenced=recorded)
    findings = [*gathered.findings, *lost]
    if not recorded:
        findings.append(reported.closed_loop(inputs))
    out: list[FrequencyResponse] = []
    failed: list[EstimateError] = []
    for own in sets:
        try:
            out.append(_one_set(own, gathered.columns, how, recorded=recorded))
        except EstimateError as error:
            failed.append(error)
    if not out:
        raise failed[0]
    findings += [Finding("repeat", "error", f"not estimated: {error}") for error in failed]
    out[0] = replace(out[0], findings=(*out[0].findings, *dict.fromkeys(findings)))
    return out


def _without_still(gathered: Gathered, *, chosen: bool) -> Gathered:
    """The same without outputs that never changed; refused where an input never moves."""
    columns = gathered.columns
    pieces = [p for e in gathered.experiments for p in e.group.pieces]
    still = [all(np.ptp(p.z[:, k]) == 0 for p in pieces) for k in range(len(columns.all))]
    resting = [c.name for c, s in zip(columns.all, still, strict=True) if s and c in columns.inputs]
    if resting:
        raise EstimateError(
            f"{pieces[0].name}: the input {', '.join(dict.fromkeys(resting))} never moves"
        )
    first = columns.part("outputs").start
    dead = [c.name for c, s in zip(columns.outputs, still[first:], strict=True) if s]
    if not dead:
        return gathered
    if chosen or len(dead) == len(columns.outputs):
        raise EstimateError(
            f"{pieces[0].name}: {', '.join(dead)} never changed while the inputs moved"
        )
    kept = [k for k in range(len(columns.all)) if k < first or not still[k]]
    for e in gathered.experiments:
        e.group.pieces = [replace(p, z=p.z[:, kept]) for p in e.group.pieces]
    left = tuple(c for c in columns.outputs if c.name not in dead)
    text = f"{', '.join(dead)} never changed while the inputs moved; left out"
    finding = Finding("stuck", "error", text, channel=dead[0])
    return Gathered(
        replace(columns, outputs=left), gathered.experiments, [*gathered.findings, finding]
    )


def _one_set(own: Set, columns: Columns, how: How, *, recorded: bool) -> FrequencyResponse:
    names = [c.name for c in columns.inputs]
    n = len(own.experiments)
    level = f"at {own.level:g} {own.experiments[0].group.unit}" if np.isfinite(own.level) else "all"
    continuous = all(e.group.kind == "single" for e in own.experiments) or how.method == "h1"
    if not continuous:
        solve.require_independent(np.ones(1, bool), n, names, f"recordings {level}")
    if how.method == "h1":
        return _welch(own, columns, how, recorded=recorded)
    chosen: list[tuple[str, str]] = []
    for e in own.experiments:
        seen = outputs_of(e.group, columns)
        chosen.append(choose(seen, how.method))
        e.group.unsettled, e.group.findings = seen.unsettled, seen.findings
    if any(method == "local" for method, _ in chosen):
        why = next(why for method, why in chosen if method == "local")
        return _local(own, columns, how, why, recorded=recorded)
    return _lines(own, columns, how, chosen, recorded=recorded)


def _lines(
    own: Set, columns: Columns, how: How, chosen: list[tuple[str, str]], *, recorded: bool
) -> FrequencyResponse:
    parts = [
        lines.measured(e, method, columns)
        for e, (method, _) in zip(own.experiments, chosen, strict=True)
    ]
    if len({m.frequency.size for m in parts}) > 1:
        raise EstimateError("the experiments differ in length; expected one length for all inputs")
    refs = columns.part("references")
    mean = np.stack([m.Z[:, :, refs].mean(axis=0) for m in parts], axis=2)
    periodic = all(method == "periodic" for method, _ in chosen)
    at = _band(mean, parts, how.band, periodic=periodic)
    R = _references(mean[at], own, columns) if recorded else None
    realised = periodic and _realised(own, len(columns.inputs))
    found = lines.estimate(parts, columns, at, R, own.classes, realised=realised)
    if periodic:
        amplitude = np.sqrt(2 * found.input / parts[0].n_samples)
    else:
        amplitude = _at_passing(own, parts, columns, found.at)
    return reported.of_lines(own, columns, found, amplitude, chosen[0])


def _band(
    mean: Complex,
    parts: Sequence[lines.Measured],
    band: tuple[float, float] | None,
    *,
    periodic: bool,
) -> Int:
    """The lines that any reference of any experiment excites."""
    top = np.abs(mean).max(axis=(0, 2), keepdims=True)
    power = np.sum(np.abs(mean / np.where(top > 0, top, 1.0)) ** 2, axis=(1, 2))
    carrier = spectra.Spectrum(
        parts[0].frequency, np.sqrt(power) + 0j, parts[0].Z[0], parts[0].n_samples
    )
    return spectra.comb([carrier], band) if periodic else spectra.excited([carrier], band)


def _references(mean: Complex, own: Set, columns: Columns) -> Complex:
    """R (n_freq, n_ref, E); one column for all inputs counts as one for each that it drives."""
    if mean.shape[1] >= len(columns.inputs):
        return mean
    names = [c.name for c in columns.inputs]
    R = np.zeros((len(mean), len(names), mean.shape[2]), complex)
    for k, label in enumerate(own.labels):
        R[:, names.index(label[0]), k] = mean[:, :, k].sum(axis=1)
    return R


def _realised(own: Set, n_in: int) -> bool:
    """Whether there are more experiments than inputs, in every class that drives some alone."""
    return all(
        len(members) > (n_in if len(own.labels[members[0]]) > 1 else 1) for members in own.classes
    )


def _at_passing(own: Set, parts: Sequence[lines.Measured], columns: Columns, at: Int) -> Float:
    """(n_freq, n_in) rms of each input as a sweep passes the line, of the experiment that drives
    it most."""
    out = []
    for e, m in zip(own.experiments, parts, strict=True):
        piece = e.group.pieces[-1]
        carrier = np.abs(spectra.spectrum(piece, e.group.rate_hz).R[at])
        V = np.abs(m.Z[:, at, columns.part("inputs")].mean(axis=0))
        out.append(V / np.maximum(carrier, 1e-300)[:, None] * np.abs(piece.r).max() / np.sqrt(2))
    return np.asarray(np.max(out, axis=0))


def _local(own: Set, columns: Columns, how: How, why: str, *, recorded: bool) -> FrequencyResponse:
    """Local polynomials over all records of the set, cut to the shortest."""
    records = _records(own, columns, recorded=recorded)
    rate = own.experiments[0].group.rate_hz
    shortest, longest = (f(len(p) for p in records) for f in (min, max))
    if shortest < CUT * longest:
        raise EstimateError("the records differ in length; expected one length for all of them")
    records = [replace(p, z=p.z[:shortest], r=p.r[:shortest]) for p in records]
    found = [spectra.spectrum(p, rate) for p in records]
    at = spectra.excited(found, how.band)
    at = at[:: max(1, -(-at.size // LOCAL_LINES))]
    n_in = len(columns.inputs)
    # A record that was cut need not end at rest.
    still = shortest == longest and all(
        at_rest(outputs_of(e.group, columns)) for e in own.experiments
    )
    fit = polynomial.fit(found, at, n_in, at_rest=still)
    names = [c.name for c in columns.inputs]
    solve.require_independent(fit.apart, n_in, names, f"{len(records)} records")
    return reported.of_local(own, columns, fit, found[0].frequency[at], why, len(records), still)


def _records(own: Set, columns: Columns, *, recorded: bool) -> list[Piece]:
    """All pieces with z of as many references as inputs, the inputs and the outputs."""
    refs, n_in = columns.part("references"), len(columns.inputs)
    names = [c.name for c in columns.inputs]
    used = np.arange(refs.stop)
    if used.size > n_in:  # others may move in other sets: set points where here it is the outputs
        moved = {n for e in own.experiments for n in e.used}
        used = np.array([k for k, c in enumerate(columns.references) if c.name in moved])
    out = []
    for e, label in zip(own.experiments, own.labels, strict=True):
        for p in e.group.pieces:
            r = p.z[:, used]
            if recorded and r.shape[1] < n_in:
                single, r = r.sum(axis=1), np.zeros((len(p), n_in))
                r[:, names.index(label[0])] = single
            elif r.shape[1] > n_in:
                found = [c.name for c in columns.references]
                raise InputError("estimate", "reference", found, f"one for each of {names}")
            out.append(replace(p, z=np.hstack([r, p.z[:, refs.stop :]])))
    return out


def _welch(own: Set, columns: Columns, how: How, *, recorded: bool) -> FrequencyResponse:
    records, n_in = _records(own, columns, recorded=recorded), len(columns.inputs)
    rate = own.experiments[0].group.rate_hz
    found = welch.response([p.z for p in records], rate, n_in, how.nperseg)
    return reported.of_welch(own, columns, found, how.band, how.nperseg)
