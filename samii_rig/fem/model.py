"""The finite element model of a rig: frequency responses, natural frequencies, poles.

    fem = Fem(load_rig("samii")[0])
    H = fem.response(np.geomspace(0.1, 50, 500))       # (500, n_sensor, n_actuator)
    fem.modes().frequency_hz[:2]                       # paper 1, Table III
    reduce(fem).to_statespace()                        # python-control, see `fem.reduce`

Paper 1, section II-B. Nothing here knows of the transfer matrices: each model checks the other.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping

import numpy as np
from numpy.typing import ArrayLike
from scipy.sparse import csc_array, hstack, vstack
from scipy.sparse.linalg import splu

from samii_rig.errors import InputError
from samii_rig.fem import modal
from samii_rig.fem.assemble import assemble
from samii_rig.rig.schema import Rig
from samii_rig.rig.schema.elements import BEAMS, flattened
from samii_rig.types import Complex, Float


class Fem:
    """The finite element model of `rig`; it never changes.

    elements : beam elements in each beam.
    rigid : torsional springs that are locked, as in paper 1, section III.
    feedback : {source: (g_v, g_a)} sources that have intrinsic velocity feedback,
        T = g_v (g_a v - theta') (paper 1, eq. 18; N m s/rad and rad/s per unit of the input),
        in place of the prescribed rotation. `theta` is the source's own: a spring after it stays.
    rayleigh : (alpha, beta) for C = alpha K + beta M (paper 1, section III-C; s and 1/s) in
        place of all damping of the rig file.

    Raises InputError for an unknown name, a value out of range, or an element it has no
    matrices for.
    """

    def __init__(
        self,
        rig: Rig,
        elements: int = 15,
        rigid: Collection[str] = (),
        feedback: Mapping[str, tuple[float, float]] | None = None,
        rayleigh: tuple[float, float] | None = None,
    ) -> None:
        self.rig = rig
        self.mechanism = assemble(rig, elements, rigid, feedback)
        self.lossy = rayleigh is None and self.mechanism.H.count_nonzero() > 0
        m = self.mechanism
        self.C: csc_array = m.G + (
            m.C if rayleigh is None else rayleigh[0] * m.K + rayleigh[1] * m.M
        )

    @property
    def size(self) -> tuple[int, int]:
        """(coordinates, Lagrange multipliers); the first less the second can move."""
        m = self.mechanism
        return m.M.shape[0], m.Phi.shape[0] + len(m.locks)

    def held(self, also: Collection[int] = ()) -> list[int]:
        """Coordinates of the joints that are locked or prescribed, and those of `also`."""
        locks = self.mechanism.locks.values()
        return [*locks, *(j for j in also if j not in locks)]

    def constraints(self, also: Collection[int] = ()) -> csc_array:
        """(n_c, n_q) gradient Phi of all constraints: first of joined parts, then of `held`."""
        m, held = self.mechanism, self.held(also)
        rows = csc_array(
            (np.ones(len(held)), (np.arange(len(held)), held)), shape=(len(held), m.M.shape[0])
        )
        return csc_array(vstack([m.Phi, rows]))

    def response(self, frequency_hz: ArrayLike) -> Complex:
        """(n_freq, n_sensor, n_actuator) response of the continuous system, SI units.

        Actuator unit in, sensor unit out; no hold, filter or delay. Sensors and actuators in
        the rig file's order. A lag is a negative phase.

        Raises InputError for a frequency that is not above 0 Hz or at which nothing resists.
        """
        return self.evaluate(2j * np.pi * positive_hz(frequency_hz))

    def evaluate(self, s: ArrayLike) -> Complex:
        """The same as `response` at complex s, rad/s, shape (n,); one sparse solution each.

            [K + j H + s C + s^2 M   Phi^T] [q     ]   [f]
            [Phi                     0    ] [lambda] = [b]

        At Im s < 0 the loss H changes sign, so that the response of a real input is real.
        """
        s = np.atleast_1d(np.asarray(s, dtype=complex))
        m, Phi = self.mechanism, self.constraints()
        n, n_c = m.M.shape[0], Phi.shape[0]
        unit = multiplier_unit(m.K)
        frame = saddle(csc_array((n, n)), unit * Phi)
        parts = [frame, *(_padded(X, n_c) for X in (m.K, m.H, self.C, m.M))]
        pattern, (fixed, k, h, c, mass) = _aligned(parts)
        n_out, n_in = len(self.rig.sensor), len(self.rig.actuator)
        H = np.zeros((s.size, n_out, n_in), complex)
        locks = list(m.locks)
        for i, at in enumerate(s):
            loss = 0j if not self.lossy else 1j if at.imag >= 0 else -1j
            # Set anew for each s, on the pattern that all share.
            pattern.data = fixed + k + loss * h + at * c + at**2 * mass
            rhs = np.zeros((n + n_c, n_in), complex)
            for joint in m.feedback:
                rhs[joint.coordinate, joint.column] += joint.gain
            for load in m.loads:
                rhs[load.coordinate, load.column] += load.law.at(complex(at))
            for source in m.sources:
                row = n + m.Phi.shape[0] + locks.index(source.element)
                rhs[row, source.column] += unit * source.law.at(complex(at))
            try:
                x = splu(pattern).solve(rhs)
            except RuntimeError as error:  # exactly singular
                raise InputError(
                    self.rig.name,
                    "s",
                    complex(at),
                    "no pole, and no part without mass and stiffness",
                ) from error
            H[i] = m.angle @ x[:n] + at * (m.velocity @ x[:n]) + at**2 * (m.acceleration @ x[:n])
            for sensor, row, factor in m.moment:
                H[i, sensor] = factor * unit * x[n + row]
            for sensor, index, factor in m.feed:
                load = m.loads[index]
                H[i, sensor, load.column] += factor * load.law.at(complex(at))
        return H

    def basis(self, also: Collection[int] = ()) -> modal.Basis:
        """All motions with the prescribed and locked joints, and the coordinates `also`, held."""
        m = self.mechanism
        Phi = self.constraints(also).toarray()
        return modal.basis(m.M.toarray(), m.K.toarray(), Phi, self.rig.name)

    def modes(self, n: int | None = None) -> modal.Modes:
        """The `n` lowest undamped modes, default all, at zero input: a velocity source holds
        its joint, one with velocity feedback lets it go.

        The sign of a shape makes its largest displacement positive.
        """
        modes = self.basis().modes
        w = self.mechanism.places.w @ modes.shapes
        sign = np.sign(w[np.argmax(abs(w), axis=0), np.arange(w.shape[1])])
        return modal.Modes(modes.omega[:n], (modes.shapes * np.where(sign, sign, 1.0))[:, :n])

    def poles(self) -> Complex:
        """(n,) rad/s, Im >= 0, by modulus; without the source's own at 0 and -p.

        Raises InputError for a beam with `eta`: a constant loss factor is not causal and has
        no poles; `response` bears it.
        """
        self.refuse_loss()
        return modal.poles(self.basis(), self.C.toarray())

    def refuse_loss(self) -> None:
        """InputError if a beam has a constant loss factor."""
        for e in flattened(self.rig.element):
            if self.lossy and isinstance(e, BEAMS) and e.eta.value > 0:
                raise InputError(
                    self.rig.name,
                    f"{e.name}.eta",
                    e.eta.value,
                    "0 where equations in time are needed: use tau, or rayleigh damping",
                )


def positive_hz(frequency_hz: ArrayLike) -> Float:
    """(n,) frequencies; InputError if one is not above 0 Hz."""
    f = np.atleast_1d(np.asarray(frequency_hz, dtype=float))
    wrong = f[~((f > 0) & np.isfinite(f))]
    if wrong.size:
        raise InputError("response", "frequency_hz", float(wrong[0]), "more than 0 Hz")
    return f


def multiplier_unit(K: csc_array) -> float:
    """The unit of the multipliers, N: that of the stiffness, so that `saddle` is well scaled."""
    return float(np.max(abs(K.diagonal()), initial=1.0))


def saddle(A: csc_array, Phi: csc_array) -> csc_array:
    """[[A, Phi^T], [Phi, 0]]."""
    corner = csc_array((Phi.shape[0], Phi.shape[0]))
    return csc_array(vstack([hstack([A, Phi.T]), hstack([Phi, corner])]))


def _padded(X: csc_array, n_c: int) -> csc_array:
    size = X.shape[0] + n_c
    ends = np.append(X.indptr, np.full(n_c, X.nnz))
    return csc_array((X.data, X.indices, ends), shape=(size, size))


def _aligned(parts: list[csc_array]) -> tuple[csc_array, list[Float]]:
    """A matrix with the union of the patterns, and the values of each part in its order."""
    union = csc_array(parts[0].shape)
    for X in parts:
        union = union + abs(X)
    union.sort_indices()
    column = np.repeat(np.arange(union.shape[1]), np.diff(union.indptr))
    return union.astype(complex), [np.asarray(X[union.indices, column]) for X in parts]
