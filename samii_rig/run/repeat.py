"""Whether a recording still gives the frequency responses that were logged in it, to the digit."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from samii_rig.errors import EstimateError
from samii_rig.record import response
from samii_rig.record.reader import read_frequency_responses, read_notes, read_recording
from samii_rig.run.campaign import versions
from samii_rig.signal.estimate import estimate
from samii_rig.types import FrequencyResponse


@dataclass(frozen=True, slots=True)
class Repeat:
    """What repeating an estimate gave.

    numbers : how many were compared. differences : one line for each field that differs, none
        if every digit is as it was. versions : what is of another version now than at the run.
    """

    responses: tuple[FrequencyResponse, ...]
    numbers: int
    differences: tuple[str, ...]
    versions: tuple[str, ...]


def repeat(path: Path) -> Repeat:
    """Estimate again from the samples of a run, as the run itself did, and compare bit by bit.

    EstimateError if the run left no frequency response, RecordingError if it cannot be read.
    """
    recorded = read_frequency_responses(path)
    if not recorded:
        raise EstimateError(f"{path} holds no frequency response to compare with")
    recording = read_recording(path)
    source = recorded[0].sources[0] if recorded[0].sources else str(path)
    estimated = estimate([replace(recording, source=source)])
    again = [response.decode(response.encode(r)) for r in estimated]
    differences: list[str] = []
    if len(again) != len(recorded):
        differences.append(f"{len(recorded)} responses recorded, {len(again)} now")
    numbers = 0
    for was, now in zip(recorded, again, strict=False):
        level = f"{was.level:g} {was.level_unit}"
        for field in fields(FrequencyResponse):
            a, b = getattr(was, field.name), getattr(now, field.name)
            numbers += a.size if isinstance(a, np.ndarray) else 1
            if said := _difference(a, b):
                differences.append(f"{field.name} at level {level}: {said}")
    then, today = read_notes(path), versions()
    other = tuple(
        f"{name.removeprefix('version_')} {then[name]} then, {version} now"
        for name, version in today.items()
        if name in then and then[name] != version
    )
    return Repeat(tuple(again), numbers, tuple(differences), other)


def _difference(a: Any, b: Any) -> str:
    """How two values differ in any bit; "" if they do not."""
    if isinstance(a, np.ndarray) and isinstance(b, np.ndarray):
        if a.shape != b.shape or a.dtype != b.dtype:
            return f"{a.dtype} {a.shape} recorded, {b.dtype} {b.shape} now"
        x, y = np.ascontiguousarray(a), np.ascontiguousarray(b)
        width = x.dtype.itemsize
        differ = (x.view(np.uint8) != y.view(np.uint8)).reshape(-1, width).any(axis=1)
        if not differ.any():
            return ""
        at = int(np.argmax(differ))
        p, q = x.reshape(-1)[at], y.reshape(-1)[at]
        return f"{int(differ.sum())} of {x.size} numbers, first {p!r} recorded, {q!r} now"
    if isinstance(a, tuple) and isinstance(b, tuple) and len(a) == len(b):
        return next((said for p, q in zip(a, b, strict=True) if (said := _difference(p, q))), "")
    # By their text, in which every digit stands and what is no number equals itself.
    return "" if repr(a) == repr(b) else f"{a!r} recorded, {b!r} now"
