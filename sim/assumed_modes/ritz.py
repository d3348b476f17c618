"""The chain as a mechanism with few coordinates: assumed modes in relative coordinates.

Each joint's spring has its own relative rotation or displacement as a coordinate, a source its
angle. A beam of length L has the curvature

    kappa(x) = (1/L) sum_i q_i P_i(2 x/L - 1),       i = 0 ... ORDER - 1,

P_i the Legendre polynomials. q_0 and q_1 are the exact static shapes under an end moment and
an end force (the static correction); the others leave displacement and slope of the end alone.
Its stiffness is diagonal, EI/L /(2 i + 1), as Legendre polynomials are orthogonal; its mass
follows from products of the shapes, by Gauss's quadrature, exactly. No smooth shape has a slope
that jumps: where a beam is cracked the jump is a coordinate of its own, whose shape is straight but
for a kink there. Displacement w and slope theta of every place are rows over all coordinates, with
the rig file's convention w' = theta.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise

import numpy as np
from numpy.polynomial import legendre
from scipy.linalg import eigh

from samii_rig.rig.schema import Force, Moment, Pressure
from samii_rig.types import Float
from sim.assumed_modes.parts import (
    ANGLE_SOURCES,
    EXTENDED,
    JOINTS,
    MOTION_SOURCES,
    Part,
    Setup,
)

# Shapes a beam. With 12 all natural frequencies of SAMII and SFLR below 200 Hz are right to
# 2e-7; the shapes beyond carry the statics of what is higher. A moment on a beam between its ends
# is none of theirs: its curvature jumps, and 36 shapes still miss a mode by some per cent.
ORDER = 12
FLOOR = 0  # the coordinate that moves with the floor


def _integrals(times: int) -> list[Float]:
    """Coefficients of P_i integrated `times` times from the root on, over x/L."""
    # d(2x/L - 1)/d(x/L) = 2, hence half an integral each; all vanish at x = 0.
    return [
        np.asarray(legendre.legint(row, m=times, lbnd=-1, scl=0.5), dtype=np.float64)
        for row in np.eye(ORDER)
    ]


_SLOPES, _PLACES = _integrals(1), _integrals(2)


@lru_cache(maxsize=4096)
def shapes(x: float) -> tuple[Float, Float]:
    """Displacement over L and slope, (ORDER,) each, at x/L for unit q_i."""
    at = 2 * x - 1
    place = np.array([legendre.legval(at, c) for c in _PLACES], dtype=np.float64)
    slope = np.array([legendre.legval(at, c) for c in _SLOPES], dtype=np.float64)
    return place, slope


@dataclass(frozen=True, slots=True)
class Maxwell:
    """A spring k in series with a dashpot k t, beside the coordinate `at`."""

    at: int
    k: float
    t: float


class Mechanism:
    """Mass, damping and stiffness over all coordinates, and the rows of every place.

    M, C, K : (n, n), prescribed coordinates included. free : the coordinates that move by
    themselves. sources : coordinate of each source of an angle or a displacement by name.
    cuts, gaps : coordinate of a rotation or a displacement, locked, at the place of each sensor
    of the moment or of the force: what holds it is that. joints : coordinate of each spring by
    name.
    """

    def __init__(self, setup: Setup) -> None:
        self.setup = setup
        self._cut_after = [s.after for s in setup.sensors if isinstance(s, Moment)]
        self._gap_after = [
            s.after
            for s in setup.sensors
            if isinstance(s, Force) or (isinstance(s, Pressure) and s.area is not None)
        ]
        n = (
            3
            + len(self._cut_after)
            + len(self._gap_after)
            + sum(_coordinates(p) for p in setup.parts)
        )
        n += sum(a.kind in ("oscillator", "crack") for a in setup.attachments)
        self._n, self._used = n, 1
        self.M, self.C, self.K = np.zeros((n, n)), np.zeros((n, n)), np.zeros((n, n))
        self.maxwell: list[Maxwell] = []
        self.sources: dict[str, int] = {}
        self.cuts: dict[str, int] = {}
        self.gaps: dict[str, int] = {}
        self.joints: dict[str, int] = {}
        self._before: dict[str, tuple[Float, Float]] = {}
        self._after: dict[str, tuple[Float, Float]] = {}
        self._beams: dict[str, tuple[float, slice]] = {}
        self._kinks: dict[str, list[tuple[float, int]]] = {}  # of a beam: x/L, coordinate
        self._walk()
        for a in setup.attachments:
            if a.kind == "crack":  # a coordinate of its beam, not of a place on it
                continue
            self._attach(a.kind, self.place(a.on, a.x), a.values)
        for r in setup.relaxations:
            at = self.joints[r.on]
            self.maxwell += [Maxwell(at, k, t) for k, t in zip(r.stiffness, r.times, strict=True)]
        n = self._used
        self.M, self.C, self.K = self.M[:n, :n], self.C[:n, :n], self.K[:n, :n]
        held = {FLOOR, *self.sources.values(), *self.cuts.values(), *self.gaps.values()}
        self.free = np.array([i for i in range(n) if i not in held], dtype=np.int64)

    @property
    def size(self) -> int:
        """Number of coordinates, prescribed ones included."""
        return self._used

    def before(self, name: str) -> tuple[Float, Float]:
        """Rows of w and theta upstream of a part."""
        return self._cut_to_size(self._before[name])

    def after(self, name: str) -> tuple[Float, Float]:
        """Rows of w and theta downstream of a part."""
        return self._cut_to_size(self._after[name])

    def place(self, on: str, x: float) -> tuple[Float, Float]:
        """Rows of w and theta at `x` m along a part, right behind one without extent."""
        part = self.setup.part(on)
        if part.kind not in EXTENDED:
            return self._cut_to_size(self._after[on])
        return self._cut_to_size(self._along(part, x))

    def against_ground(self, on: str) -> Float:
        """The row of w right behind a part, less that of the ground, which moves with the floor."""
        row = self.after(on)[0].copy()
        row[FLOOR] = 0.0
        return row

    def bend(self, on: str, x: float) -> Float:
        """The row of the curvature at `x` m along a beam."""
        length, own = self._beams[on]
        row = np.zeros(self._n)
        at = 2 * x / length - 1
        row[own] = [legendre.legval(at, unit) / length for unit in np.eye(ORDER)]
        return row[: self._used]

    def _cut_to_size(self, rows: tuple[Float, Float]) -> tuple[Float, Float]:
        return rows[0][: self._used], rows[1][: self._used]

    def _new(self) -> int:
        self._used += 1
        return self._used - 1

    def _unit(self, at: int) -> Float:
        row = np.zeros(self._n)
        row[at] = 1.0
        return row

    def _add(self, matrix: Float, row: Float, value: float) -> None:
        n = len(row)
        matrix[:n, :n] += value * np.outer(row, row)

    def _walk(self) -> None:
        w, theta = self._unit(FLOOR), np.zeros(self._n)
        if self.setup.base == "free":
            w = w + self._unit(self._new())
        if self.setup.base != "clamped" and self.setup.motion == "lateral":
            theta = theta + self._unit(self._new())
        for part in self.setup.parts:
            self._before[part.name] = (w, theta)
            w, theta = self._through(part, w, theta)
            if part.name in self._cut_after and part.name not in self.cuts:
                self.cuts[part.name] = self._new()
                theta = theta + self._unit(self.cuts[part.name])
            if part.name in self._gap_after and part.name not in self.gaps:
                self.gaps[part.name] = self._new()
                w = w + self._unit(self.gaps[part.name])
            self._after[part.name] = (w, theta)

    def _through(self, part: Part, w: Float, theta: Float) -> tuple[Float, Float]:
        v = part.values
        if part.kind in JOINTS or part.kind == "oil_column":
            at = self.joints[part.name] = self._new()
            self.K[at, at] += v["k"] if part.kind in JOINTS else v["D"] ** 2 / v["C_h"]
            self.C[at, at] += v.get("c", 0.0)
            jump = self._unit(at)
            return (w + jump, theta) if part.kind == "translational_spring" else (w, theta + jump)
        if part.kind == "cylinder":
            return w + self._unit(self._cylinder(part)), theta
        if part.kind in (*ANGLE_SOURCES, *MOTION_SOURCES):
            moved = self._unit(self.sources.setdefault(part.name, self._new()))
            return (w, theta + moved) if part.kind in ANGLE_SOURCES else (w + moved, theta)
        if part.kind == "gear":
            return w, theta / v["n"]
        if part.kind == "spindle":  # what turned stays behind
            return w + v["lead"] * theta, np.zeros(self._n)
        if part.kind == "rigid_link":
            self._attach("mass", (w + v["r"] * theta, theta), {"m": v["m"], "J": v["I"]})
            return w + v["L"] * theta, theta
        if part.kind == "beam":
            self._beam(part)
            return self._along(part, v["L"])
        if part.kind == "lumped_mass":
            self._attach("mass", (w, theta), {"m": v["m"], "J": v["I"]})
        elif part.kind == "translational_ground_spring":
            self._attach("ground", (w, theta), v)
        elif part.kind in ("torsional_ground_spring", "gravity_stiffness"):
            self._attach("ground_torsion", (w, theta), v)
        return w, theta

    def _cylinder(self, part: Part) -> int:
        """The coordinate of the oil's stretch: a spring and, by the leak, one that relaxes
        (`samii_rig.rig.schema.elements.Cylinder`, k(s) in partial fractions)."""
        v = part.values
        S0, S1, S2 = (v["A_1"] ** n / v["V_1"] + v["A_2"] ** n / v["V_2"] for n in range(3))
        at = self.joints[part.name] = self._new()
        relaxes = v["leak"] > 0
        self.K[at, at] += v["B"] * (S2 - relaxes * S1**2 / S0)
        if relaxes:
            self.maxwell.append(Maxwell(at, v["B"] * S1**2 / S0, 1.0 / (v["B"] * v["leak"] * S0)))
        return at

    def _beam(self, part: Part) -> None:
        v = part.values
        own = slice(self._used, self._used + ORDER)
        self._used += ORDER
        self._beams[part.name] = (v["L"], own)
        k = v["EI"] / v["L"] / (2.0 * np.arange(ORDER) + 1.0)
        at = np.arange(own.start, own.stop)
        strengths, times, static = prony(v["eta"])
        self.K[at, at] += static * k
        self.C[at, at] += v["tau"] * k
        for i, ki in zip(at, k, strict=True):
            self.maxwell += [
                Maxwell(int(i), float(ki * g), float(t))
                for g, t in zip(strengths, times, strict=True)
            ]
        kinks = self._kinks[part.name] = self._cracks(part)
        # Products of two shapes are polynomials of degree 2 ORDER + 2 from kink to kink.
        x, weight = legendre.leggauss(ORDER + 2)
        for start, end in pairwise([0.0, *sorted(kink for kink, _ in kinks), 1.0]):
            for xi, gi in zip((x + 1) / 2, weight / 2, strict=True):
                w, _ = self._rows(part.name, float(start + (end - start) * xi))
                self._add(self.M, w, v["mu"] * v["L"] * (end - start) * gi)

    def _cracks(self, part: Part) -> list[tuple[float, int]]:
        """x/L of each crack of a beam and the coordinate of its jump. One beyond the end of a beam
        that a refit made shorter is a coordinate without mass, of which no plant is made."""
        found = []
        for a in self.setup.attachments:
            if a.kind == "crack" and a.on == part.name:
                at = self._new()
                self.K[at, at] += a.values["k"]
                self.C[at, at] += a.values["c"]
                found.append((min(a.x / part.values["L"], 1.0), at))
        return found

    def _rows(self, beam: str, at: float) -> tuple[Float, Float]:
        """Rows of w and theta at x/L of a beam."""
        w, theta = self._before[beam]
        length, own = self._beams[beam]
        out_w, out_theta = w + at * length * theta, theta.copy()
        place, slope = shapes(at)
        out_w[own] += length * place
        out_theta[own] += slope
        for kink, i in self._kinks[beam]:
            if at > kink:
                out_w[i] += length * (at - kink)
                out_theta[i] += 1.0
        return out_w, out_theta

    def _along(self, part: Part, x: float) -> tuple[Float, Float]:
        if part.kind == "beam":
            return self._rows(part.name, x / part.values["L"])
        w, theta = self._before[part.name]
        return w + x * theta, theta.copy()

    def _attach(self, kind: str, rows: tuple[Float, Float], v: dict[str, float]) -> None:
        w, theta = rows
        if kind == "mass":
            self._add(self.M, w, v["m"])
            self._add(self.M, theta, v.get("J", 0.0))
            return
        # The ground moves with the floor: what is tied to it feels the difference.
        row = np.array(theta if kind == "ground_torsion" else w)
        if kind == "oscillator":
            at = self._new()
            mass = np.zeros(max(len(row), self._used))
            mass[: len(row)] = row
            mass[at] = 1.0  # its coordinate is the spring's stretch
            self._add(self.M, mass, v["m"])
            self.K[at, at] += v["k"]
            self.C[at, at] += v["c"]
            return
        row[FLOOR] = 0.0
        self._add(self.K, row, v["k"])
        self._add(self.C, row, v.get("c", 0.0))


def _coordinates(part: Part) -> int:
    if part.kind == "beam":
        return ORDER
    return int(part.kind in (*JOINTS, *ANGLE_SOURCES, *MOTION_SOURCES, "oil_column", "cylinder"))


def first_hz(setup: Setup) -> float:
    """The first natural frequency, Hz, sources held; 0 where nothing swings."""
    mech = Mechanism(setup)
    f = np.ix_(mech.free, mech.free)
    K = mech.K[f].copy()
    for branch in mech.maxwell:  # swings are fast beside what relaxes
        at = np.flatnonzero(mech.free == branch.at)
        K[at, at] += branch.k
    try:
        square = eigh(K, mech.M[f], eigvals_only=True)
    except np.linalg.LinAlgError:  # a coordinate without mass
        return 0.0
    stiff = square[square > 1.0]  # rad^2/s^2: what only turns on has none
    return float(np.sqrt(stiff[0])) / (2 * np.pi) if stiff.size else 0.0


RELAX_LOW, RELAX_HIGH = 0.05, 2000.0  # Hz, band over which the loss factor is held
RELAX_PER_DECADE = 2  # branches: ripple of 2 % of the loss factor
REFERENCE_HZ = 3.0  # where the storage modulus is the file's: the geometric middle of SAMII's modes


def prony(eta: float) -> tuple[Float, Float, float]:
    """Maxwell branches whose loss factor is `eta` over the band: strengths g and times t (s),
    and the static stiffness, all relative to EI:

        E(s)/EI = static + sum_k g_k s t_k/(1 + s t_k),  Im E/Re E = eta at s = jw.

    The modulus rises with frequency, as causality demands, by 2 eta/pi a neper.
    """
    if eta == 0.0:
        return np.zeros(0), np.zeros(0), 1.0
    decades = np.log10(RELAX_HIGH / RELAX_LOW)
    n = round(RELAX_PER_DECADE * decades) + 1
    t = 1.0 / (2 * np.pi * np.geomspace(RELAX_LOW, RELAX_HIGH, n))
    w = 2 * np.pi * np.geomspace(2 * RELAX_LOW, RELAX_HIGH / 2, 8 * n)
    x = w[:, None] * t
    loss, storage = x / (1 + x**2), x**2 / (1 + x**2)
    # Im E - eta Re E = 0 with the static part 1: linear least squares in g.
    g = np.linalg.lstsq(loss - eta * storage, np.full(w.size, eta), rcond=None)[0]
    x0 = 2 * np.pi * REFERENCE_HZ * t
    at_reference = 1.0 + float(g @ (x0**2 / (1 + x0**2)))
    return g / at_reference, t, 1.0 / at_reference
