"""Methods 1 and 2 of paper 1 (section IV-C, IV-D) from measured responses to stiffnesses.

    found = from_responses("2", responses, rig, ["joint_1.k", "joint_2.k"])

The numbers that the methods start from are those of `modal`, the search is that of `targets`.
Neither weighs a number by how well it is known, and neither gives an interval: `identify` does.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, get_args

from samii_rig.errors import EstimateError, InputError
from samii_rig.identify.actuator import BodeFit
from samii_rig.identify.modal import Modes, estimate_modes
from samii_rig.identify.parameters import Free, space
from samii_rig.identify.targets import Match, Target, match
from samii_rig.identify.velocity_feedback import SUFFIX, fit_gain
from samii_rig.modal.modes import Value
from samii_rig.rig.schema import Acceleration, RelativeAngle, Rig
from samii_rig.types import Float, FrequencyResponse

Method = Literal["1", "2"]
LIGHT = 0.3  # damping ratio below which a zero shows as a notch
MODES = 2  # natural frequencies of method 1


@dataclass(frozen=True, slots=True)
class Found:
    """What a method made of one response.

    level, level_unit : of the response. numbers : what was measured, by name, Hz or a ratio.
    start : (n,) the values of `match.names` before. gain : the second stage of method 1, None
    for method 2 and for a rig whose source has no velocity feedback.
    """

    method: Method
    level: float
    level_unit: str
    numbers: dict[str, Value]
    start: Float
    match: Match
    gain: BodeFit | None

    def plain(self) -> dict[str, object]:
        """The same as plain data, for machines."""
        m, g = self.match, self.gain
        return {
            "method": self.method,
            "rig": m.rig.name,
            "level": self.level,
            "measured": {k: {"value": v.value, "sd": v.sd} for k, v in self.numbers.items()},
            "model": dict(zip(self.numbers, map(float, m.model), strict=True)),
            "parameters": dict(zip(m.names, map(float, m.values), strict=True)),
            "error": m.error,
            "gain": dict(zip(g.names, map(float, g.values), strict=True)) if g else {},
        }


def from_responses(
    method: Method,
    responses: Sequence[FrequencyResponse],
    rig: Rig,
    free: Sequence[str | Free],
    *,
    outputs: Sequence[str] | None = None,
    band: tuple[float, float] | None = None,
) -> Found:
    """Method 1 or 2 on the strongest level of `responses`.

    outputs : method 1: the accelerometer whose first zero counts; method 2: the two whose mode
        shape ratio counts. Default the first ones of the rig file that were measured.
    band : Hz, in which modes are looked for.

    Raises InputError for unknown names, too few outputs, more parameters than numbers;
    EstimateError if the modes or the zero do not stand out of the noise.
    """
    if method not in get_args(Method):
        raise InputError("identify", "method", method, f"one of {', '.join(get_args(Method))}")
    if not responses:
        raise InputError("responses", "", 0, "at least one frequency response")
    chosen = space(rig, free)
    needed = MODES + 1 if method == "1" else 2
    if len(chosen.names) > needed:
        raise InputError(
            f"method {method}",
            "data",
            f"{needed} numbers for {len(chosen.names)} parameters",
            f"at most {needed} free: what is left over would be any point of a valley",
        )
    response = max(responses, key=lambda r: r.level)
    at = _outputs(method, response, rig, outputs)
    modes = estimate_modes(response, rig, band=band)
    targets, numbers = (_one if method == "1" else _two)(modes, at)
    found = match(rig, free, targets, damped=method == "1")
    gain = None
    if method == "1" and any(e.name.endswith(SUFFIX) for e in rig.element):
        gain = fit_gain([response], found.rig, _encoder(response, rig), band=band)
    return Found(method, response.level, response.level_unit, numbers, chosen.start, found, gain)


def _one(modes: Modes, at: Sequence[str]) -> tuple[list[Target], dict[str, Value]]:
    if len(modes.modes) < MODES:
        raise EstimateError(
            f"{len(modes.modes)} modes stand out of the noise, method 1 needs {MODES}; "
            "a wider band, more repeats or a higher level would show more"
        )
    light = [z for z in modes.zeros_of(at[0]) if abs(z.damping.value) < LIGHT]
    if not light:
        raise EstimateError(f"{at[0]} has no lightly damped zero in the band; another output may")
    numbers = {f"f_{i + 1}, Hz": modes.modes[i].frequency_hz for i in range(MODES)}
    targets = [Target("frequency", v.value, i) for i, v in enumerate(numbers.values())]
    zero = light[0].frequency_hz
    numbers[f"z_1 of {at[0]}, Hz"] = zero
    return [*targets, Target("zero", zero.value, 0, at[0])], numbers


def _two(modes: Modes, at: Sequence[str]) -> tuple[list[Target], dict[str, Value]]:
    if not modes.modes:
        raise EstimateError("no mode stands out of the noise; a higher level would show one")
    f, ratio = modes.modes[0].frequency_hz, modes.shape_ratio(0, at[0], at[1])
    targets = [
        Target("frequency", f.value, relative=False),
        Target("ratio", ratio.value, 0, at[0], at[1], relative=False),
    ]
    return targets, {"f_1, Hz": f, f"phi_1({at[0]})/phi_1({at[1]})": ratio}


def _outputs(
    method: Method, response: FrequencyResponse, rig: Rig, outputs: Sequence[str] | None
) -> list[str]:
    """The accelerometers that the method looks at."""
    measured = [c.name for c in response.outputs]
    known = [s.name for s in rig.sensor if isinstance(s, Acceleration) and s.name in measured]
    needed = 1 if method == "1" else 2
    chosen = list(outputs) if outputs else known[:needed] if method == "1" else known[-needed:]
    for name in chosen:
        if name not in known:
            raise InputError(f"method {method}", "output", name, f"one of {', '.join(known)}")
    if len(chosen) != needed:
        expected = f"{needed} accelerometer{'s' * (needed > 1)}"
        raise InputError(f"method {method}", "outputs", ", ".join(chosen) or None, expected)
    return chosen


def _encoder(response: FrequencyResponse, rig: Rig) -> str:
    """The encoder that spans the damper."""
    measured = [c.name for c in response.outputs]
    for s in rig.sensor:
        spans = isinstance(s, RelativeAngle) and any(e.endswith(SUFFIX) for e in s.across)
        if spans and s.name in measured:
            return s.name
    raise InputError("method 1", "outputs", ", ".join(measured), "an encoder across the source")
