"""What may disturb a rig, and how each disturbance looks in all sensors.

A force and a torque at every place of the chain, a torque across each joint, the floor's
acceleration, what is added to the input, and the noise of the sensor around which a loop is closed.
Each comes out through the rig and its loop: y = u_k d, with d of any spectrum
(`samii_rig.likelihood.noise`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from samii_rig.diagnose.physics import insert
from samii_rig.diagnose.physics.loops import Closed
from samii_rig.diagnose.physics.model import Model
from samii_rig.model.sampled import sensor_response
from samii_rig.model.tmm import Chain
from samii_rig.rig.schema import (
    AccelerationSource,
    ActuatorSpec,
    Element,
    ForceSource,
    Rig,
    TorqueSource,
    TorsionalSpring,
    TranslationalSpring,
)
from samii_rig.types import Complex, Float, Int

NAME = f"{insert.PREFIX}disturbance_"
# rad/s, of the suspension that an acceleration source must have: far below any record's lines.
SUSPENSION = 1e-4


@dataclass(frozen=True)
class Disturbed:
    """A chain with an input for every force that may disturb it.

    sensor : (q,) indices of those that are read. first : how many inputs are its own. pairs : of
    the other inputs those before and behind a joint, whose difference acts across it.
    """

    chain: Chain
    rig: Rig
    sensor: Int
    first: int
    pairs: tuple[tuple[int, int], ...]

    @classmethod
    def of(cls, model: Model, x: Float, sensor: Int) -> Disturbed:
        """Of a model at x, wherever a force acts on it."""
        rig, wide = model.rig, model.built
        kinds: tuple[type, ...] = (
            (ForceSource,) if wide.motion == "axial" else (ForceSource, TorqueSource)
        )
        elements = wide.element
        inputs: list[tuple[type, str]] = []
        for after in ("", *(e.name for e in elements)):
            for kind in kinds:
                wide = _with_input(wide, len(inputs), kind, after)
                inputs.append((kind, after))
        pairs = [
            (inputs.index((across, before)), inputs.index((across, spring.name)))
            for before, spring in zip(("", *(e.name for e in elements)), elements, strict=False)
            if (across := _across(spring)) is not None and across in kinds
        ]
        wide = _with_input(wide, len(inputs), AccelerationSource, "")
        chain = Chain(wide)
        # A law that no element has stands beside the chain, and is left out of its disturbances.
        known = set(chain.parameters)
        chain = chain.with_values({k: v for k, v in model.values(x).items() if k in known})
        return cls(chain, rig, sensor, len(rig.actuator), tuple(pairs))

    def response(self, f: Float, H: Complex, loop: Closed | None) -> Complex:
        """(n, q, K) at f (n,) Hz, the sensors' own noises first. H : (n, q) from the input, or
        (n, q m) from m of them, the loop closed."""
        G = self.chain.response(f)[:, self.sensor, self.first :]
        across = [G[:, :, j] - G[:, :, i] for i, j in self.pairs]
        G = np.concatenate([G, *(one[:, :, None] for one in across)], axis=2)
        G = G * sensor_response(self.rig.sensor, f)[:, self.sensor, None]
        q = self.sensor.size
        own = np.broadcast_to(np.eye(q, dtype=complex), (f.size, q, q))
        every = np.concatenate([own, G], axis=2)
        if loop is not None:
            # Whatever the loop's sensor shows goes round it.
            every = loop.around(H, every)
        return np.concatenate([every, H.reshape(f.size, q, -1)], axis=2)


def _across(element: Element) -> type | None:
    """What acts across a joint."""
    if isinstance(element, TorsionalSpring):
        return TorqueSource
    return ForceSource if isinstance(element, TranslationalSpring) else None


def _with_input(rig: Rig, number: int, kind: type, after: str) -> Rig:
    """The rig with one more input, of power 1, that acts behind an element, or at the base."""
    name = f"{NAME}{number}"
    values = {"K": insert.parameter(1.0, "1")}
    if kind is AccelerationSource:
        values["omega"] = insert.parameter(SUSPENSION, "rad/s")
        values["zeta"] = insert.parameter(1.0, "1")
    made = kind(kind=insert.tag(kind), name=name, input=name, **values)
    spec = ActuatorSpec(name=name, unit="1", low=-1.0, high=1.0)
    wide = insert.inserted(rig, after or None, made)
    return wide.model_copy(update={"actuator": (*rig.actuator, spec)})
