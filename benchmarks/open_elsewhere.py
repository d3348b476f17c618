"""A recording and a live run, read by Foxglove's own JavaScript libraries and held against ours.

    python benchmarks/open_elsewhere.py

Wants Node.js 20 and npm, which fetches the libraries that `open_elsewhere/package.json` names. A
run of the simulated SAMII is followed live; then its recording is read. Every channel, instant,
value and mark must be the same, digit by digit; ends with 1 if not.
"""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "tests" / "kits"))

from serve_kit import Service, sweep  # found by the line above
from wait_kit import found

from samii_rig.record.layout import EVENTS, RESPONSES, SAMPLES, field_names
from samii_rig.record.reader import read_events, read_frequency_responses, read_recording
from samii_rig.types import Recording

LONGEST = 600.0  # s for the run and its diagnosis, on a machine with much else to do


def numbers(messages: list[dict[str, Any]], field: str) -> np.ndarray:
    """A field of all messages; null stands for what is no number."""
    return np.array([m["message"][field] for m in messages], dtype=float)


def same(what: str, a: object, b: object) -> None:
    try:
        np.testing.assert_array_equal(a, b)
    except AssertionError as error:
        sys.exit(f"{what}: {error}")


def samples_agree(told: list[dict[str, Any]], recording: Recording) -> None:
    """Number, values and, in a file, marks of each sample."""
    sequence = np.array([int(m["message"]["sequence"]) for m in told])
    at = np.searchsorted(recording.sequence, sequence)
    same("sequence", sequence, recording.sequence[at])
    names = field_names(recording.channels)
    for name, values in zip(names, recording.values[at].T, strict=True):
        same(name, numbers(told, name), values)
    quality = np.array([m["message"]["quality"] for m in told])
    same("quality", quality, recording.quality[at])


def file_agrees(place: Path, path: Path) -> None:
    done = subprocess.run(
        ["node", "file.js", str(path)], cwd=place, stdout=subprocess.PIPE, text=True, check=True
    )
    lines = [json.loads(line) for line in done.stdout.splitlines()]
    recording = read_recording(path)
    by_topic = {
        topic: [m for m in lines if m.get("topic") == topic]
        for topic in (SAMPLES, EVENTS, RESPONSES)
    }
    same("channels", {m["channel"] for m in lines if "channel" in m}, set(by_topic))
    samples = by_topic[SAMPLES]
    same("samples", len(samples), len(recording))
    samples_agree(samples, recording)
    same("instants", [int(m["time"]) for m in samples], recording.wall_time)
    (about,) = (m for m in lines if m.get("channel") == SAMPLES)
    for name, channel in zip(field_names(recording.channels), recording.channels, strict=True):
        same("unit", about["metadata"][f"unit.{name}"], channel.unit)
    same("events", len(by_topic[EVENTS]), len(read_events(path)))
    ours = read_frequency_responses(path)
    same("responses", len(by_topic[RESPONSES]), len(ours))
    for message, r in zip(by_topic[RESPONSES], ours, strict=True):
        m = message["message"]
        same("frequency", m["frequency"], r.frequency)
        same("H, real part", m["h_real"], r.H.real.ravel())
        same("H, imaginary part", m["h_imag"], r.H.imag.ravel())
    texts = {m["attachment"]: m["text"] for m in lines if "attachment" in m}
    same("rig file", texts["rig.toml"], recording.rig_toml)
    print(
        f"file: {len(samples):,} samples of {len(recording.channels)} channels, "
        f"{len(by_topic[EVENTS])} events, {len(ours)} frequency responses: all equal"
    )


def over(service: Service, id_: str) -> dict[str, Any] | None:
    """The job, once it is the last one."""
    last = service.state()["last"]
    return last if last and last["id"] == id_ else None


def live_agrees(place: Path, folder: Path) -> Path:
    """Follow a run, and hold what came against its recording, whose path this gives."""
    with Service(folder, "--pace", "1", "--foxglove", "0") as service:
        assert service.process.stdout is not None
        url = service.process.stdout.readline().split(": ", 1)[1].strip()
        told = place / "live.txt"
        with (
            told.open("w") as out,
            subprocess.Popen(
                ["node", "live.js", url], cwd=place, stdin=subprocess.PIPE, stdout=out
            ) as node,
            service.lease() as lease,
        ):
            service.until(lambda: '"server":"SAMII"' in told.read_text())
            id_ = service.start(lease, sweep(duration=8.0), diagnosis=True)
            last = found(lambda: over(service, id_), LONGEST, every=0.2)
            node.communicate()
        known = service.http.get(f"/api/jobs/{id_}/responses").json()
    lines = [json.loads(line) for line in told.read_text().splitlines()]
    path = folder / last["recording"]
    recording = read_recording(path)
    samples = [m for m in lines if m.get("topic") == SAMPLES]
    samples_agree(samples, recording)
    same("no sample left out", np.diff([int(m["message"]["sequence"]) for m in samples]), 1)
    # Instants of the wall clock, as even as the samples.
    apart = np.diff([int(m["time"]) for m in samples]) * 1e-9 * recording.rate_hz
    same("instants apart, samples", np.round(apart, 6), 1.0)
    bode = [m for m in lines if m.get("topic") == "/bode"]
    newest, kept = bode[-1]["message"]["responses"], known["responses"]
    for a, b in zip(newest, kept[: len(newest)], strict=True):
        for curve in b["curves"]:
            if a["frequency"] == b["frequency"]:
                same("gain", a[curve["output"]]["gain"], curve["gain"])
    print(
        f"live: {len(samples):,} samples of {len(recording):,} in the recording "
        f"(those from the subscription on), {len(bode)} times the frequency responses: all equal"
    )
    return path


def main() -> None:
    for program in ("node", "npm"):
        if shutil.which(program) is None:
            sys.exit(f"{program} is not installed; expected Node.js 20 or newer")
    with tempfile.TemporaryDirectory() as name:
        place = Path(name) / "node"
        shutil.copytree(Path(__file__).with_name("open_elsewhere"), place)
        subprocess.run(["npm", "install", "--silent", "--no-audit"], cwd=place, check=True)
        file_agrees(place, live_agrees(place, Path(name) / "runs"))


if __name__ == "__main__":
    main()
