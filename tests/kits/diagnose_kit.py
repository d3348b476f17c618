"""What tests of the diagnose share."""

import numpy as np
from identify_kit import noiseless, samii
from table_kit import Effects, table_of

from samii_rig.diagnose.physics.grid import grid
from samii_rig.diagnose.physics.model import Model
from samii_rig.identify.bootstrap import redraw

BAND = (0.5, 40.0)


LINES = np.geomspace(*BAND, 200)


ALL = Effects(lambda: table_of(samii(), *BAND))


_FEW = ("torsional_compliance", "velocity_feedback", "sensor_delay", "sensor_gain")
FEW = Effects(lambda: table_of(samii(), *BAND, *_FEW))


def effect(physics, site, variant=""):
    return next(e for e in ALL if e.name == (physics, site) and e.variant.startswith(variant))


def concealing(*effects, seed=1, rig=None, f=LINES, shared=10):
    """A measurement of the rig with (effect, values) in it."""
    rig = rig or samii()
    model = Model(rig, [e for e, _ in effects])
    x = np.concatenate([np.zeros(model.n_nominal), *(np.log(values) for _, values in effects)])
    at = grid(rig, f, np.arange(len(rig.sensor)), np.zeros(len(rig.sensor), dtype=np.int64))
    exact = noiseless(rig, f)
    return redraw(exact, model.response(x, at)[:, :, None], np.random.default_rng(seed), shared)
