"""What the actuators do to the mechanism, and the law by which they follow their input."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from samii_rig.errors import InputError
from samii_rig.rig.schema import (
    AccelerationSource,
    AngularVelocitySource,
    AngularVelocitySource2,
    DisplacementSource,
    Source,
    VelocitySource,
)
from samii_rig.types import Float


@dataclass(frozen=True, slots=True)
class Law:
    """Output per unit of the input: gain exp(-s dead_time)/(s^n + ... + denominator[-1]).

    denominator : coefficients of falling powers of s, the first 1.
    """

    gain: float
    denominator: tuple[float, ...]
    dead_time: float = 0.0

    def at(self, s: complex) -> complex:
        """The value at s, rad/s."""
        return complex(
            self.gain * np.exp(-s * self.dead_time) / np.polyval(np.array(self.denominator), s)
        )

    @property
    def order(self) -> int:
        """Number of states in time."""
        return len(self.denominator) - 1


@dataclass(frozen=True, slots=True)
class Prescribed:
    """A joint whose rotation follows a law (paper 2, eq. 1 and 2).

    coordinate : of the joint; column : of the input among the rig's actuators.
    """

    element: str
    coordinate: int
    column: int
    law: Law


@dataclass(frozen=True, slots=True)
class Feedback:
    """A joint with intrinsic velocity feedback, T = g_v (g_a v - theta') (paper 1, eq. 18).

    coordinate, column : as in `Prescribed`. gain : g_v g_a in N m per unit of the input; g_v
    itself stands in `Mechanism.G`.
    """

    element: str
    coordinate: int
    column: int
    gain: float


@dataclass(frozen=True, slots=True)
class Load:
    """A torque or force from the ground that follows a law, on one coordinate of a node."""

    element: str
    coordinate: int
    column: int
    law: Law


def law(e: Source) -> Law:
    """The law of a source of the rig file."""
    match e:
        case AngularVelocitySource() | VelocitySource():
            return Law(e.K.value * e.p.value, (1.0, e.p.value, 0.0), e.tau.value)
        case AngularVelocitySource2():
            omega = e.omega.value
            falling = (1.0, 2 * e.zeta.value * omega, omega**2, 0.0)
            return Law(e.K.value * omega**2, falling, e.tau.value)
        case DisplacementSource():
            omega = e.omega.value
            second = (1.0, 2 * e.zeta.value * omega, omega**2)
            return Law(e.K.value * omega**2, second, e.tau.value)
        case AccelerationSource():
            omega, zeta = e.suspension
            return Law(e.K.value, (1.0, 2 * zeta * omega, omega**2), e.tau.value)
        case _ if e.p is None:
            return Law(e.K.value, (1.0,), e.tau.value)
        case _:
            return Law(e.K.value * e.p.value, (1.0, e.p.value), e.tau.value)


def refuse_dead_time(where: str, parts: tuple[Prescribed | Load, ...]) -> None:
    """InputError if a law has a dead time, which no finite number of states has."""
    for part in parts:
        if part.law.dead_time > 0:
            raise InputError(
                where, f"{part.element}.tau", part.law.dead_time,
                "0 where equations in time are needed: a dead time has no finite order",
            )  # fmt: skip


def states(drive: Law) -> tuple[Float, Float]:
    """A (n, n) and b (n,) of a law in time: states y, y', ... of y^(n) = gain u - ... ."""
    n = drive.order
    A = np.eye(n, k=1)
    if n:
        A[-1] = -np.array(drive.denominator[:0:-1])
    b = np.zeros(n)
    b[n - 1 : n] = drive.gain
    return A, b
