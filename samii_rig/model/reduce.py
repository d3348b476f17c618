"""A small state space of a rig, with a bound on what it gets wrong.

    small = reduce_model(rig, 30.0, tolerance=0.01)
    small.bound                      # (n_sensor, n_actuator), SI: |H - H_small| up to 30 Hz
    small.to_statespace()            # python-control

Starts from the partial fractions of `realise`, sensor filters included, hold, delays and dead
times not.
Poles at s = 0 (a velocity source integrates) are split off and kept as they are. The stable
rest is either

- balanced and truncated: the error at every frequency is at most twice the sum of the Hankel
  singular values left out (Glover 1984; Enns 1984), here of the outputs each over its largest
  response in the band; or
- cut by modes: poles above the band are replaced by their static answer, and the bound is the
  sum of what each of them does in the band less that.

What the partial fractions themselves leave out is measured against the transfer matrices on a
grid with points around every resonance, and added.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import solve_continuous_lyapunov

from samii_rig.errors import InputError
from samii_rig.model.realise import ERROR_LOW, Realisation, realise
from samii_rig.model.sampled import filter_response, immediate
from samii_rig.model.tmm import Chain
from samii_rig.rig.schema import Rig
from samii_rig.types import Complex, Float

if TYPE_CHECKING:
    from control import StateSpace

TOLERANCE = 0.01  # default bound over each output's largest response in the band
GRID = 1500  # frequencies at which the remainder is measured, beside those around resonances
AROUND = np.linspace(-3.0, 3.0, 13)  # half widths of a resonance at which it is measured too
INTEGRATES = 1e-6  # rad/s, a pole of smaller modulus is one at s = 0
# Hankel singular values below this, over the largest, are rounding of the Gramians.
ROUNDING = 1e-10

Method = Literal["balanced", "modal"]


@dataclass(frozen=True, slots=True)
class ReducedModel:
    """x' = A x + B u, y = C x + D u; real, SI units, inputs in actuator units.

    integrators : states at s = 0, the first ones. hankel : (n,) Hankel singular values of the
        stable part, outputs scaled by 1/`scale`; empty for the modal method.
    scale : (n_out,) largest response of the stable part in the band.
    truncation : (n_out, n_in) bound on the error of leaving states out; over all frequencies
        if balanced, in the band if modal. remainder : (n_out, n_in) largest deviation measured in
        the band of the partial fractions from the transfer matrices.
    low_hz, high_hz : the band.
    """

    A: Float
    B: Float
    C: Float
    D: Float
    integrators: int
    hankel: Float
    scale: Float
    truncation: Float
    remainder: Float
    low_hz: float
    high_hz: float
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]

    @property
    def order(self) -> int:
        """Number of states, integrators included."""
        return len(self.A)

    @property
    def bound(self) -> Float:
        """(n_out, n_in) bound on |H - H_reduced| in the band."""
        return self.truncation + self.remainder

    def response(self, frequency_hz: ArrayLike) -> Complex:
        """(n_freq, n_out, n_in), sensor filters included."""
        s = 2j * np.pi * np.atleast_1d(np.asarray(frequency_hz, dtype=np.float64))
        states = np.linalg.solve(s[:, None, None] * np.eye(self.order) - self.A, self.B + 0j)
        return np.asarray(self.C @ states + self.D)

    def to_statespace(self) -> StateSpace:
        """The model as `control.StateSpace`, inputs and outputs named."""
        import control  # takes a second, and most uses of a model need it not

        names = {"inputs": list(self.inputs), "outputs": list(self.outputs)}
        return control.ss(self.A, self.B, self.C, self.D, **names)


def reduce_model(
    rig: Rig,
    high_hz: float,
    *,
    order: int | None = None,
    tolerance: float = TOLERANCE,
    method: Method = "balanced",
    realisation: Realisation | None = None,
) -> ReducedModel:
    """The reduced model of a rig for frequencies up to high_hz.

    order : states of the stable part to keep if balanced; default the fewest with a truncation
        bound of at most `tolerance` of each output's largest response in the band. The modal
        method takes neither: it keeps the poles up to high_hz.
    realisation : that of `rig`, if it is known already.

    Raises InputError for a band that does not lie within what `realise` judges (up to half the
    rate), an order or tolerance that cannot be met, and as `realise` does.
    """
    low_hz, top = ERROR_LOW * rig.rate_hz, rig.rate_hz / 2
    if not low_hz < high_hz <= top:
        expected = f"more than {low_hz:g} Hz, at most half the rate, {top:g} Hz"
        raise InputError("reduction", "high_hz", high_hz, expected)
    full = realise(rig) if realisation is None else realisation
    f = _grid(full, low_hz, high_hz)
    exact = Chain(immediate(rig)).response(f)
    for i, sensor in enumerate(rig.sensor):
        exact[:, i] *= filter_response(sensor, np.asarray(2j * np.pi * f))[:, None]
    remainder = np.max(np.abs(full.response(f) - exact), axis=0)
    still = np.abs(full.poles) < INTEGRATES
    stable = replace(full, poles=full.poles[~still], residues=full.residues[~still])
    scale = np.max(np.abs(stable.response(f)), axis=(0, 2))
    scale = np.where(scale > 0, scale, 1.0)
    hankel = np.zeros(0)
    if method == "modal":
        (A, B, C, D), truncation = _modal(stable, f, high_hz)
    else:
        (A, B, C, D), truncation, hankel = _balanced(stable, scale, order, tolerance)
    residue = full.residues[still].real.sum(axis=0)
    A0, B0, C0 = _integrators(residue)
    n = len(A0)
    return ReducedModel(
        np.block([[A0, np.zeros((n, len(A)))], [np.zeros((len(A), n)), A]]),
        np.vstack([B0, B]),
        np.hstack([C0, C]),
        D,
        n,
        hankel,
        scale,
        truncation,
        remainder,
        low_hz,
        high_hz,
        tuple(a.name for a in rig.actuator),
        tuple(s.name for s in rig.sensor),
    )


StateMatrices = tuple[Float, Float, Float, Float]


def _integrators(residue: Float) -> tuple[Float, Float, Float]:
    """residue/s by as many integrators as it has rank."""
    U, size, Vh = np.linalg.svd(residue)
    n = int(np.sum(size > 1e-12 * size[0])) if size[0] > 0 else 0
    return np.zeros((n, n)), Vh[:n], U[:, :n] * size[:n]


def _balanced(
    stable: Realisation, scale: Float, order: int | None, tolerance: float
) -> tuple[StateMatrices, Float, Float]:
    """Square root method: reduced matrices, truncation bound, Hankel singular values."""
    A, B, C, D = stable.state_space()
    # Each state as large at the input as at the output, so that the Gramians are well scaled.
    C = C / scale[:, None]
    gain = np.sqrt(
        _of_pairs(A, np.linalg.norm(C, axis=0)) / _of_pairs(A, np.linalg.norm(B, axis=1))
    )
    B, C = B * gain[:, None], C / gain
    root_c = _root(np.asarray(solve_continuous_lyapunov(A, -B @ B.T), dtype=np.float64))
    root_o = _root(np.asarray(solve_continuous_lyapunov(A.T, -C.T @ C), dtype=np.float64))
    U, hankel, Vh = np.linalg.svd(root_o.T @ root_c)
    known = int(np.sum(hankel > ROUNDING * hankel[0]))
    tails = 2 * (hankel.sum() - np.concatenate([[0.0], np.cumsum(hankel)]))
    if order is None:
        enough = np.flatnonzero(tails[: known + 1] <= tolerance)
        if not enough.size:
            raise InputError("reduction", "tolerance", tolerance, f"at least {tails[known]:.2g}")
        order = int(enough[0])
    if not 0 <= order <= known:
        raise InputError("reduction", "order", order, f"0 to {known} states")
    weight = np.sqrt(hankel[:order])
    T = root_c @ Vh[:order].T / weight
    back = (U[:, :order] / weight).T @ root_o.T
    bound = np.broadcast_to(tails[order] * scale[:, None], D.shape).copy()
    return (back @ A @ T, back @ B, scale[:, None] * (C @ T), D), bound, hankel


def _of_pairs(A: Float, size: Float) -> Float:
    """`size` of each state, that of both in a 2 x 2 block alike, none 0."""
    first = np.flatnonzero(np.diag(A, -1))
    out = size.copy()
    out[first] = out[first + 1] = np.hypot(size[first], size[first + 1])
    return np.where(out > 0, out, 1.0)


def _root(gramian: Float) -> Float:
    """L with L L^T = gramian; rounding may leave it slightly indefinite."""
    values, vectors = np.linalg.eigh((gramian + gramian.T) / 2)
    return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0)))


def _modal(stable: Realisation, f: Float, high_hz: float) -> tuple[StateMatrices, Float]:
    """Poles up to the band's edge; the others as their static answer."""
    left = np.abs(stable.poles) > 2 * np.pi * high_hz
    s = np.asarray(2j * np.pi * f, dtype=np.complex128)
    direct = stable.direct.copy()
    bound = np.zeros((f.size, *direct.shape))
    for p, R in zip(stable.poles[left], stable.residues[left], strict=True):
        term = (
            R / (s - p)[:, None, None]
            + (p.imag > 0) * R.conj() / (s - p.conjugate())[:, None, None]
        )
        static = -((1 + (p.imag > 0)) * (R / p)).real
        direct += static
        bound += np.abs(term - static)
    kept = replace(
        stable, poles=stable.poles[~left], residues=stable.residues[~left], direct=direct
    )
    return kept.state_space(), np.max(bound, axis=0)


def _grid(full: Realisation, low_hz: float, high_hz: float) -> Float:
    """Frequencies even on a logarithmic axis, and around every resonance."""
    p = full.poles[full.poles.imag > 0]
    around = (p.imag[:, None] + np.abs(p.real)[:, None] * AROUND) / (2 * np.pi)
    f = np.union1d(np.geomspace(low_hz, high_hz, GRID), around.ravel())
    return f[(f >= low_hz) & (f <= high_hz)]
