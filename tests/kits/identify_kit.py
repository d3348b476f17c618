"""Responses of the model with the noise that a measurement of some minutes has."""

from functools import cache

import numpy as np

from samii_rig.identify.bootstrap import redraw
from samii_rig.model.sampled import sampled_response
from samii_rig.rig.load import load_rig
from samii_rig.rig.schema import parameters
from samii_rig.types import Channel, FrequencyResponse

STIFFNESSES = ("clamp.k", "joint_1.k", "joint_2.k", "joint_3.k")


@cache
def samii():
    return load_rig("samii")[0]


def noiseless(rig, f, outputs=None, *, relative=0.01, dof=40.0, correlation=0.3):
    """The rig's response, with a covariance that has `relative` noise and correlated outputs."""
    names = [s.name for s in rig.sensor]
    outputs = tuple(outputs or names)
    H = sampled_response(rig, f)[:, [names.index(o) for o in outputs]]
    size = np.abs(H[:, :, 0])
    sd = relative * (size + np.median(size, axis=0)) / 2
    p = len(outputs)
    shape = np.full((p, p), correlation) + (1 - correlation) * np.eye(p)
    return FrequencyResponse(
        frequency=f,
        H=H,
        covariance=sd[:, :, None] * shape * sd[:, None, :] + 0j,
        dof=np.full(f.size, dof),
        coherence=np.ones((f.size, p)),
        inputs=(Channel(rig.actuator[0].name, rig.actuator[0].unit, "command"),),
        outputs=tuple(Channel(o, rig.units()[o]) for o in outputs),
        level=1.0,
        level_unit=rig.actuator[0].unit,
        input_rms=np.ones((f.size, 1)),
        rate_hz=rig.rate_hz,
        n_averages=round(dof) + 1,
        method="burst (drawn)",
        why="drawn",
    )


def drawn(rig, seed=0, *, n=200, band=(0.5, 40.0), outputs=None, truth=None, **noise):
    """A measurement of `truth` (the rig itself) with fresh noise."""
    like = noiseless(rig, np.geomspace(*band, n), outputs, **noise)
    H = like.H if truth is None else noiseless(truth, like.frequency, outputs).H
    return redraw(like, H, np.random.default_rng(seed))


def without_tolerances(rig, but=()):
    """The rig with tolerances of these elements alone."""

    def exact(e):
        held = {s: p.model_copy(update={"tolerance": 0.0}) for s, p in parameters(e).items()}
        return e if e.name in but else e.model_copy(update=held)

    return rig.model_copy(update={"element": tuple(exact(e) for e in rig.element)})
