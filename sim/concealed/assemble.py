"""Matrices of the chain in minimal coordinates, M q'' + C q' + K q = forces.

Every displacement of the chain is a linear form of the coordinates, carried as a row from base to
tip: w and theta of the current place. A spring adds a coordinate of its own (the angle across it),
a beam the displacement and rotation of its nodes, a crack in it the jump of the slope, a rigid link
none. So no constraint is left, and the angle of a driven joint is one coordinate among the others,
prescribed by its drive.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np

from samii_rig.errors import InputError
from samii_rig.types import Float
from sim.concealed.parts import Description, Part

MOST_COORDINATES = 200  # coordinates; 2 a beam element, 1 a spring
# Phase of a bending wave over one beam element at half the sample rate. The natural
# frequencies of cubic elements are too high by (phase^4)/1440 of themselves: 4e-5 here, and
# falling with the square of the frequency.
PHASE = 0.5
LEAST_ELEMENTS = 8
# Two springs in series have no mass between them. A coordinate gets this part of its own
# inertia in addition, so that what would be algebraic is fast instead (1e5 rad/s and more),
# and as much more as keeps its damper's pole below the fastest, 1/s, that eigenvalues can bear.
SPARE_INERTIA = 1e-7
FASTEST_POLE = 1e8


@dataclass
class Relaxation:
    """A spring that relaxes: force -row stiffness z with z' = row . q' - rate z."""

    row: Float
    stiffness: float
    rate: float


@dataclass
class Structure:
    """The chain's matrices, (n, n), and rows to read it by.

    driven : by element name, the coordinate that a source prescribes.
    ends : by element name, rows (w, theta) behind it. starts : before it.
    inside : of beams, (x0, h, rows (4, n)) of each finite element.
    joints : by element name, the coordinates of the angles across all its parts.
    """

    M: Float
    C: Float
    K: Float
    driven: dict[str, int]
    ends: dict[str, tuple[Float, Float]]
    starts: dict[str, tuple[Float, Float]]
    inside: dict[str, list[tuple[float, float, Float]]]
    joints: dict[str, list[int]]
    relaxations: list[Relaxation] = field(default_factory=list)

    def lateral(self, element: str, x: float) -> tuple[Float, Float]:
        """Rows of displacement and rotation `x` metres behind the upstream end of an element."""
        for x0, h, rows in self.inside.get(element, ()):
            if x0 <= x <= x0 + h * (1 + 1e-12):
                value, slope = shape(x - x0, h)
                return value @ rows, slope @ rows
        w, theta = self.starts[element]
        return w + x * theta, theta


def shape(x: float, h: float) -> tuple[Float, Float]:
    """Hermite's cubics at x in [0, h]: displacement and slope from [w0, theta0, w1, theta1]."""
    t = x / h
    value = [1 - 3 * t**2 + 2 * t**3, h * (t - 2 * t**2 + t**3), 3 * t**2 - 2 * t**3]
    slope = [(6 * t**2 - 6 * t) / h, 1 - 4 * t + 3 * t**2, (6 * t - 6 * t**2) / h]
    return (
        np.array([*value, h * (t**3 - t**2)]),
        np.array([*slope, 3 * t**2 - 2 * t]),
    )


def bending(h: float) -> Float:
    """Stiffness of an element of EI = 1: integral of w'' w''."""
    return np.array(
        [
            [12, 6 * h, -12, 6 * h],
            [6 * h, 4 * h * h, -6 * h, 2 * h * h],
            [-12, -6 * h, 12, -6 * h],
            [6 * h, 2 * h * h, -6 * h, 4 * h * h],
        ]
    ) / (h**3)


def consistent_mass(h: float) -> Float:
    """Mass of an element of mu = 1: integral of w w."""
    return (h / 420) * np.array(
        [
            [156, 22 * h, 54, -13 * h],
            [22 * h, 4 * h * h, 13 * h, -3 * h * h],
            [54, 13 * h, 156, -22 * h],
            [-13 * h, -3 * h * h, -22 * h, 4 * h * h],
        ]
    )


