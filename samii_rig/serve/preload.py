"""All that the service's processes need before they are told what to do; see `loaded`."""

from __future__ import annotations

import gc
from contextlib import suppress

import numpy as np

import samii_rig.report.drawing
import samii_rig.run.order
import samii_rig.serve.motion
import samii_rig.serve.runner
import samii_rig.serve.words  # noqa: F401
from samii_rig.model.kernels.respond import compiled
from samii_rig.model.realise import realise
from samii_rig.model.sampled import sampled_response
from samii_rig.rig.load import load_rig


def _kernels() -> None:
    """The compiled ones of the model, by what uses them: they are the same for every rig.

    To compile them takes a minute, in which nobody could be copied and the service could not end:
    the first who needs them does it.
    """
    if not compiled():
        return
    rig, _ = load_rig("one_mass")
    sampled_response(rig, np.array([1.0]))
    realise(rig)


# Who needs them and has them not says what is wrong.
with suppress(Exception):
    _kernels()
# It stays in use: no copy looks through it for garbage, and its memory stays shared.
gc.collect()
gc.freeze()
