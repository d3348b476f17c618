"""Natural frequencies and poles of a rig, each list with the count that proves it complete.

    found = natural_frequencies(rig, 0.1, 200.0)       # without damping, sources held
    found.hz, found.count, found.proof
    damped = poles(rig, 200.0)                         # with damping
    damped.hz, damped.ratio, damped.proof

Paper 1, section II-A: the natural frequencies are the roots of the sub-determinant of the chain's
transfer matrix that the boundary conditions leave. They are counted by the argument principle,
on the imaginary axis by half a contour (`axis`), in the plane by boxes (`poles`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from samii_rig.errors import InputError
from samii_rig.model.axis import axis_zeros
from samii_rig.model.damping import CausalChain, relaxed_beams
from samii_rig.model.poles import Characteristic, PoleSet, find_poles
from samii_rig.model.realise import LOSS_LOW, search_region, source_poles
from samii_rig.model.tmm import Chain
from samii_rig.rig.schema import (
    SOURCES,
    LumpedLine,
    Rig,
    TorsionalSpring,
    TranslationalSpring,
    flattened,
)
from samii_rig.types import Complex, Float, Int

LOSSES = ("c", "eta", "tau", "R")  # parameters that turn energy into heat, or delay


@dataclass(frozen=True, slots=True)
class NaturalFrequencies:
    """Undamped natural frequencies in a band, sources held still.

    hz : (n,) increasing. multiplicity : (n,) of each. number : (n,) of each among all of the
        chain, 1 the lowest; motions without stiffness (0 Hz) and unstable ones count first.
    count : by the argument principle, equal to the sum of `multiplicity`.
    turn : by how many pi the phase of the determinant turned, before rounding to `count`.
    low_hz, high_hz : the band searched. below : natural frequencies under it.
    """

    hz: Float
    multiplicity: Int
    number: Int
    count: int
    turn: float
    low_hz: float
    high_hz: float
    below: int

    @property
    def proof(self) -> str:
        """Why none is missing, in words."""
        return (
            f"the phase of the determinant turns by {self.turn:.9f} pi around {self.low_hz:.6g} "
            f"to {self.high_hz:.6g} Hz: {self.count} natural frequencies, "
            f"{int(self.multiplicity.sum())} found; {self.below} lie below the band"
        )


@dataclass(frozen=True, slots=True)
class Poles:
    """Poles of the damped chain in a region of the s-plane.

    pole : (n,) rad/s, Im >= 0, by modulus; one with Im > 0 stands for its conjugate as well.
    multiplicity : (n,). own : the sources' poles, which are not the structure's and lie
        beside these: {actuator: (rad/s, ...)}, Im >= 0.
    found : the search, with its region and the count by the argument principle.
    """

    pole: Complex
    multiplicity: Int
    own: dict[str, tuple[complex, ...]]
    found: PoleSet

    @property
    def hz(self) -> Float:
        """(n,) |s|/(2 pi): the natural frequency of a pair, the corner of a real pole."""
        return np.asarray(np.abs(self.pole) / (2 * np.pi))

    @property
    def ratio(self) -> Float:
        """(n,) damping ratio -Re s/|s|: 1 for a real pole, negative for an unstable one."""
        return np.asarray(-self.pole.real / np.maximum(np.abs(self.pole), 1e-300))

    @property
    def oscillating(self) -> np.ndarray[tuple[int, ...], np.dtype[np.bool_]]:
        """(n,) whether a pole stands for a pair."""
        return np.asarray(self.pole.imag > 0)

    @property
    def proof(self) -> str:
        """Why none is missing, and what is left out, in words."""
        region = self.found.region
        pairs = int(self.oscillating @ self.multiplicity)
        real = int((~self.oscillating) @ self.multiplicity)
        text = (
            f"{self.found.count} zeros of the determinant counted where {region.left:.6g} <= Re s "
            f"<= {region.right:.6g} and |Im s| <= {region.top:.6g} rad/s, and as many found: "
            f"{pairs} pairs and {real} real poles"
        )
        if region.holes:
            shown = ", ".join(f"({low:.6g}, {high:.6g})" for low, high in region.holes)
            text += f"; left out are squares on {shown}, where poles gather without end"
        for name, own in self.own.items():
            places = ", ".join(f"{p.real:g}" if p.imag == 0 else f"{p:.6g}" for p in own)
            has = f"poles of its own at {places}" if places else "no pole of its own"
            text += f"; the source driven by {name} has {has}"
        return text


def natural_frequencies(model: Rig | Chain, low_hz: float, high_hz: float) -> NaturalFrequencies:
    """All natural frequencies between two frequencies (Hz), without damping.

    Every c, eta, tau and line resistance is taken as 0 and every source holds still: a source
    of motion is rigid, one of force is absent. An end of the band that lies on a natural
    frequency is moved outwards by at most a thousandth.

    Raises InputError for a band that is none or holds no root, and for a damper without
    a spring, which leaves nothing when its c is 0.
    """
    if not (np.isfinite([low_hz, high_hz]).all() and 0 < low_hz < high_hz):
        expected = "two frequencies above 0 Hz, the lower one first"
        raise InputError("natural frequencies", "band", (low_hz, high_hz), expected)
    chain = undamped(model)
    zeros = axis_zeros(determinant(chain), 2 * np.pi * low_hz, 2 * np.pi * high_hz)
    if zeros.count == 0:
        raise InputError.saying(
            chain.rig.name,
            "band",
            f"no natural frequency from {low_hz:g} to {high_hz:g} Hz; expected a band that holds "
            f"one ({zeros.below} lie below it)",
        )
    number = zeros.below + 1 + np.concatenate([[0], np.cumsum(zeros.multiplicity)[:-1]])
    return NaturalFrequencies(
        zeros.omega / (2 * np.pi),
        zeros.multiplicity,
        np.asarray(number, dtype=np.int64),
        zeros.count,
        zeros.turn,
        zeros.low / (2 * np.pi),
        zeros.high / (2 * np.pi),
        zeros.below,
    )


def poles(model: Rig | Chain, high_hz: float) -> Poles:
    """All poles of the damped chain with |Im s| and -Re s up to 2 pi high_hz.

    A beam's constant loss factor is replaced by its causal stand-in (`damping`). The poles of
    springs' laws at s = -k/c are none of the chain and are cleared from the determinant.

    Raises InputError for high_hz that is not above 0, or a region without poles.
    """
    if not (np.isfinite(high_hz) and high_hz > 0):
        raise InputError("poles", "high_hz", high_hz, "a frequency above 0 Hz")
    chain = model if isinstance(model, Chain) else Chain(model)
    rig = chain.rig
    found = find_poles(determinant(chain), search_region(rig, high_hz))
    if not found.count:
        raise InputError.saying(
            rig.name, "high_hz", f"no pole up to {high_hz:g} Hz; expected a band that holds one"
        )
    own = {a.name: own_poles(rig, a.name) for a in rig.actuator}
    return Poles(found.poles, found.multiplicity, own, found)


def causal(chain: Chain) -> Chain | CausalChain:
    """The chain with the causal stand-in of every beam that has a constant loss factor."""
    rig = chain.rig
    beams = relaxed_beams(rig, LOSS_LOW * rig.rate_hz, 0.5 * rig.rate_hz)
    return CausalChain(rig, beams) if beams else chain


def determinant(chain: Chain) -> Characteristic:
    """The characteristic function of a chain in the whole plane: causal, poles of laws cleared."""
    stand_in = causal(chain)

    def D(s: Complex) -> tuple[Complex, Float]:
        # The sources' laws, infinite at their own poles, are no part of D.
        with np.errstate(divide="ignore", invalid="ignore"):
            return stand_in.characteristic(s, clear=True)

    return D


def own_poles(rig: Rig, actuator: str) -> tuple[complex, ...]:
    """Poles (rad/s, conjugates included) of the laws of all sources of one actuator, each once."""
    driven = tuple(e for e in rig.element if isinstance(e, SOURCES) and e.input == actuator)
    upper = source_poles(rig.model_copy(update={"element": driven}))
    both = (q for p in upper for q in ((p, p.conjugate()) if p.imag > 0 else (p,)))
    return tuple(dict.fromkeys(both))


def undamped(model: Rig | Chain) -> Chain:
    """The chain with every c, eta, tau, resistance and damping ratio of a line 0.

    Raises InputError for a damper without a spring.
    """
    chain = model if isinstance(model, Chain) else Chain(model)
    for e in flattened(chain.rig.element):
        if isinstance(e, TorsionalSpring | TranslationalSpring) and e.k.value == 0:
            raise InputError(
                chain.rig.name, f"{e.name}.k", e.k.value,
                "more than 0: a damper alone has no undamped counterpart; poles() bears it",
            )  # fmt: skip
    lumps = [(e.name, "zeta") for e in chain.rig.element if isinstance(e, LumpedLine)]
    losses = {key: 0.0 for key in chain.parameters if key[1] in LOSSES or key in lumps}
    return chain.with_values(losses) if losses else chain