class Assembly:
    """Carries the rows from base to tip and gathers the matrices."""

    def __init__(self, base: str, highest_hz: float, like: Structure | None) -> None:
        self.n = 0
        self.like = like
        self.highest = 2 * math.pi * highest_hz
        self.M, self.C, self.K = (np.zeros((MOST_COORDINATES, MOST_COORDINATES)) for _ in range(3))
        self.w, self.theta = np.zeros(MOST_COORDINATES), np.zeros(MOST_COORDINATES)
        self.joints: dict[str, list[int]] = {}
        self.inside: dict[str, list[tuple[float, float, Float]]] = {}
        self.relaxations: list[Relaxation] = []
        self.driven: dict[str, int] = {}
        if base == "free":
            self.w = self.unit(self.coordinate())
        if base in ("free", "pinned"):
            self.theta = self.unit(self.coordinate())

    def coordinate(self) -> int:
        """A new coordinate."""
        if self.n == MOST_COORDINATES:
            raise InputError("plant", "coordinates", self.n, f"at most {MOST_COORDINATES}")
        self.n += 1
        return self.n - 1

    @staticmethod
    def unit(i: int) -> Float:
        """The row that is 1 at coordinate i."""
        row = np.zeros(MOST_COORDINATES)
        row[i] = 1.0
        return row

    def add(self, part: Part) -> None:
        """Go through one part."""
        v = part.values
        match part.kind:
            case "beam":
                self._beam(part)
            case "rigid_link":
                self._mass(self.w + v["r"] * self.theta, self.theta, v["m"], v["I"])
                self.w = self.w + v["L"] * self.theta
            case "lumped_mass":
                self._mass(self.w, self.theta, v["m"], v.get("I", 0.0))
            case "torsional_spring":
                self._joint(part, v["k"], v.get("c", 0.0))
            case "translational_spring":
                i = self.coordinate()
                self.w = self.w + self.unit(i)
                self.K[i, i] += v["k"]
                self.C[i, i] += v.get("c", 0.0)
            case "torsional_ground_spring" | "gravity_stiffness":
                self._spring(self.theta, v["k"], v.get("c", 0.0))
            case "translational_ground_spring":
                self._spring(self.w, v["k"], v.get("c", 0.0))
            case "angular_velocity_source":
                i = self.driven[part.name] = self.coordinate()
                self.theta = self.theta + self.unit(i)
                self.joints.setdefault(part.name, []).append(i)
            case "oil":
                i = self._joint(part, v["k"], v["c"])
                line = self.unit(i) + self.unit(self.driven[part.name])
                self.M += v["J"] * np.outer(line, line)
            case "oscillator":
                i = self.coordinate()
                self.M[i, i] += v["m"]
                self._spring(self.unit(i) - self.w, v["k"], v["c"])
            case "ladder":
                row = self.unit(self.joints[part.name][-1])
                self.relaxations += [Relaxation(row, k, rate) for k, rate in part.ladder]
            case _:
                raise InputError("plant", part.name, part.kind, "a part that it knows")

    def _joint(self, part: Part, k: float, c: float) -> int:
        i = self.coordinate()
        self.theta = self.theta + self.unit(i)
        self.K[i, i] += k
        self.C[i, i] += c
        self.joints.setdefault(part.name, []).append(i)
        return i

    def _spring(self, row: Float, k: float, c: float) -> None:
        self.K += k * np.outer(row, row)
        self.C += c * np.outer(row, row)

    def _mass(self, w: Float, theta: Float, m: float, inertia: float) -> None:
        self.M += m * np.outer(w, w) + inertia * np.outer(theta, theta)

    def _beam(self, part: Part) -> None:
        v = part.values
        tau = v.get("tau", 0.0)
        gives = {x: (k, c) for x, k, c in part.cracks}
        found, bent = [], []
        for x, h in self._divided(part):
            if x in gives:
                self._joint(part, *gives[x])
            stiffness, mass = v["EI"] * bending(h), v["mu"] * consistent_mass(h)
            w1, theta1 = self.unit(self.coordinate()), self.unit(self.coordinate())
            rows = np.stack([self.w, self.theta, w1, theta1])
            used = np.flatnonzero(rows.any(axis=0))
            r, block = rows[:, used], np.ix_(used, used)
            bent_by = r.T @ stiffness @ r
            self.K[block] += bent_by
            self.C[block] += tau * bent_by
            self.M[block] += r.T @ mass @ r
            found.append((x, h, rows))
            if part.ladder:
                bent += self._curvatures(rows, h, v["EI"])
            self.w, self.theta = w1, theta1
        self.inside[part.name] = found
        self.relaxations += [Relaxation(b, k, rate) for b in bent for k, rate in part.ladder]

    def _divided(self, part: Part) -> Iterator[tuple[float, float]]:
        """Place and length of each element of a beam: a node at each crack, even between them."""
        length = part.values["L"]
        for x0, x1 in pairwise([0.0, *sorted(x for x, *_ in part.cracks), length]):
            if self.like:
                count = sum(x0 <= x < x1 for x, *_ in self.like.inside[part.name])
            else:
                count = math.ceil(self._elements(part.values) * ((x1 - x0) / length))
            h = (x1 - x0) / count
            yield from ((x0 + j * h, h) for j in range(count))

    def _elements(self, v: dict[str, float]) -> int:
        wave: float = (v["mu"] * self.highest**2 / v["EI"]) ** 0.25
        return max(LEAST_ELEMENTS, math.ceil(wave * v["L"] / PHASE))

    @staticmethod
    def _curvatures(rows: Float, h: float, EI: float) -> list[Float]:
        """Rows whose squares sum to the bending energy: mean and linear part of the curvature."""
        mean = math.sqrt(EI / h) * (rows[3] - rows[1])
        linear = math.sqrt(3 * EI / h) * (rows[1] + rows[3] - 2 / h * (rows[2] - rows[0]))
        return [mean, linear]


