"""The arm of two links under gravity as files of a lab: its rig, and a sweep of it."""

from __future__ import annotations

from pathlib import Path

from poses_kit import two_links

from samii_rig.diagnose.fit.rigfile import toml

SWEEP = """
experiment = "swept_sine"
name = "sweep"
actuator = "v"
unit = "V"
drive = "output"
sweep = "logarithmic"
start_hz = 0.6
stop_hz = 25.0
duration = 12.0
ramp = 1.0
lead_in = 0.5
ring_down = 3.0
amplitudes = [1.0]
repeats = 2
"""


def arm_text() -> str:
    """The rig file, with sensors that have noise and limits that a sweep keeps."""
    rig = two_links()
    sensors = tuple(
        s.model_copy(update={"noise_rms": 2e-4, "low": -1.5, "high": 1.5}) for s in rig.sensor
    )
    text = toml(rig.model_copy(update={"name": "arm", "sensor": sensors}))
    return text + '\n[[limit]]\nchannel = "q_1"\nunit = "rad"\nmax = 1.0\nreason = "a stop"\n'


def files(folder: Path) -> tuple[str, str]:
    """Paths of the rig file and of the experiment."""
    rig, experiment = folder / "arm.toml", folder / "sweep.toml"
    rig.write_text(arm_text())
    experiment.write_text(SWEEP)
    return str(rig), str(experiment)
