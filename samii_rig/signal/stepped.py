"""Stepped sine: one frequency after the other, each measured in blocks of whole periods.

After settling every block holds the same motion, so a block is free of leakage, and what
scatters from block to block is noise. With V_k and Y_k the lines of block k at the frequency,

    H = sum Y_k R_k^* / sum V_k R_k^*,     e_k = Y_k - H V_k,     C_e = sum e_k e_k^H/(n - 1),
    C_H = C_e sum |R_k|^2 / |sum V_k R_k^*|^2,

with n - 1 degrees of freedom: `repeats` on a single line, and nothing pooled.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from samii_rig.errors import EstimateError
from samii_rig.signal.choose import drop_stuck
from samii_rig.signal.gather import Gaps, gather
from samii_rig.signal.groups import Group
from samii_rig.signal.quantisation import floor_of
from samii_rig.signal.spectra import COMB_POWER, period
from samii_rig.types import Complex, Finding, Float, FrequencyResponse, Recording, Segment

# Standard deviations above which blocks are said to be correlated: of white noise, once in
# 2000 responses of 40 frequencies and 4 outputs.
CHANCE_Z = 4.5
SHOWN = 4  # frequencies named in a finding
SAME_HZ = 1e-6  # two frequencies that are one


@dataclass(frozen=True, slots=True)
class Line:
    """The response at one frequency: H (p,), covariance (p, p), nu degrees of freedom.

    residuals : (n, p) e_k of the blocks in order. gain : V/R. power : mean |V|^2.
    """

    H: Complex
    covariance: Complex
    dof: float
    residuals: Complex
    gain: complex
    power: float

    @property
    def relative(self) -> Float:
        """(p,) sqrt(E|dH|^2)/|H|; inf where H is 0."""
        size = np.abs(self.H)
        sd = np.sqrt(np.diagonal(self.covariance).real)
        return np.asarray(np.divide(sd, size, out=np.full(size.shape, np.inf), where=size > 0))


def line(R: Complex, Z: Complex, floor: Float | None = None) -> Line:
    """The response from blocks: R (n,) reference, Z (n, 1 + p) input and outputs, n >= 2.

    floor : (p,) variance of rounding that repeats in every block, see `repeats.over_repeats`.
    """
    n = len(R)
    V, Y = Z[:, 0], Z[:, 1:]
    S_vr = complex(V @ R.conj())
    S_rr = float(np.sum(np.abs(R) ** 2))
    H = (R.conj() @ Y) / S_vr
    e = Y - np.outer(V, H)
    noise = e.T @ e.conj() / (n - 1)
    if floor is not None:
        noise = noise + n * np.diag(np.maximum(floor - np.diagonal(noise).real, 0.0))
    return Line(
        H=H,
        covariance=noise * (S_rr / abs(S_vr) ** 2),
        dof=float(n - 1),
        residuals=e,
        gain=S_vr / S_rr,
        power=float(np.mean(np.abs(V) ** 2)),
    )


def blocks_of(x: Float, block: int, cycles: int) -> Complex:
    """(n_block, ...) line `cycles` of the discrete Fourier transform of each whole block of x
    (n, ...), over sqrt(block): white noise of variance s^2 a sample has variance s^2."""
    n = len(x) // block
    turn = np.exp(-2j * np.pi * cycles * np.arange(block) / block) / np.sqrt(block)
    whole = x[: n * block].reshape(n, block, *x.shape[1:])
    return np.asarray(np.einsum("b,nb...->n...", turn, whole))


def one_line(r: Float) -> tuple[int, int] | None:
    """(block, cycles) of a reference that is one sine, periodic in blocks; else None."""
    p = period(r)
    if p == r.size:
        return None
    power = np.abs(np.fft.rfft(r[:p])) ** 2
    k = int(np.argmax(power[1:])) + 1
    rest = float(power[1:].sum() - power[k])
    # Its own phase is any, so the mean of a block is nearly 0 and not exactly.
    return (p, k) if rest <= COMB_POWER * power[k] and 0 < k < p / 2 else None


def is_stepped(recording: Recording, segment: Segment) -> bool:
    """Whether a segment is a sine of one frequency in whole periods."""
    if segment.kind != "periodic":
        return False
    cut = recording.cut(segment)
    used = [cut.values_of(n) for n in cut.names("reference")]
    used = [r for r in used if r.size and np.isfinite(r).all() and np.any(r)]
    return len(used) == 1 and one_line(used[0]) is not None


def split(recordings: Sequence[Recording]) -> tuple[list[Recording], list[Recording]]:
    """Recordings of one stepped segment each, and recordings with what is left of them."""
    sines: list[Recording] = []
    rest: list[Recording] = []
    for recording in recordings:
        stepped = [s for s in recording.segments if is_stepped(recording, s)]
        sines += [replace(recording, segments=(s,)) for s in stepped]
        others = tuple(s for s in recording.segments if s not in stepped)
        if others or not stepped:
            rest.append(replace(recording, segments=others))
    return sines, rest


@dataclass(frozen=True, slots=True)
class _Point:
    """All blocks at one frequency and level."""

    group: Group
    frequency: float
    R: Complex
    Z: Complex
    peak: float


def estimate_stepped(
    recordings: Sequence[Recording],
    *,
    input: str | None,
    outputs: Sequence[str] | None,
    reference: str | None,
    gaps: Gaps,
    band: tuple[float, float] | None,
) -> tuple[list[FrequencyResponse], list[EstimateError]]:
    """One response a level from recordings of one stepped segment each (see `split`).

    Options as for `samii_rig.signal.estimate.estimate`. Also what could not be estimated.
    """
    levels: dict[tuple[str, float], list[_Point]] = {}
    failed: list[EstimateError] = []
    for recording in recordings:
        try:
            for group in gather(
                [recording], input=input, outputs=outputs, reference=reference, gaps=gaps
            ):
                drop_stuck(group, chosen=outputs is not None)
                for point in _points(group):
                    if band is None or band[0] <= point.frequency <= band[1]:
                        levels.setdefault((group.unit, group.level), []).append(point)
        except EstimateError as error:
            failed.append(error)
    out = []
    for points in levels.values():
        try:
            out.append(_response(points))
        except EstimateError as error:
            failed.append(error)
    return out, failed


def _points(group: Group) -> Iterator[_Point]:
    for piece in group.pieces:
        found = one_line(piece.r)
        if found is None:
            raise EstimateError(f"{piece.name}: not a sine of whole periods; samples are missing")
        block, cycles = found
        yield _Point(
            group,
            cycles * group.rate_hz / block,
            blocks_of(piece.r, block, cycles),
            blocks_of(piece.z, block, cycles),
            float(np.abs(piece.r).max()),
        )


def _response(points: list[_Point]) -> FrequencyResponse:
    """All points of a level as one response; repeats of a frequency are joined."""
    points = sorted(points, key=lambda p: p.frequency)
    first = points[0].group
    # An output that stood still somewhere is left out everywhere.
    common = set.intersection(*(set(p.group.selection.names) for p in points))
    outputs = tuple(c for c in first.selection.outputs if c.name in common)
    if not outputs:
        raise EstimateError("no output moved at every frequency; name the outputs to estimate")
    joined: list[list[_Point]] = []
    for point in points:
        if joined and point.frequency - joined[-1][0].frequency < SAME_HZ:
            joined[-1].append(point)
        else:
            joined.append([point])
    frequency = np.array([same[0].frequency for same in joined])
    lines = [_line_of(same, [c.name for c in outputs]) for same in joined]
    findings = [f for p in points for f in p.group.findings]
    if remark := _correlated(frequency, [x.residuals for x in lines]):
        findings.append(remark)
    H = np.stack([x.H for x in lines])
    noise = np.stack([np.mean(np.abs(x.residuals) ** 2, axis=0) for x in lines])
    signal = np.abs(H) ** 2 * np.array([x.power for x in lines])[:, None]
    total = signal + noise
    rms = [abs(x.gain) * max(p.peak for p in s) for x, s in zip(lines, joined, strict=True)]
    n = [len(x.residuals) for x in lines]
    return FrequencyResponse(
        frequency=frequency,
        H=H[:, :, None],
        covariance=np.stack([x.covariance for x in lines]),
        dof=np.array([x.dof for x in lines]),
        coherence=np.divide(signal, total, out=np.zeros_like(total), where=total > 0),
        inputs=(first.selection.input,),
        outputs=outputs,
        level=first.level,
        level_unit=first.unit,
        input_rms=np.array(rms)[:, None] / np.sqrt(2),
        rate_hz=first.rate_hz,
        n_averages=min(n),
        method=f"stepped (over blocks of whole periods, through {first.through})",
        why=f"a sine of one frequency at a time: no leakage; {min(n)} to {max(n)} blocks each",
        findings=tuple(dict.fromkeys(findings)),
        sources=tuple(dict.fromkeys(s for p in points for s in p.group.sources)),
    )


def _line_of(same: Sequence[_Point], names: Sequence[str]) -> Line:
    """The line of all blocks at one frequency, for these outputs."""

    def columns(point: _Point) -> list[int]:
        return [point.group.selection.names.index(name) for name in names]

    R = np.concatenate([p.R for p in same])
    Z = np.concatenate([p.Z[:, [0, *columns(p)]] for p in same])
    if len(R) <= len(names) + 1:
        raise EstimateError(
            f"{len(R)} blocks at {same[0].frequency:.4g} Hz do not give a covariance of "
            f"{len(names)} outputs; a longer dwell or fewer outputs would"
        )
    group = same[0].group
    floor, _ = floor_of(group, group.pieces)
    return line(R, Z, floor[[i - 1 for i in columns(same[0])]])


def _correlated(frequency: Float, residuals: Sequence[Complex]) -> Finding | None:
    """Whether neighbouring blocks scatter alike: noise slower than a block, or a transient.

    Under white noise the lag-one correlation of n residuals about their mean is -1/n with
    variance 1/(2 n) (complex). Each frequency and output is held against that, and the sum of
    all frequencies.
    """
    excess = np.zeros((len(residuals), residuals[0].shape[1]))
    variance = np.array([0.5 / len(e) for e in residuals])[:, None]
    for k, e in enumerate(residuals):
        power = np.sum(np.abs(e) ** 2, axis=0)
        lag = np.sum(e[1:].conj() * e[:-1], axis=0).real + power / len(e)
        excess[k] = np.divide(lag, power, out=np.zeros_like(power), where=power > 0)
    alone = np.flatnonzero((excess > CHANCE_Z * np.sqrt(variance)).any(axis=1))
    if not alone.size and np.all(excess.sum(axis=0) < CHANCE_Z * np.sqrt(variance.sum())):
        return None
    where = "at most frequencies"
    if alone.size:
        shown = ", ".join(f"{frequency[k]:.4g}" for k in alone[:SHOWN])
        where = f"at {shown}{', ...' if alone.size > SHOWN else ''} Hz"
    message = (
        f"neighbouring blocks scatter alike {where}: the motion had not settled or the noise is "
        "slower than a block, so the intervals there are too narrow; more time to settle or a "
        "longer block would help"
    )
    return Finding("leakage", "warning", message)
