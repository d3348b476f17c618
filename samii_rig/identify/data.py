"""Measured responses in noise units: what the likelihood is made of.

With nu complex degrees of freedom the covariance C that was estimated for p entries is a
complex Wishart matrix, and its inverse is too large, and by chance too large in some
directions. For a linear model fitted with weights w C^-1,

    E[C^-1] = nu/(nu - p) S^-1,   E[C^-1 S C^-1] = nu^3/((nu - p)((nu - p)^2 - 1)) S^-1,

S the true covariance. The factor w = ((nu - p)^2 - 1)/nu^2 is the one for which the inverse
of the information J^H w C^-1 J is the estimator's true covariance, and with several nu it
weighs the lines best.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from samii_rig.errors import EstimateError, InputError
from samii_rig.rig.schema import Rig
from samii_rig.types import Complex, Float, FrequencyResponse, Int

# A local quadratic fit over m lines has 9/(4 m) of a line's variance, and neighbours share
# their data: 9/4 of the m estimates are independent.
INDEPENDENT = 2.25
LOCAL_PARAMETERS = 6  # complex numbers of a local model at least: H and a transient, quadratic


@dataclass(frozen=True, slots=True)
class Lines:
    """The lines of one response that are fitted.

    frequency : (n,) Hz. H : (n, p). place : (n,) index into the union of all frequencies.
    sensor, actuator : (p,) index into the rig's. outputs, inputs : (p,) their names.
    root : (n, p, p) with root^H root = C^-1. sd : (n, p) standard deviation of each entry.
    factor : (n,) w above over the number of lines that share data.
    dof : (n,). shared : lines that went into one covariance, and into one estimate.
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

    @property
    def p(self) -> int:
        """Entries a line."""
        return int(self.H.shape[1])

    def mean(self) -> Float:
        """(n,) the mean of T^2 = e^H C^-1 e when the model holds, nu p/(nu - p)."""
        return np.asarray(self.dof * self.p / (self.dof - self.p))


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


def factor(dof: Float, p: int) -> Float:
    """w = ((nu - p)^2 - 1)/nu^2 (see above); EstimateError where nu is too small for it."""
    if np.any(dof <= p + 1):
        raise EstimateError(
            f"{float(np.min(dof)):.3g} degrees of freedom are too few to weigh {p} outputs; "
            "more repeats, a wider pooling or fewer outputs would do"
        )
    return np.asarray(((dof - p) ** 2 - 1) / dof**2)


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
    for channel in response.inputs:
        if channel.name not in actuators:
            expected = f"an actuator of {rig.name}: {actuators}"
            raise InputError("response", "input", channel.name, expected)
    n_in = len(response.inputs)
    entries = np.array([i * n_in + j for i in chosen for j in range(n_in)])
    used = [(names[i], c.name) for i in chosen for c in response.inputs]
    C = response.covariance[mask][:, entries[:, None], entries[None, :]]
    H = response.H[mask].reshape(int(mask.sum()), -1)[:, entries]
    dof = response.dof[mask]
    sharing = _shared(response)
    return Lines(
        response=response,
        frequency=response.frequency[mask],
        H=H,
        place=np.searchsorted(union, response.frequency[mask]).astype(np.int64),
        sensor=np.array([sensors.index(o) for o, _ in used], dtype=np.int64),
        actuator=np.array([actuators.index(i) for _, i in used], dtype=np.int64),
        outputs=tuple(o for o, _ in used),
        inputs=tuple(i for _, i in used),
        root=_root(C),
        sd=np.sqrt(np.diagonal(C, axis1=1, axis2=2).real),
        factor=factor(dof, len(used)) / sharing[1],
        dof=dof,
        shared=sharing,
    )


def _root(C: Complex) -> Complex:
    """(n, p, p) inverse of the lower Cholesky factor of each C."""
    scale = np.sqrt(np.diagonal(C, axis1=1, axis2=2).real)
    if not np.all(scale > 0):
        raise EstimateError("an output has no noise at some line; leave it out or pool more lines")
    try:
        lower = np.linalg.cholesky(C / (scale[:, :, None] * scale[:, None, :]))
    except np.linalg.LinAlgError as failure:
        raise EstimateError(
            "the noise covariance is singular: two outputs carry the same noise; "
            "leave one of them out"
        ) from failure
    return np.asarray(np.linalg.inv(lower) / scale[:, None, :])


def _shared(response: FrequencyResponse) -> tuple[float, float]:
    """Lines that share one covariance, and lines that share the data of one estimate."""
    dof, n = float(np.median(response.dof)), response.n_averages
    if response.estimator == "local":
        window = (dof + LOCAL_PARAMETERS) / max(n, 1)
        return max(1.0, window), max(1.0, window / INDEPENDENT)
    return max(1.0, dof / max(n - 1, 1)), 1.0
