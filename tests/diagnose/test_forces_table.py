"""Which forces may act on a command."""

from __future__ import annotations

from typing import Any, cast

import pytest

from samii_rig.diagnose.forces.paths import TransferPaths
from samii_rig.diagnose.forces.place import Place
from samii_rig.diagnose.forces.table import _drive
from samii_rig.rig.schema import ActuatorSpec


class Moved:
    """Under a command of 1 V that turns nothing, recorded as it was sent or by a meter."""

    def __init__(self, noise: float = 0.0, *, resting: bool = True) -> None:
        self.noise = noise
        self.resting = resting

    def largest(self, place: Place) -> float:
        return 1.0

    def meter_noise(self, place: Place, step: float) -> float:
        return self.noise

    def rests(self, place: Place, width: float) -> bool:
        return self.resting

    def ports(self, place: Place, *, of_speed: bool) -> Any:
        return None


@pytest.mark.parametrize(
    ("step", "known"),
    [(0.01, {"valve_deadband", "output_saturation"}), (3.0, {"output_saturation"})],
)
def test_a_coarse_converter_hides_a_dead_band_and_no_limit(step: float, known: set[str]) -> None:
    valve = ActuatorSpec(name="v", unit="V", low=-10.0, high=10.0, resolution=step)
    found = _drive(cast(TransferPaths, Moved()), "motor", valve, turns=False)
    assert {e.physics for e in found} == known


def test_what_is_as_narrow_as_a_meters_noise_is_none_of_the_rig() -> None:
    """A dead band takes the noise out where the command rests, a limit at its top; it bends the
    top by less than that until it is as far again below."""
    valve = ActuatorSpec(name="v", unit="V", low=-10.0, high=10.0, resolution=1e-3)
    ends = {}
    for noise in (0.0, 0.01):
        found = _drive(cast(TransferPaths, Moved(noise)), "motor", valve, turns=False)
        ends[noise] = {e.physics: (e.unknowns[0].low, e.unknowns[0].high) for e in found}
    assert ends[0.0]["valve_deadband"][0] == pytest.approx(1e-3)
    assert ends[0.01]["valve_deadband"][0] == pytest.approx(0.03)
    swings = _drive(cast(TransferPaths, Moved(0.01, resting=False)), "motor", valve, turns=False)
    (narrowest,) = (e.unknowns[0].low for e in swings if e.physics == "valve_deadband")
    assert narrowest == pytest.approx(1e-3)
    assert ends[0.0]["output_saturation"][1] == pytest.approx(1.0)
    assert ends[0.01]["output_saturation"][1] == pytest.approx(0.88)
