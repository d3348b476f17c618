"""Identification from a few numbers: natural frequencies, zeros, mode shape ratios.

Methods 1 and 2 of paper 1 (section IV-C, IV-D), for any chain. Each minimises a sum of
squared differences by the method of Nelder and Mead. They need no covariance and give none;
`valley` shows what the numbers leave open.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.optimize import minimize

from samii_rig.errors import InputError
from samii_rig.identify.conservative import Conservative
from samii_rig.identify.parameters import Free, changed, space
from samii_rig.rig.schema import Rig
from samii_rig.types import Float

MISSING = 1.0  # difference charged for a frequency that the model does not have in the band
BELOW, ABOVE = 0.1, 3.0  # ends of the band over the lowest and the highest target
TOLERANCE = 1e-10  # of e and of log(parameter) at which the simplex ends
EVALUATIONS = 4000
SLOPE = 1e-4  # step in log(parameter) of a derivative
RANK = 1e-4  # singular value over the largest below which a direction counts as flat
WALK = 0.04  # step along the valley in log(parameter)


@dataclass(frozen=True, slots=True)
class Target:
    """A measured number that the model shall have.

    kind : natural `frequency` number `index` (0 the lowest), `zero` number `index` of
        `output` (the same for the way from the driven angle to it), or mode shape `ratio`
        phi(output)/phi(other) of mode `index`.
    value : Hz, or the ratio. weight : of the squared difference.
    relative : whether the difference is divided by `value`.
    """

    kind: Literal["frequency", "zero", "ratio"]
    value: float
    index: int = 0
    output: str = ""
    other: str = ""
    weight: float = 1.0
    relative: bool = True


@dataclass(frozen=True, slots=True)
class Match:
    """What a search found. values : (n,) SI; error : the cost e; model : the targets'
    numbers at `values`; evaluations : of the cost."""

    rig: Rig
    names: tuple[str, ...]
    values: Float
    error: float
    model: Float
    evaluations: int


@dataclass(frozen=True, slots=True)
class Valley:
    """A line of parameters along which the cost stays zero, to both sides of a match.

    values : (n_step, n) SI. error : (n_step,) cost. direction : (n,) of log(parameter) at
    the match. dimensions : how many such directions there are.
    """

    names: tuple[str, ...]
    values: Float
    error: Float
    direction: Float
    dimensions: int


def match(
    rig: Rig, free: Sequence[str | Free], targets: Sequence[Target], damped: bool = False
) -> Match:
    """Search for the `free` parameters with which the rig has the `targets`.

    damped : compare with |s|/(2 pi) of the poles and zeros that the rig has with its damping,
        as measured ones are; the papers' models have none.

    Raises InputError for unknown parameters or outputs, and without targets.
    """
    chosen = space(rig, free)
    numbers = _numbers(rig, free, targets, damped)
    wanted = np.array([t.value for t in targets])
    root = _weights(targets)

    def cost(x: Float) -> float:
        return float(np.sum((root * (numbers(x) - wanted)) ** 2))

    found = minimize(
        cost,
        np.zeros(chosen.start.size),
        method="Nelder-Mead",
        bounds=list(zip(chosen.lower, chosen.upper, strict=True)),
        options={
            "xatol": TOLERANCE**0.5,
            "fatol": TOLERANCE,
            "maxfev": EVALUATIONS,
            "initial_simplex": _simplex(chosen.start.size),
        },
    )
    return Match(
        changed(rig, chosen.mapping(found.x)),
        chosen.names,
        chosen.values(found.x),
        float(found.fun),
        numbers(found.x),
        int(found.nfev),
    )


def method_1(
    rig: Rig,
    frequencies_hz: Sequence[float],
    zero_hz: float,
    output: str,
    free: Sequence[str | Free],
    damped: bool = False,
) -> Match:
    """Method 1 of paper 1, first stage: its cost e of relative differences.

    frequencies_hz : the first natural frequencies, lowest first (the paper has two).
    zero_hz : first zero of the way from the driven joint's angle to `output` (a_0).
    The second stage, the gains g_v from the amplitudes, is `velocity_feedback.fit_gain`.
    """
    targets = [Target("frequency", f, i) for i, f in enumerate(frequencies_hz)]
    return match(rig, free, [*targets, Target("zero", zero_hz, 0, output)], damped)


def method_2(
    rig: Rig,
    frequency_hz: float,
    ratio: float,
    outputs: tuple[str, str],
    free: Sequence[str | Free],
    weight: float = 1.0,
) -> Match:
    """Method 2 of paper 1, eq. 19, on the rig as it was braced.

    frequency_hz : first natural frequency. ratio : phi_1(outputs[0])/phi_1(outputs[1]).
    weight : of the squared difference of the ratio against that in Hz^2.
    """
    return match(
        rig,
        free,
        [
            Target("frequency", frequency_hz, relative=False),
            Target("ratio", ratio, 0, *outputs, weight=weight, relative=False),
        ],
    )


def braced(rig: Rig, first: str, base: Literal["clamped", "pinned"] = "clamped") -> Rig:
    """The rig with everything before the element `first` held fast by braces.

    Sensors, actuators and limits that lose their place go. Raises InputError if the element
    does not exist or nothing drives what is left.
    """
    names = [e.name for e in rig.element]
    if first not in names:
        raise InputError("braced", "first", first, f"one of {', '.join(names)}")
    data = rig.model_dump()
    data["base"] = base
    data["element"] = data["element"][names.index(first) :]
    left = set(names[names.index(first) :])
    data["sensor"] = [s for s in data["sensor"] if _held(s) <= left]
    inputs = {e.get("input") for e in data["element"]}
    data["actuator"] = [a for a in data["actuator"] if a["name"] in inputs]
    if not data["actuator"]:
        raise InputError("braced", "first", first, "an element before a source that drives")
    channels = {x["name"] for x in (*data["sensor"], *data["actuator"])}
    data["limit"] = [x for x in data["limit"] if x["channel"] in channels]
    if data["actuator"][0]["centring"]:  # it was not the first
        data["centring"] = data["actuator"][0]["centring"]
        data["actuator"][0] = {**data["actuator"][0], "centring": None}
    if data["centring"] and data["centring"]["sensor"] not in channels:
        data["centring"] = None
    return Rig.model_validate(data)


def valley(found: Match, targets: Sequence[Target], reach: float = 3.0) -> Valley:
    """Follow the flattest direction of the cost from a match, until a parameter has changed
    by the factor `reach` or the targets are left.

    From each point a step along the direction that changes no target, then Gauss-Newton
    steps of least norm back to the targets.
    """
    free = [_free(name) for name in found.names]
    numbers = _numbers(found.rig, free, targets)
    wanted, root = np.array([t.value for t in targets]), _weights(targets)

    def residual(x: Float) -> Float:
        return np.asarray(root * (numbers(x) - wanted))

    zero = np.zeros(found.values.size)
    J = _slopes(residual, zero)
    s, vt = np.linalg.svd(J)[1:]
    rank = int(np.count_nonzero(s > RANK * s[0]))
    if rank == zero.size:
        return Valley(found.names, found.values[None], np.array([found.error]), vt[-1], 0)
    level = max(10 * found.error, 1e-8)
    sides = []
    for sign in (-1.0, 1.0):
        points: list[Float] = []
        x, along = zero, sign * vt[-1]
        while np.max(np.abs(x)) < np.log(reach) and len(points) < 50 * np.log(reach) / WALK:
            trial = x + WALK * along
            back = np.linalg.pinv(_slopes(residual, trial), rcond=RANK)
            for _ in range(3):
                trial = trial - back @ residual(trial)
            if not np.all(np.isfinite(trial)) or np.sum(residual(trial) ** 2) > level:
                break
            moved = trial - x
            x, along = trial, moved / np.linalg.norm(moved)
            points.append(x)
        sides.append(points)
    line = np.array([*sides[0][::-1], zero, *sides[1]])
    error = np.array([np.sum(residual(x) ** 2) for x in line])
    return Valley(found.names, found.values * np.exp(line), error, vt[-1], zero.size - rank)


def _free(name: str) -> Free:
    element, _, symbol = name.partition(".")
    return Free(element, symbol)


def _held(sensor: dict[str, object]) -> set[object]:
    """Names of the elements that a dumped sensor stands on."""
    across = sensor.get("across")
    if isinstance(across, list | tuple):
        return set(across)
    return {sensor[k] for k in ("after", "on") if k in sensor}


def _weights(targets: Sequence[Target]) -> Float:
    return np.array([np.sqrt(t.weight) / (abs(t.value) if t.relative else 1.0) for t in targets])


def _numbers(
    rig: Rig, free: Sequence[str | Free], targets: Sequence[Target], damped: bool = False
) -> Callable[[Float], Float]:
    """The model's numbers for the targets as a function of log(parameter/start)."""
    hertz = [t.value for t in targets if t.kind != "ratio"]
    if not hertz:
        raise InputError("targets", "", len(targets), "at least one frequency or zero")
    band = (BELOW * min(hertz), ABOVE * max(hertz))
    chosen = space(rig, free)

    def numbers(x: Float) -> Float:
        chain = Conservative(changed(rig, chosen.mapping(x)), band)
        modes = chain.frequencies()
        out = []
        for t in targets:
            have = chain.zeros(t.output) if t.kind == "zero" else modes
            if t.index >= have.size:
                out.append(t.value * (1 + MISSING))
            elif t.kind == "ratio":
                out.append(chain.shape_ratio(float(have[t.index]), t.output, t.other))
            elif damped:
                output = t.output if t.kind == "zero" else None
                out.append(float(chain.damped(have[t.index : t.index + 1], output)[0]))
            else:
                out.append(float(have[t.index]))
        return np.array(out)

    return numbers


def _slopes(residual: Callable[[Float], Float], x: Float) -> Float:
    steps = SLOPE * np.eye(x.size)
    return np.stack([(residual(x + h) - residual(x - h)) / (2 * SLOPE) for h in steps], axis=1)


def _simplex(n: int) -> Float:
    """Corners 10 % away from the start in each parameter."""
    return np.vstack([np.zeros(n), np.log(1.1) * np.eye(n)])
