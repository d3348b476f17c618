"""A joint with a fractional damper c s^alpha beside its spring, between a spring and a dashpot.

No element of the chain is one. But every response is a Moebius function of the joint's own
z = k + c_0 s + x, so that three evaluations of the chain, at x = 0 and at two dashpots x_1 and x_2,
give it at any x, exactly (`moebius`):

    H(x) = a + b x/(1 - d x),    g_i = (H(x_i) - a)/x_i,    d = (R - 1)/(R x_1 - x_2),  R = g_1/g_2,
    b = g_1 (1 - d x_1).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from samii_rig.model.tmm import Chain
from samii_rig.rig.schema import Key
from samii_rig.types import Complex, Float

DASHPOT_RATIO = 10.0  # between the two dashpots: far enough for R, near enough for both to be seen


class ChainLike(Protocol):
    """What a model asks of a chain; all as of `samii_rig.model.tmm.Chain`."""

    parameters: tuple[Key, ...]

    @property
    def plain(self) -> Chain:
        """The chain itself."""
        ...

    def values(self) -> Float:
        """Of `parameters`."""
        ...

    def with_values(self, values: Mapping[Key, float]) -> ChainLike:
        """With other parameters."""
        ...

    def response(self, frequency_hz: Float) -> Complex:
        """(n, n_out, n_in)."""
        ...

    def evaluate(self, s: Complex) -> Complex:
        """The same at s."""
        ...

    def gradient(self, frequency_hz: Float, wrt: Sequence[Key]) -> tuple[Complex, Complex]:
        """`response`, and its derivatives (n, n_out, n_in, n_param)."""
        ...

    def gradient_at(self, s: Complex, wrt: Sequence[Key]) -> tuple[Complex, Complex]:
        """The same at s."""
        ...


@dataclass(frozen=True, slots=True)
class Joint:
    """A fractional damper beside the spring of this name.

    c (N m or N) s^alpha, alpha between 0 and 1. dashpot : N m s or N s a metre, of the size at
    which one there begins to matter.
    """

    name: str
    dashpot: float

    @property
    def keys(self) -> tuple[Key, Key]:
        """Of its two parameters, which the chain itself does not have."""
        return (self.name, "c_alpha"), (self.name, "alpha")


class FractionalChain:
    """As `Chain`, with a fractional damper at one joint."""

    def __init__(self, chain: ChainLike, joint: Joint, c: float = 0.0, alpha: float = 0.5) -> None:
        self._chain, self._joint, self._c, self._alpha = chain, joint, c, alpha
        self.parameters = (*chain.parameters, *joint.keys)

    @property
    def plain(self) -> Chain:
        """The chain without it."""
        return self._chain.plain

    def values(self) -> Float:
        """As of `Chain`."""
        return np.append(self._chain.values(), [self._c, self._alpha])

    def with_values(self, values: Mapping[Key, float]) -> FractionalChain:
        """As of `Chain`."""
        c, alpha = self._joint.keys
        chain = self._chain.with_values({k: v for k, v in values.items() if k not in (c, alpha)})
        own = values.get(c, self._c), values.get(alpha, self._alpha)
        return FractionalChain(chain, self._joint, *own)

    def response(self, frequency_hz: Float) -> Complex:
        """As of `Chain`."""
        return self.evaluate(np.asarray(2j * np.pi * frequency_hz, np.complex128))

    def evaluate(self, s: Complex) -> Complex:
        """As of `Chain`."""
        return self._joined(s, ())[0]

    def gradient(self, frequency_hz: Float, wrt: Sequence[Key]) -> tuple[Complex, Complex]:
        """As of `Chain`."""
        return self.gradient_at(np.asarray(2j * np.pi * frequency_hz, np.complex128), wrt)

    def gradient_at(self, s: Complex, wrt: Sequence[Key]) -> tuple[Complex, Complex]:
        """As of `Chain`."""
        return self._joined(s, wrt)

    def _joined(self, s: Complex, wrt: Sequence[Key]) -> tuple[Complex, Complex]:
        """H (n, n_out, n_in) and its derivatives (..., n_param)."""
        inner = [k for k in wrt if k not in self._joint.keys]
        a, da = self._at(0.0, s, inner)
        g, dg, xs = [], [], []
        for share in (DASHPOT_RATIO**-0.5, DASHPOT_RATIO**0.5):
            more = share * self._joint.dashpot
            H, dH = self._at(more, s, inner)
            x = (more * s)[:, None, None]
            xs.append(more * s)
            g.append((H - a) / x)
            dg.append((dH - da) / x[..., None])
        rows = np.arange(s.size)
        flat = [y.reshape(s.size, -1) for y in g]
        at = np.argmax(np.abs(flat[0]), axis=1)  # the entry that moves most
        one, two = (y[rows, at] for y in flat)
        d_one, d_two = (y.reshape(s.size, g[0][0].size, -1)[rows, at] for y in dg)
        R = np.divide(one, two, out=np.ones_like(one), where=two != 0)
        dR = np.divide(
            d_one - R[:, None] * d_two, two[:, None], out=np.zeros_like(d_one),
            where=two[:, None] != 0,
        )  # fmt: skip
        below = R * xs[0] - xs[1]
        # Where nothing moves both are rounding, and d is none.
        some = below != 0
        d = np.divide(R - 1, below, out=np.zeros_like(R), where=some)
        turn = np.divide(xs[0] - xs[1], below**2, out=np.zeros_like(R), where=some)
        dd = dR * turn[:, None]
        x = self._c * s**self._alpha
        phi = x / (1 - d * x)
        by_x = 1 / (1 - d * x) ** 2
        left = 1 - d * xs[0]
        b = g[0] * left[:, None, None]
        H = a + b * phi[:, None, None]
        db = (
            dg[0] * left[:, None, None, None]
            - g[0][..., None] * (dd * xs[0][:, None])[:, None, None]
        )
        own = (
            da
            + db * phi[:, None, None, None]
            + b[..., None] * (dd * (x**2 * by_x)[:, None])[:, None, None]
        )
        out = np.zeros((*H.shape, len(wrt)), complex)
        out[..., [i for i, k in enumerate(wrt) if k not in self._joint.keys]] = own
        slopes = (s**self._alpha, x * np.log(s))
        for key, slope in zip(self._joint.keys, slopes, strict=True):
            if key in wrt:
                out[..., list(wrt).index(key)] = b * (by_x * slope)[:, None, None]
        return H, out

    def _at(self, more: float, s: Complex, wrt: Sequence[Key]) -> tuple[Complex, Complex]:
        """With a dashpot `more` at the joint."""
        key = (self._joint.name, "c")
        own = float(self._chain.values()[self._chain.parameters.index(key)])
        chain = self._chain.with_values({key: own + more})
        if wrt:
            return chain.gradient_at(s, wrt)
        H = chain.evaluate(s)
        return H, np.zeros((*H.shape, 0), complex)
