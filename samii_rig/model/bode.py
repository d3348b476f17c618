"""Bode diagrams of a model: magnitude in dB, phase in degrees without jumps."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from samii_rig.errors import InputError
from samii_rig.model.tmm import Chain
from samii_rig.rig.schema import Rig
from samii_rig.types import Complex, Float

if TYPE_CHECKING:
    from control import FrequencyResponseData


@dataclass(frozen=True, slots=True)
class Bode:
    """A response as it is drawn.

    frequency_hz : (n_freq,). H : (n_freq, n_out, n_in). outputs, inputs : names.
    """

    frequency_hz: Float
    H: Complex
    outputs: tuple[str, ...]
    inputs: tuple[str, ...]

    @property
    def magnitude_db(self) -> Float:
        """(n_freq, n_out, n_in) 20 log10 |H|, of SI unit per actuator unit."""
        with np.errstate(divide="ignore"):
            return np.asarray(20 * np.log10(np.abs(self.H)))

    @property
    def phase_deg(self) -> Float:
        """(n_freq, n_out, n_in) unwrapped along the frequency, a lag negative; the first
        value lies above -180 and up to 180 degrees."""
        return np.asarray(np.degrees(np.unwrap(np.angle(self.H), axis=0)))

    def over(self, output: str) -> Bode:
        """Every other output over this one, each input by itself: theta_2 -> a_0 and so on.

        Raises InputError for an output that there is not.
        """
        if output not in self.outputs:
            raise InputError("Bode", "output", output, f"one of {list(self.outputs)}")
        at = self.outputs.index(output)
        kept = [i for i in range(len(self.outputs)) if i != at]
        names = tuple(f"{output} by {u}" if len(self.inputs) > 1 else output for u in self.inputs)
        ratio = self.H[:, kept] / self.H[:, [at]]
        return Bode(self.frequency_hz, ratio, tuple(self.outputs[i] for i in kept), names)

    def to_frd(self) -> FrequencyResponseData:
        """The response as python-control's FRD, rad/s, names kept."""
        import control  # takes a second, and most uses need it not

        return control.FrequencyResponseData(
            np.moveaxis(self.H, 0, -1),
            2 * np.pi * self.frequency_hz,
            inputs=list(self.inputs),
            outputs=list(self.outputs),
        )


def bode(model: Rig | Chain, frequency_hz: ArrayLike) -> Bode:
    """The continuous response of a chain at increasing frequencies (n_freq,), Hz.

    The phase is right if it moves by less than half a turn between neighbours.
    Raises InputError for frequencies that do not increase or are not above 0.
    """
    chain = model if isinstance(model, Chain) else Chain(model)
    f = np.atleast_1d(np.asarray(frequency_hz, dtype=np.float64))
    if f.ndim != 1 or np.any(np.diff(f) <= 0):
        raise InputError("Bode", "frequency_hz", f.tolist(), "a list of increasing frequencies")
    rig = chain.rig
    return Bode(
        f,
        chain.response(f),
        tuple(s.name for s in rig.sensor),
        tuple(a.name for a in rig.actuator),
    )
