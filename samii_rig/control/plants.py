"""The rigs that a controller must hold for: the one identified, and those it may be."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from itertools import product

import numpy as np
from scipy.linalg import block_diag

from samii_rig.control.margins import Margins, margins
from samii_rig.errors import InputError
from samii_rig.model.loops import Loops, Sampled, closed_poles, sampled_system
from samii_rig.model.realise import Realisation, realise
from samii_rig.model.sampled import as_sent, sampled_response
from samii_rig.model.tmm import Chain
from samii_rig.rig.schema import Key, Rig, parameters
from samii_rig.types import Complex, Float

Values = Mapping[Key, float]
"""(element, symbol) -> SI value, as `Chain.with_values` takes it."""

STIFFNESSES = ("k", "EI", "GA")  # symbols of what +-20 % is said of
MOST_CORNERS = 64  # all of them for six stiffnesses; of more, as many at random
# Band of the realisation over the rate: what lies beyond is far above that of the loop. The
# next one serves where the edge of one parts two neighbouring poles.
BANDS_OVER_RATE = (0.2, 0.4, 1.0)
# Lowest and highest frequency of the loop's gain over the rate: 0.02 Hz at 500 samples/s.
LOWEST, HIGHEST = 4e-5, 0.4999
POINTS = 240  # of the loop's gain up to half the rate,
# and beside each resonance at these multiples of its half width.
BESIDE = np.sinh(np.linspace(-3.5, 3.5, 36))


@dataclass(frozen=True, slots=True, eq=False)
class Plant:
    """One rig, ready to be closed by any controller.

    frequency, response : (n,) Hz and (n, n_sensor, n_actuator), sampled. system : the
    realised rig, one actuator. split : rad/s between its modes 1 and 2.
    mode_1 : its first oscillating pole, loops open, rad/s. structure : all that were found.
    """

    name: str
    rig: Rig
    frequency: Float
    response: Complex
    system: Sampled
    mode_1: complex
    split: float
    structure: Complex


@dataclass(frozen=True, slots=True)
class Judgement:
    """What a controller makes of one plant.

    poles : (m,) of the closed loop, rad/s, by modulus. outside : how many do not decay.
    damping, frequency_hz : of its least damped oscillating pole below the split between
        modes 1 and 2; damping 1 if none oscillates, below 0 if that pole grows.
    actuator : margins of the loop cut at the actuator, centring and feedback together.
    feedback : of the feedback alone, with the centring closed.
    """

    plant: str
    poles: Complex
    outside: int
    damping: float
    frequency_hz: float
    actuator: Margins
    feedback: Margins

    @property
    def gain_db(self) -> float:
        """The smaller of the two gain margins."""
        return min(self.actuator.gain_db, self.feedback.gain_db)

    @property
    def phase_deg(self) -> float:
        """The smaller of the two phase margins."""
        return min(self.actuator.phase_deg, self.feedback.phase_deg)


def plant(name: str, rig: Rig, loops: Loops, near: Complex | None = None) -> Plant:
    """`rig` for loops on the actuator of `loops`; InputError if it has less than two modes.

    near : the `structure` of a rig that is nearly the same, from which it takes half the time.
    """
    made = slow_modes(rig, near)
    pairs = made.structure.poles[made.structure.poles.imag > 0]
    if pairs.size < 2:
        raise InputError(rig.name, "element", f"{pairs.size} modes", "two oscillating modes")
    f = np.geomspace(LOWEST * rig.rate_hz, HIGHEST * rig.rate_hz, POINTS)
    beside = (pairs.imag + np.outer(BESIDE, pairs.real)).ravel() / (2 * np.pi)
    f = np.union1d(f, beside[(beside > f[0]) & (beside < f[-1])])
    chain = Chain(rig)
    split = float(np.sqrt(np.abs(pairs[0] * pairs[1])))
    return Plant(
        name,
        rig,
        f,
        sampled_response(as_sent(rig), f, chain),
        sampled_system(rig, made, loops.actuator),
        complex(pairs[0]),
        split,
        made.structure.poles,
    )


def slow_modes(rig: Rig, near: Complex | None = None) -> Realisation:
    """The rig realised no further than a loop on its first modes needs; near : as of `plant`."""
    *narrow, widest = BANDS_OVER_RATE
    for band in narrow:
        with suppress(InputError):
            return realise(rig, band * rig.rate_hz, near)
    return realise(rig, widest * rig.rate_hz, near)


def judge(given: Plant, loops: Loops) -> Judgement:
    """Close `loops` on a plant."""
    poles = closed_poles(given.system, loops)
    low = poles.oscillating(given.split)
    damping, hz = 1.0, float("nan")
    if low.size:
        each = -low.real / np.abs(low)
        at = int(np.argmin(each))
        damping, hz = float(each[at]), float(np.abs(low[at]) / (2 * np.pi))
    f, H = given.frequency, given.response
    z = np.exp(2j * np.pi * f / given.rig.rate_hz)
    L = loops.gain(H, loops.filters(z, given.rig.rate_hz))
    return Judgement(
        given.name,
        poles.s,
        poles.outside,
        damping,
        hz,
        margins(f, L),
        margins(f, alone(H, L, loops)),
    )


def alone(H: Complex, L: Complex, loops: Loops) -> Complex:
    """Loop gain of the feedback with the centring closed, from that of both."""
    centring = loops.kp * H[:, loops.theta, loops.actuator]
    return np.asarray((L - centring) / (1 + centring))


def with_values(rig: Rig, values: Values) -> Rig:
    """The rig with other values of some parameters."""
    return Chain(rig).with_values(values).rig


def stiffnesses(rig: Rig) -> tuple[Key, ...]:
    """Every stiffness of the chain that is not 0, as (element, symbol)."""
    return tuple(
        (e.name, symbol)
        for e in rig.element
        for symbol, p in parameters(e).items()
        if symbol in STIFFNESSES and p.value != 0
    )


def corners(rig: Rig, spread: float, seed: int = 0) -> dict[str, Values]:
    """Every stiffness low or high by `spread` (a part of its value), in all combinations, or
    MOST_CORNERS of them at random; by name, such as `-+-++`."""
    keys = stiffnesses(rig)
    signs = list(product((-1, 1), repeat=len(keys)))
    if len(signs) > MOST_CORNERS:
        chosen = np.random.default_rng(seed).choice(len(signs), MOST_CORNERS, replace=False)
        signs = [signs[i] for i in np.sort(chosen)]
    return {
        "".join("+" if x > 0 else "-" for x in row): _scaled(rig, keys, 1 + spread * np.array(row))
        for row in signs
    }


def inside(rig: Rig, spread: float, n: int, seed: int) -> dict[str, Values]:
    """n draws, every stiffness even within +-`spread`."""
    keys = stiffnesses(rig)
    factors = np.random.default_rng(seed).uniform(1 - spread, 1 + spread, (n, len(keys)))
    return {f"draw {i + 1}": _scaled(rig, keys, row) for i, row in enumerate(factors)}


@dataclass(frozen=True, slots=True, eq=False)
class Known:
    """What an identification knows: keys, and log_covariance (n, n) of their logarithms."""

    keys: tuple[Key, ...]
    log_covariance: Float


def uncertain(rig: Rig, n: int, seed: int, known: Known | None = None) -> dict[str, Values]:
    """n draws of every parameter that has a tolerance, log-normal with that deviation, those
    of `known` with its covariance. Lengths are left: a sensor's place is on them, and they
    are known best."""
    keys = list(known.keys) if known else []
    covariance = known.log_covariance if known else np.zeros((0, 0))
    sd = []
    for e in rig.element:
        for symbol, p in parameters(e).items():
            key = (e.name, symbol)
            if p.tolerance > 0 and p.value != 0 and symbol != "L" and key not in keys:
                keys.append(key)
                sd.append(p.tolerance)
    whole = block_diag(covariance, np.diag(np.square(sd)))
    rng = np.random.default_rng(seed)
    factors = np.exp(rng.multivariate_normal(np.zeros(len(keys)), whole, n, method="eigh"))
    return {f"rig {i + 1}": _scaled(rig, tuple(keys), row) for i, row in enumerate(factors)}


def _scaled(rig: Rig, keys: tuple[Key, ...], factors: Float) -> Values:
    value = {(e.name, s): p.value for e in rig.element for s, p in parameters(e).items()}
    return {key: value[key] * float(x) for key, x in zip(keys, factors, strict=True)}
