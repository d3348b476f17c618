"""A stiffness that is not constant: another one in each run, or one that swings while it lasts."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from sim.assumed_modes.effects import Draft, Numbers
from sim.assumed_modes.forces import Swing, joint, on_joint
from sim.assumed_modes.parts import Setup

Rng = np.random.Generator
BETWEEN = "between runs"


def between_runs(rng: Rng, setup: Setup, swing: Swing) -> Draft:
    """A joint whose stiffness is another one in each run."""
    on, _, _ = joint(rng, setup, swing)
    seed = int(rng.integers(2**31))

    def run(s: Setup, v: Numbers, number: int) -> Setup:
        step = float(np.random.default_rng([seed, number]).standard_normal())
        return s.with_value(on, "k", s.part(on).values["k"] * float(np.exp(v["spread"] * step)))

    return Draft(
        "stiffness_variation", on, None, {"spread": "1"}, lambda x: {"spread": x},
        lambda s, v: run(s, v, 0), 1e-6, 0.3, run=run,
    )  # fmt: skip


def parametric(rng: Rng, setup: Setup, swing: Swing) -> Draft:
    """A joint whose stiffness swings in time at two frequencies, the second by less."""
    on, _, _ = joint(rng, setup, swing)
    w = 2 * np.pi * np.exp(rng.uniform(np.log(0.1), np.log(3.0), 2))
    share = float(rng.uniform(0.0, 0.6))
    law = on_joint("parametric", on)

    def apply(s: Setup, v: Numbers) -> Setup:
        numbers = {"depth_1": v["depth"], "depth_2": share * v["depth"], "w_1": w[0], "w_2": w[1]}
        return law(s, numbers)

    return Draft(
        "stiffness_variation", on, None, {"depth": "1", "f": "Hz"},
        lambda x: {"depth": x, "f": float(w[0]) / (2 * np.pi)}, apply, 1e-5, 0.4,
    )  # fmt: skip


VARYING: dict[str, Callable[[Rng, Setup, Swing], Draft]] = {
    BETWEEN: between_runs,
    "in time": parametric,
}
