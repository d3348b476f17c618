"""Swept sines whose phase is the exact integral of their frequency.

A burst starts and ends at rest: silence, a cosine ramp up, the sweep, a ramp down, and
silence again while the rig rings down.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from samii_rig.types import Float

Sweep = Literal["linear", "logarithmic"]
Interpolation = Literal["linear", "logarithmic"]


def sweep_frequency(t: Float, start_hz: float, stop_hz: float, T: float, sweep: Sweep) -> Float:
    """Instantaneous frequency in Hz at times `t` of any shape, s, of a sweep that lasts `T` s.

    linear: f = f0 + (f1 - f0) t/T. logarithmic: f = f0 (f1/f0)^(t/T), which spends the same
    time in every octave. start_hz may lie above stop_hz.
    """
    x = np.asarray(t, dtype=np.float64) / T
    if sweep == "linear":
        return start_hz + (stop_hz - start_hz) * x
    return np.asarray(start_hz * (stop_hz / start_hz) ** x, dtype=np.float64)


def sweep_phase(t: Float, start_hz: float, stop_hz: float, T: float, sweep: Sweep) -> Float:
    """Phase in rad at times `t` of any shape, s: 2 pi times the integral of `sweep_frequency`
    from 0 to `t`, closed form.

    linear: 2 pi (f0 t + (f1 - f0) t^2/(2 T)).
    logarithmic: 2 pi f0 T (e^(a t/T) - 1)/a with a = ln(f1/f0), and 2 pi f0 t where a = 0.
    """
    time = np.asarray(t, dtype=np.float64)
    if sweep == "linear":
        cycles = start_hz * time + (stop_hz - start_hz) * time**2 / (2.0 * T)
    else:
        a = np.log(stop_hz / start_hz)
        # expm1 keeps all digits when the band is narrow and e^(a t/T) - 1 would cancel.
        growth = time / T if a == 0.0 else np.expm1(a * time / T) / a
        cycles = start_hz * T * growth
    return np.asarray(2.0 * np.pi * cycles, dtype=np.float64)


def cosine_ramp(n: int, rate_hz: float, ramp: float) -> Float:
    """(n,) factor that rises from 0 as (1 - cos(pi t/ramp))/2 in `ramp` s, and falls likewise
    to reach 0 at sample n. Its slope is zero at both ends of each ramp."""
    if ramp <= 0.0:
        return np.ones(n)
    t = np.arange(n) / rate_hz
    to_edge = np.clip(np.minimum(t, n / rate_hz - t), 0.0, ramp) / ramp
    return np.asarray(0.5 - 0.5 * np.cos(np.pi * to_edge), dtype=np.float64)


def schedule_factor(
    frequency: Float, schedule: Sequence[tuple[float, float]], interpolation: Interpolation
) -> Float:
    """Amplitude factor at each `frequency` (Hz) from points (Hz, factor), Hz increasing.

    linear: straight lines of factor over frequency. logarithmic: straight lines of
    log(factor) over log(frequency), which needs factors above 0. Constant outside the
    points; 1 everywhere if there are none.
    """
    if not schedule:
        return np.ones_like(frequency)
    hz, factor = np.array(schedule, dtype=np.float64).T
    if interpolation == "linear":
        return np.asarray(np.interp(frequency, hz, factor), dtype=np.float64)
    return np.asarray(np.exp(np.interp(np.log(frequency), np.log(hz), np.log(factor))))


@dataclass(frozen=True, slots=True)
class Profile:
    """How frequency and amplitude run along a sweep: `sweep` as in `sweep_frequency`, `schedule`
    and `interpolation` as in `schedule_factor`."""

    sweep: Sweep = "logarithmic"
    schedule: Sequence[tuple[float, float]] = ()
    interpolation: Interpolation = "logarithmic"


EVEN = Profile()  # logarithmic, of one amplitude


def swept_sine(
    rate_hz: float,
    start_hz: float,
    stop_hz: float,
    duration: float,
    *,
    ramp: float = 0.0,
    lead_in: float = 0.0,
    ring_down: float = 0.0,
    profile: Profile = EVEN,
) -> tuple[Float, Float]:
    """A burst of unit level and its instantaneous frequency.

    Parameters
    ----------
    duration : s of the sweep, both ramps inside it.
    ramp : s of the cosine ramp at its start and at its stop.
    lead_in, ring_down : s of silence before and after it.
    profile : of frequency and amplitude over the sweep.

    Returns
    -------
    u : (n,) factor(f) ramp(t) sin(phase), 0 where silent.
    frequency : (n,) Hz, NaN where silent.
    """
    before, n, after = (round(x * rate_hz) for x in (lead_in, duration, ring_down))
    t = np.arange(n) / rate_hz
    T = n / rate_hz
    f = sweep_frequency(t, start_hz, stop_hz, T, profile.sweep)
    factor = schedule_factor(f, profile.schedule, profile.interpolation)
    envelope = factor * cosine_ramp(n, rate_hz, ramp)
    u = np.zeros(before + n + after)
    frequency = np.full(u.shape, np.nan)
    u[before : before + n] = envelope * np.sin(sweep_phase(t, start_hz, stop_hz, T, profile.sweep))
    frequency[before : before + n] = f
    return u, frequency
