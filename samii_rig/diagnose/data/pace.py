"""The rate: samples left out, or a rate that is another, stretch all frequencies alike."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from samii_rig.diagnose.data.wiring import LINES_LOOKED_AT, MISFIT, SWAPPED, misfit
from samii_rig.errors import InputError
from samii_rig.model.sampled import sampled_response
from samii_rig.model.tmm import Chain
from samii_rig.rig.schema import Rig
from samii_rig.types import FrequencyResponse

ROUGHLY = 0.01  # of a response, what its aliases may be off by: misfits of 0.5 are told apart
PACES = (2.0, 4.0, 5.0, 10.0)  # one of so many samples was kept, or so many times as many


def paced(responses: Sequence[FrequencyResponse], rig: Rig) -> None:
    """Raise InputError where each response is the rig's, as the swapped channels' test asks for it,
    at frequencies that are all the same multiple of those recorded, and is not at those."""
    chain = Chain(rig)
    found = [_pace(r, chain) for r in responses]
    if found and found[0] != 1.0 and all(k == found[0] for k in found):
        k, rate = found[0], responses[0].rate_hz
        many = f"{k:g} times" if k > 1 else f"1/{1 / k:g} of"
        what = f"{rate / k:g} Hz: every frequency stands at {many} the rig file's"
        raise InputError("recording", "rate_hz", rate, f"{what}; were samples left out?")


def _pace(r: FrequencyResponse, chain: Chain) -> float:
    rig = chain.rig
    pick = np.unique(np.linspace(0, r.frequency.size - 1, LINES_LOOKED_AT).astype(int))
    on = [[s.name for s in rig.sensor].index(c.name) for c in r.outputs]
    by = [[a.name for a in rig.actuator].index(c.name) for c in r.inputs]

    def misfit_at(k: float) -> float:
        f = r.frequency[pick] / k
        inside = f < rig.rate_hz / 2
        if not inside.any():
            return math.inf
        model = sampled_response(rig, f[inside], chain, ROUGHLY)[:, on][:, :, by]
        return misfit(r.H[pick][inside], model)

    as_it_is = misfit_at(1.0)
    if as_it_is < MISFIT:
        return 1.0
    each = {k: misfit_at(k) for pace in PACES for k in (pace, 1 / pace)}
    best = min(each, key=lambda k: each[k])
    return best if each[best] < SWAPPED * as_it_is else 1.0
