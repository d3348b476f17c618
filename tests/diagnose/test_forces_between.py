"""A command between the samples that were recorded."""

from __future__ import annotations

import numpy as np
import pytest

from samii_rig.diagnose.forces.problem import _recorded, between


@pytest.mark.parametrize("every", [2, 5, 8])
def test_a_command_is_known_between_its_samples_to_a_hundred_thousandth(every: int):
    """At 0.44 of the record's rate; a limit that it just reaches is told as nearly."""
    n, fine = np.arange(4000), np.arange(4000 * every) / every
    smooth = np.hanning(4000)
    v = np.sin(2 * np.pi * 0.44 * n + 0.3) * smooth
    there = between(v, every)
    exact = np.sin(2 * np.pi * 0.44 * fine + 0.3) * np.interp(fine, n, smooth)
    assert np.max(np.abs(there - exact)) < 3e-5
    assert np.max(np.abs(_recorded(there[None], every)[0] - v)) < 3e-5
    both = between(np.stack([v, -v], axis=1), every)
    np.testing.assert_allclose(both[:, 1], -there, atol=1e-12)
