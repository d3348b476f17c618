"""The filter of a feedback loop as the device runs it.

F(s) of the rig file becomes a digital filter by Tustin's rule, s = 2 rate (z - 1)/(z + 1): a
stable filter stays stable, and at a hundredth of the rate its frequencies are off by 0.03 %. It
runs as a cascade of sections of second order from zero state,

    f = b0 y + w_0,     w_0 <- b1 y - a1 f + w_1,     w_1 <- b2 y - a2 f,

and its output is clipped at `max`. The filter is stable and sees what was measured, not what
went out, so a clipped output winds nothing up.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np

from samii_rig.rig.schema import Feedback
from samii_rig.types import Complex, Float

MEMORY = 20.0  # time constants of the slowest pole after which an impulse response has ended
MOST_MEMORY = 1_000_000  # samples; a pole slower than this is cut off


def analogue(loop: Feedback, s: Complex) -> Complex:
    """F at complex s of any shape, rad/s."""
    zeros, poles, k = loop.zpk()
    s = np.asarray(s, dtype=np.complex128)
    value = np.full_like(s, k)
    for zero in zeros:
        value = value * (s - zero)
    for pole in poles:
        value = value / (s - pole)
    return value


def digital(loop: Feedback, z: Complex, rate_hz: float) -> Complex:
    """The digital filter at complex z (not -1) of any shape, F at s = 2 f_s (z - 1)/(z + 1)
    (Tustin)."""
    z = np.asarray(z, dtype=np.complex128)
    return analogue(loop, 2.0 * rate_hz * (z - 1.0) / (z + 1.0))


@lru_cache(maxsize=64)
def sections(loop: Feedback, rate_hz: float) -> Float:
    """(n, 5) rows b0 b1 b2 a1 a2 of the cascade, the first one first; one row at least.

    Do not change what is returned: it is kept, because a design asks for it again and again.
    """
    from scipy import signal  # takes a second, which a mistyped experiment does not wait for

    roots: Any = signal.bilinear_zpk(*loop.zpk(), rate_hz)  # complex, which the stubs deny
    sos = signal.zpk2sos(*roots)
    return np.ascontiguousarray(sos[:, [0, 1, 2, 4, 5]])


@lru_cache(maxsize=64)
def state_space(loop: Feedback, rate_hz: float) -> tuple[Float, Float, Float, Float]:
    """(A, B, C, D) of the cascade, two states w_0 w_1 a section; kept like `sections`."""
    A, B, C, D = np.zeros((0, 0)), np.zeros((0, 1)), np.zeros((1, 0)), np.ones((1, 1))
    for b0, b1, b2, a1, a2 in sections(loop, rate_hz):
        a = np.array([[-a1, 1.0], [-a2, 0.0]])
        b = np.array([[b1 - a1 * b0], [b2 - a2 * b0]])
        A = np.block([[A, np.zeros((len(A), 2))], [b @ C, a]])
        B = np.concatenate([B, b @ D])
        C = np.concatenate([b0 * C, [[1.0, 0.0]]], axis=1)
        D = b0 * D
    return A, B, C, D


@dataclass(frozen=True, slots=True)
class Reach:
    """What the filter can make of its input, from its impulse response h.

    peak : sum |h|, largest |f| over largest |y|. slew : largest |df/dt| in 1/s over largest
    |y|. rms : root of sum h^2, rms of f over that of white noise.
    """

    peak: float
    slew: float
    rms: float


def reach(loop: Feedback, rate_hz: float) -> Reach:
    """Bounds of the digital filter's output, before it is clipped."""
    from scipy import signal

    poles = loop.zpk()[1]
    slowest = min((-p.real for p in poles), default=rate_hz)
    n = min(MOST_MEMORY, 2 + int(np.ceil(MEMORY / slowest * rate_hz)))
    impulse = np.zeros(n)
    impulse[0] = 1.0
    rows = sections(loop, rate_hz)
    sos = np.insert(rows, 3, 1.0, axis=1)
    h = np.asarray(signal.sosfilt(sos, impulse), dtype=np.float64)
    return Reach(
        float(np.abs(h).sum()),
        float(np.abs(np.diff(h, prepend=0.0)).sum()) * rate_hz,
        float(np.sqrt(np.sum(h**2))),
    )
