"""A whole run: predict, drive, record, estimate, and keep it all in one file."""

from __future__ import annotations

import gc
import json
import platform
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import asdict, replace
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path

from samii_rig.devices.opening import close_device, open_device
from samii_rig.devices.protocols import OpenRig
from samii_rig.errors import NO_MEMORY, RecordedError, RecordingError, SamiiRigError
from samii_rig.record.reader import read_frequency_responses, read_recording
from samii_rig.record.writer import Origin, RunWriter
from samii_rig.run.client import NOBODY, Client
from samii_rig.run.dryrun import DryRun
from samii_rig.run.ending import finish
from samii_rig.run.interrupts import Interrupts
from samii_rig.run.loop import run
from samii_rig.run.order import RunOrder
from samii_rig.run.outcome import Outcome
from samii_rig.run.pace import LoopSettings
from samii_rig.run.priority import prioritised
from samii_rig.run.sink import Sink, Watched, recorded_channels
from samii_rig.safety.latch import Cleared, Latch
from samii_rig.signal.estimate import estimate
from samii_rig.types import SampleBlock, StopRecord

# What can change a result and is not in the recording otherwise.
VERSIONS_OF = ("samii-rig", "numpy", "scipy", "numba", "mcap")


def carry_out(
    order: RunOrder,
    path: Path,
    client: Client = NOBODY,
    *,
    loop: LoopSettings | None = None,
    watch: Callable[[SampleBlock], None] | None = None,
    at_rest: Callable[[StopRecord], None] | None = None,
    why: Callable[[StopRecord], str] | None = None,
) -> Outcome:
    """Run the order's plan on the rig's device into the recording `path`, estimate, close.

    However the run ends, the recording is whole and says how; what was measured until then
    is estimated where it suffices. A FAULT on a real rig is latched (`samii_rig.safety.latch`), and
    while one is, nothing is opened. client, loop : see `samii_rig.run.loop.run`.
    watch : gets every block after it was recorded, for a display; it must neither wait nor raise.
    why : is asked for the reason of an end, where it may be known better than here: a signal does
    not say who sent it. at_rest : is told how the run ended once nothing moves, before the estimate
    is made and the recording closed.

    Raises LimitError if the order would break a limit, GateError for a latched fault, DeviceError
    if the rig does not open or another program drives it, RecordingError if the file cannot be
    made, and DiskError if the disk has no room or refuses it later; RecordedError if the recording
    is closed and cannot be read back; the output is at zero before each of them.
    """
    order.refuse(path)
    rig = order.rig
    latch = Latch(rig.name, rig.device.driver)
    latch.refuse()
    # Before any device waits: the samples of a run before are garbage in cycles, which by itself
    # may stay for a hundred runs.
    gc.collect()
    device = open_device(rig, order.settings)
    try:
        real_latch = _real_latch(device, latch)
        notes = _notes(order, device, real_latch.cleared if real_latch else None)
        with (
            latch.held(device),
            Interrupts() as interrupts,
            _writer(order, path, device, notes) as writer,
        ):
            sink = writer if watch is None else Watched(writer, watch)
            with _refusal_recorded(writer, interrupts):
                ended = _drive(order, device, sink, client, loop, interrupts, real_latch)
            if why is not None:
                ended = replace(ended, reason=why(ended))
            if at_rest is not None:
                at_rest(ended)
            # What the device has learnt meanwhile, as how well its clocks are known.
            if news := dict(_of_device(device).items() - notes.items()):
                writer.note(news)
            trouble = _estimate_into(writer, interrupts)
            finish(writer, ended)
    finally:
        close_device(device)
    with _recorded(path, ended):
        responses = tuple(read_frequency_responses(path))
        return Outcome(path, read_recording(path), responses, ended, trouble, interrupts.came)


def _real_latch(device: OpenRig, latch: Latch) -> Latch | None:
    """The latch that holds for this device, None for a simulated one; GateError where the device
    itself says that it tripped."""
    if device.metadata.get("clock") == "simulated":
        return None
    if tripped := device.metadata.get("tripped"):
        latch.set(tripped)
        latch.refuse()
    return latch


def _drive(
    order: RunOrder,
    device: OpenRig,
    sink: Sink,
    client: Client,
    loop: LoopSettings | None,
    interrupts: Interrupts,
    latch: Latch | None,
) -> StopRecord:
    """The loop itself: with a latch, which a real rig has, at the priority of real time."""
    with nullcontext() if latch is None else prioritised():
        return run(
            order.plan,
            order.rig,
            device,
            sink,
            client,
            settings=loop,
            interrupts=interrupts,
            latch=None if latch is None else latch.set,
        )


@contextmanager
def _recorded(path: Path, ended: StopRecord) -> Iterator[None]:
    """RecordedError instead of what else would be taken for a run that left nothing."""
    try:
        yield
    except (RecordingError, OSError) as error:
        raise RecordedError(path, ended.status, str(error)) from error
    except MemoryError as error:
        raise RecordedError(path, ended.status, NO_MEMORY) from error


def _notes(order: RunOrder, device: OpenRig, cleared: Cleared | None) -> dict[str, str]:
    """What the recording says of the run beside its files, by name."""
    return {
        "experiment": order.plan.experiment,
        "seed": str(order.plan.seed),
        "operator": order.operator,
        "started": datetime.now(UTC).isoformat(timespec="seconds"),
        "device": device.description,
        "centring": "; ".join(f"{o.centring_sensor} {o.kp!r}" for o in order.plan.outputs),
        "predicted_peaks": json.dumps(_peaks(order.predicted)),
        **_of_device(device),
        **({f"fault_cleared_{k}": v for k, v in asdict(cleared).items()} if cleared else {}),
        **versions(),
    }


def _of_device(device: OpenRig) -> dict[str, str]:
    """What the device says of itself now, by the names of the recording."""
    return {f"device_{key}": value for key, value in device.metadata.items()}


def _writer(order: RunOrder, path: Path, device: OpenRig, notes: dict[str, str]) -> RunWriter:
    return RunWriter(
        path,
        recorded_channels(order.rig, order.plan, device.sensor.channels),
        order.plan.rate_hz,
        Origin(order.rig_toml, order.experiment_toml, notes),
    )


@contextmanager
def _refusal_recorded(writer: RunWriter, interrupts: Interrupts) -> Iterator[None]:
    """What is refused before anything moved has a whole recording too, which says so."""
    try:
        yield
    except BaseException as error:
        interrupts.ending = True
        writer.close(StopRecord("failed", _line(error)))
        raise


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


def _estimate_into(writer: RunWriter, interrupts: Interrupts) -> str:
    """Estimate what was recorded so far into the same file; why not, "" if it went well.

    Nothing that goes wrong here may keep the recording from its end: the samples are kept,
    and `samii-rig frf` can be asked again, with other options.
    """
    try:
        with interrupts.give_up():
            writer.flush()
            recording = read_recording(writer.partial_path, partial=True)
            if not recording.segments:
                return "no segment was completed"
            if all(s.kind == "transient" for s in recording.segments):
                return ""
            responses = estimate([replace(recording, source=str(writer.path))])
        for response in responses:
            writer.frequency_response(response)
    except KeyboardInterrupt as error:
        return f"the estimate was given up on {error}; samii-rig frf makes it from the recording"
    except Exception as error:
        return _line(error)
    return ""


def _line(error: BaseException) -> str:
    text = " ".join(str(error).split())
    return text if isinstance(error, SamiiRigError) else f"{type(error).__name__}: {text}"
