"""The ratio of two outputs' frequency responses, with its uncertainty.

Where v drives and both x and y are measured, x/y = (x/v)/(y/v). Each response goes through
the reference, so noise in y does not bias the ratio, as it would bias a response that is
estimated with y as its input.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from samii_rig.errors import InputError
from samii_rig.types import FrequencyResponse


def ratio(
    response: FrequencyResponse, bottom: str, tops: Sequence[str] | None = None
) -> FrequencyResponse:
    """Q = H_top/H_bottom of a response to one input, as a response whose input is `bottom`.

    Parameters
    ----------
    bottom : output to divide by. tops : outputs to divide, in this order; all others without.

    To first order in the error of H, dQ = (dH_top - Q dH_bottom)/H_bottom. That is linear
    in dH, so the error stays circular complex normal and

        C_Q = T C_H T^H / |H_bottom|^2,      T = [1 ... -Q],

    with the degrees of freedom of C_H. It holds where the relative error of H_bottom is small.

    Returns (n_freq, n_top, 1) in top unit per bottom unit; `coherence` is that of each
    top over the input, `input_rms` the rms of `bottom` itself. InputError for an output
    that there is not, or for a response to several inputs.
    """
    names = [c.name for c in response.outputs]
    if len(response.inputs) != 1:
        raise InputError("ratio", "inputs", len(response.inputs), "a response to one input")
    chosen = [n for n in names if n != bottom] if tops is None else list(tops)
    for field, name in [("bottom", bottom), *(("top", n) for n in chosen)]:
        if name not in names:
            raise InputError("ratio", field, name, f"one of {', '.join(names)}")
    if not chosen or bottom in chosen:
        raise InputError("ratio", "top", bottom, f"an output beside {bottom}")
    b, rows = names.index(bottom), [names.index(n) for n in chosen]
    H = response.H[:, :, 0]
    below = H[:, b]
    Q = H[:, rows] / below[:, None]
    T = np.zeros((len(H), len(rows), len(names)), dtype=np.complex128)
    T[:, np.arange(len(rows)), rows] = 1.0
    T[:, :, b] = -Q
    T /= below[:, None, None]
    return replace(
        response,
        H=Q[:, :, None],
        covariance=np.asarray(T @ response.covariance @ T.conj().transpose(0, 2, 1)),
        coherence=response.coherence[:, rows],
        inputs=(response.outputs[b],),
        outputs=tuple(response.outputs[i] for i in rows),
        input_rms=response.input_rms * np.abs(below)[:, None],
        even=None,
        odd=None,
        noise=None,
        distortion=None,
        why=f"{response.why}; divided by {bottom}",
    )
