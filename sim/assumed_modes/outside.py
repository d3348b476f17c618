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


def one_sided(rng: Rng, setup: Setup, swing: Swing) -> Draft:
    """A joint that is stiffer by dk to one side, as where a crack closes."""
    on, k, _ = joint(rng, setup, swing)
    force, motion = units(setup, on)
    return Draft(
        "one_sided_stiffness", on, None, {"dk": f"{force}/{motion}"}, lambda x: {"dk": x},
        on_joint("one_sided", on), 1e-6 * k, k,
    )  # fmt: skip


OUTSIDE: dict[str, Callable[[Rng, Setup, Swing], Draft]] = {
    "hysteresis": hysteresis,
    "fractional_damper": fractional,
    "one_sided_stiffness": one_sided,
}
