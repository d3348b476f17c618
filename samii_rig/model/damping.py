"""A causal stand-in for a beam's constant loss factor.

A stiffness EI (1 + j eta) at all frequencies would answer before it is asked. The nearest
causal law is a series of relaxations (a generalised Maxwell solid),

    EI(s) = E0 [1 + sum_i a_i s/(s + b_i)],      a_i >= 0, b_i > 0,

fitted so that its loss factor is eta over a band. What comes with it is physics, not error:
the stiffness of such a beam rises with frequency, by 2 eta/pi for every factor e (0.6 % a
decade at eta = 0.004). E0 is chosen so that the real part is EI in the middle of the band.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np
from scipy.optimize import nnls

from samii_rig.errors import InputError
from samii_rig.model.tmm import Chain
from samii_rig.rig.schema import BEAMS, Rig, flattened
from samii_rig.types import Complex, Float

PER_DECADE = 2.0  # relaxations
OUTSIDE = 2.2  # factor by which the relaxations reach beyond the band on each side
LOSS_POINTS = 200  # frequencies of the fit
ALONE = 0.05  # half width around a zero without relaxation to its left (a viscous beam's)
EI, ETA, TAU, GA = 0, 3, 4, 5  # places among the beams' parameters; a Beam has 0 for GA


@dataclass(frozen=True, slots=True)
class Relaxations:
    """EI(s)/EI = scale [1 + sum a s/(s + b)] + s tau.

    a (n,), b (n,) rad/s. ripple : largest deviation of the loss factor from eta over the
    band, relative to eta.
    """

    scale: float
    a: Float
    b: Float
    tau: float
    ripple: float

    def modulus(self, s: Complex) -> Complex:
        """EI(s)/EI, (n_s,)."""
        below = s[:, None] + self.b
        below = np.where(below == 0, 1e-12 * self.b, below)  # infinitely stiff at s = -b
        series = np.sum(self.a * s[:, None] / below, axis=1)
        return np.asarray(self.scale * (1 + series) + s * self.tau)

    def zeros(self) -> Float:
        """(n_relaxation,) rad/s, where the modulus vanishes: negative, one by every relaxation."""
        poly = np.polynomial.Polynomial
        whole = poly.fromroots(-self.b)
        total = whole * poly([self.scale, self.tau])
        for i, a in enumerate(self.a):
            total += self.scale * a * poly([0.0, 1.0]) * poly.fromroots(np.delete(-self.b, i))
        return np.sort(total.roots().real)

    def holes(self) -> list[tuple[float, float]]:
        """Intervals of the real axis that hold all poles which accumulate at a zero.

        They lie where the modulus is small and negative: between a zero and the -b left of it.
        """
        poles = np.sort(-self.b)
        out = []
        for zero in self.zeros():
            left = poles[poles < zero]
            width = zero - left[-1] if left.size else ALONE * abs(zero)
            out.append((float(zero - 2 * width), float(zero + width)))
        return out


def fit_loss(eta: float, tau: float, low_hz: float, high_hz: float) -> Relaxations:
    """Relaxations whose loss factor is eta from low_hz to high_hz.

    With 2 a decade, over bands of 1.5 to 5 decades, the ripple stays below 0.4 % of eta for eta
    up to 0.05, 1.3 % up to 0.1 and 7.1 % up to 0.2: what loses much stiffens by so much that few
    relaxations no longer follow it, at the upper end first. `ripple` holds the one found.
    """
    decades = np.log10(high_hz / low_hz * OUTSIDE**2)
    n = max(2, int(np.ceil(PER_DECADE * decades)) + 1)
    b = 2 * np.pi * np.geomspace(low_hz / OUTSIDE, high_hz * OUTSIDE, n)
    w = 2 * np.pi * np.geomspace(low_hz, high_hz, LOSS_POINTS)
    terms = 1j * w[:, None] / (1j * w[:, None] + b)
    # Loss factor = Im/Re; the real part is not known before a, so repeat: it converges at once.
    real = np.ones(LOSS_POINTS)
    for _ in range(4):
        a = nnls(terms.imag / (eta * real)[:, None], np.ones(LOSS_POINTS))[0]
        real = 1 + terms.real @ a
    kept = a > 0
    a, b, terms = a[kept], b[kept], terms[:, kept]
    loss = (terms.imag @ a) / (1 + terms.real @ a)
    middle = 2j * np.pi * np.sqrt(low_hz * high_hz)
    scale = 1 / (1 + np.sum(a * middle / (middle + b)).real)
    return Relaxations(float(scale), a, b, tau, float(np.max(np.abs(loss / eta - 1))))


def relaxed_beams(rig: Rig, low_hz: float, high_hz: float) -> dict[str, Relaxations]:
    """The stand-in of every beam with a loss factor, by name.

    Raises InputError for one in a branch.
    """
    out = {}
    for e in flattened(rig.element):
        if isinstance(e, BEAMS) and e.eta.value > 0:
            if e not in rig.element:
                raise InputError(
                    rig.name, f"{e.name}.eta", e.eta.value, "0 in a branch, with tau instead"
                )
            out[e.name] = fit_loss(e.eta.value, e.tau.value, low_hz, high_hz)
    return out


class CausalChain:
    """A chain whose lossy beams have the relaxing stiffness instead, at any complex s.

    At one s any complex stiffness is one of the form EI (1 + j eta): the chain's own
    response, with EI and eta set anew for each s. Exact, but one call a point.
    """

    def __init__(self, rig: Rig, beams: Mapping[str, Relaxations]) -> None:
        # A chain of our own: its compiled parameters are written anew for each s.
        self._chain = Chain(rig)
        self._pars = self._chain._c.system.pars
        self._given = self._pars.copy()
        slots = self._chain._c.slots[:, EI]
        # A beam that carries a sensor counts as several elements.
        self._rows = [
            np.flatnonzero(slots == self._chain.parameters.index((name, "EI"))) for name in beams
        ]
        self._beams = list(beams.values())

    def evaluate(self, s: Complex) -> Complex:
        """As `Chain.evaluate`."""
        return np.concatenate([self._chain.evaluate(one) for one in self._points(s)])

    def characteristic(self, s: Complex, clear: bool = False) -> tuple[Complex, Float]:
        """As `Chain.characteristic`."""
        parts = [self._chain.characteristic(one, clear) for one in self._points(s)]
        return np.concatenate([m for m, _ in parts]), np.concatenate([x for _, x in parts])

    def _points(self, s: Complex) -> Iterator[Complex]:
        """Each s by itself, with the chain's parameters set for it."""
        moduli = [beam.modulus(s) for beam in self._beams]
        sign = np.where(s.imag < 0, -1.0, 1.0)  # the chain turns that of eta there
        for i in range(s.size):
            for rows, m in zip(self._rows, moduli, strict=True):
                for stiffness in (EI, GA):
                    self._pars[rows, stiffness] = self._given[rows, stiffness] * m[i].real
                self._pars[rows, ETA] = sign[i] * m[i].imag / m[i].real
                self._pars[rows, TAU] = 0.0
            yield s[i : i + 1]
