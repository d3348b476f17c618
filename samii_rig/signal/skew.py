"""What an uncertain time between two devices does to a frequency response.

Where output and input of H were stamped by clocks whose offset is known to sigma only, H is off
by exp(-j 2 pi f dt): to first order by -j 2 pi f dt H, the same dt at every frequency and for
every channel of one device. Repeats of a run do not show it, so it is added to the covariance,

    E|dH|^2 += (2 pi f sigma)^2 |H|^2,

with the correlation between the channels that share a clock.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from samii_rig.types import Finding, FrequencyResponse, Recording

KEY = "device_timing"  # of a recording's metadata
WORTH_SAYING = 0.01  # rad at the highest frequency


@dataclass(frozen=True, slots=True)
class Skew:
    """A channel's clock, by name, and the standard deviation of its offset, s."""

    clock: str
    sigma: float


def to_text(skews: Mapping[str, Skew]) -> str:
    """As it stands in a recording's metadata."""
    return json.dumps({name: [s.clock, s.sigma] for name, s in skews.items()})


def skews_of(recordings: Iterable[Recording]) -> dict[str, Skew]:
    """The skews that the recordings state, of each channel the largest; what is not readable as
    one states none."""
    found: dict[str, Skew] = {}
    for recording in recordings:
        try:
            given = json.loads(recording.metadata.get(KEY, "{}"))
            stated = {str(k): Skew(str(c), float(s)) for k, (c, s) in given.items()}
        except (ValueError, TypeError, AttributeError):
            continue
        for name, skew in stated.items():
            known = name in found and found[name].sigma >= skew.sigma
            if not known and 0.0 <= skew.sigma < math.inf:
                found[name] = skew
    return found


def with_skew(response: FrequencyResponse, skews: Mapping[str, Skew]) -> FrequencyResponse:
    """The response with the uncertainty of time in its covariance, and a finding that says so.

    Channels without a skew are on the main clock. What leaves H untouched (input and output on
    one clock) adds nothing.
    """
    H = response.H
    n, p = len(H), H.shape[1] * H.shape[2]
    covariance = response.covariance
    findings = response.findings
    for clock in sorted({s.clock for s in skews.values()}):
        own = {name: s.sigma for name, s in skews.items() if s.clock == clock}
        late = np.array([own.get(c.name, 0.0) for c in response.outputs])
        ahead = np.array([own.get(c.name, 0.0) for c in response.inputs])
        sigma = ahead[None, :] - late[:, None]
        if not sigma.any():
            continue
        off = (2 * np.pi * response.frequency[:, None, None] * sigma * H).reshape(n, p)
        covariance = covariance + off[:, :, None] * off[:, None, :].conj()
        worst = 2 * np.pi * float(response.frequency.max(initial=0.0)) * float(abs(sigma).max())
        if worst > WORTH_SAYING:
            text = (
                f"the clock of {clock} is known to {abs(sigma).max() * 1e3:.2g} ms: up to "
                f"{worst:.2g} rad of phase, which the covariance holds"
            )
            findings = (*findings, Finding("clock", "note", text))
    return replace(response, covariance=covariance, findings=findings)
