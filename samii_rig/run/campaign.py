"""A whole run: predict, drive, record, estimate, and keep it all in one file."""

from __future__ import annotations

import json
import platform
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path
from threading import Event

from samii_rig.errors import EstimateError
from samii_rig.record.reader import read_recording
from samii_rig.record.writer import RunWriter
from samii_rig.rig.schema import Rig
from samii_rig.run.devices import open_device
from samii_rig.run.dryrun import DryRun
from samii_rig.run.loop import Progress, run
from samii_rig.run.protocols import Plan
from samii_rig.run.sink import recorded_channels
from samii_rig.signal.estimate import estimate
from samii_rig.types import FrequencyResponse, Recording, StopRecord

# What can change a result and is not in the recording otherwise.
VERSIONS_OF = ("samii-rig", "numpy", "scipy", "numba", "mcap")


@dataclass(frozen=True, slots=True)
class Outcome:
    """What a run left behind. `trouble` says why there are no responses, "" if there are."""

    path: Path
    recording: Recording
    responses: tuple[FrequencyResponse, ...]
    stop: StopRecord
    trouble: str


def carry_out(
    rig: Rig,
    rig_toml: str,
    experiment_toml: str,
    plan: Plan,
    predicted: DryRun,
    path: Path,
    *,
    settings: dict[str, object] | None = None,
    operator: str = "",
    progress: Callable[[Progress], None] | None = None,
    stop: Event | None = None,
) -> Outcome:
    """Run `plan` on the rig's device into the recording `path`, estimate, close.

    However the run ends, the recording is whole and says how; what was measured until then
    is estimated where it suffices. Raises DeviceError if the rig does not open and
    RecordingError if the file cannot be written; the output is at zero before either.
    """
    predicted.refuse()
    device = open_device(rig, settings or {})
    try:
        notes = {
            "experiment": plan.experiment,
            "seed": str(plan.seed),
            "operator": operator,
            "started": datetime.now(UTC).isoformat(timespec="seconds"),
            "device": device.description,
            "centring": f"{plan.centring_sensor} {plan.kp!r}",
            "predicted_peaks": json.dumps(_peaks(predicted)),
            **{f"device_{key}": value for key, value in device.metadata.items()},
            **versions(),
        }
        with RunWriter(
            path,
            recorded_channels(rig, plan, device.sensor.channels),
            plan.rate_hz,
            rig_toml=rig_toml,
            experiment_toml=experiment_toml,
            metadata=notes,
        ) as writer:
            ended = run(plan, rig, device, writer, progress, stop)
            writer.flush()
            recording = read_recording(writer.partial_path, partial=True)
            responses, trouble = _estimated(replace(recording, source=str(path)))
            for response in responses:
                writer.frequency_response(response)
            writer.close(ended)
    finally:
        device.close()
    return Outcome(path, read_recording(path), responses, ended, trouble)


def versions() -> dict[str, str]:
    """Versions of what the numbers depend on, for the recording."""
    found = {f"version_{name}": metadata.version(name) for name in VERSIONS_OF}
    return {"version_python": sys.version.split()[0], "platform": platform.platform(), **found}


def _peaks(predicted: DryRun) -> dict[str, float]:
    """Largest |value| of each channel in the whole plan."""
    highest = predicted.peaks.max(axis=0)
    return {
        name: float(f"{peak:.6g}") for name, peak in zip(predicted.channels, highest, strict=True)
    }


def _estimated(recording: Recording) -> tuple[tuple[FrequencyResponse, ...], str]:
    if not recording.segments:
        return (), "no segment was completed"
    try:
        return estimate([recording]), ""
    except EstimateError as error:
        # The samples are kept; `samii-rig frf` can be asked again, with other options.
        return (), str(error)
