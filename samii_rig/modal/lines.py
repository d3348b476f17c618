"""The lines of one frequency response that modes are estimated from, in noise units."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from samii_rig.errors import EstimateError, InputError
from samii_rig.rig.schema import Rig
from samii_rig.signal.whitening import Fit, factor, goodness, root, shared_lines
from samii_rig.types import Complex, Float, FrequencyResponse

LEAST_LINES = 8  # a pair of poles and what lies beyond the band take 7 real numbers an entry


@dataclass(frozen=True, slots=True)
class Lines:
    """One response within a band.

    frequency : (n,) Hz. G : (n, p) the response, entry by entry (output, then input), hold,
        filters and delays divided out where the rig file gives them. seen : (n, p) these.
    outputs, inputs : names; p = n_out n_in.
    s : (n,) j omega over `scale`, rad/s. W : (n, p, p) weights: chi-square is sum e^H W e.
    root : (n, p, p) root^H root = C^-1 of G. sd : (n, p) standard deviation of G.
    dof : (n,). shared : lines that share one covariance, and one estimate.
    divided : what was divided out, in words.
    """

    response: FrequencyResponse
    frequency: Float
    G: Complex
    seen: Complex
    outputs: tuple[str, ...]
    inputs: tuple[str, ...]
    s: Complex
    scale: float
    W: Complex
    root: Complex
    sd: Float
    dof: Float
    shared: tuple[float, float]
    divided: str

    @property
    def p(self) -> int:
        """Entries a line."""
        return int(self.G.shape[1])

    @property
    def independent(self) -> float:
        """Lines that share no data."""
        return len(self.frequency) / self.shared[1]

    def thinned(self, most: int) -> Lines:
        """Every so many lines, so that no more than about `most` are left."""
        step = max(1, len(self.frequency) // most)
        if step == 1:
            return self
        names = ("frequency", "G", "seen", "s", "W", "root", "sd", "dof")
        fewer = {name: getattr(self, name)[::step] for name in names}
        shared = tuple(max(1.0, x / step) for x in self.shared)
        return replace(self, **fewer, shared=(shared[0], shared[1]))

    def fit(self, model: Complex, n_free: int) -> Fit:
        """Chi-square of `model` (n, p), a model of G with `n_free` real parameters."""
        t2 = np.sum(np.abs(self.root @ (model - self.G)[:, :, None]) ** 2, axis=(1, 2))
        return goodness([self], [t2], n_free)


def lines_of(
    response: FrequencyResponse,
    rig: Rig | None = None,
    band: tuple[float, float] | None = None,
    outputs: Sequence[str] | None = None,
) -> Lines:
    """The lines of `response` in `band` (Hz) and of `outputs`.

    Raises InputError for an unknown output or a band without lines; EstimateError for too few
    lines, too few degrees of freedom, or a covariance that is none.
    """
    names = [c.name for c in response.outputs]
    for name in outputs or ():
        if name not in names:
            raise InputError("modes", "--output", name, f"one of {', '.join(names)}")
    f = response.frequency
    low, high = band or (0.0, np.inf)
    # Half the sample rate: beyond it there are aliases alone.
    use = (f > 0) & (f >= low) & (f <= min(high, response.rate_hz / 2))
    if not use.any():
        shown = f"a band that meets {f[0]:.4g} to {f[-1]:.4g} Hz, which was measured"
        raise InputError("modes", "--band", band, shown)
    chosen = [i for i, name in enumerate(names) if outputs is None or name in outputs]
    n_in = len(response.inputs)
    entries = np.array([i * n_in + j for i in chosen for j in range(n_in)])
    C = response.covariance[:, entries[:, None], entries[None, :]]
    H = response.H.reshape(len(f), -1)[:, entries]
    use &= np.isfinite(H).all(axis=1) & np.isfinite(C).all(axis=(1, 2))
    if use.sum() < LEAST_LINES:
        raise EstimateError(
            f"{int(use.sum())} lines are too few for modes; {LEAST_LINES} would do for one"
        )
    seen, divided = _seen(response, rig, [names[i] for i in chosen], f[use])
    return _whitened(response, use, H[use] / seen, C[use], seen, chosen, divided)


def _whitened(
    response: FrequencyResponse,
    use: np.ndarray,
    G: Complex,
    C: Complex,
    seen: Complex,
    chosen: Sequence[int],
    divided: str,
) -> Lines:
    f, dof = response.frequency[use], response.dof[use]
    sharing = shared_lines(response)
    half = root(C) * seen[:, None, :]
    factors = factor(dof, G.shape[1]) / sharing[1]
    # chi-square counts real numbers of variance 1: the real and the imaginary part have C/2 each.
    W = 2 * factors[:, None, None] * (half.conj().transpose(0, 2, 1) @ half)
    scale = 2 * np.pi * float(np.sqrt(f[0] * f[-1]))
    return Lines(
        response=response,
        frequency=f,
        G=G,
        seen=seen,
        outputs=tuple(response.outputs[i].name for i in chosen),
        inputs=tuple(c.name for c in response.inputs),
        s=np.asarray(2j * np.pi * f / scale),
        scale=scale,
        W=W,
        root=half,
        sd=np.sqrt(np.diagonal(C, axis1=1, axis2=2).real) / np.abs(seen),
        dof=dof,
        shared=sharing,
        divided=divided,
    )


def _seen(
    response: FrequencyResponse, rig: Rig | None, outputs: Sequence[str], f: Float
) -> tuple[Complex, str]:
    """(n, p) what the rig file says lies between chain and numbers, and that in words."""
    n_in = len(response.inputs)
    seen = np.ones((f.size, len(outputs), n_in), dtype=np.complex128)
    if rig is None:
        return seen.reshape(f.size, -1), "nothing divided out: no rig file"
    from samii_rig.model.sampled import given_response, sensor_response  # loads the compiler

    sensors = {s.name: s for s in rig.sensor}
    actuators = {a.name: a for a in rig.actuator}
    said = []
    for j, channel in enumerate(response.inputs):
        if channel.name in actuators:
            actuator = actuators[channel.name]
            seen[:, :, j] *= given_response(actuator, f, response.rate_hz)[:, None]
            said.append(f"the {'hold' if actuator.held else 'delay'} of {channel.name}")
    known = [name for name in outputs if name in sensors]
    for i, name in enumerate(outputs):
        if name in sensors:
            seen[:, i] *= sensor_response([sensors[name]], f)
    if known:
        said.append(f"filters and delays of {', '.join(known)}")
    text = f"divided out: {' and '.join(said)}" if said else "nothing divided out"
    return seen.reshape(f.size, -1), text
