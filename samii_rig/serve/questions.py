"""What the service is asked that takes more than a moment; `desk` has it done beside."""

from __future__ import annotations

import math
import tempfile
from base64 import b64encode
from contextlib import suppress
from itertools import pairwise
from pathlib import Path
from typing import Any

MOST_POINTS = 4000  # of one curve in one answer
MOST_VALUES = 8_000_000  # of samples in one answer: ten channels at 1 kHz for 13 minutes


def awake() -> dict[str, Any]:
    """Nothing; what a prediction needs is loaded, which takes seconds."""
    import samii_rig.run.order  # noqa: F401

    return {}


def rig(rig_toml: str) -> dict[str, Any]:
    """The rig as data, as a drawing, and how it moves with its sensors (see `motion`)."""
    import numpy as np

    from samii_rig.report.drawing import draw
    from samii_rig.rig.load import parse
    from samii_rig.rig.schema import Rig
    from samii_rig.serve.motion import motion

    the_rig = parse(Rig, rig_toml, "rig file")
    moves = motion(the_rig)
    moving = None
    if moves is not None:
        kinds = {e.name: e.kind for e in the_rig.element}
        moving = {
            "x": moves.x.tolist(),
            "element": list(moves.element),
            "kind": [kinds[name] for name in moves.element],
            "sensors": list(moves.sensors),
            "accelerations": list(moves.accelerations),
            "hz": moves.hz.tolist(),
            "matrix": np.round(moves.matrix, 5).tolist(),
        }
    found = the_rig.model_dump(mode="json", exclude={"device": {"settings"}})
    return {"rig": found, "drawing": draw(the_rig), "motion": moving, "text": rig_toml}


def in_pose(rig_toml: str, pose: str) -> dict[str, Any]:
    """The text of the rig file in a pose, such as "30 deg"."""
    from samii_rig.rig.pose import posed_text

    return {"text": posed_text(rig_toml, pose, "pose")}


def dry_run(rig_toml: str, name: str, text: str, pose: str = "") -> dict[str, Any]:
    """What an experiment would do: margins, expected errors, one prediction for each run.

    name : of a shipped experiment, or `text` : of its file. No path from a client is ever opened.
    pose : that the rig stands in, "" for that of its file.
    refused : the line of what limit would be broken, "" if none. text : of the experiment.
    """
    from samii_rig.errors import InputError, LimitError, one_of
    from samii_rig.rig.load import parse
    from samii_rig.rig.schema import Rig
    from samii_rig.run.experiments import shipped
    from samii_rig.run.order import Order
    from samii_rig.serve.words import prediction

    if pose:
        rig_toml = str(in_pose(rig_toml, pose)["text"])
    the_rig = parse(Rig, rig_toml, "rig file")
    if bool(name) == bool(text):
        raise InputError("experiment", "", name, "a name or a text, one of the two")
    if name and name not in shipped():
        raise InputError("experiment", "", name, one_of(name, shipped()))
    if name:
        order = Order.named(name, the_rig, rig_toml)
    else:
        order = Order.written(text, "experiment.toml", the_rig, rig_toml)
    runs, refused = [], ""
    for run in order.runs():
        predicted = run.predict().predicted
        try:
            predicted.refuse()
        except LimitError as error:
            refused = refused or str(error)
        about = {"setup": run.setup.name, "instruction": run.setup.instruction}
        runs.append({**about, "segments": len(run.plan.segments), **prediction(predicted)})
    asked = {"experiment": order.experiment.name, "text": order.experiment_toml}
    return {**asked, "runs": runs, "refused": refused}


