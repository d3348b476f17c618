"""The nonlinear forces that a rig may hide, each with its range over the data at hand."""

from __future__ import annotations

from collections.abc import Iterator

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
from samii_rig.types import Float

STARTS = 14
COMPUTED = 0.01  # of a strength: what it was off by where it is hidden in strong forces
RANGE = (1e-6, 30.0)  # of a strength over the one that doubles or halves the motion at its place
WIDTHS = (1e-6, 2.0)  # of a gap or limit over the largest amplitude that meets it
# Starts of a limit over the largest amplitude: one just below it cuts only a little.
LIMITS = (0.1, 0.2, 0.35, 0.5, 0.65, 0.8, 0.9, 0.95, 0.98, 0.99, 0.995, 0.999)


def forces(rig: Rig, problem: Problem) -> Iterator[Effect]:
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
                yield from _joint(rig, problem, across, e.name)
    actuator = rig.actuator[int(problem.at.actuator[0])]
    source = next(
        (e for e in rig.element if isinstance(e, SOURCES) and e.input == actuator.name), None
    )
    if source is None:
        return
    alias = actuator.name
    largest = _largest(problem)
    if isinstance(source, ANGLE_SOURCES):
        across = (source.name,)
        yield _force(
            "coulomb_friction", source.name, alias, Quasi("drive", across, FRICTION),
            _log("T_c", actuator.unit, WIDTHS[0] * largest, WIDTHS[1] * largest),
        )  # fmt: skip
        flow = Quasi("flow", across, None)
        scale = _motion(rig, problem, flow)
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


def _joint(rig: Rig, problem: Problem, across: tuple[str, ...], spring: str) -> Iterator[Effect]:
    """Forces between both sides of a joint: of its spring alone, or of spring and source."""
    friction = Quasi("joint", across, FRICTION)
    alone = len(across) == 1
    other = next((n for n in across if n != spring), "")
    speed = _motion(rig, problem, friction)
    if speed is None:
        return
    A, y1 = speed
    torque = float(np.median(np.pi / 4 * A / y1))
    low, high = (x * torque for x in RANGE)
    yield _force("coulomb_friction", spring, other, friction, _log("T_c", "N m", low, high))
    if not alone:
        return
    cubic = Quasi("joint", across, CUBIC)
    turned = _motion(rig, problem, cubic)
    assert turned is not None
    A, y1 = turned
    k3 = 4 / 3 / float(np.median(y1)) / float(np.max(A)) ** 2
    yield _force(
        "cubic_stiffness", spring, "", cubic,
        _log("k3", "N m/rad^3", RANGE[0] * k3, RANGE[1] * k3),
    )  # fmt: skip
    top = float(np.max(A))
    yield _force(
        "backlash", spring, "", Quasi("joint", across, GAP, 1.0, (spring, "k")),
        _log("width", "rad", WIDTHS[0] * top, WIDTHS[1] * top),
    )  # fmt: skip


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


def _largest(problem: Problem) -> float:
    """Largest amplitude of the input at any level."""
    at = problem.at
    assert isinstance(at, LevelGrid)
    sine = np.sqrt(2 * at.driven.max(axis=1))
    return float(np.max(np.where(at.random, 3 * np.sqrt(at.driven.sum(axis=1)), sine)))


def _motion(rig: Rig, problem: Problem, quasi: Quasi) -> tuple[Float, Float] | None:
    """Amplitude of what drives a force at every line, and how much a unit force moves it; None
    where nothing moves, or the force cannot act."""
    at = problem.at
    assert isinstance(at, LevelGrid)
    assert at.power is not None
    try:
        G = Chain(quasi.widened(rig)).response(at.frequency)
    except SamiiRigError:
        return None
    n = len(rig.sensor)
    rate = np.ones(at.frequency.size)
    if quasi.law is not None and quasi.law.of_speed:
        rate = 2 * np.pi * at.frequency
    A = np.abs(rate * G[:, n, int(at.actuator[0])]) * np.sqrt(2 * at.power)
    y1 = np.abs(rate * G[:, n, -1])  # the force's own input, or the only one
    on = A > 0
    if not on.any() or not np.all(y1 > 0) or not np.all(np.isfinite(y1)):
        return None
    return A[on], y1[on]
