"""What the simulated rig shows: an experiment carried out, recorded and estimated.

The papers' measured curves exist only as pictures. In their place stands the simulated rig with
its sampling, filters, noise and converters, driven through the safety gate by the same commands
that drive a real one.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import cast

import numpy as np
from pydantic import BaseModel

from samii_rig.errors import DeviceError, EstimateError
from samii_rig.model.sampled import hold_response, sensor_response
from samii_rig.rig.load import load_rig
from samii_rig.rig.schema import Rig
from samii_rig.run.campaign import carry_out
from samii_rig.run.dryrun import predict
from samii_rig.run.experiments import load_experiment
from samii_rig.run.order import RunOrder
from samii_rig.run.plan import Experiment
from samii_rig.types import Complex, FrequencyResponse

SEED = 20  # of every simulated run here


@cache
def recorded(rig_name: str, experiment: str, seed: int = SEED) -> FrequencyResponse:
    """The response of a shipped rig in a shipped experiment, at its highest level."""
    rig, text = load_rig(rig_name)
    return carried_out(rig, text, experiment, seed)


def carried_out(
    rig: Rig,
    rig_toml: str,
    experiment: str,
    seed: int = SEED,
    changes: Mapping[str, object] | None = None,
) -> FrequencyResponse:
    """The response of `rig` in an experiment, by name or path; nothing is kept on the disk.

    Of an experiment's levels only the highest is driven: it has the least noise. changes :
    other values of fields of the experiment's file.
    Raises DeviceError if the run does not end by itself, EstimateError without a response.
    """
    planned, experiment_toml = load_experiment(experiment, rig)
    if isinstance(planned, BaseModel):
        levels = getattr(planned, "amplitudes", ())
        loudest = {"amplitudes": (max(levels),)} if levels else {}
        planned = cast("Experiment", planned.model_copy(update={**loudest, **(changes or {})}))
    plan = planned.plan(rig)
    with TemporaryDirectory() as folder:
        order = RunOrder(
            rig, rig_toml, experiment_toml, plan, predict(plan, rig), settings={"seed": seed}
        )
        outcome = carry_out(order, Path(folder) / "run.mcap")
    if outcome.stop.status != "completed":
        raise DeviceError(f"the run ended {outcome.stop.status}: {outcome.stop.reason}")
    if not outcome.responses:
        raise EstimateError(outcome.trouble)
    return outcome.responses[0]


def thinned(r: FrequencyResponse, step: int) -> FrequencyResponse:
    """Every `step`-th line of a response."""
    per_line = ("frequency", "H", "covariance", "dof", "coherence", "input_rms")
    return replace(r, **{name: getattr(r, name)[:: max(step, 1)] for name in per_line})


def continuous(response: FrequencyResponse, rig: Rig) -> Complex:
    """(n_freq, n_out, n_in) with hold, filters and delays of the rig file divided out."""
    f = response.frequency
    names = [s.name for s in rig.sensor]
    seen = sensor_response(rig.sensor, f)[:, [names.index(y.name) for y in response.outputs]]
    inputs = {a.name: a for a in rig.actuator}
    holds = np.stack(
        [hold_response(f, response.rate_hz, inputs[u.name].delay) for u in response.inputs], axis=1
    )
    return np.asarray(response.H / (seen[:, :, None] * holds[:, None, :]))
