"""Measured responses in noise units (`signal.whitening`), by the channels of a rig."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from samii_rig.errors import InputError
from samii_rig.rig.schema import Rig
from samii_rig.signal.whitening import factor, mean_t2, root, shared_lines
from samii_rig.types import Complex, Float, FrequencyResponse, Int


@dataclass(frozen=True, slots=True)
class Lines:
    """The lines of one response that are fitted.

    frequency : (n,) Hz. H : (n, p). place : (n,) index into the union of all frequencies.
    sensor, actuator : (p,) index into the rig's. outputs, inputs : (p,) their names.
    root : (n, p, p) with root^H root = C^-1. sd : (n, p) standard deviation of each entry.
    factor : (n,) w of `whitening.factor` over the number of lines that share data.
    dof : (n,). shared : lines that went into one covariance, and into one estimate.
    follow : actuators that nothing drove, each with how far it moved (n, p) per unit of each
        entry's input: the entry is H + the sum of H of these by it.
    """

    response: FrequencyResponse
    frequency: Float
    H: Complex
    place: Int
    sensor: Int
    actuator: Int
    outputs: tuple[str, ...]
    inputs: tuple[str, ...]
    root: Complex
    sd: Float
    factor: Float
    dof: Float
    shared: tuple[float, float]
    follow: tuple[tuple[int, Complex], ...] = ()

    @property
    def p(self) -> int:
        """Entries a line."""
        return int(self.H.shape[1])

    def mean(self) -> Float:
        """(n,) the mean of T^2 = e^H C^-1 e when the model holds, nu p/(nu - p)."""
        return mean_t2(self.dof, self.p)


@dataclass(frozen=True, slots=True)
class Data:
    """All lines of all responses, on the union of their frequencies."""

    frequency: Float
    lines: tuple[Lines, ...]

    @property
    def n_real(self) -> int:
        """Real numbers measured."""
        return sum(2 * part.H.size for part in self.lines)

    def independent(self) -> float:
        """Real numbers measured, but for those that share data."""
        return sum(2 * part.H.size / part.shared[1] for part in self.lines)


def collect(
    responses: Sequence[FrequencyResponse],
    rig: Rig,
    band: tuple[float, float] | None = None,
    outputs: Sequence[str] | None = None,
) -> Data:
    """The lines of `responses` in `band` (Hz) and of `outputs`, mapped to the rig's channels.

    Raises InputError for channels that the rig does not have, a band without lines or rates
    that differ; EstimateError for too few degrees of freedom or a singular covariance.
    """
    if not responses:
        raise InputError("responses", "", 0, "at least one frequency response")
    rates = {r.rate_hz for r in responses}
    if len(rates) > 1:
        raise InputError("responses", "rate_hz", sorted(rates), "one sample rate")
    masks = [_mask(r, band) for r in responses]
    union = np.unique(
        np.concatenate([r.frequency[m] for r, m in zip(responses, masks, strict=True)])
    )
    parts = [_lines(r, rig, mask, outputs, union) for r, mask in zip(responses, masks, strict=True)]
    return Data(union, tuple(parts))


def _mask(response: FrequencyResponse, band: tuple[float, float] | None) -> np.ndarray:
    f = response.frequency
    low, high = band or (0.0, np.inf)
    mask = (f > 0) & (f >= low) & (f <= min(high, response.rate_hz / 2))
    if not mask.any():
        span = f"a band that meets {f[0]:.4g} to {f[-1]:.4g} Hz, which was measured"
        raise InputError("identify", "band", band, span)
    return np.asarray(mask)


def _lines(
    response: FrequencyResponse,
    rig: Rig,
    mask: np.ndarray,
    outputs: Sequence[str] | None,
    union: Float,
) -> Lines:
    sensors = [s.name for s in rig.sensor]
    actuators = [a.name for a in rig.actuator]
    names = [c.name for c in response.outputs]
    for name in outputs or ():
        if name not in names:
            raise InputError("identify", "outputs", name, f"outputs measured: {names}")
    chosen = [i for i, name in enumerate(names) if outputs is None or name in outputs]
    for i in chosen:
        if names[i] not in sensors:
            raise InputError("response", "output", names[i], f"a sensor of {rig.name}: {sensors}")
    for channel in (*response.inputs, *response.followers):
        if channel.name not in actuators:
            expected = f"an actuator of {rig.name}: {actuators}"
            raise InputError("response", "input", channel.name, expected)
    n_in = len(response.inputs)
    entries = np.array([i * n_in + j for i in chosen for j in range(n_in)])
    used = [(names[i], c.name) for i in chosen for c in response.inputs]
    C = response.covariance[mask][:, entries[:, None], entries[None, :]]
    H = response.H[mask].reshape(int(mask.sum()), -1)[:, entries]
    dof = response.dof[mask]
    sharing = shared_lines(response)
    return Lines(
        response=response,
        frequency=response.frequency[mask],
        H=H,
        place=np.searchsorted(union, response.frequency[mask]).astype(np.int64),
        sensor=np.array([sensors.index(o) for o, _ in used], dtype=np.int64),
        actuator=np.array([actuators.index(i) for _, i in used], dtype=np.int64),
        outputs=tuple(o for o, _ in used),
        inputs=tuple(i for _, i in used),
        root=root(C),
        sd=np.sqrt(np.diagonal(C, axis1=1, axis2=2).real),
        factor=factor(dof, len(used)) / sharing[1],
        dof=dof,
        shared=sharing,
        follow=_follow(response, mask, actuators, len(chosen)),
    )


def _follow(
    response: FrequencyResponse, mask: np.ndarray, actuators: Sequence[str], n_out: int
) -> tuple[tuple[int, Complex], ...]:
    if response.follow is None:
        return ()
    of_entries = np.tile(response.follow[mask], (1, 1, n_out))
    names = [c.name for c in response.followers]
    return tuple((actuators.index(n), of_entries[:, k]) for k, n in enumerate(names))
