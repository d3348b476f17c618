"""The sampled chain at the lines that were measured, with its derivatives.

The response of the sampled rig is hold * chain * filter plus its aliases. The aliases are
6e-4 of SAMII's response at 40 Hz and 500 samples/s, and hardly depend on what is free: they
are a constant during a fit, taken anew where it ended. So the derivatives leave them out and
the optimum does not.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from samii_rig.identify.data import Data
from samii_rig.identify.parameters import Space
from samii_rig.identify.poses import at_pose
from samii_rig.model.sampled import given_response, sampled_response, sensor_response
from samii_rig.model.tmm import Chain
from samii_rig.rig.schema import Rig
from samii_rig.rig.schema.pose import Angle
from samii_rig.types import Complex, Float


class Predictor:
    """Sampled responses of a rig as a function of x = log(value/start).

    poses : of the rig in each response of the data; that of the rig file if left out. All
        poses share the parameters.
    """

    def __init__(
        self, rig: Rig, data: Data, space: Space, poses: Sequence[Angle | None] = ()
    ) -> None:
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
        at = list(poses) or [rig.pose] * len(data.lines)
        apart = list(dict.fromkeys(at))
        self._chains = tuple(Chain(at_pose(rig, pose)) for pose in apart)
        self._chain_of = [apart.index(pose) for pose in at]
        f = data.frequency
        hold = [given_response(a, f, rig.rate_hz) for a in rig.actuator]
        self._factor = (
            sensor_response(rig.sensor, f)[:, :, None] * np.stack(hold, axis=1)[:, None, :]
        )
        self.aliases: tuple[Complex, ...] | None = None

    def chains(self, x: Float) -> tuple[Chain, ...]:
        """The chain at x, in each of its poses."""
        values = self._space.mapping(x)
        return tuple(chain.with_values(values) for chain in self._chains)

    def update_aliases(self, x: Float) -> None:
        """Take the aliases at x."""
        f = self._data.frequency
        self.aliases = tuple(
            sampled_response(chain.rig, f, chain) - chain.response(f) * self._factor
            for chain in self.chains(x)
        )

    def response(self, x: Float) -> list[Complex]:
        """(n, p) for each response of the data."""
        f = self._data.frequency
        return self._split(self._whole([chain.response(f) for chain in self.chains(x)]))

    def gradient(self, x: Float) -> tuple[list[Complex], list[Complex]]:
        """The same, and its derivatives by x, (n, p, n_free) each."""
        whole, slopes = [], []
        for chain in self.chains(x):
            H, dH = chain.gradient(self._data.frequency, self._space.keys)
            dH *= self._factor[..., None]
            dH *= self._space.values(x)
            whole.append(H)
            slopes.append(dH)
        return self._split(self._whole(whole)), self._split(slopes)

    def _whole(self, responses: list[Complex]) -> list[Complex]:
        sampled = [H * self._factor for H in responses]
        if self.aliases is None:
            return sampled
        return [H + a for H, a in zip(sampled, self.aliases, strict=True)]

    def _split(self, H: list[Complex]) -> list[Complex]:
        out = []
        for d, row, k in zip(self._data.lines, self._row, self._chain_of, strict=True):
            at = d.place[:, None]
            own = H[k][at, row, d.actuator]
            for actuator, moved in d.follow:
                own = own + (H[k][at, row, actuator].T * moved.T).T
            out.append(own)
        return out
