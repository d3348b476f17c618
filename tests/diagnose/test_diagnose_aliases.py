"""Records at rates that fold the rig's own modes: the contour's samples against the rig's poles."""

from __future__ import annotations

import numpy as np
import pytest

from samii_rig.diagnose.physics.model import Model, grid
from samii_rig.likelihood.contour import EXACT, Contour
from samii_rig.model.realise import realise
from samii_rig.rig.load import load_rig
from samii_rig.rig.schema import Rig
from samii_rig.types import Float

N = 3000


def held_impulse(rig: Rig, n: int) -> Float:
    """(n, q) what the sensors show of an output of 1 held for a sample, by partial fractions."""
    made = realise(rig)
    T = 1 / rig.rate_hz
    pairs = np.where(made.poles.imag > 0, 2.0, 1.0)
    R = made.residues[:, :, 0] * pairs[:, None]
    grow = np.exp(made.poles * T)
    still = np.abs(made.poles) < 1e-9
    push = np.where(still, T, (grow - 1) / np.where(still, 1.0, made.poles))
    later = grow[None, :] ** np.arange(n - 1)[:, None]
    out = np.zeros((n, R.shape[1]))
    out[1:] = ((later * push) @ R).real
    out[1] += made.direct[:, 0]  # read just before the output changes again
    return out


@pytest.mark.parametrize("rate", [200.0, 250.0])
def test_the_samples_of_a_slow_record_are_the_rigs(rate: float):
    """The beam's second mode is near half of either rate."""
    rig = load_rig("beam_on_shaker")[0].model_copy(update={"rate_hz": rate})
    q = len(rig.sensor)
    contour = Contour.over(N, rate, EXACT)
    model = Model(rig)
    at = grid(rig, contour.frequency[1:], np.arange(q), np.zeros(q, int), sigma=contour.sigma)
    H = np.concatenate([np.zeros((1, q), complex), model.response(np.zeros(model.n), at)])
    impulse = np.zeros(N)
    impulse[0] = 1.0
    shown = contour.predicted(H, impulse)
    exact = held_impulse(rig, N)
    # The line at 0 Hz is missing: a constant, which an accelerometer hardly has.
    for i in range(q):
        off = shown[: N // 2, i] - exact[: N // 2, i]
        assert np.std(off) < 5e-4 * np.std(exact[: N // 2, i])
