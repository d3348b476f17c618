"""Short runs of an experiment on the simulated rig, and how often intervals hold the truth."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from experiments.multisine import Multisine
from samii_rig.model.sampled import sampled_response
from samii_rig.rig.load import load_rig
from samii_rig.rig.schema import Rig
from samii_rig.run.campaign import Outcome, carry_out
from samii_rig.run.dryrun import predict
from samii_rig.run.experiments import load_experiment
from samii_rig.run.order import RunOrder
from samii_rig.run.plan import Experiment
from samii_rig.signal.statistics import imag_interval, real_interval
from samii_rig.types import FrequencyResponse

# Four periods of a quiet second.
SHORT = Multisine(
    experiment="multisine",
    name="short",
    actuator="v_2",
    unit="V",
    drive="output",
    period=1.0,
    low_hz=4.0,
    high_hz=30.0,
    realisations=1,
    periods=4,
    ramp=0.2,
    amplitudes=(0.5,),
    seed=1,
)


def shipped(rig_name: str, name: str, **changes: object) -> tuple[Rig, str, Experiment]:
    """A rig, its text, and a shipped experiment on it with some fields changed."""
    rig, text = load_rig(rig_name)
    experiment, _ = load_experiment(name, rig)
    kind = type(experiment)
    data = experiment.model_dump(exclude_unset=True)  # type: ignore[attr-defined]
    return rig, text, kind.model_validate({**data, **changes})  # type: ignore[attr-defined]


def simulate(rig: Rig, text: str, experiment: Experiment, path: Path, seed: int = 1) -> Outcome:
    """The experiment on the simulated rig, whole."""
    plan = experiment.plan(rig)
    order = RunOrder(rig, text, "", plan, predict(plan, rig), settings={"seed": seed})
    outcome = carry_out(order, path)
    assert outcome.stop.status == "completed", outcome.stop.reason
    assert outcome.trouble == ""
    return outcome


def coverage(response: FrequencyResponse, rig: Rig, band: tuple[float, float]) -> float:
    """Part of all 90 % intervals (real and imaginary, all outputs) that hold the truth."""
    truth = sampled_response(rig, response.frequency)
    order = [[s.name for s in rig.sensor].index(c.name) for c in response.outputs]
    truth = truth[:, order]
    inside = (response.frequency >= band[0]) & (response.frequency <= band[1])
    held = []
    for interval, part in (
        (real_interval(response), truth.real),
        (imag_interval(response), truth.imag),
    ):
        held.append((interval.low < part) & (part < interval.high))
    return float(np.mean(np.stack(held)[:, inside]))
