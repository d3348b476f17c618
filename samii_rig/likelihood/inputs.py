"""A command that was measured, not recorded as it was sent: the loop's law without a meter's noise.

v = u + kp (theta_ref - theta) holds for what was sent. A loop that runs k times as fast as the
record holds it for T/k. A meter shows the mean of both sides of each edge, so that what it shows is
half a period of the loop late, and has noise that never drove the rig. That delay determines k,
and the law what was sent at the record's samples.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import linalg, ndimage, signal

from samii_rig.likelihood.spikes import TO_SD
from samii_rig.signal.columns import asked
from samii_rig.types import Float, Recording

NOISE = 0.5  # of what was measured, sd, that may be the meter's: of more the law says nothing
# Samples further out than so many sd are none of its noise, but edges within a sample; of all
# samples they may be this part.
BEYOND_METER, EDGES = 7.0, 1e-3
LOUDER = 2.0  # noise among the lines of the command, over that of all lines: no noise above
BUSY = 0.01  # of the command's largest line, in power, above which a line is the command's
LOWEST = 1 / 8  # of all lines; a rig that is recorded well moves in these
BETWEEN_TAPS = np.arange(-3.0, 4.0)  # samples: of a twentieth of the rate they are exact to 1e-7
ORDER = np.arange(BETWEEN_TAPS.size, dtype=np.float64)
FIT_ROUNDS, STEP = 4, 1e-3  # of Gauss and Newton, and samples for a slope
LATEST = 0.5  # samples: of a loop that runs at the record's rate
WHOLE = 0.02  # samples, from the delay of a loop that runs a whole number of times as fast
LEAST = 3e-4  # samples, deviation of a delay at least: loops of up to 16 times are told apart
# Of what is neither the command's converter's nor excitation, the power over that of its steps from
# which it is a meter's noise; of the largest line, the power that it stays below; the part of the
# lines, the upper ones, that show it.
METER_STANDS, BELOW_LARGEST, UPPER = 9.0, 1e-3, 0.5
# Of a meter's noise, the part of its power that second differences show at least, to which an input
# adds.
EVERY = 0.5
# Samples in every stretch of which it is seen. The quietest shows 0.79 to 0.93 of its deviation, by
# seven records whose meter is known.
IN_EACH = 512
BENDS = 6  # order of differences there: a sine of a fiftieth of the rate has 1e-7 of its amplitude
# Lines of a record that are taken for the input's though they are a meter's noise, in the mean. And
# lines among which another is judged: of so many the median is known to 10 %. And how many times
# the noise these must have: of less than half input the rest would move a rig more than that does.
ONCE, JUDGED_AMONG, HALF = 0.01, 201, 2.0
# Of an input of pulses, as a hammer's: standard deviations of what is between them beyond which one
# begins, which noise does once in 5e8 samples; by which the largest stands out, as no wide input
# does; and down to which one lasts, with so many samples to each side. Of all samples the part that
# they may be, whose noise stays, and the part that one may be.
PULSE_BEGINS, PULSE, LASTS, BESIDE_PULSE, SPARSE, SHORT = 6.0, 30.0, 2.5, 2, 0.2, 0.05
# Of what is between them, the part of its deviation that its second differences show at least:
# white noise has all of it, what a band of an input has less.
WHITE_BETWEEN = 0.8
# Of the rate, from where on what a pulse has there folds back as much: a filter of an analyser may
# pass up to 0.46 of it. Lines of its spectrum.
FOLDED, PULSE_LINES = 0.495, 1024
# Samples by which a record's going on is foretold, and until it is at rest.
FORETOLD, AFTER = 64, 512
# Of an input's largest, a jump after or before rest for so many samples that counts as an edge: a
# smaller one that came half a sample earlier is below a hundredth of what the rest makes.
JUMP, AT_REST = 0.01, 4
# Of a record that begins at rest, samples at least, whose mean has a quarter of a meter's noise,
# and the part of it. Of an input's largest, its standard deviation in them: a sweep that begins at
# once has ten times that. Of its deviation, how far the mean and the middle of one that swings to
# both sides alike lie apart at most: of noise with 100 independent samples.
RESTING, RESTS_FOR, RESTS_WITHIN, SWINGS_ALIKE = 16, 0.01, 0.02, 0.1
# Samples to each side of those between which a sweep turns that are as unknown: of an oscillation
# at 0.37 of the rate that begins at an instant, what folds back lasts so long. One that turns
# there, nothing hidden: chi-square 5.0, 1.31 and 0.99 with 0, 1 and 2.
BESIDE_TURN = 2
# An input that is smooth on both sides of a jump or a turn bends there this many times as much as
# anywhere within so many samples.
BENT, SMOOTH_OVER = 8.0, 16
BENT_BY_NOISE = 6.0  # standard deviations of what noise bends: of 1e8 samples none are beyond


@dataclass(frozen=True, slots=True)
class Meter:
    """What a meter showed of a command that follows from its law.

    law : (n,) what was sent. kp : gain of the loop in it, 0 where none ran. late : samples by which
    the meter shows it later, sd : standard deviation of that by its noise. far : (n,) where the
    command has an edge within a sample, so that nobody knows when that came.
    """

    law: Float
    kp: float
    late: float
    sd: float
    far: NDArray[np.bool_]

    @property
    def faster(self) -> bool:
        """Whether the loop ran more than once for each sample that was recorded."""
        return abs(self.late - LATEST) > BENT_BY_NOISE * max(self.sd, LEAST)

    @classmethod
    def of(
        cls,
        recording: Recording,
        command: int,
        kp: float,
        theta: Float | None,
        lost: NDArray[np.bool_] | None = None,
    ) -> Meter | None:
        """Of a command; None where it was recorded as it was sent, or its law is not known.
        Arguments as of `sent`."""
        if not recording.names("reference"):
            return None
        channel = recording.channels[command]
        v = np.array(recording.values[:, command], np.float64)
        if lost is not None:
            v[lost] = np.nan  # a guess is no reading
        laws = {k: _law(recording, command, k, theta) for k in (kp, 0.0)}
        if any(not np.any(np.abs(v - law) > channel.resolution) for law in laws.values()):
            return None  # as it was sent
        shown = {k: _shown(recording, v, law) for k, law in laws.items()}
        runs = min(shown, key=lambda k: float(np.nansum(shown[k][2] ** 2)))
        late, sd, off = shown[runs]
        far = _far(off)
        rests = not np.any(asked(recording, channel.name, kp))
        # What moves at rest is the loop's answer to the rig, and may be far below a meter's noise.
        moves = laws[runs] if rests else v
        small = rests or _sd(off) < NOISE * float(np.std(v[np.isfinite(off) & np.isfinite(v)]))
        if not small or not _noise(off, moves, far, channel.resolution):
            return None
        return cls(laws[runs], runs, late, sd, far)


def times_of(found: Sequence[Meter | None]) -> int:
    """How often the loop behind all commands ran for each sample that was recorded; 0 where that is
    not known of one of them, or not to a whole number."""
    known = [meter for meter in found if meter is not None and np.isfinite(meter.sd)]
    if not known or len(known) < len(found):
        return 0
    weight = np.array([max(meter.sd, LEAST) ** -2 for meter in known])
    late = float(weight @ [meter.late for meter in known] / np.sum(weight))
    off = BENT_BY_NOISE / math.sqrt(float(np.sum(weight)))
    times = round(1 / (2 * late)) if late > 0 else 0
    if times < 1 or abs(late - 1 / (2 * times)) > off:
        return 0
    return times if late - off > 1 / (2 * (times + 1)) else 0


def sent(
    recording: Recording,
    command: int,
    kp: float,
    theta: Float | None,
    times: int = 0,
    lost: NDArray[np.bool_] | None = None,
) -> tuple[Float, Float, NDArray[np.bool_]]:
    """(n,) the command v as it drove the rig, as near as the recording shows; v + kp theta; and
    where it has an edge within a sample, so that nobody knows when that came.

    command : its column. theta : (n,) of the sensor around which a loop of gain kp is closed.
    times : how often the loop is known to run for each sample, 0 where it is not: then the command
    is a smooth one, the mean over the last hold. lost : (n,) samples that were not recorded.
    """
    v = np.asarray(recording.values[:, command], np.float64)
    fed = np.zeros(v.size) if theta is None else kp * theta
    meter = Meter.of(recording, command, kp, theta, lost)
    if meter is None:
        return v, v + fed, np.zeros(v.size, np.bool_)
    if times:
        drawn, r = meter.law, meter.law + fed
    else:
        held = _held(_near(meter.late))
        drawn = _filtered(recording, meter.law, held)
        # What is fed back is held, too. Of the rest, the sensor's noise would lead a change of the
        # response that is free to itself.
        calm = calibrated(fed, 0.0)[0]
        r = drawn + _filtered(recording, fed - calm, held) + calm
    known = np.isfinite(drawn)
    return np.where(known, drawn, v), np.where(known, r, v + fed), meter.far


class MeterNoise(NamedTuple):
    """Standard deviation of what a meter put on a command: in its record, and left of that where
    it was taken out as far as the record shows it. folds : of pulses, between which it was taken
    out, what the middle one has just below half the rate over the most that it has at any
    frequency, as much of which folded back; nan of an input of another kind."""

    shown: float = 0.0
    left: float = 0.0
    folds: float = math.nan

    @property
    def on_lines(self) -> float:
        """Of what is left at the lines that the input has."""
        return self.shown if math.isnan(self.folds) else self.left

    @property
    def on_samples(self) -> float:
        """Of what is left where the input is largest."""
        return self.left if math.isnan(self.folds) else self.shown


def calibrated(r: Float, step: float) -> tuple[Float, MeterNoise]:
    """(n,) the input as likely as a meter's white noise on r (n,) leaves it: every line by the part
    of its power that is not noise (regression calibration: Carroll et al. 2006, Measurement Error
    in Nonlinear Models, ch. 4). A line shows that part by itself where it stands out alone, the
    others together with their neighbours. r itself where the meter shows none, or the input is as
    wide as what was recorded. And that noise.

    step : of the command's converter, whose rounding is the input's own.
    """
    if (between := _between_pulses(r, step)) is not None:
        rest, sd = float(np.mean(r[between])), float(np.std(r[between]))
        pulses = np.where(between, rest, r)
        left = sd * math.sqrt(float(np.mean(~between)))
        return pulses, MeterNoise(sd, left, _folds(pulses - rest, ~between))
    floor = meter_noise(r, step) ** 2
    if floor == 0:
        return r, MeterNoise()
    known: Float = _stairs(r, math.sqrt(floor)) + float(np.mean(r))
    x: Float = r - known
    way = np.concatenate([_on(x[::-1])[::-1], x, _on(x)])
    spectrum = np.fft.rfft(way)
    power = np.abs(spectrum) ** 2 / r.size
    around = ndimage.median_filter(power, min(JUDGED_AMONG, power.size), mode="nearest") / np.log(2)
    clear = math.log(power.size / ONCE) * floor
    loud = around > HALF * floor
    expected = np.where(power > clear, power, np.where(loud, around, 0.0))
    part = 1 - floor / np.maximum(expected, floor)
    spectrum *= part
    more = (way.size - r.size) // 2
    own: Float = known + np.fft.irfft(spectrum, way.size)[more : more + r.size]
    return own, MeterNoise(math.sqrt(floor), math.sqrt(floor * float(np.mean(part))))


def _between_pulses(r: Float, step: float) -> NDArray[np.bool_] | None:
    """(n,) where an input r (n,) of few pulses rests, so that what is there is its meter's noise;
    None for an input of another kind, or without noise. step : as of `calibrated`."""
    if not np.isfinite(r).all():
        return None
    off = np.abs(r - np.median(r))
    sd = TO_SD * float(np.median(off))
    if sd <= step or np.max(off) < PULSE * sd:
        return None
    lasts = ndimage.binary_dilation(off > LASTS * sd)
    pulses = ndimage.binary_propagation(off > PULSE_BEGINS * sd, mask=lasts)
    pulses = ndimage.binary_dilation(pulses, iterations=BESIDE_PULSE)
    longest = max(one.stop - one.start for (one,) in ndimage.find_objects(ndimage.label(pulses)[0]))
    if np.mean(pulses) > SPARSE or longest > SHORT * r.size:
        return None
    rest = r[~pulses]
    return np.asarray(~pulses) if _by_bends(rest) > WHITE_BETWEEN * np.std(rest) else None


def _by_bends(r: Float, order: int = 2) -> float:
    """Standard deviation of white noise by differences of r (n,), the second ones or of a higher
    order, which few jumps and whatever is slow hardly change."""
    size = math.sqrt(math.comb(2 * order, order))
    return TO_SD * float(np.median(np.abs(np.diff(r, order)))) / size


def _folds(x: Float, pulses: NDArray[np.bool_]) -> float:
    """As of `MeterNoise`, of x (n,) that is 0 but for its pulses (n,)."""
    each = []
    for (one,) in ndimage.find_objects(ndimage.label(pulses)[0]):
        size = np.abs(np.fft.rfft(x[one], max(PULSE_LINES, one.stop - one.start)))
        each.append(np.max(size[int(2 * FOLDED * size.size) :]) / np.max(size))
    return float(np.median(each))


def _stairs(r: Float, noise: float) -> Float:
    """(n,) the jumps of r (n,) that stand out of a meter's noise, less how it goes on beside them:
    each of their lines may have less than the noise has. noise : its standard deviation."""
    d = np.diff(r)
    steps = np.zeros(d.size)
    for i in np.flatnonzero(_bends(r, 0.0, noise)).tolist():  # a meter may show both sides between
        some = slice(max(i - 1, 0), i + 2)
        steps[some] = d[some] - (d[max(i - 2, 0)] + d[min(i + 2, d.size - 1)]) / 2
    return np.asarray(np.append(0.0, np.cumsum(steps)))


def _on(x: Float) -> Float:
    """(m,) how x (n,) might go on until it is at rest: by what its own past foretells (Yule and
    Walker), so that a record which is cut leaks nothing."""
    order, m = min(FORETOLD, x.size // 4), min(AFTER, x.size // 2)
    power = np.abs(np.fft.rfft(x, 2 * x.size)) ** 2
    c = np.fft.irfft(power)[: order + 1]
    a = linalg.solve_toeplitz(c[:-1], c[1:])[::-1]
    on = np.append(x[-order:], np.zeros(m))
    for i in range(order, order + m):
        on[i] = a @ on[i - order : i]
    return np.asarray(on[order:] * np.cos(np.linspace(0.0, np.pi / 2, m)) ** 2)


def meter_noise(r: Float, step: float) -> float:
    """Standard deviation of a meter's white noise on r (n,); 0 where the meter shows none, or the
    input is as wide as what was recorded. step : as of `calibrated`."""
    if not np.isfinite(r).all():
        return 0.0
    power = np.abs(np.fft.rfft(r - np.mean(r))) ** 2 / r.size
    # Under a window: a record that is cut ends with an edge, whose lines are no noise.
    window = signal.windows.hann(r.size, sym=False)
    apart = np.abs(np.fft.rfft(window * (r - np.mean(r)))) ** 2 / float(window @ window)
    upper = apart[int((1 - UPPER) * power.size) :]
    floor = float(np.median(upper)) / np.log(2)
    white = float(np.mean(upper)) < LOUDER * floor
    # An input that is held for some samples has a wide spectrum, too, but noise is in every sample.
    # So have jumps beside a fast sweep: noise is what is there in the quietest stretch, too.
    stretches = np.array_split(r, max(r.size // IN_EACH, 1))
    quiet = min(_by_bends(x, BENDS) for x in stretches) ** 2
    floor = floor if quiet > EVERY * floor else quiet
    shown = white and METER_STANDS * step**2 / 12 <= floor <= BELOW_LARGEST * np.max(power)
    return float(np.sqrt(floor)) if shown else 0.0


def rest_of(v: Float, noise: float, *, moving: bool) -> float:
    """What a meter shows of an input v (n,) that rests: its first part, where the rig rested before
    it and the input goes on resting; else the mean of one that swings to both sides alike; 0 of
    another, as that may be the input's own. noise : the meter's standard deviation, 0 where that is
    not known. moving : whether the rig moved before."""
    head = v[: max(RESTING, round(RESTS_FOR * v.size))]
    level, mean = float(np.median(head)), float(np.mean(v))
    within = max(RESTS_WITHIN * float(np.max(np.abs(v - level))), 2 * noise)
    if not moving and np.std(head) <= within:
        return level
    return mean if abs(mean - np.median(v)) < SWINGS_ALIKE * np.std(v) else 0.0


def jumps(recording: Recording, command: int, kp: float, theta: Float | None) -> NDArray[np.bool_]:
    """(n,) where the input jumped, from or to a rest or between two smooth stretches, and the
    sample before: where not every sample of the rig was recorded, nobody knows when between them.
    Of one that turns between smooth stretches those beside them, too.

    command : its column. kp : gain of the loop around it, 0 for none. theta : (n,) of its sensor.
    """
    still = 0.0  # of a rest, from sample to sample
    if recording.names("reference"):
        u = asked(recording, recording.channels[command].name, kp)
    else:
        u = np.asarray(recording.values[:, command], np.float64)
        if theta is not None:
            u, still = u + kp * theta, recording.channels[command].resolution
    if u.size <= 2 * AT_REST:
        return np.zeros(u.size, np.bool_)
    d = np.diff(u)
    quiet = np.abs(d) <= still
    # Whether it was at rest for the last samples; a rest ended just before, or begins just behind.
    rests = np.convolve(quiet, np.ones(AT_REST), "full")[: d.size] == AT_REST
    after = np.append(False, rests[:-1])
    before = np.append(rests[AT_REST:], np.zeros(AT_REST, np.bool_))
    least = JUMP * np.nanmax(np.abs(u))
    edge = ~quiet & (np.abs(d) > least) & (after | before)
    turns = _bends(u, least) & ~ndimage.binary_dilation(edge, iterations=AT_REST)
    turned = ndimage.binary_dilation(_of_both(turns), iterations=BESIDE_TURN)
    return np.asarray(_of_both(edge) | turned)


def stepped(r: Float, meter: MeterNoise) -> NDArray[np.bool_]:
    """(n,) where an input r (n,) jumps that a meter showed, and the sample before: as `jumps`, of
    what nobody knows how the loop sent it. None of a pulse, which is as smooth as the filter before
    the converter."""
    if meter.shown == 0 or not math.isnan(meter.folds):
        return np.zeros(r.size, np.bool_)
    return _of_both(_bends(r, 0.0, min(meter.shown, _by_bends(r))))


def _of_both(step: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """(n,) the samples on both sides of steps (n - 1,)."""
    return np.asarray(np.append(step, False) | np.append(False, step))


def _bends(u: Float, least: float, noise: float = 0.0) -> NDArray[np.bool_]:
    """(n - 1,) of an input u (n,) the steps d = diff(u) at which it does not go on as it came: by
    more than `least`, and than white noise on u of a standard deviation may, d leaves the
    oscillation d[i + 1] + d[i - 1] = 2 cos(w) d[i], w that of `SMOOTH_OVER` samples before,
    behind, or on both sides: there a sweep's own change of w cancels.
    """
    d = np.diff(u)
    out = np.zeros(d.size, np.bool_)
    if d.size <= 2 * (SMOOTH_OVER + AT_REST):
        return out
    both, mid = d[2:] + d[:-2], d[1:-1]
    bent = np.full(mid.size, np.inf)
    for before, behind in ((1.0, 1.0), (1.0, 0.0), (0.0, 1.0)):
        sides = np.zeros(2 * (SMOOTH_OVER + AT_REST) + 1)
        sides[:SMOOTH_OVER], sides[-SMOOTH_OVER:] = behind, before  # a convolution turns them round
        turn, power = (np.convolve(x, sides, "same") for x in (mid * both, 2 * mid**2))
        cosine = np.divide(turn, power, out=np.ones_like(power), where=power > 0)
        twice = 2 * np.clip(cosine, -1.0, 1.0)
        by_noise = BENT_BY_NOISE * noise * np.sqrt(2 + 2 * (1 + twice) ** 2)
        bent = np.minimum(bent, np.maximum(np.abs(both - twice * mid) - by_noise, 0.0))
    around = np.ones(2 * SMOOTH_OVER + 1, np.bool_)
    # What the same jump bends.
    around[SMOOTH_OVER - AT_REST : SMOOTH_OVER + AT_REST + 1] = False
    beside = ndimage.maximum_filter(bent, footprint=around)
    highest = bent == ndimage.maximum_filter1d(bent, 2 * AT_REST + 1)
    out[1:-1] = highest & (bent > BENT * beside) & (bent > least)
    return out


def _law(recording: Recording, command: int, kp: float, theta: Float | None) -> Float:
    """(n,) u + kp (theta_ref - theta)."""
    law = asked(recording, recording.channels[command].name, kp)
    return law if theta is None or kp == 0 else law - kp * theta


def _shown(recording: Recording, v: Float, law: Float) -> tuple[float, float, Float]:
    """How many samples late a meter shows a law as v, the standard deviation of that, and what that
    leaves of v."""
    late, sd = 0.0, math.inf
    for _ in range(FIT_ROUNDS):
        off = v - _filtered(recording, law, _mean(late))
        slope = _filtered(recording, law, (_mean(late + STEP) - _mean(late - STEP)) / (2 * STEP))
        known = np.isfinite(off) & np.isfinite(slope)
        if not known.any() or not np.any(slope[known]):
            break
        # Edges say nothing of a delay: they pass within a sample.
        known &= np.abs(off) <= BEYOND_METER * _sd(off)
        turns = float(slope[known] @ slope[known])
        if turns == 0:  # at rest for most of the record, and recorded as it was sent
            break
        late += float(off[known] @ slope[known]) / turns
        late = min(max(late, 0.0), LATEST)
        sd = _sd(off) / math.sqrt(turns)
    off = v - _filtered(recording, law, _mean(_near(late)))
    return late, sd, np.where(np.isfinite(off), off, np.nan)


def _near(late: float) -> float:
    """A delay, or that of the loop that runs a whole number of times as fast, if one is near."""
    times = round(1 / (2 * late)) if late > 0 else 0
    return 1 / (2 * times) if times and abs(late - 1 / (2 * times)) < WHOLE else late


def _mean(late: float) -> Float:
    """Weights of neighbouring samples: the mean of a signal now and 2 `late` samples before."""
    return _weights(np.append(1.0, (2 * late) ** ORDER[1:] / 2))


def _held(late: float) -> Float:
    """The same of the mean over the last 2 `late` samples, which a hold gives."""
    return _weights((2 * late) ** ORDER / (ORDER + 1))


def _weights(moments: Float) -> Float:
    """Exact for polynomials up to the order of the neighbours."""
    return np.linalg.solve(np.vander(BETWEEN_TAPS, increasing=True).T, moments)


def _filtered(recording: Recording, x: Float, weights: Float) -> Float:
    """(n,) sum of neighbours n - j of x (n,), NaN where a row is missing between them."""
    out = np.full(x.size, np.nan)
    reach = len(weights) // 2
    if x.size <= 2 * reach:
        return out
    out[reach:-reach] = np.convolve(x, weights, "valid")
    apart = recording.sequence[2 * reach :] - recording.sequence[: -2 * reach] != 2 * reach
    out[reach:-reach][apart] = np.nan
    return out


def _sd(off: Float) -> float:
    return TO_SD * float(np.nanmedian(np.abs(off)))


def _far(off: Float) -> NDArray[np.bool_]:
    return np.asarray(np.abs(off) > BEYOND_METER * _sd(off))


def _noise(off: Float, moves: Float, far: NDArray[np.bool_], step: float) -> bool:
    """Whether what the law leaves of a command is a meter's noise: more than its converter's steps,
    with next to no sample far out, and no louder where the command moves."""
    known = np.isfinite(off) & np.isfinite(moves)
    if not step < _sd(off) or np.mean(far) > EDGES:
        return False
    rest = np.where(far, 0.0, off)[known]
    power, own = (np.abs(np.fft.rfft(x - np.mean(x)))[1:] ** 2 for x in (rest, moves[known]))
    busy = own > BUSY * np.max(own)
    if not busy.any():  # no loop around an input at rest: rigs move in the lowest lines
        busy[: int(LOWEST * busy.size)] = True
    return bool(np.mean(power[busy]) < LOUDER * np.mean(power))
