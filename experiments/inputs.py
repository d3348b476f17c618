"""What experiments share that drive several actuators of a rig: one after the other, or together.

A frequency response from k inputs needs at least k experiments whose inputs are not alike. One
input after the other is the plainest. Driven together, all inputs move the rig all the time: in
each block of experiments the inputs have signs that make them orthogonal over the block, and so
each is as well known as if it had been driven alone in all of them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import ClassVar

import numpy as np
from pydantic import field_validator

from experiments.driven import Driven
from samii_rig.errors import InputError
from samii_rig.rig.schema import Name, Rig
from samii_rig.run.outputs import at_rest
from samii_rig.run.plan import Plan, PlannedSegment
from samii_rig.types import Float

MOST_INPUTS = 16  # more joints than any arm; the signs grow with their square


class Inputs(Driven):
    """An experiment file that may drive several actuators.

    beside : actuators that are driven like `actuator`, at the same levels in the same unit. Each
        is centred by its own loop, so kp is left out with them.
    """

    several: ClassVar[bool] = True  # whether this kind of experiment has a use for more than one

    beside: tuple[Name, ...] = ()

    @field_validator("beside")
    @classmethod
    def _few(cls, beside: tuple[str, ...]) -> tuple[str, ...]:
        if len(set(beside)) != len(beside):
            raise ValueError("each actuator once")
        if len(beside) >= MOST_INPUTS:
            raise ValueError(f"at most {MOST_INPUTS} inputs with `actuator`")
        return beside

    @property
    def block(self) -> int:
        """How many experiments with all inputs together tell them apart: a power of 2."""
        return 1 << (len(self.inputs) - 1).bit_length()

    @property
    def inputs(self) -> tuple[str, ...]:
        """All actuators that are driven."""
        return (self.actuator, *self.beside)

    def loop(self, rig: Rig, where: str) -> tuple[float, str]:
        """As of one actuator, checked of all; InputError too if kp is given beside others."""
        if self.beside and not self.several:
            raise InputError(where, "beside", list(self.beside), "none in such an experiment")
        if self.actuator in self.beside:
            raise InputError(where, "beside", self.actuator, "an actuator beside `actuator`")
        if self.beside and self.kp is not None:
            expected = "none with `beside`: each actuator keeps its own loop"
            raise InputError(where, "kp", self.kp, expected)
        for name in self.beside:
            self._loop_on(name, rig, where)
        return super().loop(rig, where)

    def one_by_one(self, rig: Rig, plan: Plan) -> Plan:
        """The segments of `plan`, which drives `actuator`, for each input in its turn."""
        if not self.beside:
            return plan
        segments = [
            self._placed(rig, s, {name: 1.0}, name) for name in self.inputs for s in plan.segments
        ]
        return self._on_all(rig, plan, segments)

    def together(self, rig: Rig, plan: Plan, others: Sequence[Sequence[Float]]) -> Plan:
        """Every segment of `plan` as a block of experiments in which all inputs are driven.

        others : for each segment the references (n,) of the inputs after the first. Of m
        experiments, a power of 2, input q has the signs of column q of a Hadamard matrix: its
        columns are orthogonal, and a sign changes no peak.
        """
        if not self.beside:
            return plan

        from scipy.linalg import hadamard

        k = len(self.inputs)
        m = self.block
        signs = hadamard(m)[:, :k]
        segments = []
        for s, waves in zip(plan.segments, others, strict=True):
            for e in range(m):
                one = replace(s, repeat=s.repeat * m + e)
                placed = self._placed(rig, one, {self.actuator: float(signs[e, 0])}, f"{e + 1}")
                for q, (name, wave) in enumerate(zip(self.beside, waves, strict=True), start=1):
                    u, theta_ref = self.references(signs[e, q] * wave)
                    at = [a.name for a in rig.actuator].index(name)
                    placed.u[:, at], placed.theta_ref[:, at] = u, theta_ref
                segments.append(replace(placed, excited=self.inputs))
        return self._on_all(rig, plan, segments)

    def _placed(
        self, rig: Rig, s: PlannedSegment, signs: dict[str, float], name: str
    ) -> PlannedSegment:
        """A segment of one input in the columns of these, times their signs; all others rest."""
        names = [a.name for a in rig.actuator]
        u, theta_ref = (np.zeros((len(s.u), len(names))) for _ in range(2))
        for actuator, sign in signs.items():
            at = names.index(actuator)
            u[:, at], theta_ref[:, at] = sign * s.u, sign * s.theta_ref
        return replace(s, name=f"{s.name}_{name}", u=u, theta_ref=theta_ref, excited=tuple(signs))

    def _on_all(self, rig: Rig, plan: Plan, segments: list[PlannedSegment]) -> Plan:
        first, *beside = (at_rest(rig, a.name) for a in rig.actuator)
        return replace(
            plan,
            actuator=first.actuator,
            kp=first.kp,
            centring_sensor=first.centring_sensor,
            beside=tuple(beside),
            segments=tuple(segments),
        )
