"""What an identification found, with intervals, and how well it fits."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass

import numpy as np
from scipy import special

from samii_rig.identify.data import Data
from samii_rig.identify.identifiability import Identifiability
from samii_rig.identify.parameters import Space
from samii_rig.rig.schema import Rig
from samii_rig.signal.statistics import octaves
from samii_rig.signal.whitening import Fit
from samii_rig.types import Complex, Float

TAIL = 0.05  # beyond either end of an interval of 90 %, and beyond a limit
AT_BOUND = 1e-3  # distance of log(value) from its bound that counts as on it


@dataclass(frozen=True, slots=True)
class Residual:
    """What is left of one channel in one band at one level.

    ratio : mean of |e|^2/C over its mean if the model holds.
    error : |e| over |H|, both summed in squares over the band.
    """

    output: str
    input: str
    level: float
    level_unit: str
    low_hz: float
    high_hz: float
    ratio: float
    error: float


@dataclass(frozen=True, slots=True)
class Identification:
    """Free parameters of a rig from measured responses.

    rig : with the values found. names, units, start, values : (n,) SI.
    log_covariance : (n, n) of log(value) if the model holds.
    prior_sd : (n,) relative, inf for none.
    at_bound : names of parameters that ended on a bound. on_top : of these, on the upper one.
    starts, reached : how many starts were tried, how many ended at this optimum.
    prediction : (n_freq, p) at the lines used, for each response.
    """

    rig: Rig
    names: tuple[str, ...]
    units: tuple[str, ...]
    start: Float
    values: Float
    log_covariance: Float
    prior_sd: Float
    fit: Fit
    start_fit: Fit
    residuals: tuple[Residual, ...]
    identifiability: Identifiability
    at_bound: tuple[str, ...]
    starts: int
    reached: int
    prediction: tuple[Complex, ...]
    on_top: tuple[str, ...] = ()

    def value(self, name: str) -> float:
        """SI value of the parameter called `element.symbol`."""
        return float(self.values[self.names.index(name)])

    def inflation(self) -> float:
        """Factor on standard deviations where the model is refused: the root of `fit.ratio`."""
        return 1.0 if self.fit.holds else math.sqrt(max(self.fit.ratio, 1.0))

    def interval(self, level: float = 0.9) -> tuple[Float, Float]:
        """Lower and upper ends (n,) of the intervals of the values.

        Where the model is refused they are wider by `inflation`: the misfit, taken for noise.
        """
        sd = np.sqrt(np.diag(self.log_covariance)) * self.inflation()
        factor = np.exp(float(special.ndtri((1 + level) / 2)) * sd)
        ends = np.stack([self.values / factor, self.values * factor])
        return np.min(ends, axis=0), np.max(ends, axis=0)

    def limits(self) -> tuple[Float, Float]:
        """As `interval` of 90 %, but of a parameter on a bound: NaN for the end that the data do
        not set, and for the other a limit that 95 % keep.

        On its lower bound it is not distinguished from 0, on its upper one from any larger: what
        the data know is linear in the value, or in its inverse, and no longer in its logarithm.
        """
        low, high = self.interval()
        reach = -float(special.ndtri(TAIL)) * self.inflation()
        width = reach * np.sqrt(np.diag(self.log_covariance))
        for i, name in enumerate(self.names):
            if name not in self.at_bound:
                continue
            if name in self.on_top:
                ends = self.values[i] / (1 + width[i]), math.nan
            else:
                ends = math.nan, self.values[i] * (1 + width[i])
            low[i], high[i] = ends if self.values[i] > 0 else ends[::-1]
        return low, high

    def limit(self, i: int) -> str:
        """The limit of parameter i in words; "" where it has an interval."""
        low, high = (float(end[i]) for end in self.limits())
        if math.isnan(low):
            return f"at most {high:.3g} {self.units[i]}"
        return f"at least {low:.3g} {self.units[i]}" if math.isnan(high) else ""

    def correlation(self) -> Float:
        """(n, n) correlation of the estimates of log(value)."""
        sd = np.sqrt(np.diag(self.log_covariance))
        return np.asarray(self.log_covariance / np.outer(sd, sd))

    def plain(self) -> dict[str, object]:
        """Numbers and words as plain data, for machines."""
        low, high = self.limits()

        def end(x: float) -> float | None:
            return None if math.isnan(x) else float(x)

        return {
            "rig": self.rig.name,
            "parameters": {
                name: {
                    "start": float(self.start[i]),
                    "value": float(self.values[i]),
                    "low_90": end(low[i]),
                    "high_90": end(high[i]),
                    "unit": self.units[i],
                }
                for i, name in enumerate(self.names)
            },
            "log_covariance": (self.log_covariance * self.inflation() ** 2).tolist(),
            "chi_square_per_dof": self.fit.ratio,
            "p_value": self.fit.p_value,
            "residuals": [asdict(r) for r in self.residuals],
            "verdict": list(self.sentences()),
        }

    def sentences(self) -> tuple[str, ...]:
        """The verdict in words: fit, identifiability, bounds, starts."""
        f = self.fit
        if f.holds:
            first = (
                f"The model fits: chi-square per degree of freedom {f.ratio:.3f}, "
                f"p = {f.p_value:.2g}."
            )
        else:
            first = (
                f"The model does not fit: what is left is {math.sqrt(f.ratio):.3g} times the "
                f"noise (chi-square per degree of freedom {f.ratio:.4g}, p = {f.p_value:.1g}). "
                f"Intervals are widened by {self.inflation():.3g} and hold only if what is "
                "missing acts like noise."
            )
        out = [first, *self.identifiability.sentences]
        out += [
            f"{name} ended on its bound: {self.limit(i)}."
            for i, name in enumerate(self.names)
            if name in self.at_bound
        ]
        if self.reached < self.starts:
            out.append(
                f"{self.reached} of {self.starts} starts ended here, the others at a worse fit."
            )
        return tuple(out)


def residuals_of(data: Data, prediction: Sequence[Complex]) -> tuple[Residual, ...]:
    """Per response, channel and octave, what the prediction leaves."""
    out = []
    for d, H in zip(data.lines, prediction, strict=True):
        error = np.abs(H - d.H)
        expected = d.dof / np.maximum(d.dof - 1, 1e-9)
        for low, high in octaves(d.frequency):
            inside = (d.frequency >= low) & (d.frequency < high)
            if not inside.any():
                continue
            for k in range(d.p):
                noise = (error[inside, k] / d.sd[inside, k]) ** 2 / expected[inside]
                out.append(
                    Residual(
                        d.outputs[k],
                        d.inputs[k],
                        d.response.level,
                        d.response.level_unit,
                        float(d.frequency[inside][0]),
                        float(d.frequency[inside][-1]),
                        float(np.mean(noise)),
                        float(np.linalg.norm(error[inside, k]) / np.linalg.norm(d.H[inside, k])),
                    )
                )
    return tuple(out)


def bounds_met(space: Space, x: Float) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Names of the parameters that lie on a bound at x, and of those on their upper one."""
    top = space.upper - x < AT_BOUND
    near = top | (x - space.lower < AT_BOUND)

    def names(some: Sequence[bool]) -> tuple[str, ...]:
        return tuple(name for name, on in zip(space.names, some, strict=True) if on)

    return names(near.tolist()), names(top.tolist())
