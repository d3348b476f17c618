"""The drawn rig moves as the rig does, as far as its sensors and its model tell.

Plan: the model's own motion at many frequencies, seen by its sensors alone, is drawn again.
"""

from __future__ import annotations

import numpy as np
import pytest

from samii_rig.model.sampled import sensor_response
from samii_rig.model.tmm import Chain
from samii_rig.rig.load import load_rig
from samii_rig.rig.schema.elements import BEAMS
from samii_rig.serve import questions
from samii_rig.serve.motion import BENDS, Motion, motion

RIG, TEXT = load_rig("samii")


@pytest.fixture(scope="module")
def found() -> Motion:
    made = motion(RIG)
    assert made is not None
    return made


@pytest.mark.parametrize("name", ["samii", "sflr"])
@pytest.mark.parametrize("hz", [0.6, 1.0, 1.7, 3.0, 5.0, 7.4, 15.0])
def test_the_drawing_moves_as_the_rig(name: str, hz: float) -> None:
    """Every part, relative to the largest displacement: to 2 % below 6 Hz, to 20 % above, where
    another mode lies within an octave."""
    rig, _ = load_rig(name)
    found = motion(rig)
    assert found is not None
    positions = {
        e.name: np.linspace(0, e.L.value, BENDS + 1).tolist()
        for e in rig.element
        if isinstance(e, BEAMS)
    }
    chain = Chain(rig)
    true = chain.field(hz, positions=positions)[0, 0, :, 0]
    read = (chain.response([hz])[0] * sensor_response(rig.sensor, np.array([hz])).T)[:, 0]
    s = 2j * np.pi * hz
    of = dict(zip([s.name for s in rig.sensor], read, strict=True))
    y = np.array(
        [
            of[n] / (s**2 if integrate else 1.0)
            for n, integrate in zip(found.sensors, found.accelerations, strict=True)
        ]
    )
    nearest = 1 + int(np.argmin(np.abs(np.log2(found.hz[1:] / hz))))
    drawn = found.matrix[nearest] @ y
    within = 0.02 if hz < 6.0 else 0.2
    assert np.abs(drawn - true).max() < within * np.abs(true).max()


def test_at_a_sensor_the_drawing_shows_what_it_measures(found: Motion) -> None:
    """The tip stands where its accelerometer says, whatever the others read."""
    tip = found.sensors.index("a_2")
    rng = np.random.default_rng(5)
    chain = Chain(RIG)
    f = np.array([1.0, 3.0])
    y = chain.response(f)[:, :, 0] / np.where(
        found.accelerations, (2j * np.pi * f[:, None]) ** 2, 1.0
    )
    y = np.real(y * np.exp(2j * np.pi * rng.random(2))[:, None])
    for row, k in zip(y, (2, 3), strict=True):
        assert (found.matrix[k] @ row)[-1] == pytest.approx(row[tip], rel=0.05)


def test_a_rig_without_sensors_of_motion_is_drawn_at_rest() -> None:
    none = RIG.model_copy(update={"sensor": (), "limit": (), "centring": None})
    assert motion(none) is None


def test_the_rig_comes_with_its_motion(found: Motion) -> None:
    answer = questions.rig(TEXT)
    assert answer["motion"]["sensors"] == list(found.sensors)
    np.testing.assert_allclose(answer["motion"]["matrix"], found.matrix, atol=1e-5)
    assert len(answer["motion"]["x"]) == len(answer["motion"]["element"])
