"""Recordings and frequency responses as data sets 58, and time responses back as columns."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from samii_rig.errors import InputError
from samii_rig.record.uff import function
from samii_rig.record.uff.file import FUNCTION, DataSet, UffFile
from samii_rig.record.uff.sets import Fields
from samii_rig.signal.coherence import partial_coherence
from samii_rig.types import Channel, Complex, Float, FrequencyResponse, Recording

# Codes of the format: what an axis shows, and along what a channel counts.
_TIME, _FREQUENCY, _ACCELERATION, _UNKNOWN = 17, 18, 12, 0
_PLUS_X, _PLUS_Z_ROTATION = 1, 6
_SETS = {
    15: "nodes",
    55: "data at nodes",
    82: "trace line",
    151: "header",
    164: "units",
    2411: "nodes",
    2412: "elements",
}
_FUNCTIONS = {
    0: "general function",
    1: "time response",
    2: "auto spectrum",
    3: "cross spectrum",
    4: "frequency response",
    6: "coherence",
    9: "power spectral density",
    12: "spectrum",
    21: "partial coherence",
    26: "multiple coherence",
}
NO_LABEL = {"", "NONE", "-"}  # what universal files write for "no label"
# An uneven abscissa has 6 digits in text, an even one a start and a step. Beyond this relative
# deviation it is uneven.
_EVEN = 1e-9


def function_fields(id1: str, *, data: Float | Complex, unit: str, **others: Any) -> Fields:
    """The fields of a function whose `others` stand for what is not none of it."""
    axes = {
        f"{axis}_{what}": 0
        for axis in ("x", "y", "y2", "z")
        for what in ("type", "length", "force", "temperature")
    }
    labels = {f"{axis}_{what}": "NONE" for axis in ("y2", "z") for what in ("label", "unit")}
    ids = {f"id{i}": "NONE" for i in range(2, 6)}
    degree = {
        f"{end}_{what}": value
        for end in ("response", "reference")
        for what, value in (("entity", "NONE"), ("node", 0), ("direction", 0))
    }
    numbers = dict.fromkeys(("function_id", "version", "load_case"), 0)
    return {
        "id1": id1,
        **ids,
        "function_type": function.TIME_RESPONSE,
        **numbers,
        **degree,
        "x_min": 0.0,
        "x_step": 0.0,
        "z": 0.0,
        **axes,
        **labels,
        "x_label": "Time",
        "x_unit": "s",
        "x_type": _TIME,
        "y_label": "NONE",
        "y_unit": unit[:20] or "NONE",
        "data": data,
        **others,
    }


def recording_sets(recording: Recording) -> Iterator[DataSet]:
    """A binary time response a channel. InputError for a recording with gaps."""
    r = recording
    require_even(r, "UFF 58")
    for i, channel in enumerate(r.channels):
        yield DataSet(
            FUNCTION,
            function_fields(
                channel.name,
                id4=f"{channel.role}, {r.rate_hz:g} Hz",
                data=r.values[:, i],
                unit=channel.unit,
                x_step=1.0 / r.rate_hz,
                response_entity=channel.name[:10],
                response_node=i + 1,
                response_direction=_direction(channel),
                y_type=_ACCELERATION if channel.unit == "m/s^2" else _UNKNOWN,
                y_label=channel.name,
            ),
            binary=True,
        )


def require_even(recording: Recording, form: str) -> None:
    """InputError if samples or values are missing, which a format of one step in time cannot
    show."""
    r = recording
    said = "" if len(r) else "there is no sample"
    jumps = np.flatnonzero(np.diff(r.sequence) != 1)
    empty = np.argwhere(~np.isfinite(r.values))
    if jumps.size:
        lost = int(r.sequence[-1] - r.sequence[0]) + 1 - len(r)
        said = f"{lost} samples are missing, the first after sample {jumps[0]}"
    elif empty.size:
        row, column = (int(k) for k in empty[0])
        said = f"{len(empty)} values are missing, the first in {r.channels[column].name} at {row}"
    if said:
        expected = f"none for {form}, which has one step in time; CSV, Parquet and MAT show gaps"
        raise InputError.saying(r.source, "", f"{said}; expected {expected}")


def response_sets(response: FrequencyResponse) -> Iterator[DataSet]:
    """H of each entry and the coherence of each output; of several inputs the multiple coherence
    of each output and the partial coherence of each entry."""
    r, many = response, len(response.inputs) > 1
    partial = partial_coherence(r)
    coherence = "Multiple coherence" if many else "Coherence"
    for i, y in enumerate(r.outputs):
        for j, u in enumerate(r.inputs):
            unit = f"{y.unit}/{u.unit}"
            yield _of_response(r, "FRF", r.H[:, i, j], (i, y), (j, u), unit)
            if many:
                yield _of_response(r, "Partial coherence", partial[:, i, j], (i, y), (j, u), "")
        yield _of_response(r, coherence, r.coherence[:, i], (i, y), (0, r.inputs[0]), "")


def _of_response(
    r: FrequencyResponse,
    what: str,
    data: Complex | Float,
    response: tuple[int, Channel],
    reference: tuple[int, Channel],
    unit: str,
) -> DataSet:
    (i, y), (j, u) = response, reference
    f = r.frequency
    step = (f[-1] - f[0]) / (len(f) - 1) if len(f) > 1 else 0.0
    even = len(f) > 1 and bool(np.all(np.abs(np.diff(f) / step - 1) < _EVEN))
    kinds = {
        "FRF": function.FREQUENCY_RESPONSE,
        "Coherence": function.COHERENCE,
        "Partial coherence": function.PARTIAL_COHERENCE,
        "Multiple coherence": function.MULTIPLE_COHERENCE,
    }
    return DataSet(
        FUNCTION,
        function_fields(
            f"{what} {y.name}/{u.name}",
            function_type=kinds[what],
            id2=f"level {r.level:g} {r.level_unit}, {r.n_averages} averages",
            id4=f"method {' '.join(r.method.split())}",
            data=data,
            unit=unit,
            **({"x_min": float(f[0]), "x_step": float(step)} if even else {"x": f}),
            response_entity=y.name[:10],
            response_node=i + 1,
            response_direction=_direction(y),
            reference_entity=u.name[:10],
            reference_node=j + 1,
            reference_direction=_direction(u),
            x_type=_FREQUENCY,
            x_label="Frequency",
            x_unit="Hz",
            y_type=_ACCELERATION if y.unit == "m/s^2" else _UNKNOWN,
            y_label=what,
        ),
    )


def _direction(channel: Channel) -> int:
    """Direction code: an angle turns about +Z, an acceleration goes along +X, else scalar."""
    return {"rad": _PLUS_Z_ROTATION, "m/s^2": _PLUS_X}.get(channel.unit, 0)


def inventory(file: UffFile) -> list[str]:
    """What sets the file holds, a line a kind, in the order of the file."""
    said = []
    for i, kind in enumerate(file.kinds):
        what = _SETS.get(kind, "not known here")
        if kind == FUNCTION:
            of_type = file.head(i)["function_type"]
            what = _FUNCTIONS.get(of_type, f"function of type {of_type}")
        said.append(f"{kind}, {what}")
    return [f"{said.count(line)} x {line}" for line in dict.fromkeys(said)]


def time_responses(file: UffFile) -> dict[str, int]:
    """Index of each set 58 that is a time response, by its first ID line; by its place among them
    (`#1`, `#2`, ...) where that line is empty or not its own."""
    places = [
        i
        for i, kind in enumerate(file.kinds)
        if kind == FUNCTION and file.head(i)["function_type"] == function.TIME_RESPONSE
    ]
    labels = [str(file.head(i)["id1"]).strip() for i in places]
    names = [
        label if label.upper() not in NO_LABEL and labels.count(label) == 1 else f"#{n}"
        for n, label in enumerate(labels, 1)
    ]
    return dict(zip(names, places, strict=True))
