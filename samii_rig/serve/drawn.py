"""The frequency responses of a run as its page draws them, with the model's."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cached_property
from typing import Any

import numpy as np

from samii_rig.model.sampled import as_sent, sampled_response
from samii_rig.rig.schema import Rig
from samii_rig.run.plan import Plan
from samii_rig.serve.sofar import driven, first
from samii_rig.signal.statistics import magnitude_interval, phase, phase_half_width
from samii_rig.types import Complex, Float, FrequencyResponse, Int

POINTS = 200  # of a curve on a page
BAND = 0.9
DIGITS = 4


class Drawn:
    """Those of one run."""

    def __init__(self, rig: Rig, plan: Plan) -> None:
        self._rig, self._plan = rig, plan

    @cached_property
    def _model(self) -> dict[str, Any]:
        f = _grid(self._plan)
        return _curves_of_model(self._rig, self._plan, f, sampled_response(as_sent(self._rig), f))

    def told(
        self,
        responses: Sequence[tuple[FrequencyResponse, bool]],
        done: int,
        *,
        trouble: str = "",
        took_s: float = 0.0,
        final: bool = False,
    ) -> dict[str, Any]:
        """As JSON. responses : each with whether it still goes on. done : segments that are whole.
        trouble : why the newest part has none. final : of all that was recorded.

        first_s : of the plan, after which there may be one; None where there never is."""
        plan = self._plan
        n = first(plan)
        return {
            "low_hz": min((s.band_hz[0] for s in plan.segments), default=0.0),
            "high_hz": max((s.band_hz[1] for s in plan.segments), default=0.0),
            "first_s": None if n is None else n / plan.rate_hz,
            "done": done,
            "of": len(plan.segments),
            "took_s": took_s,
            "trouble": trouble,
            "final": final,
            "model": self._model,
            "responses": [
                {
                    "level": r.level,
                    "unit": r.level_unit,
                    "method": r.method,
                    "n": r.n_averages,
                    "going_on": going_on,
                    "low_hz": float(r.frequency[0]),
                    "high_hz": float(r.frequency[-1]),
                    **curves(r),
                }
                for r, going_on in responses
            ],
        }


def curves(r: FrequencyResponse) -> dict[str, Any]:
    """Gain and phase of each entry with their 90 % bands, few enough points for a page."""
    inside = magnitude_interval(r, BAND)
    angle, half = phase(r), phase_half_width(r, BAND)
    at = _thinned(r.frequency)
    entries = [
        {
            "output": y.name,
            "input": u.name,
            "unit": f"{y.unit}/{u.unit}",
            "gain": _short(np.abs(r.H[at, i, j])),
            "low": _short(inside.low[at, i, j]),
            "high": _short(inside.high[at, i, j]),
            "phase": _short(angle[at, i, j]),
            "half": _short(half[at, i, j]),
            "coherence": _short(r.coherence[at, i]),
        }
        for i, y in enumerate(r.outputs)
        for j, u in enumerate(r.inputs)
    ]
    return {"frequency": _short(r.frequency[at]), "curves": entries}


def _curves_of_model(rig: Rig, plan: Plan, f: Float, H: Complex) -> dict[str, Any]:
    inputs = driven(plan)
    entries = [
        {
            "output": sensor.name,
            "input": actuator.name,
            "unit": f"{sensor.unit}/{actuator.unit}",
            "gain": _short(np.abs(H[:, i, j])),
            "phase": _short(np.degrees(np.unwrap(np.angle(H[:, i, j])))),
        }
        for i, sensor in enumerate(rig.sensor)
        for j, actuator in enumerate(rig.actuator)
        if actuator.name in inputs
    ]
    return {"frequency": _short(f), "curves": entries}


def _grid(plan: Plan) -> Float:
    """(n,) Hz, even on a logarithmic axis over all that the plan drives."""
    bands = [s.band_hz for s in plan.segments] or [(0.1, 1.0)]
    high = min(max(b[1] for b in bands), 0.49 * plan.rate_hz)
    low = max(min(b[0] for b in bands), 1e-3 * high)
    return np.geomspace(low, high, POINTS)


def _thinned(f: Float) -> Int:
    """Which lines are drawn: about even on a logarithmic axis."""
    f = np.where(f > 0, f, np.nextafter(0.0, 1.0))
    if f.size <= POINTS:
        return np.arange(f.size)
    bins = np.floor(POINTS * np.log(f / f[0]) / np.log(f[-1] / f[0]))
    return np.unique(bins, return_index=True)[1]


def _short(x: Float) -> list[float | None]:
    """Few digits, and null for what is no number."""
    return [float(f"{v:.{DIGITS}g}") if math.isfinite(v) else None for v in x.tolist()]
