"""Physics that the diagnosis's table does not have: what it must not name."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from scipy.optimize import nnls

from samii_rig.types import Float
from sim.assumed_modes.effects import Draft, Numbers
from sim.assumed_modes.forces import START, Swing, joint, on_joint, units
from sim.assumed_modes.parts import Relaxation, Setup

Rng = np.random.Generator
FRACTION_LOW, FRACTION_HIGH = 0.05, 500.0  # Hz, where a fractional damper is one
BRANCHES = 14  # over those four decades: within 2 % of its modulus


def hysteresis(rng: Rng, setup: Setup, swing: Swing) -> Draft:
    """A joint with hysteresis (Bouc and Wen): the force T_y z, with
    z' = (x' - beta |x'| |z|^(n-1) z - (1 - beta) x' |z|^n)/z_y."""
    on, k, peak = joint(rng, setup, swing)
    z_y = peak * float(np.exp(rng.uniform(np.log(0.05), np.log(0.7))))
    beta, n = float(rng.uniform(0.5, 0.9)), float(rng.uniform(1.0, 2.0))
    law = on_joint("bouc_wen", on)

    def apply(s: Setup, v: Numbers) -> Setup:
        return law(s, {**v, "z_y": z_y, "beta": beta, "gamma": 1 - beta, "n": n})

    return Draft(
        "hysteresis", on, None, {"T_y": units(setup, on)[0]}, lambda x: {"T_y": x}, apply,
        START * k * z_y, 2 * k * z_y,
    )  # fmt: skip


def fraction(alpha: float) -> tuple[Float, Float]:
    """Maxwell branches (k, t) whose sum is s^alpha at s = jw over the band."""
    t = 1.0 / (2 * np.pi * np.geomspace(FRACTION_LOW / 10, FRACTION_HIGH * 10, BRANCHES))
    s = 2j * np.pi * np.geomspace(FRACTION_LOW, FRACTION_HIGH, 200)
    wanted = s**alpha
    rows = (s[:, None] * t / (1 + s[:, None] * t)) / wanted[:, None]
    k, _ = nnls(np.vstack([rows.real, rows.imag]), np.repeat([1.0, 0.0], s.size))
    return k, t


def fractional(rng: Rng, setup: Setup, swing: Swing) -> Draft:
    """A joint with a damper c s^alpha, between a spring and a dashpot."""
    on, spring, _ = joint(rng, setup, swing)
    alpha = float(rng.uniform(0.3, 0.7))
    k, t = fraction(alpha)
    force, motion = units(setup, on)

    def apply(s: Setup, v: Numbers) -> Setup:
        branches = Relaxation(on, tuple((v["c"] * k).tolist()), tuple(t.tolist()))
        return replace(s, relaxations=(*s.relaxations, branches))

    return Draft(
        "fractional_damper", on, None, {"c": f"{force} s^{alpha:.3f}/{motion}", "alpha": "1"},
        lambda x: {"c": x, "alpha": alpha}, apply, 1e-6 * spring, spring,
    )  # fmt: skip


def between_runs(rng: Rng, setup: Setup, swing: Swing) -> Draft:
    """A joint whose stiffness is another one in each run."""
    on, _, _ = joint(rng, setup, swing)
    seed = int(rng.integers(2**31))

    def run(s: Setup, v: Numbers, number: int) -> Setup:
        step = float(np.random.default_rng([seed, number]).standard_normal())
        return s.with_value(on, "k", s.part(on).values["k"] * float(np.exp(v["spread"] * step)))

    return Draft(
        "run_to_run_stiffness", on, None, {"spread": "1"}, lambda x: {"spread": x},
        lambda s, v: run(s, v, 0), 1e-6, 0.3, run=run,
    )  # fmt: skip


def parametric(rng: Rng, setup: Setup, swing: Swing) -> Draft:
    """A joint whose stiffness swings in time at two frequencies."""
    on, _, _ = joint(rng, setup, swing)
    w = 2 * np.pi * np.exp(rng.uniform(np.log(0.1), np.log(3.0), 2))
    share = float(rng.uniform(0.3, 1.0))
    law = on_joint("parametric", on)

    def apply(s: Setup, v: Numbers) -> Setup:
        numbers = {"depth_1": v["depth"], "depth_2": share * v["depth"], "w_1": w[0], "w_2": w[1]}
        return law(s, numbers)

    return Draft(
        "parametric_stiffness", on, None, {"depth": "1"}, lambda x: {"depth": x}, apply, 1e-5, 0.4
    )


OUTSIDE: dict[str, Callable[[Rng, Setup, Swing], Draft]] = {
    "hysteresis": hysteresis,
    "fractional_damper": fractional,
    "run_to_run_stiffness": between_runs,
    "parametric_stiffness": parametric,
}
