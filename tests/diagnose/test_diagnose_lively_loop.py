"""A loop that nobody stated, around a sensor whose noise it makes a command of.

Above the band of its reference the command is the loop's answer to noise: there a response that is
free shows -1/C, and fits the noise with it.
"""

import numpy as np
import pytest
from two_masses_kit import RATE, diagnosed, recorded

from samii_rig.types import Float

PD = (3000.0, 100.0)


def stairs() -> Float:
    """(n,) V, a new value each 0.8 s."""
    return np.repeat(np.random.default_rng(3).uniform(-1.5, 1.5, 10), int(0.8 * RATE))


def test_where_nothing_is_hidden_it_says_so() -> None:
    found = diagnosed(recorded(stairs(), 5, pd=PD))
    assert found.verdict == "no_mismatch"
    assert found.chi2_per_dof == pytest.approx(1.0, abs=0.15)
    (left,) = found.used.left_out
    assert "a loop makes of" in left[1]
    assert not any("times the noise" in words for words in found.not_physics)


def test_a_mass_is_named() -> None:
    found = diagnosed(recorded(stairs(), 8, pd=PD, more=0.2))
    assert found.verdict == "named"
    (cause,) = found.causes
    assert (cause.physics, cause.site) == ("added_mass", "mass_2")
    m = cause.parameters["m"]
    assert m.low is not None
    assert m.high is not None
    assert m.low < 0.2 < m.high
