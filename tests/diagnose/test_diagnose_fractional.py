"""A joint with a damper c s^alpha: what its chain says, against chains without one."""

import numpy as np
import pytest
from identify_kit import samii
from table_kit import table_of

from samii_rig.diagnose.forces.laws import FRICTION, Force
from samii_rig.diagnose.forces.model import model_of
from samii_rig.diagnose.forces.place import Place
from samii_rig.diagnose.physics.effect import Effect, Unknown
from samii_rig.diagnose.physics.fractional import FractionalChain, Joint
from samii_rig.diagnose.physics.grid import grid
from samii_rig.diagnose.physics.model import Model
from samii_rig.model.tmm import Chain

F = np.geomspace(0.5, 40.0, 20)
CHAIN = Chain(samii())
JOINT = Joint("joint_1", 50.0)
K, C = (CHAIN.values()[CHAIN.parameters.index(("joint_1", s))] for s in ("k", "c"))


def fractional(c: float, alpha: float) -> FractionalChain:
    return FractionalChain(CHAIN, JOINT).with_values(dict(zip(JOINT.keys, (c, alpha), strict=True)))


@pytest.mark.parametrize(
    ("c", "alpha", "same"),
    [
        (0.0, 0.5, {}),
        (3000.0, 0.0, {("joint_1", "k"): K + 3000.0}),
        (300.0, 1.0, {("joint_1", "c"): C + 300.0}),
    ],
    ids=["none", "a spring", "a dashpot"],
)
def test_at_the_ends_of_its_power_it_is_a_spring_or_a_dashpot(c, alpha, same) -> None:
    theirs = CHAIN.with_values(same).response(F)
    np.testing.assert_allclose(fractional(c, alpha).response(F), theirs, rtol=1e-10)


def test_at_each_frequency_it_is_a_spring_beside_a_dashpot() -> None:
    c, alpha = 1000.0, 0.4
    ours = fractional(c, alpha).response(F)
    for f, H in zip(F, ours, strict=True):
        z = c * (2j * np.pi * f) ** alpha
        at_f = {("joint_1", "k"): K + z.real, ("joint_1", "c"): C + z.imag / (2 * np.pi * f)}
        np.testing.assert_allclose(H, CHAIN.with_values(at_f).response([f])[0], rtol=1e-10)


def test_its_derivatives_are_those_of_differences() -> None:
    chain = fractional(1000.0, 0.4)
    keys = (("joint_1", "k"), ("joint_1", "c"), ("beam", "EI"), *JOINT.keys)
    slopes = chain.gradient(F, keys)[1]
    values = dict(zip(chain.parameters, chain.values(), strict=True))
    for i, key in enumerate(keys):
        step = 1e-5 * values[key]
        up, down = (chain.with_values({key: values[key] + d}).response(F) for d in (step, -step))
        differences = (up - down) / (2 * step)
        error = np.abs(slopes[..., i] - differences).max()
        assert error < 1e-7 * np.abs(differences).max()


def test_it_stands_beside_a_lossy_beam() -> None:
    """A causal loss factor and a fractional damper in one model, with its derivatives."""
    rig = samii()
    every = table_of(rig, 0.5, 40.0)
    names = (("structural_damping", "beam"), ("fractional_damping", "joint_1"))
    model = Model(rig, [next(e for e in every if e.name == n) for n in names])
    at = grid(rig, F, np.arange(len(rig.sensor)), np.zeros(len(rig.sensor), dtype=np.int64))
    x = np.append(np.zeros(model.n_nominal), np.log([0.02, 3000.0, 0.4]))
    slopes = model.gradient(x, at)[1]
    for j in range(model.n_nominal, model.n):
        step = 1e-4 * np.eye(model.n)[j]
        differences = (model.response(x + step, at) - model.response(x - step, at)) / 2e-4
        assert np.abs(slopes[..., j] - differences).max() < 1e-5 * np.abs(differences).max()


def test_beside_a_force_the_chain_is_that_without_both() -> None:
    """A force and a fractional damper of one joint ended with "expected a known parameter"."""
    every = table_of(samii(), 0.5, 40.0)
    damper = next(e for e in every if e.fractional is not None and e.site == "joint_2")
    strength = Unknown("T_c", "N m", 1e-3, 1e3, (1.0,))
    force = Force(Place("joint", ("joint_1",)), FRICTION)
    rubbed = Effect("coulomb_friction", "joint_1", (strength,), force=force)
    both, alone = model_of(samii(), (rubbed, damper)), Model(samii(), (damper,))
    x = np.zeros(both.n)
    chain = both.plain(x)
    assert chain.parameters == alone.plain(x[: alone.n]).parameters
    assert np.allclose(chain.response([3.0]), Chain(samii()).response([3.0]))
