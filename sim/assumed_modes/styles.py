"""How a trial is recorded: what excites the rig, what is recorded of it, and how badly.

An excitation is a list of files, a file a list of segments, a segment the references from sample
to sample. Of a rig with several inputs it is made once in as many experiments as tell them apart:
the inputs in turn, or together with signs that are orthogonal over the experiments. Faults of the
recording (no reference, shifted columns, gaps, hum) are drawn beside it.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from scipy.linalg import hadamard

from samii_rig.types import Float, Kind

Rng = np.random.Generator

EXCITATIONS = (
    "bursts",
    "cut",
    "single",
    "updown",
    "stepped",
    "multisine",
    "multisine_once",
    "random",
    "steps",
)
SEVERAL = ("in_turn", "together")  # how several inputs are driven, one of these
# What no estimate of several inputs takes: `samii_rig.signal.several`.
OF_ONE_INPUT = ("stepped", "gaps")
# Excitations that are drawn anew for each input where they are driven together.
BY_INPUT = ("multisine", "multisine_once", "random")
RUNS = ("bursts", "cut", "updown", "multisine", "random")  # that make several runs
# Faults and choices, with the probability that a trial has them.
OPTIONS: dict[str, float] = {
    "open_loop": 0.1,
    "no_reference": 0.15,
    "measured": 0.12,
    "shifted": 0.08,
    "gaps": 0.1,
    "wander": 0.2,
    "hum": 0.15,
    "spikes": 0.08,
    "coarse": 0.15,
    "other_rate": 0.3,
    "other_channels": 0.4,
}

# Loop samples that a trial has at most, so that it is made in some seconds.
BUDGET = 100_000
HIGH_HZ = (15.0, 45.0)  # the band's upper end is drawn between these
LEAST_PERIODS = 2  # measured periods of a multisine of many


@dataclass(frozen=True, slots=True)
class Piece:
    """One segment: its references at unit level (n, n_in) at the loop's rate.

    skip : samples at its beginning that are recorded outside of the segment. level, repeat : as in
    `samii_rig.types.Segment`. driven : of several inputs the numbers of those that it drives.
    """

    name: str
    kind: Kind
    r: Float
    level: float
    repeat: int
    skip: int = 0
    driven: tuple[int, ...] = ()


@dataclass(frozen=True, slots=True)
class Style:
    """What was drawn. rate_hz : of the loop; every : loop samples a recorded one.

    options : names of `OPTIONS` that hold. levels : relative to the largest, 1 among them.
    """

    excitation: str
    options: tuple[str, ...]
    rate_hz: float
    every: int
    low_hz: float
    high_hz: float
    levels: tuple[float, ...]
    repeats: int
    inputs: int = 1
    files: tuple[tuple[Piece, ...], ...] = field(default=(), repr=False)


@dataclass(frozen=True, slots=True)
class About:
    """What a style is drawn for: the rig's samples/s, its first resonance (Hz), s of records at
    most, for which there is room within `BUDGET`, and how many inputs it has."""

    rate_hz: float
    first_hz: float = 0.0
    seconds: float = np.inf
    inputs: int = 1


def draw(rng: Rng, forced: tuple[str, ...], about: About, *, runs: bool = False) -> Style:
    """A style. forced : excitation and options by name, `clean` for no option; runs : several."""
    named = [x for x in forced if x in EXCITATIONS]
    choice = [x for x in EXCITATIONS if x in RUNS] if runs else list(EXCITATIONS)
    choice = [x for x in named if x in choice] or choice
    beyond = OF_ONE_INPUT if about.inputs > 1 else ()
    excitation = str(rng.choice([x for x in choice if x not in beyond]))
    chosen = [name for name, p in OPTIONS.items() if rng.random() < p]
    if "clean" in forced:
        chosen = []
    chosen = [x for x in OPTIONS if (x in chosen or x in forced) and x not in beyond]
    if about.inputs > 1:
        how = [x for x in SEVERAL if x in forced] or list(SEVERAL)
        chosen.append(str(rng.choice(how)))
    rate, every = _rates(rng, about.rate_hz, tuple(chosen))
    low = float(rng.uniform(0.3, 0.8))
    # A rig that has no resonance within is driven to twice its first one.
    above = HIGH_HZ[0], HIGH_HZ[1] if about.first_hz < HIGH_HZ[1] else 2.0 * about.first_hz
    high = float(min(rng.uniform(*above), 0.4 * rate / every))
    n_levels = (
        1 if excitation == "single" else int(rng.choice([1, 2, 3, 4], p=[0.3, 0.4, 0.2, 0.1]))
    )
    repeats = 1 if excitation == "single" else int(rng.choice([1, 2, 3], p=[0.4, 0.4, 0.2]))
    if runs:
        repeats = max(2, repeats)
    levels = tuple(float(x) for x in np.geomspace(1.0, 0.25, 4)[:n_levels][::-1])
    style = Style(excitation, tuple(chosen), rate, every, low, high, levels, repeats, about.inputs)
    return _filled(rng, style, min(about.seconds, BUDGET / rate), runs=runs)


def _rates(rng: Rng, rig_rate_hz: float, options: tuple[str, ...]) -> tuple[float, int]:
    """Samples/s of the loop, and how many of them make a recorded one."""
    rate, every = rig_rate_hz, 1
    if "other_rate" in options:
        rate = float(rng.choice([200.0, 250.0, 1000.0, 2000.0, rig_rate_hz]))
        if rate == rig_rate_hz:
            every = int(rng.choice([2, 5]))
    if "measured" in options:  # the input follows a fast loop: no hold in the recorded samples
        every = max(2, round(2000.0 / rate))
        rate = rate * every
    return rate, every


def _signs(style: Style) -> Float:
    """(n_experiment, n_in) by what the references are multiplied in each experiment."""
    if "together" not in style.options:
        return np.eye(style.inputs)
    block = 1 << (style.inputs - 1).bit_length()
    return np.asarray(hadamard(block)[:, : style.inputs], dtype=np.float64)


def _signals(style: Style) -> int:
    """How many references are drawn: one, or one for each input."""
    apart = "together" in style.options and style.excitation in BY_INPUT
    return style.inputs if apart else 1


def _filled(rng: Rng, style: Style, seconds: float, *, runs: bool) -> Style:
    """The style with its references, all records together `seconds` long at most."""
    levels, repeats = style.levels, style.repeats
    signs = _signs(style)
    seconds /= len(signs)  # of each experiment
    while len(levels) * repeats > (2 if runs else 1) and seconds / (len(levels) * repeats) < 18.0:
        if len(levels) > 1 and (repeats == 1 or runs):
            levels = levels[1:]
        else:
            repeats -= 1
    style = replace(style, levels=levels, repeats=repeats)
    each = min(seconds / (len(levels) * repeats), float(rng.uniform(25.0, 70.0)))
    make = {
        "bursts": _bursts, "cut": _cut, "single": _single, "updown": _updown,
        "stepped": _stepped, "multisine": _multisine, "multisine_once": _multisine_once,
        "random": _random, "steps": _steps,
    }[style.excitation]  # fmt: skip
    made = make(rng, style, each)
    shared: dict[tuple[int, int], Float] = {}  # equal references are one array

    def driven(p: Piece, e: int) -> Piece:
        key = id(p.r), e
        if key not in shared:
            shared[key] = p.r.reshape(len(p.r), -1) * signs[e]
        if style.inputs == 1:
            return replace(p, r=shared[key])
        inputs = tuple(np.flatnonzero(signs[e]).tolist())
        return replace(p, name=f"{p.name}_{e + 1}", r=shared[key], driven=inputs)

    files: list[tuple[Piece, ...]] = []
    for file in made:
        pieces = tuple(driven(p, e) for e in range(len(signs)) for p in file)
        files += [(p,) for p in pieces] if runs or len(file) == 1 else [pieces]
    return replace(style, files=tuple(files))


def _sweep(rng: Rng, style: Style, seconds: float, ramp: float, *, fade: bool = True) -> Float:
    """A sweep up at unit level with a cosine ramp at its start, and at its end if it fades."""
    n = round(seconds * style.rate_hz)
    t = np.arange(n) / style.rate_hz
    low, high = style.low_hz, style.high_hz
    if rng.random() < 0.6:
        rate = np.log(high / low) / seconds
        phase = 2 * np.pi * low * np.expm1(rate * t) / rate
    else:
        phase = 2 * np.pi * (low * t + (high - low) / (2 * seconds) * t**2)
    out = np.sin(phase)
    m = round(ramp * style.rate_hz)
    edge = 0.5 - 0.5 * np.cos(np.pi * np.arange(m) / m)
    out[:m] *= edge
    if fade:
        out[n - m :] *= edge[::-1]
    return np.asarray(out)


def _rest(style: Style, seconds: float) -> Float:
    return np.zeros(round(seconds * style.rate_hz))


def _each(style: Style, kind: Kind, r: Float, name: str) -> list[Piece]:
    return [
        Piece(f"{name}_{i + 1}_{k + 1}", kind, r, level, k)
        for i, level in enumerate(style.levels)
        for k in range(style.repeats)
    ]


def _bursts(rng: Rng, style: Style, each: float) -> list[list[Piece]]:
    down = float(rng.uniform(0.25, 0.4)) * each
    sweep = _sweep(rng, style, each - down - 1.0, 0.5)
    r = np.concatenate([_rest(style, 1.0), sweep, _rest(style, down)])
    return [_each(style, "burst", r, "sweep")]


def _cut(rng: Rng, style: Style, each: float) -> list[list[Piece]]:
    sweep = _sweep(rng, style, each - 0.5, 0.5, fade=False)
    r = np.concatenate([_rest(style, 0.5), sweep])
    return [[piece] for piece in _each(style, "single", r, "sweep")]


def _single(rng: Rng, style: Style, each: float) -> list[list[Piece]]:
    sweep = _sweep(rng, style, each - 1.0, 0.5)
    r = np.concatenate([_rest(style, 1.0), sweep])
    return [[Piece("sweep", "single", r, 1.0, 0)]]


def _updown(rng: Rng, style: Style, each: float) -> list[list[Piece]]:
    up = _sweep(rng, style, each / 2, 0.5, fade=False)
    r = np.concatenate([up, up[::-1]])
    return [[piece] for piece in _each(style, "single", r, "up_and_down")]


def _stepped(rng: Rng, style: Style, each: float) -> list[list[Piece]]:
    points = int(rng.integers(12, 30))
    frequency = np.geomspace(style.low_hz, style.high_hz, points)
    dwell = np.maximum(2.0 / frequency, 0.0)
    dwell += (each - dwell.sum()) / points if each > dwell.sum() else 0.0
    sign = 1 if rng.random() < 0.7 else -1
    count = np.round(dwell * style.rate_hz).astype(np.int64)[::sign]
    phase = 2 * np.pi * np.cumsum(np.repeat(frequency[::sign], count)) / style.rate_hz
    ramp = np.minimum(np.arange(phase.size) / (0.5 * style.rate_hz), 1.0)
    return [[piece] for piece in _each(style, "single", ramp * np.sin(phase), "stepped")]


def _one_period(rng: Rng, style: Style, n: int) -> Float:
    """(n, n_signal) random-phase multisines with all lines of the band, unit peak."""
    return np.stack([_one_signal(rng, style, n) for _ in range(_signals(style))], axis=1)


def _one_signal(rng: Rng, style: Style, n: int) -> Float:
    f = np.arange(n // 2 + 1) * style.rate_hz / n
    band = (f >= style.low_hz) & (f <= style.high_hz)
    best = np.zeros(n)
    for _ in range(20):  # of twenty draws the one with the smallest peak
        spectrum = np.where(band, np.exp(2j * np.pi * rng.random(f.size)), 0.0)
        x = np.fft.irfft(spectrum, n)
        x /= np.abs(x).max()
        best = x if x.std() > best.std() else best
    return best


def _multisine(rng: Rng, style: Style, each: float) -> list[list[Piece]]:
    periods = int(rng.integers(LEAST_PERIODS, 5))
    settle = int(rng.integers(1, 3))
    n = round(each / (periods + settle) * style.rate_hz / style.every) * style.every
    r = np.tile(_one_period(rng, style, n), (periods + settle, 1))
    m = round(0.2 * style.rate_hz)
    r[:m] *= (0.5 - 0.5 * np.cos(np.pi * np.arange(m) / m))[:, None]
    return [
        [Piece(p.name, "periodic", p.r, p.level, p.repeat, skip=settle * n)]
        for p in _each(style, "periodic", r, "multisine")
    ]


def _multisine_once(rng: Rng, style: Style, each: float) -> list[list[Piece]]:
    r = _one_period(rng, style, round(each * style.rate_hz))
    return [[piece] for piece in _each(style, "single", r, "multisine")]


def _random(rng: Rng, style: Style, each: float) -> list[list[Piece]]:
    """A new draw for each level and repeat: nothing is ever the same twice."""
    files = []
    for piece in _each(style, "single", np.zeros(1), "random"):
        n = round(each * style.rate_hz)
        f = np.arange(n + 1) * style.rate_hz / (2 * n)
        band = (f >= style.low_hz) & (f <= style.high_hz)
        signals = []
        for _ in range(_signals(style)):
            spectrum = band * (rng.standard_normal(f.size) + 1j * rng.standard_normal(f.size))
            x = np.fft.irfft(spectrum, 2 * n)[:n]  # half of a longer period: it does not close
            signals.append(x / np.abs(x).max())
        r = np.stack(signals, axis=1)
        files.append([Piece(piece.name, "single", r, piece.level, piece.repeat)])
    return files


def _steps(rng: Rng, style: Style, each: float) -> list[list[Piece]]:
    files = _bursts(rng, style, each)
    n = round(6.0 * style.rate_hz)
    r = np.zeros(n)
    # A pulse of the speed is a step of the angle.
    r[round(0.5 * style.rate_hz) : round(float(rng.uniform(0.8, 1.5)) * style.rate_hz)] = 1.0
    steps = [
        Piece(f"step_{k + 1}", "transient", r * sign, 1.0, k) for k, sign in enumerate((1.0, -1.0))
    ]
    return [[*files[0], *steps]]
