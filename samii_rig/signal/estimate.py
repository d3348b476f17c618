"""Frequency responses from recordings: choose the method, estimate, say why."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

from samii_rig.errors import EstimateError, InputError, one_of
from samii_rig.signal import local, periodic, repeats, stepped, welch
from samii_rig.signal.choose import Method, at_rest, choose, drop_foreign, drop_stuck
from samii_rig.signal.columns import aligned
from samii_rig.signal.distortion import Distortion, distortion
from samii_rig.signal.gather import Gaps, gather
from samii_rig.signal.groups import Group, Piece
from samii_rig.signal.quantisation import floor_of
from samii_rig.signal.several import turn
from samii_rig.signal.several.estimate import How, inputs_of, together
from samii_rig.signal.several.undriven import apart
from samii_rig.signal.skew import skews_of, with_skew
from samii_rig.signal.spectra import (
    Spectrum,
    burst_spectra,
    comb,
    excited,
    rests,
    settled_spectra,
    spectrum,
)
from samii_rig.types import Complex, Finding, Float, FrequencyResponse, Int, Recording

LEAD_IN = 0.01  # of a burst; less rest before it cannot be tapered
# Of the strongest line, what input and reference have in common: less is rounding.
NO_POWER = 1e-14
# Frequencies of a local estimate at most; neighbours share their data anyhow.
LOCAL_LINES = 2000
# A local rational model is taken where it lowers the logarithm of the leave-one-out error
# by this much: 10 % in power, more than two models of noise alone differ by.
RATIONAL_GAIN = 0.1
# Least 1 - rho^2 between reference and transient (see `local.Windows.distinct`); in simulation
# the error is as stated above it, and up to 8 sigma off below.
DISTINCT = 0.5
# Lines that can be told from a transient below which a response is estimated by Welch's windows:
# with fewer nothing is diagnosed. Windows for each output, so that with those that overlap the
# covariance of all outputs' noise is known; and samples of one, below which it has hardly a line.
LEAST_CLEAR, WINDOWS, SHORTEST_WINDOW = 12, 4, 64
# Of an input's largest line, power up to which windows are of use: a step has that at 300 lines.
REACH = 1e-5


def estimate(
    recordings: Sequence[Recording],
    *,
    input: str | Sequence[str] | None = None,
    outputs: Sequence[str] | None = None,
    reference: str | Sequence[str] | None = None,
    method: Method = "auto",
    gaps: Gaps = "refuse",
    band: tuple[float, float] | None = None,
    nperseg: int = 2048,
) -> tuple[FrequencyResponse, ...]:
    """Frequency responses from the inputs to all outputs, one for each level and experiment.

    Parameters
    ----------
    recordings : segments of equal kind, level and reference are repeats of each other; a
        recording without segments is one segment.
    input, outputs : channel names; without them the commands that move, and all sensors. With
        several inputs see `samii_rig.signal.several`: in turn, each by itself while the others
        rest; else together.
    reference : columns that carry the excitation; without them the reference columns in use
        (for one input u + kp theta_ref when both are), and the inputs themselves when none is.
    method : `auto`; `burst` and `periodic` line by line over repeats; `local` local
        polynomial or rational models; `h1`, `h2`, `hv` Welch, for comparison.
    gaps : what to do with a segment that misses samples: `refuse`, `exclude` it, or `model`
        what follows a gap as a new transient (local models); `auto` excludes, and models where
        that would leave nothing. Nothing is made up.
    band : Hz; without it, where the reference has energy.
    nperseg : samples per window (Welch).

    Returns
    -------
    One `FrequencyResponse` per group, in order of appearance, those of stepped sines first.
    `method` and `why` say what was done; `findings` what was noticed, excluded or weakened.
    `input_rms` : of the sine at the time the sweep passes a frequency (periodic: of the line).

    Raises
    ------
    InputError : a channel, method or band that does not exist.
    EstimateError : the data do not allow it; the message says what would. Where other
        groups can be estimated, a group that cannot be becomes a finding of the first.
    """
    how = How(outputs, method, gaps, band, nperseg)
    _check(how)
    skews = skews_of(recordings)
    moved = aligned(recordings)
    recordings = [r for r, _ in moved]
    inputs, undriven = inputs_of(recordings, input)
    if undriven:
        sensors = [n for n in recordings[0].names("sensor") if n not in inputs]
        how = replace(how, outputs=[*(sensors if outputs is None else outputs), *undriven])
    if len(inputs) > 1:
        references = [reference] if isinstance(reference, str) else reference
        out = _several(recordings, inputs, references, how)
    else:
        single = reference if isinstance(reference, str) else next(iter(reference or ()), None)
        out = _one(recordings, next(iter(inputs), None), single, how)
    shifted = tuple(finding for _, finding in moved if finding)
    out[0] = replace(out[0], findings=(*out[0].findings, *shifted))
    return tuple(apart(with_skew(response, skews), undriven) for response in out)


def _check(how: How) -> None:
    """InputError for a method, a way with gaps or a band that does not exist."""
    if how.method not in get_args(Method):
        raise InputError("estimate", "method", how.method, one_of(how.method, get_args(Method)))
    if how.gaps not in get_args(Gaps):
        raise InputError("estimate", "gaps", how.gaps, one_of(how.gaps, get_args(Gaps)))
    if how.band is not None and not 0 <= how.band[0] < how.band[1]:
        expected = "two frequencies in Hz, 0 or more, low below high"
        raise InputError("estimate", "band", how.band, expected)


def _several(
    recordings: Sequence[Recording],
    inputs: Sequence[str],
    references: Sequence[str] | None,
    how: How,
) -> list[FrequencyResponse]:
    """Responses to several inputs: in turn where no two ever move at once, else together."""
    alone = turn.by_input(recordings, inputs)
    if alone is None:
        return together(recordings, inputs, references, how)
    for name, own in alone.items():
        if not own:
            rest = " ".join(f"input={n!r}" for n in inputs if n != name)
            raise EstimateError(
                f"the input {name} never moves in these recordings; expected an experiment that "
                f"drives it, or {rest}"
            )
    single = references[0] if references and len(references) == 1 else None
    found = [_one(own, name, single, how) for name, own in alone.items()]
    out, lost = turn.side_by_side(found)
    out[0] = replace(out[0], findings=(*out[0].findings, *lost))
    return out


def _one(
    recordings: Sequence[Recording], input: str | None, reference: str | None, how: How
) -> list[FrequencyResponse]:
    """Responses to one input; what could not be estimated is a finding of the first."""
    method, band = how.method, how.band
    gaps: Gaps = "exclude" if how.gaps == "auto" else how.gaps
    out: list[FrequencyResponse] = []
    failed: list[EstimateError] = []
    if method in ("auto", "periodic"):
        sines, recordings = stepped.split(recordings)
        out, failed = stepped.estimate_stepped(
            sines, input=input, outputs=how.outputs, reference=reference, gaps=gaps, band=band
        )
    groups: list[Group] = []
    if recordings or not (out or failed):
        gathered = partial(
            gather, recordings, input=input, outputs=how.outputs, reference=reference
        )
        try:
            groups = gathered(gaps=gaps)
        except EstimateError:
            if how.gaps != "auto":
                raise
            groups = gathered(gaps="model")
    usable: list[Group] = []
    for group in groups:
        try:
            drop_stuck(group, chosen=how.outputs is not None)
            if method not in welch.METHODS:
                drop_foreign(group)
            usable.append(group)
        except EstimateError as error:
            failed.append(error)
    for group in periodic.joined(usable) if method in ("auto", "periodic") else usable:
        try:
            if method in welch.METHODS:
                out.append(_welch(group, method, how.nperseg, band))
                continue
            choice, why = choose(group, method)
            if choice == "local":
                out.append(_local_or_windows(group, why, band, chosen=method == "local"))
            else:
                out.append(_repeats(group, choice, why, band))
        except EstimateError as error:
            failed.append(error)
    if not out:
        raise failed[0]
    lost = tuple(Finding("repeat", "error", f"not estimated: {error}") for error in failed)
    out[0] = replace(out[0], findings=(*out[0].findings, *lost))
    return out


@dataclass(frozen=True, slots=True)
class _Spectra:
    """Repeats of one excitation in frequency. shared, correlation : as of `repeats.over_repeats`.
    periods : of a periodic one, what its pieces were cut into."""

    pieces: Sequence[Piece]
    each: Sequence[Spectrum]
    shared: float = 1.0
    correlation: float = 0.0
    periods: periodic.Periods | None = None


def _spectra(group: Group, method: Literal["burst", "settled", "periodic"]) -> _Spectra:
    """The spectra of what a method takes for repeats; what was left out is noted in the group."""
    pieces = group.pieces
    if method == "burst":
        spectra, shared = burst_spectra(pieces, group.rate_hz)
        if rests(pieces[0].r)[0] < LEAD_IN * len(pieces[0]):
            group.findings.append(_no_lead_in(pieces[0].name))
        return _Spectra(pieces, spectra, shared=shared)
    if method == "settled":
        skip = group.unsettled
        spectra, correlation = settled_spectra(pieces[skip - 1 :], group.rate_hz)
        for piece in pieces[:skip]:
            text = f"{piece.name} left out: the motion had not settled since it started from rest"
            group.findings.append(Finding("leakage", "note", text, segment=piece.name))
        return _Spectra(pieces[skip:], spectra, correlation=correlation)
    periods = periodic.periods(group)
    return _Spectra(periods.pieces, periods.independent, periods=periods)


def _raised(
    group: Group, scatter: Float, floor: Float, findings: Mapping[int, str]
) -> Iterable[Finding]:
    """What is said of outputs whose repeats scatter less than their converter rounds.

    scatter : (n_freq, p) variances over the repeats. floor : (p,) or (n_freq, p). findings : by
    output.
    """
    floor = np.broadcast_to(floor, scatter.shape)
    for i, message in findings.items():
        part = float(np.mean(scatter[:, i] < floor[:, i]))
        if part > 0:
            text = f"{message} in {part:.0%} of the lines; what is missing was added"
            name = group.selection.outputs[i].name
            yield Finding("dof", "note", text, channel=name)


def _repeats(
    group: Group,
    method: Literal["burst", "settled", "periodic"],
    why: str,
    band: tuple[float, float] | None,
) -> FrequencyResponse:
    taken = _spectra(group, method)
    pieces, spectra, periods = taken.pieces, taken.each, taken.periods
    if periods is not None and periods.why:
        why = f"{why}; {periods.why}"
    lines = comb(spectra, band) if method == "periodic" else excited(spectra, band)
    lines = _driven(group, pieces, spectra, lines)
    n, p = len(spectra), len(group.selection.outputs)
    wanted = repeats.pooling_lines(n, p)
    if min(wanted, lines.size) * (n - 1) <= p:
        raise EstimateError(
            f"{n} repeats of {lines.size} lines do not give a covariance of {p} outputs; "
            "more repeats, a wider band or fewer outputs would"
        )
    R = np.stack([s.R[lines] for s in spectra])
    Z = np.stack([s.Z[lines] for s in spectra])
    floor, findings = floor_of(group, pieces)
    over, seen, averages = "repeats", Distortion(None, None), n
    rounding = floor
    if periods is not None:
        over, averages = periods.over, len(pieces)
        if len(periods.spectra) > 1:
            # Each realisation is rounded in its own way, so that the scatter shows it.
            floor, findings = np.zeros_like(floor), {}
    result = repeats.over_repeats(R, Z, wanted, floor, taken.shared, taken.correlation)
    scatter = np.diagonal(result.noise, axis1=1, axis2=2).real
    group.findings += _raised(group, scatter, floor, findings)
    if periods is not None:
        names = [c.name for c in group.selection.outputs]
        seen = distortion(periods.spectra, lines, result.H, rounding, names)
        group.findings += seen.findings
        result = _with_transient(result, periods, lines, group, spectra[0].frequency[lines])
    amplitude = (
        np.sqrt(2 * result.input_power / len(pieces[0]))
        if method == "periodic"
        else np.abs(result.gain) * _peak(pieces) / np.sqrt(2)
    )
    found = _ByLine(
        frequency=spectra[0].frequency[lines],
        H=result.H,
        covariance=result.covariance,
        dof=result.dof,
        coherence=_coherence(result.H, result.gain, np.mean(np.abs(R) ** 2, axis=0), result.noise),
        input_rms=amplitude,
    )
    done = f"{method} (over {over}, through {group.through})"
    response = _response(group, found, averages, done, f"{why}; {result.remark}")
    return replace(response, even=seen.even, odd=seen.odd)


def _driven(group: Group, pieces: Sequence[Piece], spectra: Sequence[Spectrum], lines: Int) -> Int:
    """The lines at which the input follows the reference; of any other nothing is known.

    EstimateError where the input stands still: a command below its converter's step is rounded to
    rest once the start is over.
    """
    name = group.selection.input.name
    if all(np.ptp(p.z[:, 0]) == 0 for p in pieces):
        raise EstimateError(
            f"{pieces[0].name}: the input {name} stands still in all that is estimated from; "
            "expected a level above its converter's step"
        )
    R, V = (np.stack(x) for x in ([s.R for s in spectra], [s.Z[:, 0] for s in spectra]))
    power = repeats.followed(R, V)[lines]
    kept = lines[power > NO_POWER * power.max()]
    if left_out := lines.size - kept.size:
        what = "line is" if left_out == 1 else "lines are"
        text = f"{left_out} {what} left out, as the reference has no power there"
        group.findings.append(Finding("leakage", "note", text))
    return np.asarray(kept, np.int64)


def _with_transient(
    result: repeats.Lines, periods: periodic.Periods, lines: Int, group: Group, f: Float
) -> repeats.Lines:
    """The same with what the start of the run leaves in the mean of the periods in its covariance,
    and a finding that says so: no scatter of periods that all ring alike holds it."""
    left = periods.bias(lines)
    rings = np.any(left != 0, axis=1)
    if not rings.any():
        return result
    mean = np.mean([s.Z[lines, 0] for s in periods.independent], axis=0)
    off = (left[:, 1:] - result.H * left[:, :1]) / mean[:, None]
    text = (
        f"what the start of the run left still rings in the periods at {np.sum(rings)} lines "
        f"between {f[rings][0]:.3g} and {f[rings][-1]:.3g} Hz, which the covariance holds"
    )
    group.findings.append(Finding("leakage", "note", text))
    return replace(result, covariance=result.covariance + off[:, :, None] * off[:, None, :].conj())


def _no_lead_in(name: str) -> Finding:
    message = (
        f"{name} starts without rest before it: noise that resonates is cut off sharply, "
        "neighbouring lines share it, and the degrees of freedom may be fewer than stated"
    )
    return Finding("dof", "note", message)


class _UnclearError(EstimateError):
    """Hardly a line can be told from a transient. band : Hz that the input reaches."""

    def __init__(self, message: str, band: tuple[float, float]) -> None:
        super().__init__(message)
        self.band = band


def _local_or_windows(
    group: Group, why: str, band: tuple[float, float] | None, *, chosen: bool
) -> FrequencyResponse:
    """By local models; where hardly a line can be told from a transient, as of an input of few
    steps, by Welch's windows, unless local models were chosen. Whole records begin at those."""
    try:
        return _local(group, why, band, least=1 if chosen else LEAST_CLEAR)
    except _UnclearError as error:
        shortest, p = min(len(piece.z) for piece in group.pieces), len(group.selection.outputs)
        samples = shortest // (WINDOWS * p)
        if chosen or samples < SHORTEST_WINDOW:
            raise
        return _welch(group, "h1", samples, error.band, str(error))


