"""A rig with one force in it: the linear rig on the nodes, and what the force adds to all lines."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from samii_rig.diagnose.fit.rigfile import valued
from samii_rig.diagnose.forces.laws import Force
from samii_rig.diagnose.forces.place import Place
from samii_rig.diagnose.forces.steps import LAW_NUMBERS
from samii_rig.diagnose.physics.effect import Effect
from samii_rig.diagnose.physics.grid import Grid
from samii_rig.diagnose.physics.model import Model
from samii_rig.diagnose.physics.rows import EVERY_SENSOR
from samii_rig.errors import InputError
from samii_rig.rig.schema import Rig
from samii_rig.types import Complex, Float


@dataclass(frozen=True, slots=True)
class RecordGrid(Grid):
    """The nodes of whole records, where a force is computed in time under every record's input.

    added : (model, x, moving) -> (n, q, 1 + m) what the force adds to the records' lines, and its
    slopes by the entries `moving` of x. A model with a force predicts the nodes, and these lines
    behind them.
    """

    added: Callable[[ForceModel, Float, Sequence[int]], Complex] = field(kw_only=True)


class ForceModel(Model):
    """A model one of whose effects is a force; on a plain grid the force is left out.

    force : it. unknowns : where its strengths stand in x. moving : these, and the parameters of the
    rig that are among its numbers.
    """

    def __init__(self, rig: Rig, effects: Sequence[Effect]) -> None:
        super().__init__(rig, effects)
        forced = [(i, e) for i, e in enumerate(effects) if e.force is not None]
        if len(forced) != 1:
            raise InputError(rig.name, "effects", len(forced), "one force at a time")
        if any(e.site == EVERY_SENSOR for e in effects):
            # As one before the input it would change what drives the force, too.
            raise InputError(rig.name, "effects", EVERY_SENSOR, "no force beside it")
        which, effect = forced[0]
        assert effect.force is not None
        self.force: Force = effect.force
        self.force.place.augmented(self.built)  # refused where a part stands along its beam
        self.unknowns = tuple(self.own(which))
        own = (self.keys.index(key) for key in self.force.keys if key in self.keys)
        self.moving = (*self.unknowns, *own)

    def strengths(self, x: Float) -> Float:
        """The force's unknowns."""
        return np.exp(x[list(self.unknowns)])

    def numbers(self, x: Float) -> Float:
        """(3,) the numbers of its law."""
        known = {**self.nominal, **self.values(x)}
        return self.force.law.numbers(
            self.strengths(x), [float(known[key]) for key in self.force.keys]
        )

    def seeds(self, x: Float, moving: Sequence[int]) -> Float:
        """(m, 3) slopes of `numbers` by entries of x, each a logarithm."""
        own = np.array(self.force.law.enter) * self.strengths(x)[:, None]
        numbers, rows = self.numbers(x), np.zeros((len(moving), LAW_NUMBERS))
        for row, j in zip(rows, moving, strict=True):
            if j in self.unknowns:
                row[:2] = own[self.unknowns.index(j)]
            else:
                at = 1 + self.force.keys.index(self.keys[j])
                row[at] = numbers[at]
        return rows

    def channels(
        self, x: Float, s: Complex
    ) -> tuple[dict[str, Complex], dict[str, Complex]] | None:
        """(n,) at s what factors do to each command, and to each sensor, by name; None where there
        are none."""
        some = self.passing(x)
        given: dict[str, Complex] = {}
        seen: dict[str, Complex] = {}
        for factor, theta, _ in some:
            F = factor.value(s, theta)[0]
            known = given if factor.kind == "input" else seen
            known[factor.channel] = known.get(factor.channel, np.ones_like(F)) * F
        return (given, seen) if some else None

    def response(self, x: Float, at: Grid) -> Complex:
        """(n, q) at the grid's lines; of whole records, behind these what the force adds to all."""
        h = super().response(x, at)
        if not isinstance(at, RecordGrid):
            return h
        return np.concatenate([h, _wide(at.added(self, x, ())[:, :, 0], h.shape[1])])

    def gradient(self, x: Float, at: Grid) -> tuple[Complex, Complex]:
        """The same, and its derivatives (n, q, n_x). The force moves with its own numbers; what the
        chain's other parameters do to it is of second order."""
        h, dh = super().gradient(x, at)
        if not isinstance(at, RecordGrid):
            return h, dh
        added = _wide(at.added(self, x, self.moving), h.shape[1])
        more = np.zeros((*added.shape[:2], self.n), complex)
        more[:, :, list(self.moving)] = added[:, :, 1:]
        return np.concatenate([h, added[:, :, 0]]), np.concatenate([dh, more])


def augmented(model: Model, x: Float, place: Place) -> Rig:
    """The rig of a model at x with what a force at a place needs more."""
    values = model.values(x)
    element = tuple(valued(e, values, {}) for e in model.built.element)
    return place.augmented(model.built.model_copy(update={"element": element}))


def _wide(lines: Complex, width: int) -> Complex:
    """Lines (n, q, ...) as rows of responses (n, width, ...), those of several inputs."""
    out = np.zeros((len(lines), width, *lines.shape[2:]), complex)
    out[:, : lines.shape[1]] = lines
    return out


def model_of(rig: Rig, effects: Sequence[Effect]) -> Model:
    """The model that the effects need."""
    forced = any(e.force is not None for e in effects)
    return ForceModel(rig, effects) if forced else Model(rig, effects)
