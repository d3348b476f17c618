"""Partial coherence of responses to several inputs.

The multiple coherence of an output is the part of its power that all inputs together explain; it
stands in `FrequencyResponse.coherence`. The partial coherence of one entry is the part that one
input explains of what the others do not (Bendat and Piersol, Random Data, 4th ed., section 7.3),

    gamma^2_ai = |H_ai|^2 / (|H_ai|^2 + n C_ai),

since n C_ai = S_nn/S_ii.rest, the noise of the output over what of the input is its own; n the
number of averages, C_ai the variance of the entry.
"""

from __future__ import annotations

import numpy as np

from samii_rig.types import Float, FrequencyResponse


def partial_coherence(response: FrequencyResponse) -> Float:
    """(n_freq, n_out, n_in); with one input the multiple coherence, which is the ordinary one."""
    if len(response.inputs) == 1:
        return response.coherence[:, :, None]
    size = np.abs(response.H) ** 2
    total = size + max(response.n_averages, 1) * response.variance()
    return np.asarray(np.divide(size, total, out=np.zeros_like(size), where=total > 0))
