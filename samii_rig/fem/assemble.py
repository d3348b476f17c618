"""From a rig file to the matrices of a constrained mechanism.

Every beam node and every rigid body has coordinates (w, theta) of its own, every joint its
relative rotation. Nothing is shared: what is joined is joined by a constraint with a Lagrange
multiplier. That is paper 1, eq. (12), for small motions about the straight chain:

    M q'' + C q' + K q + Phi^T lambda = f,      Phi q = b,

Phi the constraint gradient Phi_q. b is zero but for an angular velocity source, whose rotation
is prescribed. The multiplier of the constraint between two rotations is the moment M there.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping

from samii_rig.errors import InputError
from samii_rig.fem.mechanism import Mechanism
from samii_rig.fem.walk import Walk
from samii_rig.rig.schema import Rig, TorsionalSpring
from samii_rig.rig.schema.elements import ANGLE_SOURCES, flattened


def assemble(
    rig: Rig,
    elements: int = 15,
    rigid: Collection[str] = (),
    feedback: Mapping[str, tuple[float, float]] | None = None,
) -> Mechanism:
    """The mechanism of `rig` (see `samii_rig.fem.model.Fem` for the arguments)."""
    feedback = {} if feedback is None else feedback
    _check(rig, elements, rigid, feedback)
    walk = Walk(rig, elements)
    walk.base()
    for e in rig.element:
        walk.over(e, rigid, feedback)
    walk.tip(rig.tip)
    return walk.mechanism()


def _check(
    rig: Rig,
    elements: int,
    rigid: Collection[str],
    feedback: Mapping[str, tuple[float, float]],
) -> None:
    if elements < 1:
        raise InputError(rig.name, "elements", elements, "1 beam element or more")
    springs = [e.name for e in flattened(rig.element) if isinstance(e, TorsionalSpring)]
    for name in rigid:
        if name not in springs:
            raise InputError(rig.name, "rigid", name, f"torsional springs, of {springs}")
    sources = [e.name for e in rig.element if isinstance(e, ANGLE_SOURCES)]
    for name, (g_v, _) in feedback.items():
        if name not in sources:
            raise InputError(rig.name, "feedback", name, f"sources, of {sources}")
        if not g_v > 0:
            raise InputError(rig.name, f"feedback.{name}", g_v, "g_v above 0 N m s/rad")
