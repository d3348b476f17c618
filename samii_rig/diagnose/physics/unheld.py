"""Inputs that a sensor measured: what a model makes of them in the place of a held command.

Grids have every input held. A factor takes the hold away, and with it what folds back.
"""

from __future__ import annotations

from functools import partial

from samii_rig.diagnose.physics.effect import Factor
from samii_rig.model.sampled import unheld_at
from samii_rig.rig.schema import Rig
from samii_rig.types import Complex, Float


def not_held(s: Complex, _x: Float, rate_hz: float) -> tuple[Complex, list[Complex]]:
    """The inverse of the converter's hold, as `model.sampled.unheld_at` has it."""
    return unheld_at(s, rate_hz), []


def measured(rig: Rig, name: str) -> Factor:
    """What makes of a held input one that was measured at the samples."""
    return Factor("input", name, partial(not_held, rate_hz=rig.rate_hz))


def stated(rig: Rig) -> tuple[Factor, ...]:
    """That of each input which the rig file states as measured."""
    return tuple(measured(rig, a.name) for a in rig.actuator if not a.held)