def assemble(plant: Description, like: Structure | None = None) -> Structure:
    """The matrices of a description. like : of the same parts; beams are divided as there, so that
    the matrices of both can be compared."""
    work = Assembly(plant.base, plant.rate_hz / 2, like)
    starts: dict[str, tuple[Float, Float]] = {}
    ends: dict[str, tuple[Float, Float]] = {}
    for part in plant.parts:
        starts.setdefault(part.name, (work.w, work.theta))
        work.add(part)
        ends[part.name] = (work.w, work.theta)
    n = work.n
    own = np.concatenate([[i] for coordinates in work.joints.values() for i in coordinates])
    M = work.M[:n, :n].copy()
    spare = np.zeros(n)
    damper, spring = np.diag(work.C)[own], np.diag(work.K)[own]
    # A damper alone has a pole at rest too, which must not drown in the fast one's rounding.
    fastest = np.where(spring == 0, 0.1 * FASTEST_POLE, FASTEST_POLE)
    slow = np.maximum(damper / fastest, spring / fastest**2)
    spare[own] = np.maximum(SPARE_INERTIA * np.diag(M)[own], slow)
    spare[list(work.driven.values())] = 0.0
    # Springs across the chain: nothing but the chain's mass behind them.
    spare[np.diag(M) == 0] = SPARE_INERTIA
    cut = {k: (a[:n], b[:n]) for k, (a, b) in starts.items()}
    return Structure(
        M=M + np.diag(spare),
        C=work.C[:n, :n],
        K=work.K[:n, :n],
        driven=work.driven,
        ends={k: (a[:n], b[:n]) for k, (a, b) in ends.items()},
        starts=cut,
        inside={k: [(x, h, r[:, :n]) for x, h, r in v] for k, v in work.inside.items()},
        joints=work.joints,
        relaxations=[Relaxation(r.row[:n], r.stiffness, r.rate) for r in work.relaxations],
    )
