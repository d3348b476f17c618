"""Torque test: one rigid link on the joint, a torque sensor between (paper 2, section 5)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from experiments.swept_sine import SweptSine
from samii_rig.errors import EstimateError, InputError
from samii_rig.rig.schema import Moment, Name, Rig
from samii_rig.run.outcome import Outcome
from samii_rig.run.plan import Plan
from samii_rig.run.setups import Conclusion
from samii_rig.types import FrequencyResponse

# Part of the rate up to which M/theta is fitted: above it the aliases of a torque that grows
# with frequency are no longer below a thousandth of it.
FIT_BELOW = 0.03
LEVEL = 0.9  # probability of the intervals that are said


@dataclass(frozen=True, slots=True)
class Pendulum:
    """J theta'' + k theta = M (paper 2, eq. 4; k = m g r, and 0 in eq. 5) fitted to M/theta.

    J kg m^2, k N m/rad; half : half widths of their 90 % intervals.
    """

    J: float
    k: float
    half: tuple[float, float]


class TorqueTest(SweptSine):
    """A torque test file: a swept sine, and what comes of it.

    angle, moment : the sensors theta and M.

    Yields theta/v and M/v as any swept sine does (Fig. 9 and 10 of paper 2), beside them
    theta/M (Fig. 8) as a file, the link's J and m g r with intervals, how M/v runs at both
    ends of the band, and the moment's mean (m g r where the link stands out level).
    """

    several = False
    experiment: Literal["torque_test"]  # type: ignore[assignment]
    angle: Name
    moment: Name

    def plan(self, rig: Rig) -> Plan:
        """As a swept sine's; InputError too if the rig has no such sensors."""
        where = f"experiment {self.name}"
        kinds = {s.name: s for s in rig.sensor}
        for field in ("angle", "moment"):
            name = getattr(self, field)
            if name not in kinds:
                expected = f"a sensor of {rig.name}: {', '.join(kinds)}"
                raise InputError(where, field, name, expected)
        if not isinstance(kinds[self.moment], Moment):
            raise InputError(where, "moment", self.moment, "a sensor of kind moment")
        return super().plan(rig)

    def conclude(self, rigs: Sequence[Rig], outcomes: Sequence[Outcome], stem: Path) -> Conclusion:
        """theta/M of every level into a file, and what the pendulum is."""
        from samii_rig.record.export import export_response
        from samii_rig.signal.ratio import ratio

        rig, outcome = rigs[0], outcomes[0]
        if not outcome.responses:
            raise EstimateError(f"no theta/M: {outcome.trouble}")
        lines, written = [], []
        for response in outcome.responses:
            q = ratio(response, self.moment, [self.angle])
            path = stem.with_name(f"{stem.name}_{self.angle}_over_{self.moment}_{q.level:g}.csv")
            written.append(export_response(path, q))
            said = f"{response.level:g} {response.level_unit}"
            band = sorted((self.start_hz, self.stop_hz))
            p = pendulum(ratio(response, self.angle, [self.moment]), rig, band[0])
            low, high = end_slopes(response, self.moment, band)
            lines += [
                f"{said}: {self.moment}/{self.angle} is a pendulum, J = {p.J:.4g} \u00b1 "
                f"{p.half[0]:.1g} kg m^2, m g r = {p.k:.4g} \u00b1 {p.half[1]:.1g} N m/rad (90 %)",
                f"{said}: {self.moment}/{self.actuator} runs as s^{low:.2f} at "
                f"{band[0]:g} Hz and as s^{high:.2f} at {band[1]:g} Hz",
            ]
        column = outcome.recording.column(self.moment)
        mean = float(np.nanmean(outcome.recording.values[:, column]))
        lines.append(f"{self.moment} is {mean:.4g} N m in the mean")
        return Conclusion(tuple(lines), tuple(written))


def pendulum(response: FrequencyResponse, rig: Rig, lowest: float) -> Pendulum:
    """J and k from M/theta (a response from theta to M), M/theta = k - J w^2.

    Least squares over the lines from `lowest` Hz to 0.03 of the rate, each weighted by its
    variance. What filters, delays and sampling do to M/theta over frequency is divided out,
    as the rig file's model has it. The half widths use the scatter about the fit where that is
    larger than the variances say. EstimateError for fewer than three lines.
    """
    # They take seconds; a test's file is looked at without them.
    from scipy import special

    from samii_rig.model.sampled import sampled_response
    from samii_rig.model.tmm import Chain

    names = (response.outputs[0].name, response.inputs[0].name)
    columns = [[s.name for s in rig.sensor].index(name) for name in names]
    f = response.frequency
    used = (f >= lowest) & (f <= FIT_BELOW * rig.rate_hz)
    if np.count_nonzero(used) < 3:
        raise EstimateError(f"J and m g r need three lines below {FIT_BELOW * rig.rate_hz:g} Hz")
    chain = Chain(rig)
    sampled = sampled_response(rig, f[used], chain)[:, columns, 0]
    continuous = chain.response(f[used])[:, columns, 0]
    seen = (sampled / continuous)[:, 0] / (sampled / continuous)[:, 1]
    filters = seen / seen[0].real  # what they do over frequency; the gain is the reading's own
    y = (response.H[used, 0, 0] / filters).real
    # Half of a circular error is in its real part.
    sd = np.sqrt(response.variance()[used, 0, 0] / 2) / np.abs(filters)
    A = np.stack([-((2 * np.pi * f[used]) ** 2), np.ones_like(y)], axis=1) / sd[:, None]
    N = np.linalg.inv(A.T @ A)
    x = N @ (A.T @ (y / sd))
    free = y.size - 2
    spread = max(1.0, float(np.sum((y / sd - A @ x) ** 2)) / free)
    half = special.stdtrit(free, (1 + LEVEL) / 2) * np.sqrt(spread * np.diagonal(N))
    return Pendulum(float(x[0]), float(x[1]), (float(half[0]), float(half[1])))


def end_slopes(
    response: FrequencyResponse, output: str, band: Sequence[float]
) -> tuple[float, float]:
    """d ln|H|/d ln f of one output over the first and the last octave of a band in Hz."""
    i = [c.name for c in response.outputs].index(output)
    f, size = response.frequency, np.abs(response.H[:, i, 0])

    def slope(chosen: NDArray[np.bool_]) -> float:
        return float(np.polyfit(np.log(f[chosen]), np.log(size[chosen]), 1)[0])

    inside = (f >= band[0]) & (f <= band[1])
    return slope(inside & (f <= 2 * band[0])), slope(inside & (f >= band[1] / 2))
