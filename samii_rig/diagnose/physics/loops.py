"""Proportional loops of the device, closed around the response of a rig."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from samii_rig.types import Complex, Float


@dataclass(frozen=True, slots=True)
class Loop:
    """A proportional loop of the device, v = r - kp y of one entry, closed around the rig."""

    kp: float
    entry: int

    def part(self, H: Complex, b: Complex) -> tuple[Complex, Complex]:
        """b (n, q) and c (n,) around which a part is closed that changes H by b x:
        H + b x becomes, closed, H/(1 + L) + b' x/(1 - c x)."""
        sensitivity = 1 / (1 + self.kp * H[:, self.entry])
        back = self.kp * b[:, self.entry] * sensitivity
        return sensitivity[:, None] * (b - back[:, None] * H), -back

    def closed(self, H: Complex) -> Complex:
        """(n, q) to the reference from those to the command."""
        return np.asarray(H / (1 + self.kp * H[:, self.entry])[:, None])

    def slopes(self, H: Complex, dH: Complex) -> Complex:
        """(n, q, m) derivatives of `closed`."""
        sensitivity = 1 / (1 + self.kp * H[:, self.entry])
        back = self.kp * dH[:, self.entry, None, :] * self.closed(H)[:, :, None]
        return np.asarray(sensitivity[:, None, None] * (dH - back))

    def around(self, H: Complex, every: Complex) -> Complex:
        """(n, q, K) what the sensors show of every (n, q, K) that they would show without a loop.
        H : (n, q), closed."""
        return np.asarray(every - self.kp * H[:, :, None] * every[:, self.entry, None, :])


@dataclass(frozen=True, slots=True)
class JointLoops:
    """Proportional loops of a device of m inputs, v_j = r_j - kp_j y_i, closed around the rig.

    Entries (n, q m) are those of all inputs to the first sensor, then to the next. gain : (m, q)
    K with v = r - K y, so that H becomes H S with S = (I + K H)^-1.
    """

    gain: Float

    def _by_input(self, H: Complex) -> Complex:
        """(n, q, m, ...) of entries (n, q m, ...)."""
        m, q = self.gain.shape
        return H.reshape(len(H), q, m, *H.shape[2:])

    def _sensitivity(self, H: Complex) -> Complex:
        """S (n, m, m) of H (n, q, m), open."""
        return np.asarray(np.linalg.inv(np.eye(len(self.gain)) + self.gain @ H))

    def part(self, H: Complex, b: Complex) -> tuple[Complex, Complex]:
        """As of `Loop`. A part is of rank one, B = u w^T. By Sherman and Morrison H + B x becomes,
        closed, H S + (I - H S K) B S x/(1 + tr(S K B) x)."""
        G, B = self._by_input(H), self._by_input(b)
        S = self._sensitivity(G)
        BS = B @ S
        turned = BS - G @ S @ (self.gain @ BS)
        c = -np.trace(S @ (self.gain @ B), axis1=1, axis2=2)
        return np.asarray(turned.reshape(b.shape)), np.asarray(c)

    def closed(self, H: Complex) -> Complex:
        """(n, q m) to the references from those to the commands."""
        G = self._by_input(H)
        return np.asarray((G @ self._sensitivity(G)).reshape(H.shape))

    def slopes(self, H: Complex, dH: Complex) -> Complex:
        """(n, q m, k) derivatives of `closed`: (I - H S K) dH S."""
        G = self._by_input(H)
        S = self._sensitivity(G)
        own = np.moveaxis(self._by_input(dH), 3, 1) @ S[:, None]
        out = own - (G @ S)[:, None] @ (self.gain @ own)
        return np.asarray(np.moveaxis(out, 1, 3).reshape(dH.shape))

    def around(self, H: Complex, every: Complex) -> Complex:
        """As of `Loop`: (I + H K)^-1 = I - H S K."""
        return np.asarray(every - self._by_input(H) @ (self.gain @ every))


Closed = Loop | JointLoops
