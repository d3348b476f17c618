"""Natural frequencies, zeros and mode shapes of a chain without its damping.

What the papers' methods compare with the measured ones. Without damping and with sources
that do not lag, D and every numerator are real on the imaginary axis up to a factor that is
known, so that each frequency is a change of sign.
"""

from __future__ import annotations

import numpy as np

from samii_rig.errors import InputError
from samii_rig.identify.parameters import changed
from samii_rig.model.tmm import Chain
from samii_rig.rig.schema import Rig, parameters
from samii_rig.types import Float

DAMPING = ("c", "tau", "eta", "R")  # symbols of what is set to zero
HELD = 1e15  # N m/rad, of a joint that is a damper alone: its source holds it (g_v to infinity)
NO_LAG = 1e15  # rad/s, a pole this far away turns nothing
GRID = 300  # points over the band in which changes of sign are looked for
REFINED = 24  # points put into each interval that holds one
ROUNDS = 4  # of refinement: 23^-4 of the interval, then a secant
REAL = 1e-6  # largest imaginary share, in the median, of what must be real
BESIDE = 1e-5  # relative distance from a natural frequency at which its shape is taken
NEWTON = 6  # steps from an undamped frequency to the damped one


class Conservative:
    """The undamped chain of a rig within a band, Hz."""

    def __init__(self, rig: Rig, band: tuple[float, float]) -> None:
        self._rig = rig
        update = {}
        for e in rig.element:
            for symbol in parameters(e):
                if symbol in DAMPING:
                    update[e.name, symbol] = 0.0
                elif symbol == "k" and getattr(e, symbol).value == 0:
                    update[e.name, symbol] = HELD
                elif symbol == "p":
                    update[e.name, symbol] = NO_LAG
        self._chain = Chain(changed(rig, update))
        self._outputs = [s.name for s in rig.sensor]
        self._grid = np.geomspace(*band, GRID)

    def frequencies(self) -> Float:
        """Natural frequencies in the band, Hz, increasing: paper 1, eq. 17."""
        return self._changes(None)

    def zeros(self, output: str, actuator: int = 0) -> Float:
        """Zeros on the imaginary axis of the response of `output` to an actuator, Hz.

        They are those of the way from the driven angle to `output` as well.
        """
        return self._changes((self._column(output), actuator))

    def damped(self, frequencies_hz: Float, output: str | None = None, actuator: int = 0) -> Float:
        """|s|/(2 pi) of the poles, or of the zeros of `output`, with the rig's damping, Hz.

        Those that `frequencies` or `zeros` become, by Newton's method from each of them.
        """
        entry = None if output is None else (self._column(output), actuator)
        chain = Chain(self._rig)
        s = 2j * np.pi * frequencies_hz
        for _ in range(NEWTON):
            near = np.stack([s, s * (1 + BESIDE), s * (1 - BESIDE)])
            mantissa, log_scale = chain.characteristic(near.ravel())
            value = mantissa * np.exp(log_scale - log_scale.max(initial=0.0))
            if entry is not None:
                value = value * chain.evaluate(near.ravel())[:, entry[0], entry[1]]
            value = value.reshape(near.shape)
            s = s - value[0] * 2 * BESIDE * s / (value[1] - value[2])
        return np.asarray(np.abs(s) / (2 * np.pi))

    def shape_ratio(self, frequency_hz: float, top: str, bottom: str) -> float:
        """phi(top)/phi(bottom) of the mode at one of `frequencies`, in the sensors' units."""
        f = np.array([frequency_hz * (1 + BESIDE), frequency_hz * (1 - BESIDE)])
        H = self._chain.response(f)[:, :, 0]
        # The difference of both sides of a pole leaves out what the other modes add to both.
        near = H[0] - H[1]
        return float((near[self._column(top)] / near[self._column(bottom)]).real)

    def _column(self, output: str) -> int:
        if output not in self._outputs:
            raise InputError("target", "output", output, f"one of {', '.join(self._outputs)}")
        return self._outputs.index(output)

    def _changes(self, entry: tuple[int, int] | None) -> Float:
        f = self._grid[:, None]
        value = self._values(f, entry)
        at = np.flatnonzero(np.sign(value[1:, 0]) * np.sign(value[:-1, 0]) < 0)
        low, high = f[at, 0], f[at + 1, 0]
        for _ in range(ROUNDS):
            f = np.linspace(low, high, REFINED, axis=0)
            value = self._values(f, entry)
            k = np.argmax(np.sign(value) != np.sign(value[0]), axis=0)
            columns = np.arange(low.size)
            low, high = f[k - 1, columns], f[k, columns]
        if not low.size:
            return np.zeros(0)
        a, b = value[k - 1, columns], value[k, columns]
        return np.asarray(low - a * (high - low) / (b - a))

    def _values(self, f: Float, entry: tuple[int, int] | None) -> Float:
        """D, or the numerator of an entry, over a positive factor, of the shape of f."""
        s = 2j * np.pi * f.ravel()
        if not s.size:
            return np.zeros(f.shape)
        mantissa, log_scale = self._chain.characteristic(s)
        value = mantissa
        if entry is not None:
            value = value * self._chain.evaluate(s)[:, entry[0], entry[1]] * s
        log_scale = log_scale.reshape(f.shape)
        value = value.reshape(f.shape)
        # The median: in rounding's reach of a root the phase is anything.
        if np.median(np.abs(value.imag) / np.maximum(np.abs(value), 1e-300)) > REAL:
            raise InputError(
                self._chain.rig.name,
                "element",
                "damping beside c, tau and eta",
                "a chain that is conservative without them",
            )
        return np.asarray(value.real * np.exp(log_scale - log_scale.max(axis=0)))
