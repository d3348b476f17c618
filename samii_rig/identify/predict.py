"""The sampled chain at the lines that were measured, with its derivatives.

The response of the sampled rig is hold * chain * filter plus its aliases. The aliases are
6e-4 of SAMII's response at 40 Hz and 500 samples/s, and hardly depend on what is free: they
are a constant during a fit, taken anew where it ended. So the derivatives leave them out and
the optimum does not.
"""

from __future__ import annotations

import numpy as np

from samii_rig.identify.data import Data
from samii_rig.identify.parameters import Space
from samii_rig.model.sampled import hold_response, sampled_response, sensor_response
from samii_rig.model.tmm import Chain
from samii_rig.rig.schema import Rig
from samii_rig.types import Complex, Float


class Predictor:
    """Sampled responses of a rig as a function of x = log(value/start)."""

    def __init__(self, rig: Rig, data: Data, space: Space) -> None:
        self._space, self._data = space, data
        # Of the sensors only those measured: each costs a solution of its own.
        used = np.unique(np.concatenate([d.sensor for d in data.lines]))
        self._row = [np.searchsorted(used, d.sensor) for d in data.lines]
        kept = {
            "rate_hz": data.lines[0].response.rate_hz,
            "sensor": tuple(rig.sensor[i] for i in used),
            "feedback": (),  # the loops of the device are not in the chain's response
        }
        rig = rig.model_copy(update=kept)
        self._chain = Chain(rig)
        f = data.frequency
        hold = [hold_response(f, rig.rate_hz, a.delay) for a in rig.actuator]
        self._factor = (
            sensor_response(rig.sensor, f)[:, :, None] * np.stack(hold, axis=1)[:, None, :]
        )
        self.aliases: Complex | None = None

    def chain(self, x: Float) -> Chain:
        """The chain at x."""
        return self._chain.with_values(self._space.mapping(x))

    def update_aliases(self, x: Float) -> None:
        """Take the aliases at x."""
        chain = self.chain(x)
        exact = sampled_response(chain.rig, self._data.frequency, chain)
        self.aliases = exact - chain.response(self._data.frequency) * self._factor

    def response(self, x: Float) -> list[Complex]:
        """(n, p) for each response of the data."""
        return self._split(self._whole(self.chain(x).response(self._data.frequency)))

    def gradient(self, x: Float) -> tuple[list[Complex], list[Complex]]:
        """The same, and its derivatives by x, (n, p, n_free) each."""
        H, dH = self.chain(x).gradient(self._data.frequency, self._space.keys)
        dH *= self._factor[..., None]
        dH *= self._space.values(x)
        return self._split(self._whole(H)), self._split(dH)

    def _whole(self, H: Complex) -> Complex:
        H = H * self._factor
        return H if self.aliases is None else H + self.aliases

    def _split(self, H: Complex) -> list[Complex]:
        return [
            H[d.place[:, None], row, d.actuator]
            for d, row in zip(self._data.lines, self._row, strict=True)
        ]
