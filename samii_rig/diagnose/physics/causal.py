"""A beam whose loss factor is causal: its stiffness rises with frequency, as it must.

A stiffness EI (1 + j eta) with both numbers constant would answer before it is asked. The
nearest law that does not has a modulus that grows by 2 eta/pi for every factor e of frequency
(`samii_rig.model.damping`), so that a chain whose beam is missing its loss is also out of tune.
The chain is evaluated at the stiffness of a few nodes, and in between by the two next to each
frequency: exact to second order in what the stiffness changes from one node to the next, which
is small against the width of any mode that such a beam has.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from samii_rig.model.tmm import Chain
from samii_rig.rig.schema import Key
from samii_rig.types import Complex, Float, Int

# Of the logarithm of frequency, between nodes: a lightly damped mode is off by 5e-5; three times as
# far, by 1e-3, which a low noise takes for another loss.
SPACING = 0.1
RISE = 2 / math.pi  # of the logarithm of stiffness by that of frequency, over eta
STIFFNESS = ("EI", "GA")


class CausalChain:
    """As `Chain`, with the stiffness of `beams` as in the file at `middle_hz`."""

    def __init__(self, chain: Chain, beams: tuple[str, ...], middle_hz: float) -> None:
        self.plain: Chain = chain
        self._beams, self._middle = beams, middle_hz
        self.parameters = chain.parameters
        self._at = {key: i for i, key in enumerate(chain.parameters)}

    def values(self) -> Float:
        """As of `Chain`."""
        return self.plain.values()

    def with_values(self, values: Mapping[Key, float]) -> CausalChain:
        """As of `Chain`."""
        return CausalChain(self.plain.with_values(values), self._beams, self._middle)

    def response(self, frequency_hz: Float) -> Complex:
        """As of `Chain`."""
        return self.evaluate(np.asarray(2j * np.pi * frequency_hz, np.complex128))

    def evaluate(self, s: Complex) -> Complex:
        """As of `Chain`."""
        out: Complex | None = None
        for _, chain, on, weight in self._nodes(s):
            H = chain.evaluate(s[on])
            if out is None:
                out = np.zeros((s.size, *H.shape[1:]), complex)
            out[on] += weight[:, None, None] * H
        assert out is not None
        return out

    def gradient(self, frequency_hz: Float, wrt: Sequence[Key]) -> tuple[Complex, Complex]:
        """As of `Chain`."""
        return self.gradient_at(np.asarray(2j * np.pi * frequency_hz, np.complex128), wrt)

    def gradient_at(self, s: Complex, wrt: Sequence[Key]) -> tuple[Complex, Complex]:
        """As of `Chain`."""
        keys = list(wrt)
        given = self.plain.values()
        stiff = [(b, s) for b in self._beams for s in STIFFNESS if (b, s) in self._at]
        every = (*keys, *(k for k in stiff if k not in keys))
        out: tuple[Complex, Complex] | None = None
        for log, chain, on, weight in self._nodes(s):
            H, dH = chain.gradient_at(s[on], every)
            for b, name in stiff:
                i = every.index((b, name))
                ratio = math.exp(RISE * given[self._at[b, "eta"]] * log)
                slope = dH[:, :, :, i] * ratio
                dH[:, :, :, i] = slope
                if (b, "eta") in keys:
                    dH[:, :, :, keys.index((b, "eta"))] += (
                        slope * given[self._at[b, name]] * RISE * log
                    )
            if out is None:
                n = s.size
                shape = dH.shape[1:3]
                out = np.zeros((n, *shape), complex), np.zeros((n, *shape, len(keys)), complex)
            out[0][on] += weight[:, None, None] * H
            out[1][on] += weight[:, None, None, None] * dH[:, :, :, : len(keys)]
        assert out is not None
        return out

    def _nodes(self, s: Complex) -> Iterator[tuple[float, Chain, Int, Float]]:
        """Of each node ln(f/middle), the chain, the frequencies it counts at and how much."""
        log = np.log(np.abs(s) / (2 * math.pi * self._middle))
        low, high = float(np.min(log)), float(np.max(log))
        nodes = np.linspace(low, high, max(2, math.ceil((high - low) / SPACING) + 1))
        step = max(nodes[1] - nodes[0], 1e-12)
        values = self.plain.values()
        for node in nodes:
            weight = 1 - np.abs(log - node) / step
            on = np.flatnonzero(weight > 0)
            if on.size == 0:
                continue
            changed = {
                (b, s): values[self._at[b, s]] * math.exp(RISE * values[self._at[b, "eta"]] * node)
                for b in self._beams
                for s in STIFFNESS
                if (b, s) in self._at
            }
            yield float(node), self.plain.with_values(changed), on, weight[on]
