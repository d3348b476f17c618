"""Which forces may act on a command."""

from __future__ import annotations

from typing import Any, cast

import pytest

from samii_rig.diagnose.forces.paths import TransferPaths
from samii_rig.diagnose.forces.place import Place
from samii_rig.diagnose.forces.table import _drive
from samii_rig.rig.schema import ActuatorSpec


class Moved:
    """Under a command of 1 V that turns nothing."""

    def largest(self, place: Place) -> float:
        return 1.0

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
