"""The stabilisation diagram: poles over model orders, and which of them stay where they are.

A physical pole comes back at every order that is large enough, with its frequency, damping and
shape; one that stands for noise wanders. Poles that come back are linked from order to order,
and each chain of links is one candidate. No person is needed; who wants to choose may pick.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum

import numpy as np

from samii_rig.errors import InputError
from samii_rig.modal.lines import Lines
from samii_rig.modal.plscf import Coefficients, poles_by_order
from samii_rig.modal.rational import functions
from samii_rig.types import Complex, Float

# The field's usual limits of what counts as unchanged from one order to the next.
SAME_FREQUENCY = 0.01  # relative
SAME_DAMPING = 0.05  # relative
SAME_SHAPE = 0.95  # MAC
# |difference| of two damping ratios that no resonance curve shows: rounding of tiny ones.
DAMPING_FLOOR = 5e-4
LEAST_ORDERS = 4  # a chain of links of fewer is chance
MOST_ORDER = 40  # of the polynomials; 20 modes in a band are many
SHAPE_LINES = 400  # lines the shapes of the diagram are taken from
PICK_NEAR = 0.05  # how far a pole may be from the frequency that was picked, relative


class Stability(IntEnum):
    """What of a pole is as it was at the order before."""

    NEW = 0
    FREQUENCY = 1
    DAMPING = 2  # and frequency
    SHAPE = 3  # and both


@dataclass(frozen=True, slots=True)
class Diagram:
    """Every pole of every order.

    order : (m,). pole : (m,) rad/s, Im > 0. stability : (m,) of `Stability`.
    chain : (m,) which candidate a pole belongs to, -1 for none.
    candidates : (k,) one pole a chain, rad/s: its median, by frequency.
    orders : of each candidate, how many orders show it stable. coefficients : of the polynomials.
    """

    order: np.ndarray
    pole: Complex
    stability: np.ndarray
    chain: np.ndarray
    candidates: Complex
    orders: np.ndarray
    coefficients: Coefficients

    @property
    def hz(self) -> Float:
        """(m,) |pole|/(2 pi)."""
        return np.asarray(np.abs(self.pole) / (2 * np.pi))

    @property
    def damping(self) -> Float:
        """(m,) damping ratio -Re/|pole|."""
        return np.asarray(-self.pole.real / np.abs(self.pole))

    def pick(self, hz: Sequence[float]) -> Complex:
        """The candidate next to each frequency (Hz), or the highest order's pole if none is near.

        Raises InputError where the diagram has no pole within 5 %, or two picks are one pole.
        """
        out: list[complex] = []
        for f in hz:
            chosen = _nearest(self.candidates, f)
            if chosen is None:
                chosen = _nearest(self.pole[self.order == self.order.max(initial=0)], f)
            if chosen is None:
                near = ", ".join(f"{abs(p) / 2 / np.pi:.4g}" for p in self.candidates) or "none"
                raise InputError("--pick", "", f, f"a frequency next to a pole in Hz: {near}")
            if chosen in out:
                raise InputError("--pick", "", list(hz), f"one frequency for each pole ({f:g} Hz)")
            out.append(chosen)
        return np.array(out, dtype=np.complex128)


def _nearest(poles: Complex, hz: float) -> complex | None:
    if not poles.size:
        return None
    off = np.abs(np.abs(poles) / (2 * np.pi) - hz)
    best = int(np.argmin(off))
    return complex(poles[best]) if off[best] <= PICK_NEAR * hz else None


def diagram(d: Lines, coefficients: Coefficients = "real", most: int = MOST_ORDER) -> Diagram:
    """The diagram of the lines `d`, orders 1 to as many as they allow."""
    n_in = len(d.inputs)
    most = max(2, min(most, int(d.independent) // 4))
    H = d.G.reshape(len(d.frequency), -1, n_in)
    sd = np.sqrt(np.mean(d.sd.reshape(H.shape) ** 2, axis=2))
    found = poles_by_order(d.frequency, H, sd, range(1, most + 1), coefficients)
    order = np.concatenate([np.full(p.size, n, dtype=np.int64) for n, p in enumerate(found, 1)])
    stability: list[np.ndarray] = []
    before: list[np.ndarray] = []  # index of the pole of the order before, -1 for none
    last, last_shapes, first = np.zeros(0, complex), np.zeros((0, d.p), complex), 0
    for poles in found:
        shapes = _shapes(d, poles)
        state, link = _compared(poles, shapes, last, last_shapes)
        stability.append(state)
        before.append(np.where(link >= 0, link + first - last.size, -1))
        first, last, last_shapes = first + poles.size, poles, shapes
    pole = np.concatenate(found)
    states, links = np.concatenate(stability), np.concatenate(before)
    chain, candidates, length = _chains(pole, states, links)
    return Diagram(order, pole, states, chain, candidates, length, coefficients)


def _shapes(d: Lines, poles: Complex) -> Complex:
    """(n_pole, p) residues over the noise, by least squares with one weight a line."""
    if not poles.size:
        return np.zeros((0, d.p), dtype=np.complex128)
    step = max(1, d.s.size // SHAPE_LINES)
    s, sd = d.s[::step], d.sd[::step]
    w = 1 / np.exp(np.log(sd).mean(axis=1))
    F = functions(s, poles / d.scale, np.zeros(0)) * w[:, None]
    G = d.G[::step] * w[:, None]
    A = np.concatenate([F.real, F.imag])
    size = np.linalg.norm(A, axis=0)
    c = np.linalg.lstsq(A / size, np.concatenate([G.real, G.imag]), rcond=None)[0]
    c = c / size[:, None]
    # Outputs of different units are made comparable by their noise.
    R = (c[0 : 2 * poles.size : 2] + 1j * c[1 : 2 * poles.size : 2]) / np.median(sd, axis=0)
    return np.asarray(R)


def _compared(
    poles: Complex, shapes: Complex, last: Complex, last_shapes: Complex
) -> tuple[np.ndarray, np.ndarray]:
    """`Stability` of each pole, and which of the order before it comes from (-1 for none)."""
    state = np.full(poles.size, Stability.NEW, dtype=np.int64)
    link = np.full(poles.size, -1, dtype=np.int64)
    if not (poles.size and last.size):
        return state, link
    f, before = np.abs(poles), np.abs(last)
    zeta, zeta_before = -poles.real / f, -last.real / before
    near = np.argmin(np.abs(poles[:, None] - last[None, :]), axis=1)
    same_f = np.abs(f - before[near]) <= SAME_FREQUENCY * f
    off = np.abs(zeta - zeta_before[near])
    same_zeta = same_f & (off <= np.maximum(SAME_DAMPING * np.abs(zeta), DAMPING_FLOOR))
    cross = np.abs(np.sum(shapes.conj() * last_shapes[near], axis=1)) ** 2
    sizes = np.sum(np.abs(shapes) ** 2, axis=1) * np.sum(np.abs(last_shapes[near]) ** 2, axis=1)
    same_shape = same_zeta & (cross >= SAME_SHAPE * sizes)
    state = same_f.astype(np.int64) + same_zeta + same_shape
    link = np.where(same_shape, near, -1)
    # Of two poles that come from the same one, the nearer is its heir.
    for parent in np.unique(link[link >= 0]):
        heirs = np.flatnonzero(link == parent)
        best = heirs[np.argmin(np.abs(poles[heirs] - last[parent]))]
        link[heirs[heirs != best]] = -1
    return state, link


def _chains(
    pole: Complex, state: np.ndarray, link: np.ndarray
) -> tuple[np.ndarray, Complex, np.ndarray]:
    """Chain of each pole, and the candidates: one pole and the number of orders of each chain.

    Chains that broke and went on at the same place are one candidate.
    """
    root = np.arange(pole.size)
    for k in range(pole.size):  # by increasing order: the parent's root is known
        if link[k] >= 0:
            root[k] = root[link[k]]
    chains = [np.flatnonzero(root == r) for r in np.unique(root)]
    chains = [c[state[c] == Stability.SHAPE] for c in chains]
    chains = sorted((c for c in chains if c.size), key=len, reverse=True)
    groups: list[np.ndarray] = []
    for c in chains:
        middle = _median(pole[c])
        for g, members in enumerate(groups):
            if _same(middle, _median(pole[members])):
                groups[g] = np.concatenate([members, c])
                break
        else:
            groups.append(c)
    groups = [g for g in groups if g.size >= LEAST_ORDERS]
    groups.sort(key=lambda g: abs(_median(pole[g])))
    chain = np.full(pole.size, -1, dtype=np.int64)
    for g, members in enumerate(groups):
        chain[members] = g
    return (
        chain,
        np.array([_median(pole[g]) for g in groups], dtype=np.complex128),
        np.array([g.size for g in groups], dtype=np.int64),
    )


def _median(poles: Complex) -> complex:
    return complex(np.median(poles.real), np.median(poles.imag))


def _same(a: complex, b: complex) -> bool:
    """Whether two places are one pole: both are within a third of the resonance's own width."""
    width = max(min(-a.real, -b.real), DAMPING_FLOOR * abs(a))
    return abs(a - b) < width / 3
