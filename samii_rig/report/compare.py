"""A model's curve over a measured response, in numbers and in words."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from samii_rig.errors import InputError
from samii_rig.rig.schema import Rig
from samii_rig.signal.several.undriven import as_measured
from samii_rig.signal.statistics import CERTAIN, model_difference
from samii_rig.types import Complex, Float, FrequencyResponse

BAND = 0.90  # the probability of every interval that is shown

# A model that is the truth is said to differ with this probability at most, over all bands,
# outputs and levels that are judged together. Third octaves: fine enough to point, wide enough to
# see a small change.
_CHANCE = 1e-3
_BANDS_PER_OCTAVE = 3


@dataclass(frozen=True, slots=True)
class ModelCurve:
    """What a model says, to be laid over a measurement.

    frequency : (n,) Hz, increasing. H : (n, n_out, n_in), outputs and inputs by name.
    """

    name: str
    frequency: Float
    H: Complex
    outputs: tuple[str, ...]
    inputs: tuple[str, ...]

    def __post_init__(self) -> None:
        expected = (len(self.frequency), len(self.outputs), len(self.inputs))
        if self.H.shape != expected:
            raise InputError(f"model {self.name}", "H", self.H.shape, f"the shape {expected}")

    def at(self, frequency: Float, output: str, input: str) -> Complex:
        """(n,) the curve at `frequency`; NaN outside the model's own, or where it has none.

        Between its own lines log-gain and phase are interpolated.
        """
        if output not in self.outputs or input not in self.inputs:
            return np.full(len(frequency), np.nan + 0j)
        H = self.H[:, self.outputs.index(output), self.inputs.index(input)]
        if np.array_equal(frequency, self.frequency):
            return H
        with np.errstate(divide="ignore"):
            log_gain = np.log(np.abs(H))
        end = {"left": np.nan, "right": np.nan}
        gain = np.exp(np.interp(frequency, self.frequency, log_gain, **end))
        phase = np.interp(frequency, self.frequency, np.unwrap(np.angle(H)), **end)
        return np.asarray(gain * np.exp(1j * phase))

    def like(self, response: FrequencyResponse) -> Complex:
        """(n_freq, n_out, n_in) the curve at the lines of `response`."""
        acting = [c.name for c in (*response.inputs, *response.followers)]
        H = np.full((len(response.frequency), len(response.outputs), len(acting)), np.nan + 0j)
        for i, y in enumerate(response.outputs):
            for j, u in enumerate(acting):
                H[:, i, j] = self.at(response.frequency, y.name, u)
        return as_measured(response, H, acting)


def model_curve(rig: Rig, responses: Sequence[FrequencyResponse]) -> ModelCurve | None:
    """The rig's model, seen through its hold, filters and sampling, at the lines measured.

    None when nothing was measured.
    """
    from samii_rig.model.sampled import sampled_response  # loads the model and its compiler

    if not responses:
        return None
    f = np.unique(np.concatenate([r.frequency for r in responses]))
    f = f[(f > 0) & (f < rig.rate_hz / 2)]
    return ModelCurve(
        rig.name,
        f,
        sampled_response(rig, f),
        tuple(s.name for s in rig.sensor),
        tuple(a.name for a in rig.actuator),
    )


@dataclass(frozen=True, slots=True)
class Comparison:
    """Model over measurement for one output, one input, one level.

    gain, phase_deg : medians over the lines of |model/measured| and its angle.
    outside : the part of the lines at which the model lies outside the 90 % region; one in
        ten does so by chance.
    spans_hz : (low, high) of the third octaves, neighbours joined, in which the distance is
        more than noise.
    """

    output: str
    input: str
    level: float
    level_unit: str
    low_hz: float
    high_hz: float
    gain: float
    phase_deg: float
    outside: float
    spans_hz: tuple[tuple[float, float], ...]

    @property
    def first_hz(self) -> float | None:
        """Where the first of the spans begins, None if there is none."""
        return self.spans_hz[0][0] if self.spans_hz else None

    @property
    def agrees(self) -> bool:
        """No band in which the distance is more than noise."""
        return self.first_hz is None

    def sentence(self) -> str:
        """The comparison as one sentence for the person."""
        phase = round(self.phase_deg, 1) + 0.0  # no minus before a zero
        start = (
            f"{self.output}/{self.input} at {self.level:g} {self.level_unit}, model over "
            f"measurement: gain {self.gain:.3f}, phase {phase:+.1f}\u00b0 in the median, "
            f"{self.low_hz:.3g}\u2013{self.high_hz:.3g} Hz"
        )
        if self.first_hz is None:
            return f"{start}; the difference is within the noise."
        return (
            f"{start}; differs by more than the noise from {self.first_hz:.3g} Hz on, "
            f"{percent(self.outside)} of the lines outside their {percent(BAND)} band."
        )


def compare(
    response: FrequencyResponse,
    model: ModelCurve,
    band_hz: tuple[float, float] = (0.0, np.inf),
    among: int = 1,
) -> tuple[Comparison, ...]:
    """One `Comparison` for each output and input that model and measurement share.

    among : responses that are judged together; the more there are, the further off by chance
        is the worst of them.
    """
    among *= len(response.outputs) * len(response.inputs)
    H = model.like(response)
    beyond = outside(response, H)
    f = response.frequency
    found = []
    for i, y in enumerate(response.outputs):
        for j, u in enumerate(response.inputs):
            measured = response.H[:, i, j]
            use = (f > 0) & (f >= band_hz[0]) & (f <= band_hz[1]) & np.isfinite(H[:, i, j])
            use &= np.isfinite(measured) & (measured != 0)
            if not use.any():
                continue
            ratio = H[use, i, j] / measured[use]
            spans = _different(response, H, i, j, f[use], among)
            found.append(
                Comparison(
                    y.name,
                    u.name,
                    response.level,
                    response.level_unit,
                    float(f[use][0]),
                    float(f[use][-1]),
                    float(np.median(np.abs(ratio))),
                    float(np.median(np.rad2deg(np.angle(ratio)))),
                    float(np.mean(beyond[use, i, j])),
                    spans,
                )
            )
    return tuple(found)


def percent(part: float) -> str:
    """`12 %`."""
    return f"{100 * part:.0f} %"


def telling(comparisons: Sequence[Comparison]) -> dict[tuple[str, str], Comparison]:
    """For each output and input the comparison to show: the highest level that disagrees,
    or the highest of all if none does."""
    shown: dict[tuple[str, str], Comparison] = {}
    for c in sorted(comparisons, key=lambda c: (not c.agrees, c.level)):
        shown[c.output, c.input] = c
    return shown


def outside(response: FrequencyResponse, H: Complex) -> NDArray[np.bool_]:
    """(n_freq, n_out, n_in) whether `H` lies outside the 90 % region of each entry alone.

    |dH|^2/C is F(2, 2 nu) when `H` is the truth; its quantile has the closed form
    nu ((1 - p)^(-1/nu) - 1), which tends to -ln(1 - p) with certain noise.
    """
    nu = np.minimum(response.entry_dof, CERTAIN)
    quantile = nu * np.expm1(-np.log1p(-BAND) / nu)
    distance = np.abs(H - response.H) ** 2
    return np.asarray(distance > quantile[:, None, None] * response.variance())


def _different(
    response: FrequencyResponse, H: Complex, output: int, input: int, f: Float, among: int
) -> tuple[tuple[float, float], ...]:
    """The parts of the band `f` (Hz) in which the model is further off than the worst of `among`
    curves is by chance."""
    count = max(1, int(np.ceil(_BANDS_PER_OCTAVE * np.log2(f[-1] / f[0]))))
    edges = f[0] * (f[-1] / f[0]) ** (np.arange(count + 1) / count)
    edges[-1] = np.nextafter(f[-1], np.inf)
    bands = [(float(a), float(b)) for a, b in pairwise(edges)]
    spans: list[tuple[float, float]] = []
    for d in model_difference(response, H, output, input, bands):
        if d.p_value * count * among >= _CHANCE:
            continue
        if spans and spans[-1][1] == d.low_hz:
            spans[-1] = (spans[-1][0], d.high_hz)
        else:
            spans.append((d.low_hz, d.high_hz))
    return tuple(spans)
