"""Intrinsic velocity feedback: what its gain g_v does to the modes, and what g_v is.

    T = g_v (g_a v - theta')                                           (paper 1, eq. 18)

In the chain it is an angular velocity source in series with a torsional damper c = g_v (paper 1,
section V-A); in finite elements a torque at the joint. `curves` follows the modes over g_v
(section IV-A), `fit_gain` is the second stage of method 1 (section IV-C): g_v from the
amplitudes.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from samii_rig.errors import InputError
from samii_rig.fem.model import Fem
from samii_rig.identify.actuator import BodeFit, bode_fit
from samii_rig.identify.likelihood import gain_misfit
from samii_rig.identify.parameters import Free
from samii_rig.model.modes import poles
from samii_rig.rig.schema import AngularVelocitySource, Parameter, Rig, TorsionalSpring
from samii_rig.types import Complex, Float, FrequencyResponse

SUFFIX = "_feedback"  # of the damper's name, after the source's
HIGH = 3.0  # times the highest mode's frequency: how far up poles are looked for
JUMP = 0.3  # of |s|; a pole that is farther from the last one is another
SWINGS = 1e-3  # of |s|, least imaginary part of a mode


def in_series(rig: Rig, source: str, g_v: float) -> Rig:
    """The rig with a damper `g_v` (N m s/rad) behind a source; encoders of the source span both.

    The source keeps its lag, which eq. 18 does not have (p to infinity). The damper is called
    `<source>_feedback`. Raises InputError if there is no such source or g_v is not above 0.
    """
    names = [e.name for e in rig.element]
    if source not in names or not isinstance(
        rig.element[names.index(source)], AngularVelocitySource
    ):
        have = [e.name for e in rig.element if isinstance(e, AngularVelocitySource)]
        raise InputError("velocity feedback", "source", source, f"one of {', '.join(have)}")
    if not (np.isfinite(g_v) and g_v > 0):
        raise InputError("velocity feedback", "g_v", g_v, "more than 0 N m s/rad")
    name = source + SUFFIX
    damper = TorsionalSpring(
        kind="torsional_spring",
        name=name,
        k=Parameter(value=0.0, unit="N m/rad", source="a damper alone (paper 1, section V-A)"),
        c=Parameter(value=g_v, unit="N m s/rad", source="g_v (paper 1, eq. 18)"),
    )
    at = names.index(source) + 1
    data = rig.model_dump()
    data["element"] = (*data["element"][:at], damper.model_dump(), *data["element"][at:])
    for sensor in data["sensor"]:
        if source in sensor.get("across", ()):
            i = list(sensor["across"]).index(source) + 1
            sensor["across"] = (*sensor["across"][:i], name, *sensor["across"][i:])
    return Rig.model_validate(data)


@dataclass(frozen=True, slots=True)
class GainCurves:
    """Modes over g_v. g_v : (n,) falling, N m s/rad. frequency_hz : (n, n_mode) |s|/(2 pi),
    damping : (n, n_mode) ratio; NaN where the mode no longer swings."""

    g_v: Float
    frequency_hz: Float
    damping: Float

    def leaves(self, mode: int, change: float) -> float:
        """Largest g_v at which the frequency of a mode (0 the lowest) is `change` (relative)
        away from that at the largest gain, N m s/rad; 0 where it never is."""
        f = self.frequency_hz[:, mode]
        moved = np.abs(f / f[0] - 1)
        for i in range(1, f.size):
            if np.isnan(moved[i]):
                return float(self.g_v[i - 1])
            if moved[i] >= change:
                share = (change - moved[i - 1]) / (moved[i] - moved[i - 1])
                log = np.log(self.g_v[i - 1 : i + 1])
                return float(np.exp(log[0] + share * (log[1] - log[0])))
        return 0.0


def curves(
    rig: Rig,
    source: str,
    g_v: Sequence[float],
    modes: int = 2,
    by: Literal["tmm", "fem"] = "tmm",
) -> GainCurves:
    """The lowest modes over the gain of the velocity feedback of one source.

    g_v : N m s/rad, in any order, the largest large enough that the modes are those of the
        velocity source; modes are followed from there. by : transfer matrices with a damper in
        series, or finite elements with eq. 18.

    Raises InputError as `in_series`, and for fewer modes than asked for.
    """
    gains = np.sort(np.asarray(g_v, float))[::-1]
    in_series(rig, source, float(gains[0]))
    find: Callable[[float, float], Complex] = (
        (lambda g, high: poles(in_series(rig, source, g), high).pole)
        if by == "tmm"
        else (lambda g, high: Fem(rig, feedback={source: (g, 1.0)}).poles())
    )
    held = Fem(rig).modes(modes).frequency_hz
    if held.size < modes:
        raise InputError("velocity feedback", "modes", modes, f"at most {held.size}")
    high = HIGH * float(held[-1])
    last = 2j * np.pi * held
    found = np.full((gains.size, modes), np.nan + 0j)
    for i, gain in enumerate(gains):
        s = find(float(gain), high)
        s = s[s.imag > SWINGS * np.abs(s)]
        for k in np.flatnonzero(~np.isnan(last)):
            near = s[np.argmin(np.abs(s - last[k]))] if s.size else np.nan
            last[k] = near if np.abs(near - last[k]) < JUMP * np.abs(last[k]) else np.nan
        found[i] = last
    size = np.abs(found)
    return GainCurves(gains, size / (2 * np.pi), -found.real / size)


def fit_gain(
    responses: Sequence[FrequencyResponse],
    rig: Rig,
    output: str,
    free: Sequence[str | Free] | None = None,
    *,
    band: tuple[float, float] | None = None,
) -> BodeFit:
    """Method 1 of paper 1, second stage: g_v from the amplitude of theta_i/v_i, no phase.

    rig : with the damper of `in_series`, its stiffnesses those of the first stage.
    output : the encoder. free : default the damper's c alone; with the source's K as well the
        level of the amplitude need not be known.
    Least squares on log|H|, every line alike but for those that noise hides. Raises InputError
    as `identify` does, and if the rig has no such damper.
    """
    dampers = [f"{e.name}.c" for e in rig.element if e.name.endswith(SUFFIX)]
    if free is None and not dampers:
        raise InputError("velocity feedback", "rig", rig.name, "a damper of `in_series`")
    return bode_fit(gain_misfit, responses, rig, output, free or dampers, band)