def _local(
    group: Group, why: str, band: tuple[float, float] | None, *, least: int
) -> FrequencyResponse:
    """least : lines that can be told from a transient."""
    spectra = [spectrum(p, group.rate_hz) for p in group.pieces]
    longest = max(spectra, key=lambda s: s.n)
    lines = excited(spectra, band)
    lines = lines[:: max(1, -(-lines.size // LOCAL_LINES))]
    f0 = longest.frequency[lines]
    p = len(group.selection.outputs)
    still = at_rest(group)
    rate = group.rate_hz
    # A piece much shorter than the longest has too few lines in a window to help.
    used = [i for i, s in enumerate(spectra) if s.n > longest.n // 2]
    spectra = [spectra[i] for i in used]
    breaks = [[k / rate for k in group.pieces[i].breaks] for i in used]
    width, transients = local.plan(breaks, p, longest.n / rate, at_rest=still)
    data = local.windows(spectra, f0, width, transients)
    reach, told = _reach(longest, lines), data.determined()
    if np.count_nonzero(told) < least:
        raise _UnclearError("the reference has no lines between its own", reach)
    if not told.all():
        lines, f0 = lines[told], f0[told]
        data = local.windows(spectra, f0, width, transients)
    clear = data.distinct() > DISTINCT
    if np.count_nonzero(clear) < least:
        few = f"{np.count_nonzero(clear)} lines of {clear.size} can be told from a transient"
        none = "the sweep cannot be told from a transient anywhere; a lead-in at rest would help"
        raise _UnclearError(few if clear.any() else none, reach)
    if not clear.all():
        group.findings.append(_unclear(f0, clear))
        lines, f0 = lines[clear], f0[clear]
        data = local.windows(spectra, f0, width, transients)
    fits = [local.fit(data, degree) for degree in (0, 1, 2)]
    # Neighbours within a window share their data, so they decide together.
    width_lines = round(width / (f0[1] - f0[0])) if f0.size > 1 else 1
    best = _best_degree([_smooth(f.press, width_lines) for f in fits])
    rational = float(np.mean(best > 0))

    def pick(name: str) -> Complex:
        stack = np.stack([getattr(f, name) for f in fits])
        return np.asarray(stack[best, np.arange(best.size)])

    dof = np.array([f.dof for f in fits])[best]
    if fits[0].dof <= p:
        raise EstimateError(f"{dof.min():.2g} degrees of freedom for {p} outputs; more data would")
    # Of the piece in which the sweep passes the frequency.
    power = np.max([np.interp(f0, s.frequency, np.abs(s.R) ** 2) for s in spectra], axis=0)
    found = _with_rounding(group, f0, pick, dof, power)
    done = f"local (LPM, LRM at {rational:.0%} of the lines, through {group.through})"
    ends = f"{len(transients)} transients" if transients else "at rest at both ends: no transient"
    why = f"{why}; windows of {width:.3g} Hz, {ends}"
    return _response(group, found, len(group.pieces), done, why)


def _with_rounding(
    group: Group, f: Float, pick: Callable[[str], Complex], dof: Float, power: Float
) -> _ByLine:
    """Of local models what each line has, with the rounding that no residual shows. pick : of the
    models' results, by name. power : (n,) of the reference."""
    gain, noise = pick("gain"), pick("noise")
    hidden = _hidden(group, noise, dof)
    seen = np.maximum(np.abs(gain) ** 2 * power, NO_POWER * np.max(power))
    return _ByLine(
        frequency=f,
        H=pick("H"),
        covariance=pick("covariance") + hidden / seen[:, None, None],
        dof=dof,
        coherence=_coherence(pick("H"), gain, power, noise + hidden),
        input_rms=np.abs(gain) * _peak(group.pieces) / np.sqrt(2),
    )


def _hidden(group: Group, noise: Complex, dof: Float) -> Float:
    """(n, p, p) what the rounding of the outputs adds to a model's residual that does not hold it:
    a loop that feeds back an encoder at rest moves its command with each step exactly.

    noise : (n, p, p) covariance of the residual. dof : (n,). What a residual with rounding in it
    has by chance, down to 3 of its standard deviations, is not touched.
    """
    floor, findings = floor_of(group, group.pieces)
    by_chance = np.maximum(1 - 3 / np.sqrt(dof), 0.0)
    least = by_chance[:, None] * floor
    scatter = np.diagonal(noise, axis1=1, axis2=2).real
    group.findings += _raised(group, scatter, least, findings)
    return np.eye(floor.size) * np.maximum(least - scatter, 0.0)[:, None, :]


def _reach(of: Spectrum, lines: Int) -> tuple[float, float]:
    """Hz from the lowest of some lines of a piece to the highest that its input reaches."""
    power = np.abs(of.R) ** 2
    top = max(int(lines[-1]), int(np.flatnonzero(power > REACH * np.max(power))[-1]))
    return float(of.frequency[lines[0]]), float(of.frequency[top])


def _unclear(f0: Float, clear: NDArray[np.bool_]) -> Finding:
    left = f0[~clear]
    message = (
        f"{left.size} lines between {left[0]:.3g} and {left[-1]:.3g} Hz left out: the sweep "
        "passes them so near the start or the end of the record that a transient looks the same"
    )
    return Finding("leakage", "warning", message)


def _smooth(x: Float, lines: int) -> Float:
    half = min(lines // 2, x.size - 1)
    padded = np.pad(x, half, mode="edge")
    return np.convolve(padded, np.ones(2 * half + 1) / (2 * half + 1), mode="valid")


def _best_degree(press: Sequence[Float]) -> Int:
    """Degree of D per line: the smallest that no larger one beats by `RATIONAL_GAIN`."""
    best = np.zeros(press[0].size, np.int64)
    score = press[0]
    for degree in range(1, len(press)):
        better = press[degree] < score - RATIONAL_GAIN
        best = np.where(better, degree, best)
        score = np.where(better, press[degree], score)
    return best


def _welch(
    group: Group,
    method: str,
    nperseg: int,
    band: tuple[float, float] | None,
    why: str = "asked for",
) -> FrequencyResponse:
    result = welch.frequency_response(
        [p.z for p in group.pieces], group.rate_hz, nperseg=nperseg, method=method
    )
    inside = slice(1, None)
    f = result.frequency[inside]
    keep = np.ones(f.size, bool) if band is None else (f >= band[0]) & (f <= band[1])
    warning = Finding(
        "leakage",
        "warning",
        f"{method.upper()} by Welch windows of {nperseg / group.rate_hz:g} s: for comparison; "
        "leakage and what a loop feeds back bias it, and its covariance does not know",
    )
    group.findings.append(warning)
    found = _ByLine(
        frequency=f[keep],
        H=result.H[inside][keep],
        covariance=result.covariance[inside][keep],
        dof=np.full(int(keep.sum()), result.dof),
        coherence=result.coherence[inside][keep],
        input_rms=np.full(int(keep.sum()), np.nan),
    )
    done = f"{method} (Welch, {nperseg} samples, Hann)"
    return _response(group, found, result.n_frames, done, why)


def _coherence(H: Complex, gain: Complex, power: Float, noise: Complex) -> Float:
    """Part of each output's power in one repeat that the reference explains."""
    signal = np.abs(H) ** 2 * (np.abs(gain) ** 2 * power)[:, None]
    rest = np.diagonal(noise, axis1=1, axis2=2).real
    total = signal + rest
    return np.divide(signal, total, out=np.zeros_like(signal), where=total > 0)


def _peak(pieces: Sequence[Piece]) -> float:
    return max(float(np.abs(p.r).max(initial=0.0)) for p in pieces)


@dataclass(frozen=True, slots=True)
class _ByLine:
    """What an estimate of one input has for each line: frequency, dof, input_rms (n,), H and
    coherence (n, p), covariance (n, p, p), as in `FrequencyResponse`."""

    frequency: Float
    H: Complex
    covariance: Complex
    dof: Float
    coherence: Float
    input_rms: Float


def _response(group: Group, found: _ByLine, n: int, method: str, why: str) -> FrequencyResponse:
    """The response of a group over n averages, with what the group knows of it."""
    return FrequencyResponse(
        frequency=found.frequency,
        H=found.H[:, :, None],
        covariance=found.covariance,
        dof=found.dof,
        coherence=found.coherence,
        inputs=(group.selection.input,),
        outputs=group.selection.outputs,
        level=group.level,
        level_unit=group.unit,
        input_rms=found.input_rms[:, None],
        rate_hz=group.rate_hz,
        n_averages=n,
        method=method,
        why=why,
        findings=tuple(group.findings),
        sources=tuple(group.sources),
    )
