"""How large two concealed effects are, one of them a force: each beside the other."""

import numpy as np

from samii_rig.model.sampled import sampled_response
from samii_rig.prove.size import size_of
from samii_rig.rig.load import load_rig

RIG, _ = load_rig("samii")
F = np.geomspace(1.0, 24.0, 60)
TRUTH = {
    "kind": "two",
    "effects": [
        {"physics": "sensor_gain", "site": "a_0"},
        {"physics": "valve_deadband", "site": "joint_2_source"},
    ],
    "design": {"burst": 20.0, "bursts": 4, "sensors": None},
}


def size(gain: float, force: float) -> float:
    """With a_0 read `gain` times too large, and a response that changes by `force` with level."""
    H = sampled_response(RIG, F)[:, :, 0]
    samples, unit = 20.0 * RIG.rate_hz, 3.0
    noise = (1e-2 * np.abs(H)) ** 2 * unit / samples
    linear = H * np.array([1.0, gain, 1.0, 1.0])
    arrays = {
        "frequency": F,
        "linear": linear,
        "level": np.array([1.0, 2.0]),
        "reference": np.ones(F.size),
        "noise": noise[:, :, None] * np.eye(4),
        "sensor": np.arange(4),
        "actuator": np.zeros(4, dtype=int),
        "settled": np.stack([(1 - force) * linear, (1 + force) * linear]),
    }
    return size_of(TRUTH, arrays, RIG).size


def test_two_effects_are_as_large_as_the_smaller_beside_the_other() -> None:
    both, no_gain, no_force = size(1.2, 0.05), size(1.0, 0.05), size(1.2, 0.0)
    assert both > 30
    assert no_gain < 0.1 * both
    assert no_force < 0.1 * both
