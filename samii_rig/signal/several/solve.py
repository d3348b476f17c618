"""H of several inputs from the means of experiments, and the covariance of all its entries.

With V (n_in, E) and Y (n_out, E) the means of E experiments at a line and an instrument W (n_in, E)
that noise does not reach,

    H = Y W^H (V W^H)^-1 = Y Q,        e = Y - H V,        dH = e Q,
    E[dH_ai dH_bj^*] = sum_k N_k[a, b] Q_ki Q_kj^*,

N_k the noise covariance of the mean of experiment k (Pintelon and Schoukens, System
Identification, 2nd ed., section 2.7 and 7.3; Soderstrom and Stoica, Instrumental variable
methods, 1983). In closed loop e is the noise of the open loop, and W is made of the references:
what they explain of V, W = V R^+ R. With E = n_in any W gives H = Y V^-1, the joint
input-output estimate.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from samii_rig.errors import EstimateError
from samii_rig.types import Complex, Float

# Least ratio of the smallest to the largest singular value of V W^H, each input in units of its
# own size, below which a line does not distinguish the inputs: the worst combination of inputs
# has 30 times the noise of the best (the ratio goes with the square of V).
INDEPENDENT = 1e-3
# Part of the lines that must distinguish them, or the experiments as a whole do not.
MOST = 0.5
_TINY = 1e-300


@dataclass(frozen=True, slots=True)
class Solved:
    """H (n_freq, n_out, n_in) and Q (n_freq, E, n_in) with dH = e Q."""

    H: Complex
    Q: Complex


def instrument(V: Complex, R: Complex | None, weight: Float) -> Complex:
    """W (n_freq, n_in, E): what the references R (n_freq, n_ref, E) explain of V, V itself
    without any. weight : (E,) of each experiment, such as its number of repeats."""
    W = V
    if R is not None and R.shape[1] >= V.shape[1]:
        size = np.sqrt(np.mean(np.abs(R) ** 2, axis=(0, 2), keepdims=True))
        unit = R / np.where(size > 0, size, 1.0)
        W = V @ np.linalg.pinv(unit, rcond=1e-6) @ unit
    return np.asarray(W * weight, complex)


def told_apart(V: Complex, W: Complex) -> NDArray[np.bool_]:
    """(n_freq,) whether the experiments distinguish the inputs at each line."""
    unit = [x / np.maximum(np.sqrt(np.mean(np.abs(x) ** 2, axis=2, keepdims=True)), _TINY)
            for x in (V, W)]  # fmt: skip
    singular = np.linalg.svd(unit[0] @ unit[1].conj().transpose(0, 2, 1), compute_uv=False)
    return np.asarray(singular[:, -1] > INDEPENDENT * singular[:, 0])


def require_independent(
    apart: NDArray[np.bool_], n_experiments: int, inputs: list[str], where: str
) -> None:
    """EstimateError where there are fewer independent experiments than inputs."""
    n = len(inputs)
    if n_experiments >= n and np.mean(apart) >= MOST:
        return
    found = (
        f"{n_experiments} experiment{'s' * (n_experiments != 1)}"
        if n_experiments < n
        else f"{n_experiments} experiments that are not independent"
    )
    raise EstimateError(
        f"{where}: {found} for {n} inputs ({', '.join(inputs)}); expected {n} independent ones "
        "(each input in turn, or blocks of orthogonal multisines), or "
        f"input={inputs[0]!r} alone"
    )


def solve(V: Complex, Y: Complex, W: Complex) -> Solved:
    """H and Q from V, W (n_freq, n_in, E) and Y (n_freq, n_out, E); every line independent."""
    size = np.sqrt(np.mean(np.abs(V) ** 2, axis=2, keepdims=True))
    across = W.conj().transpose(0, 2, 1)
    A = (V / size) @ across
    Q = across @ np.linalg.inv(A) / size.transpose(0, 2, 1)
    return Solved(np.asarray(Y @ Q), np.asarray(Q))


def covariance(N: Complex, Q: Complex) -> Complex:
    """(n_freq, p, p) of H.reshape(n_freq, p) from N (n_freq, n_out, n_out) of each mean of the
    experiments whose weights are Q (n_freq, E, n_in)."""
    K = np.einsum("fei,fej->fij", Q, Q.conj())
    n_freq, n_out, n_in = len(N), N.shape[1], Q.shape[2]
    p = n_out * n_in
    return np.asarray(np.einsum("fab,fij->faibj", N, K).reshape(n_freq, p, p))


def leverage(V: Complex, Q: Complex) -> Float:
    """(n_freq, E) what each experiment takes of its own residual: diagonal of Q V."""
    return np.asarray(np.einsum("fei,fie->fe", Q, V).real)
