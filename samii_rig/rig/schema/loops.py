"""Loops that the device closes: the centring of a joint, and filters beside it."""

from __future__ import annotations

from typing import Annotated, Self

import numpy as np
from pydantic import Field, model_validator

from samii_rig.rig.schema.base import Finite, Name, NonNegative, Positive, Strict

MOST_STATES = 8  # of one feedback filter; a damping loop has one to four
Root = Finite | tuple[Finite, Finite]
Roots = Annotated[tuple[Root, ...], Field(max_length=MOST_STATES)]
Coefficients = Annotated[tuple[Finite, ...], Field(max_length=MOST_STATES + 1)]


class Centring(Strict):
    """The loop that keeps the joint centred: v = u + kp (theta_ref - theta).

    It runs in the device, at the sample rate. kp is in actuator units per sensor unit.
    """

    sensor: Name
    kp: NonNegative


class Feedback(Strict):
    """A loop that the device closes from a sensor to an actuator, beside the centring:

        v = u + kp (theta_ref - theta) + sum over the loops of clip(F(s) y, -max, max).

    F(s) = gain prod(s - zeros)/prod(s - poles) or gain numerator/denominator, one of the two
    forms; it runs at the sample rate (`samii_rig.model.feedback`) whenever the output is live.

    unit : of F(s), actuator unit per sensor unit.
    zeros, poles : rad/s; [re, im] with im above 0 is a pair and counts its conjugate too.
    numerator, denominator : coefficients of falling powers of s.
    max : largest |output| of this loop, in the actuator's unit; the device clips it there.
    """

    name: Name
    sensor: Name
    actuator: Name
    gain: Finite
    unit: str
    zeros: Roots = ()
    poles: Roots = ()
    numerator: Coefficients = ()
    denominator: Coefficients = ()
    max: Positive

    def zpk(self) -> tuple[list[complex], list[complex], float]:
        """All zeros and poles of F(s), conjugates included, and its leading gain."""
        if not self.denominator:
            return _conjugates(self.zeros), _conjugates(self.poles), self.gain
        zeros = [complex(x) for x in np.roots(self.numerator)]
        poles = [complex(x) for x in np.roots(self.denominator)]
        return zeros, poles, self.gain * self.numerator[0] / self.denominator[0]

    @model_validator(mode="after")
    def _filter(self) -> Self:
        if (self.zeros or self.poles) and (self.numerator or self.denominator):
            raise ValueError("zeros and poles beside numerator and denominator; expected one form")
        if bool(self.numerator) != bool(self.denominator):
            raise ValueError("half of a fraction; expected numerator and denominator")
        for name in ("numerator", "denominator"):
            row = getattr(self, name)
            if row and row[0] == 0:
                raise ValueError(f"{name} {list(row)}; expected a first coefficient that is not 0")
        zeros, poles, _ = self.zpk()
        if len(poles) > MOST_STATES:
            raise ValueError(f"{len(poles)} poles; expected at most {MOST_STATES}")
        if len(zeros) > len(poles):
            raise ValueError(
                f"{len(zeros)} zeros over {len(poles)} poles: not proper; "
                "expected no more zeros than poles"
            )
        for pole in poles:
            if not pole.real < 0:
                raise ValueError(
                    f"pole at {pole:.4g} rad/s: not stable; expected a real part below 0"
                )
        return self


def _conjugates(roots: tuple[Root, ...]) -> list[complex]:
    """Roots as they stand in the file, with the conjugate of every one above the real axis."""
    out: list[complex] = []
    for root in roots:
        value = complex(*root) if isinstance(root, tuple) else complex(root)
        if value.imag < 0:
            raise ValueError(f"root {value:.4g} rad/s; expected the one of the pair with im > 0")
        out += [value, value.conjugate()] if value.imag > 0 else [value]
    return out
