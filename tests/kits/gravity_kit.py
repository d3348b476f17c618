"""Chains that hang or stand, in a few lines each."""

from collections.abc import Collection
from typing import Any

import numpy as np
from elements_kit import part

from samii_rig.model.tmm import Chain
from samii_rig.rig.schema import Rig
from samii_rig.types import Float

G = 9.81  # m/s^2
SWAY = {"name": "y", "kind": "absolute_angle", "after": "push", "unit": "rad"}


def torque(**values: Any) -> dict[str, Any]:
    return part("torque_source", "push", K=1.0, **values)


def hanging(
    *elements: dict[str, Any], pose: float | None = None, base: str = "pinned", **other: Any
) -> Rig:
    """A chain under gravity at `pose`, deg, behind a torque at its base."""
    data: dict[str, Any] = {
        "name": "hanging",
        "base": base,
        "tip": "free",
        "rate_hz": 500.0,
        "gravity": G,
        "element": [torque(), *elements],
        "sensor": [SWAY],
        "actuator": [{"name": "v", "unit": "V", "low": -10.0, "high": 10.0, "deadman": 0.05}],
    }
    if pose is not None:
        data["pose"] = {"value": pose, "unit": "deg"}
    return Rig.model_validate({**data, **other})


def arm(
    name: str = "arm",
    L: float = 1.0,
    r: float = 0.4,
    m: float = 2.0,
    I: float = 0.3,  # noqa: E741
) -> dict[str, Any]:
    return part("rigid_link", name, L=L, r=r, m=m, I=I)


def gradient_agrees(
    chain: Chain, f: Float, floor: float, but: Collection[tuple[str, str]] = ()
) -> None:
    """Its gradient at f Hz is that of differences of fourth order, by every parameter that is not
    0 nor among `but`. floor : of the response over the parameter, what rounding leaves."""
    H, dH = chain.gradient(f)
    for i, key in enumerate(chain.parameters):
        value = chain.values()[i]
        if value == 0 or key in but:
            continue
        h = 1e-3 * value
        a, b, c, d = (
            chain.with_values({key: value + x * h}).response(f) for x in (1, -1, 0.5, -0.5)
        )
        difference = (8 * (c - d) - (a - b)) / (6 * h)
        scale = np.abs(difference) + floor * np.abs(H) / value
        assert np.max(np.abs(dH[..., i] - difference) / scale) < 2e-4, key
