"""The matrices of a constrained mechanism, as `walk` leaves them."""

from __future__ import annotations

from dataclasses import dataclass

from scipy.sparse import csc_array

from samii_rig.fem.drive import Feedback, Load, Prescribed
from samii_rig.types import Float


@dataclass(frozen=True, slots=True)
class Places:
    """Where shapes are drawn: base, beam nodes, ends of bodies, both sides of joints.

    x : (n,) m from the base. element : (n,) name of the element that ends or lies there, ""
    at the base. w, theta : (n, n_q) rows that give displacement and rotation.
    """

    x: Float
    element: tuple[str, ...]
    w: csc_array
    theta: csc_array


@dataclass(frozen=True, slots=True)
class Mechanism:
    """The matrices; n_q coordinates, n_c constraints.

    M, K : (n_q, n_q) kg, N/m and so on. C : viscous damping of the rig file, without velocity
    feedback. H : loss, the imaginary part of the stiffness of beams with `eta`.
    G : (n_q, n_q) velocity feedback, g_v at each joint that has it.
    Phi : (n_c, n_q) what joins the parts; `locks` are held beside: {element: coordinate}.
    joints : coordinate of every joint by element name.
    angle, velocity, acceleration : (n_sensor, n_q) rows on q, q' and q''; zero for a sensor of
        another kind, but for gravity on a tilted accelerometer's angle.
    moment : (sensor, row of Phi, factor) of every sensor of a moment or a force at a joint that
        can carry one.
    feed : (sensor, index of a load, factor) of every sensor that reads a load itself.
    """

    M: csc_array
    C: csc_array
    H: csc_array
    K: csc_array
    G: csc_array
    Phi: csc_array
    locks: dict[str, int]
    joints: dict[str, int]
    sources: tuple[Prescribed, ...]
    feedback: tuple[Feedback, ...]
    loads: tuple[Load, ...]
    angle: csc_array
    velocity: csc_array
    acceleration: csc_array
    moment: tuple[tuple[int, int, float], ...]
    feed: tuple[tuple[int, int, float], ...]
    places: Places
