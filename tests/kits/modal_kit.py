"""Responses of modes in closed form, with the noise of a measurement."""

import numpy as np

from samii_rig.identify.bootstrap import redraw
from samii_rig.types import Channel, FrequencyResponse

HZ = np.array([3.1, 8.0, 8.24, 14.5, 27.0])  # the second and third 3 % apart
ZETA = np.array([0.015, 0.010, 0.012, 0.03, 0.02])
SHAPE = np.array(
    [[1.0, 0.6, 0.3], [0.8, -0.5, 0.9], [-0.6, 0.7, 0.8], [0.5, 1.0, -0.7], [0.9, -0.8, 0.6]]
)
SECOND = np.array([0.7, -1.1, 0.9, 0.6, -0.8])  # how much more a second input drives each mode
BEYOND = (61.0, 0.02)  # Hz, damping of a mode above the band


def poles(hz=HZ, zeta=ZETA):
    w = 2 * np.pi * hz
    return w * (-zeta + 1j * np.sqrt(1 - zeta**2))


def modal_sum(f, hz=HZ, zeta=ZETA, shape=SHAPE, inputs=1):
    """(n, n_out, n_in): sum of shape L/(s^2 + 2 zeta w s + w^2) w^2, and a mode beyond the band."""
    s = 2j * np.pi * f
    H = np.zeros((f.size, shape.shape[1], inputs), complex)
    all_hz, all_zeta = np.append(hz, BEYOND[0]), np.append(zeta, BEYOND[1])
    all_shape = np.vstack([shape, np.ones(shape.shape[1])])
    gains = np.ones((all_hz.size, inputs))
    gains[: SECOND.size, 1:] = SECOND[: hz.size, None]
    for w, z, psi, L in zip(2 * np.pi * all_hz, all_zeta, all_shape, gains, strict=True):
        H += (w**2 / (s**2 + 2 * z * w * s + w**2))[:, None, None] * np.outer(psi, L)
    return H


def response(H, f, relative=0.01, *, dof=40.0, seed=None, outputs=3, method="burst (drawn)"):
    """H with noise of `relative` the median gain, alike at all lines, half common to all."""
    n_in = H.shape[2]
    H = H[:, :outputs]
    p = outputs * n_in
    sd = relative * np.median(np.abs(H), axis=0).reshape(p)
    C = np.outer(sd, sd) * (0.5 + 0.5 * np.eye(p)) + 0j
    like = FrequencyResponse(
        frequency=f,
        H=H,
        covariance=np.repeat(C[None], f.size, axis=0),
        dof=np.full(f.size, dof),
        coherence=np.ones((f.size, outputs)),
        inputs=tuple(Channel(f"f_{j}", "N") for j in range(n_in)),
        outputs=tuple(Channel(f"y_{k}", "m") for k in range(outputs)),
        level=1.0,
        level_unit="N",
        input_rms=np.ones((f.size, n_in)),
        rate_hz=200.0,
        n_averages=round(dof) + 1,
        method=method,
        why="drawn",
    )
    if seed is None:
        return like
    return redraw(like, H, np.random.default_rng(seed))


def noise(f, seed, outputs=3):
    """A response that is nothing but noise."""
    like = response(np.ones((f.size, outputs, 1)) + 0j, f, outputs=outputs)
    return redraw(like, np.zeros_like(like.H), np.random.default_rng(seed))
