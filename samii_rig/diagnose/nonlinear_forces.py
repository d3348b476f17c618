"""The nonlinear forces that a rig may hide, each with its range over the data at hand."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from samii_rig.diagnose.effect import Effect, Unknown
from samii_rig.diagnose.nonlinear_laws import CUBIC, EXCESS, FRICTION, GAP
from samii_rig.diagnose.nonlinear_levels import LevelGrid
from samii_rig.diagnose.nonlinear_model import Quasi
from samii_rig.diagnose.refit import Problem
from samii_rig.diagnose.scales import spread
from samii_rig.errors import SamiiRigError
from samii_rig.model.tmm import Chain
from samii_rig.rig.schema import ANGLE_SOURCES, SOURCES, Rig, TorsionalSpring
from samii_rig.types import Complex, Float

STARTS = 14
COMPUTED = 0.01  # of a strength: what it was off by where it is hidden in strong forces
RANGE = (1e-6, 30.0)  # of a strength over the one that doubles or halves the motion at its place
SOFTEST = 1.0  # the same of a stiffness that falls: beyond, a spring would push
WIDTHS = (1e-6, 2.0)  # of a gap or limit over the largest amplitude that meets it
# Starts of a limit over the largest amplitude: one just below it cuts only a little.
LIMITS = (0.1, 0.2, 0.35, 0.5, 0.65, 0.8, 0.9, 0.95, 0.98, 0.99, 0.995, 0.999)


class Reach(Protocol):
    """How far the data move a rig."""

    @property
    def actuator(self) -> int:
        """The index of the one that is driven."""

    @property
    def largest(self) -> float:
        """Amplitude of the input."""

    def motion(self, quasi: Quasi) -> tuple[Float, Float] | None:
        """Amplitude of what drives a force, and how much a unit force moves it, both (n,) over the
        band; None where nothing moves, or the force cannot act."""


def forces(rig: Rig, reach: Reach) -> Iterator[Effect]:
    """Every nonlinear force that the table knows on this rig; ranges are those of the data."""
    order = [e.name for e in rig.element]
    kinds = {e.name: e for e in rig.element}
    for e in rig.element:
        if isinstance(e, TorsionalSpring):
            at = order.index(e.name)
            near: list[tuple[str, ...]] = [
                (order[i], e.name) if i < at else (e.name, order[i])
                for i in (at - 1, at + 1)
                if 0 <= i < len(order) and isinstance(kinds[order[i]], ANGLE_SOURCES)
            ]
            for across in ((e.name,), *near):
                yield from _joint(reach, across, e.name)
    actuator = rig.actuator[reach.actuator]
    source = next(
        (e for e in rig.element if isinstance(e, SOURCES) and e.input == actuator.name), None
    )
    if source is None:
        return
    alias = actuator.name
    largest = reach.largest
    if isinstance(source, ANGLE_SOURCES):
        across = (source.name,)
        yield _force(
            "coulomb_friction", source.name, alias, Quasi("drive", across, FRICTION),
            _log("T_c", actuator.unit, WIDTHS[0] * largest, WIDTHS[1] * largest),
        )  # fmt: skip
        flow = Quasi("flow", across, None)
        scale = reach.motion(flow)
        if scale is not None:
            top = float(np.max(scale[0]))
            yield _force(
                "flow_saturation", source.name, alias, flow,
                _log("T_s", "N m", top, 1e4 * top),
            )  # fmt: skip
    at_source = (source.name,)
    yield _force(
        "valve_deadband", source.name, alias, Quasi("command", at_source, GAP),
        _log("width", actuator.unit, WIDTHS[0] * largest, WIDTHS[1] * largest),
    )  # fmt: skip
    yield _force(
        "output_saturation", source.name, alias, Quasi("command", at_source, EXCESS),
        Unknown(
            "limit", actuator.unit, 0.02 * largest, largest, tuple(x * largest for x in LIMITS)
        ),
    )  # fmt: skip


def _joint(reach: Reach, across: tuple[str, ...], spring: str) -> Iterator[Effect]:
    """Forces between both sides of a joint: of its spring alone, or of spring and source."""
    friction = Quasi("joint", across, FRICTION)
    alone = len(across) == 1
    other = next((n for n in across if n != spring), "")
    speed = reach.motion(friction)
    if speed is None:
        return
    A, y1 = speed
    torque = float(np.median(np.pi / 4 * A / y1))
    low, high = (x * torque for x in RANGE)
    yield _force("coulomb_friction", spring, other, friction, _log("T_c", "N m", low, high))
    if not alone:
        return
    cubic = Quasi("joint", across, CUBIC)
    turned = reach.motion(cubic)
    assert turned is not None
    A, y1 = turned
    k3 = 4 / 3 / float(np.median(y1)) / float(np.max(A)) ** 2
    yield _force(
        "cubic_stiffness", spring, "", cubic,
        _log("k3", "N m/rad^3", RANGE[0] * k3, RANGE[1] * k3),
    )  # fmt: skip
    soft = Quasi("joint", across, CUBIC, 1.0)
    yield replace(
        _force(
            "cubic_stiffness", spring, "", soft,
            _log("k3", "N m/rad^3", RANGE[0] * k3, SOFTEST * k3),
        ),
        report=lambda x: -x, variant=f"softening {' '.join(across)}",
    )  # fmt: skip
    top = float(np.max(A))
    yield _force(
        "backlash", spring, "", Quasi("joint", across, GAP, 1.0, (spring, "k")),
        _log("width", "rad", WIDTHS[0] * top, WIDTHS[1] * top),
    )  # fmt: skip


def softens(effect: Effect) -> bool:
    """Whether it is a spring that gives way: its describing function leads nowhere where it takes
    all stiffness, so that it is looked for in time alone."""
    return effect.quasi is not None and effect.quasi.law is CUBIC and effect.quasi.sign > 0


def _log(symbol: str, unit: str, low: float, high: float) -> Unknown:
    return Unknown(symbol, unit, low, high, spread(low, high, STARTS))


def _force(physics: str, site: str, alias: str, quasi: Quasi, unknown: Unknown) -> Effect:
    return Effect(
        physics=physics,
        site=site,
        unknowns=(unknown,),
        quasi=quasi,
        aliases=((physics, alias),) if alias else (),
        rough=0.0 if quasi.kind == "command" else COMPUTED,
        variant=f"{quasi.kind} {' '.join(quasi.across)}",
    )


@dataclass(frozen=True, slots=True)
class LineReach:
    """`Reach` of responses line by line, whose levels are apart."""

    rig: Rig
    at: LevelGrid

    @classmethod
    def of(cls, rig: Rig, problem: Problem) -> LineReach:
        """At the lines of a problem."""
        assert isinstance(problem.at, LevelGrid)
        return cls(rig, problem.at)

    @property
    def actuator(self) -> int:
        """As of `Reach`."""
        return int(self.at.actuator[0])

    @property
    def largest(self) -> float:
        """As of `Reach`, at any level."""
        at = self.at
        sine = np.sqrt(2 * at.driven.max(axis=1))
        return float(np.max(np.where(at.random, 3 * np.sqrt(at.driven.sum(axis=1)), sine)))

    def motion(self, quasi: Quasi) -> tuple[Float, Float] | None:
        """As of `Reach`."""
        at = self.at
        assert at.power is not None
        found = per_input(self.rig, quasi, at.frequency, self.actuator)
        if found is None:
            return None
        A, y1 = np.abs(found[0]) * np.sqrt(2 * at.power), np.abs(found[1])
        on = A > 0
        return (A[on], y1[on]) if on.any() and moves(y1) else None


def per_input(
    rig: Rig, quasi: Quasi, frequency: Float, actuator: int
) -> tuple[Complex, Complex] | None:
    """(n,) what drives a force, per unit of the input and of the force; None as of `Reach`."""
    try:
        G = Chain(quasi.widened(rig)).response(frequency)
    except SamiiRigError:
        return None
    n = len(rig.sensor)
    rate: Float = np.ones(frequency.size)
    if quasi.law is not None and quasi.law.of_speed:
        rate = 2 * np.pi * frequency
    # The force's own input, or the only one, is the last.
    return np.asarray(rate * G[:, n, actuator]), np.asarray(rate * G[:, n, -1])


def moves(y1: Float) -> bool:
    """Whether a unit force moves what drives it at every line."""
    return bool(np.all(y1 > 0) and np.all(np.isfinite(y1)))
