"""Line by line over repeats: bursts from rest to rest, whole periods.

Both are free of leakage by themselves, so nothing is smoothed:

    H = sum_m Y_m R_m^* / sum_m V_m R_m^*        (through the reference R, S_yr/S_vr)
    e_m = Y_m - H V_m,   C_e from e_m over repeats and neighbouring lines,
    C_H = C_e sum_m |R_m|^2 / |sum_m V_m R_m^*|^2.

In closed loop e_m is free of what the reference did and of what the loop made of the
noise (Pintelon and Schoukens, System Identification, 2nd ed., section 2.7); it is the noise
of the open loop.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from samii_rig.signal.noise import pooled
from samii_rig.types import Complex, Float


@dataclass(frozen=True, slots=True)
class Lines:
    """An estimate on some lines, before it becomes a `FrequencyResponse`.

    H (n_freq, p), covariance (n_freq, p, p), dof (n_freq,), noise (n_freq, p, p) the
    covariance of e of one repeat, gain (n_freq,) V/R, input_power (n_freq,) mean |V|^2.
    """

    H: Complex
    covariance: Complex
    dof: Float
    noise: Complex
    gain: Complex
    input_power: Float
    remark: str


def over_repeats(
    R: Complex,
    Z: Complex,
    lines: int,
    floor: Float,
    shared: float = 1.0,
    correlation: float = 0.0,
) -> Lines:
    """Estimate from R (n, n_freq) and Z (n, n_freq, 1 + p), n >= 2 repeats.

    lines : how many neighbouring lines share one covariance.
    shared : how many lines count as one independent line (tapered records).
    correlation : of the noise of neighbouring repeats: the scatter shows too little of it by
        1 - 2 correlation/n, and the mean has more by 1 + 2 correlation (n - 1)/n.
    floor : (p,) variance per line of errors that repeat with the reference (quantisation of
        a deterministic signal); repeats do not show them, so what of the floor is not in the
        scatter is added, and does not fall with the number of repeats.
    """
    n = R.shape[0]
    V, Y = Z[:, :, 0], Z[:, :, 1:]
    S_vr = np.einsum("nf,nf->f", V, R.conj())
    S_yr = np.einsum("nfp,nf->fp", Y, R.conj())
    S_rr = np.einsum("nf,nf->f", R, R.conj()).real
    H = S_yr / S_vr[:, None]
    e = Y - H * V[:, :, None]
    found = pooled(e, n - 1, lines, H)
    noise = found.covariance / (1 - 2 * correlation / n)
    more = 1 + 2 * correlation * (n - 1) / n
    # Of an output's own quantisation only; what the recorded input did is known.
    scatter = np.diagonal(noise, axis1=1, axis2=2).real
    hidden = np.maximum(floor - scatter, 0.0)
    per_line = (S_rr / np.abs(S_vr) ** 2)[:, None, None]
    repeated = (n * np.eye(H.shape[1])) * hidden[:, None, :]
    covariance = (noise * more + repeated) * per_line
    return Lines(
        H=H,
        covariance=covariance,
        dof=found.dof / shared,
        noise=noise,
        gain=S_vr / S_rr,
        input_power=np.mean(np.abs(V) ** 2, axis=0),
        remark=f"{found.remark}{min(lines, len(H))} lines pooled",
    )


def followed(R: Complex, V: Complex) -> Float:
    """|sum_m V_m R_m^*| at each line, by which a response is divided. R, V : (n, n_freq)."""
    return np.asarray(np.abs(np.einsum("nf,nf->f", V, R.conj())), float)


def wanted_dof(p: int) -> int:
    """Degrees of freedom that a pooled covariance of p outputs should have."""
    return max(30, 12 * p)


def pooling_lines(n: int, p: int) -> int:
    """How many lines to pool for n repeats of p outputs.

    30 degrees of freedom make the 90 % point of F 6 % larger than that of a known
    covariance; 12 for each output keep the joint form as near. An odd number keeps the
    window centred.
    """
    lines = -(-wanted_dof(p) // (n - 1))
    return lines + 1 - lines % 2