def signals(path: str, names: list[str], start: float, stop: float, pixels: int) -> dict[str, Any]:
    """Channels of a recording as curves of at most 2 `pixels` points whose outline is whole.

    start, stop : s from the first sample; `stop` 0 for the end.
    """
    import numpy as np

    from samii_rig.errors import InputError
    from samii_rig.record.reader import read_recording
    from samii_rig.report.decimate import thin

    recording = read_recording(Path(path))
    known = [c.name for c in recording.channels]
    for name in names:
        if name not in known:
            raise InputError("signals", "channel", name, f"one of {', '.join(known)}")
    if not 1 <= pixels <= MOST_POINTS // 2:
        raise InputError("signals", "pixels", pixels, f"1 to {MOST_POINTS // 2}")
    begin = recording.time[0] if len(recording) else 0
    t = (recording.time - begin) * 1e-9
    low, high = np.searchsorted(t, [start, stop if stop > 0 else math.inf])
    curves = []
    for name in names or known:
        column = recording.column(name)
        channel = recording.channels[column]
        x, y = thin(t[low:high], recording.values[low:high, column], pixels)
        curves.append(
            {
                "name": name,
                "unit": channel.unit,
                "role": channel.role,
                "time": x.tolist(),
                "values": y.tolist(),
            }
        )
    first = int(recording.sequence[0]) if len(recording) else 0
    rate = recording.rate_hz
    return {
        "rate_hz": rate,
        "duration_s": float(t[-1]) if len(t) else 0.0,
        "curves": curves,
        "gaps": int((np.diff(recording.sequence) > 1).sum()),
        "segments": [
            {
                "name": s.name,
                "kind": s.kind,
                "level": s.level,
                "unit": s.unit,
                "start_s": (s.start - first) / rate,
                "stop_s": (s.stop - first) / rate,
            }
            for s in recording.segments
        ],
    }


def frames(path: str, start: float, length: float) -> dict[str, Any]:
    """Samples as frames of the live data, one after the other, in base64; the first sample of the
    recording is number 0, and each stretch between gaps has frames of its own.

    start, length : s by the sample numbers.
    """
    import numpy as np

    from samii_rig.errors import InputError
    from samii_rig.record.reader import read_recording
    from samii_rig.serve.viewers import decimated, frame, step_of

    recording = read_recording(Path(path))
    rate, step = recording.rate_hz, step_of(recording.rate_hz)
    number = recording.sequence - (recording.sequence[0] if len(recording) else 0)
    # Whole steps, so that one answer goes on where the last one ended.
    low, high = (math.floor(t * rate / step) * step for t in (start, start + length))
    begin, end = np.searchsorted(number, [low, high])
    if (end - begin) * recording.values.shape[1] > MOST_VALUES:
        raise InputError("frames", "length", length, f"at most {MOST_VALUES:,} values in it")
    data = []
    cuts = begin + 1 + np.flatnonzero(np.diff(number[begin:end]) != 1)
    for first, last in pairwise([begin, *cuts, end]):
        rows = (last - first) // step * step
        if rows:
            values = decimated(recording.values[first : first + rows], step)
            data.append(frame(values, step, rate, int(number[first])))
    return {"frames": b64encode(b"".join(data)).decode()}


def responses(path: str) -> dict[str, Any]:
    """The frequency responses logged in a recording, with the half width of their 90 % bands."""
    from samii_rig.record.reader import read_frequency_responses
    from samii_rig.serve.words import response

    return {"responses": [response(r) for r in read_frequency_responses(Path(path))]}


def report(path: str, diagnosed: bool) -> dict[str, Any]:
    """The page about a recording, as `samii-rig report` writes it.

    diagnosed : with the diagnosis, made again from the responses that the run logged.
    """
    from samii_rig.errors import InputError
    from samii_rig.record.reader import read_events, read_frequency_responses, read_recording
    from samii_rig.report.compare import model_curve
    from samii_rig.report.page import Subject, write_report
    from samii_rig.rig.load import parse
    from samii_rig.rig.schema import Rig

    recording = read_recording(Path(path))
    responses = read_frequency_responses(Path(path))
    the_rig = found = None
    # Of another version, or imported: the measurement is shown all the same.
    with suppress(InputError):
        the_rig = parse(Rig, recording.rig_toml, "the recording's rig file")
    if diagnosed and responses and the_rig is not None:
        from samii_rig.diagnose.diagnose import diagnose

        found = diagnose(responses, the_rig, runs=[recording])
    with tempfile.TemporaryDirectory() as folder:
        page = write_report(
            Path(folder) / "report.html",
            Subject(
                [recording],
                responses,
                the_rig,
                model_curve(the_rig, responses) if the_rig else None,
                events=read_events(Path(path)),
            ),
            diagnosis=found,
        )
        return {"page": page.read_text(encoding="utf-8")}


def comparison(a: str, b: str) -> dict[str, Any]:
    """How the frequency responses of two recordings differ, in their own uncertainty."""
    from samii_rig.record.reader import read_frequency_responses
    from samii_rig.serve.words import compared

    first, second = (read_frequency_responses(Path(p)) for p in (a, b))
    return {"pairs": compared(first, second)}
