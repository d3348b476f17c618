"""Fresh measurements of a model with the noise of a real one, for studies and plans."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from samii_rig.errors import InputError
from samii_rig.types import Complex, FrequencyResponse


def redraw(
    like: FrequencyResponse, H: Complex, rng: np.random.Generator, shared: int = 1
) -> FrequencyResponse:
    """A measurement of H (n_freq, n_out, n_in) as `like` would have it.

    The error has the covariance that `like` states, and the covariance of the new response
    is itself estimated: complex Wishart with the degrees of freedom of `like`, `shared`
    neighbouring lines having one in common, as pooled estimates do. So what is done with the
    new response can be repeated and its intervals counted.

    Raises InputError if H does not have the shape of `like`, or with too few degrees of
    freedom for a covariance.
    """
    if H.shape != like.H.shape:
        raise InputError("redraw", "H", H.shape, f"the shape {like.H.shape}")
    n, p = len(like.frequency), like.covariance.shape[1]
    scale = np.sqrt(np.diagonal(like.covariance, axis1=1, axis2=2).real)
    root = np.linalg.cholesky(like.covariance / (scale[:, :, None] * scale[:, None, :]))
    root = scale[:, :, None] * root
    error = (root @ _normal(rng, (n, p, 1)))[:, :, 0]
    dof = np.floor(like.dof)
    if np.any(dof < p):
        raise InputError("redraw", "dof", float(like.dof.min()), f"at least {p}")
    covariance = np.empty_like(like.covariance)
    for first in range(0, n, shared):
        lines = slice(first, first + shared)
        nu = int(dof[first])
        W = _normal(rng, (p, nu))
        covariance[lines] = root[lines] @ (W @ W.conj().T / nu) @ root[lines].conj().swapaxes(1, 2)
        dof[lines] = nu
    return replace(like, H=H + error.reshape(H.shape), covariance=covariance, dof=dof)


def _normal(rng: np.random.Generator, shape: tuple[int, ...]) -> Complex:
    """Circular complex normal numbers of variance 1."""
    parts = rng.standard_normal((2, *shape)) / np.sqrt(2)
    return np.asarray(parts[0] + 1j * parts[1])
