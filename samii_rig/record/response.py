"""A frequency response as one MCAP message: what it holds, and back.

The arrays are float64[] fields under their own names, so that any reader of ROS 2 messages
gets them; the words and the channels are strings (JSON where they have structure).
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import Any, cast

import numpy as np

from samii_rig.errors import RecordingError
from samii_rig.record import cdr
from samii_rig.record.layout import MAX_CHANNELS, channel_from_json, channel_to_json
from samii_rig.types import Channel, Complex, Finding, Float, FrequencyResponse

SCHEMA = "samii_rig/msg/FrequencyResponse"

# ROS 2 wants lower case; arrays are flattened in the order of the axes in types.py.
_FIELDS: tuple[tuple[cdr.Kind, str, str], ...] = (
    ("string", "method", "which estimator"),
    ("string", "why", "why it was chosen"),
    ("string", "sources", "JSON: recordings it came from"),
    ("string", "inputs", "JSON: channels"),
    ("string", "outputs", "JSON: channels"),
    ("string", "findings", "JSON: what was noticed"),
    ("string", "level_unit", ""),
    ("float64", "level", "amplitude of the reference"),
    ("float64", "rate_hz", "samples/s"),
    ("int64", "n_averages", ""),
    ("float64[]", "frequency", "Hz, n_freq"),
    ("float64[]", "h_real", "n_freq * n_out * n_in"),
    ("float64[]", "h_imag", ""),
    ("float64[]", "covariance_real", "n_freq * p * p, p = n_out * n_in"),
    ("float64[]", "covariance_imag", ""),
    ("float64[]", "dof", "n_freq"),
    ("float64[]", "coherence", "n_freq * n_out"),
    ("float64[]", "input_rms", "n_freq * n_in"),
    ("float64[]", "even", "n_freq * n_out, NaN where unknown"),
    ("float64[]", "odd", ""),
    ("float64[]", "noise", "n_freq * n_out, of one repeat over the output; NaN where unknown"),
    ("float64[]", "distortion", "n_freq * n_out, of one realisation over the output"),
    ("string", "followers", "JSON: commands that nothing drove and their loops moved"),
    (
        "float64[]",
        "follow_real",
        "n_freq * n_followers * n_in, of each over each input; NaN of none",
    ),
    ("float64[]", "follow_imag", ""),
)
_KINDS = tuple(kind for kind, _, _ in _FIELDS)
_NONE = np.array([np.nan])  # a message holds no array that is empty
# Fields of recordings from before loops were told that nothing drove, and from before noise and
# distortion were apart.
_FEWER = (len(_KINDS) - 3, len(_KINDS) - 5)
SCHEMA_TEXT = "".join(
    f"{kind} {name}" + (f"  # {comment}\n" if comment else "\n") for kind, name, comment in _FIELDS
)


def encode(response: FrequencyResponse) -> bytes:
    """The message; RecordingError if the arrays do not have the shapes that types.py says."""
    n, n_out, n_in = response.H.shape
    p, n_followers = n_out * n_in, len(response.followers)
    none = np.zeros((n, n_followers, n_in), complex)
    follow = none if response.follow is None else response.follow
    unknown = np.full((n, n_out), np.nan)
    shapes: dict[str, tuple[Any, tuple[int, ...]]] = {
        "frequency": (response.frequency, (n,)),
        "H": (response.H, (n, n_out, n_in)),
        "covariance": (response.covariance, (n, p, p)),
        "dof": (response.dof, (n,)),
        "coherence": (response.coherence, (n, n_out)),
        "input_rms": (response.input_rms, (n, n_in)),
        "even": (unknown if response.even is None else response.even, (n, n_out)),
        "odd": (unknown if response.odd is None else response.odd, (n, n_out)),
        "noise": (unknown if response.noise is None else response.noise, (n, n_out)),
        "distortion": (
            unknown if response.distortion is None else response.distortion,
            (n, n_out),
        ),
        "follow": (follow, none.shape),
    }
    for name, (array, shape) in shapes.items():
        if np.shape(array) != shape:
            raise RecordingError(f"{name} of a response is {np.shape(array)}; expected {shape}")
    if (n_out, n_in) != (len(response.outputs), len(response.inputs)):
        raise RecordingError(
            f"a response of {n_out} x {n_in} names {len(response.outputs)} outputs and "
            f"{len(response.inputs)} inputs"
        )
    values: list[cdr.Value] = [
        response.method,
        response.why,
        json.dumps(response.sources),
        json.dumps([channel_to_json(c) for c in response.inputs]),
        json.dumps([channel_to_json(c) for c in response.outputs]),
        json.dumps([_finding_to_json(f) for f in response.findings]),
        response.level_unit,
        float(response.level),
        float(response.rate_hz),
        int(response.n_averages),
        response.frequency,
        response.H.real,
        response.H.imag,
        response.covariance.real,
        response.covariance.imag,
        response.dof,
        response.coherence,
        response.input_rms,
        shapes["even"][0],
        shapes["odd"][0],
        shapes["noise"][0],
        shapes["distortion"][0],
        json.dumps([channel_to_json(c) for c in response.followers]),
        *((follow.real, follow.imag) if n_followers else (_NONE, _NONE)),
    ]
    return cdr.encode(_KINDS, values)


def decode(data: bytes) -> FrequencyResponse:
    """The response in a message; RecordingError if it is not one."""
    values = _values(data)
    said = _description(values)
    n, n_in, n_out = np.size(values["frequency"]), len(said.inputs), len(said.outputs)
    p = n_in * n_out

    def array(name: str, *shape: int) -> Float:
        value = cast(Float, values[name])
        if value.size != int(np.prod(shape, dtype=object)):
            raise RecordingError(
                f"{name} of a frequency response has {value.size} values; expected {shape}"
            )
        return value.reshape(shape)

    def both(name: str, *shape: int) -> Complex:
        value = np.empty(shape, dtype=complex)
        value.real, value.imag = array(f"{name}_real", *shape), array(f"{name}_imag", *shape)
        return value

    def known(name: str) -> Float | None:
        value = array(name, n, n_out) if name in values else np.full((n, n_out), np.nan)
        return None if np.isnan(value).all() else value

    return FrequencyResponse(
        frequency=array("frequency", n),
        H=both("h", n, n_out, n_in),
        covariance=both("covariance", n, p, p),
        dof=array("dof", n),
        coherence=array("coherence", n, n_out),
        inputs=said.inputs,
        outputs=said.outputs,
        level=cast(float, values["level"]),
        level_unit=cast(str, values["level_unit"]),
        input_rms=array("input_rms", n, n_in),
        rate_hz=cast(float, values["rate_hz"]),
        n_averages=cast(int, values["n_averages"]),
        method=cast(str, values["method"]),
        why=cast(str, values["why"]),
        even=known("even"),
        odd=known("odd"),
        noise=known("noise"),
        distortion=known("distortion"),
        findings=said.findings,
        sources=said.sources,
        followers=said.followers,
        follow=both("follow", n, len(said.followers), n_in) if said.followers else None,
    )


@dataclass(frozen=True, slots=True)
class _Description:
    """What a message says in JSON: the columns of its arrays, findings and sources."""

    inputs: tuple[Channel, ...]
    outputs: tuple[Channel, ...]
    followers: tuple[Channel, ...]
    findings: tuple[Finding, ...]
    sources: tuple[str, ...]


def _description(values: dict[str, cdr.Value]) -> _Description:
    """RecordingError where it cannot be read, or names no inputs, no outputs or too many."""
    values = {"followers": "[]", **values}

    def items(key: str) -> list[Any]:
        return list(json.loads(cast(str, values[key])))

    try:
        said = _Description(
            inputs=tuple(channel_from_json(item) for item in items("inputs")),
            outputs=tuple(channel_from_json(item) for item in items("outputs")),
            followers=tuple(channel_from_json(item) for item in items("followers")),
            findings=tuple(_finding_from_json(item) for item in items("findings")),
            sources=tuple(str(item) for item in items("sources")),
        )
    except (KeyError, ValueError, TypeError, AttributeError, RecursionError) as error:
        raise RecordingError("a frequency response's description cannot be read") from error
    if not (0 < len(said.inputs) <= MAX_CHANNELS and 0 < len(said.outputs) <= MAX_CHANNELS):
        raise RecordingError("a frequency response names no inputs or no outputs")
    return said


def _values(data: bytes) -> dict[str, cdr.Value]:
    names = [name for _, name, _ in _FIELDS]
    try:
        return dict(zip(names, cdr.decode(_KINDS, data), strict=True))
    except RecordingError:
        for fewer in _FEWER:
            try:
                older = cdr.decode(_KINDS[:fewer], data)
            except RecordingError:
                continue
            return dict(zip(names[:fewer], older, strict=True))
        raise


def summary(response: FrequencyResponse) -> dict[str, str]:
    """What a person wants to know of it, for the metadata record beside the message."""
    return {
        "method": response.method,
        "why": response.why,
        "inputs": ", ".join(c.name for c in response.inputs),
        "outputs": ", ".join(c.name for c in response.outputs),
        "level": f"{response.level:g} {response.level_unit}",
        "lines": str(len(response.frequency)),
        "low_hz": f"{response.frequency.min():g}",
        "high_hz": f"{response.frequency.max():g}",
        "averages": str(response.n_averages),
        "sources": ", ".join(response.sources),
    }


def _finding_to_json(finding: Finding) -> dict[str, str]:
    return {
        "kind": finding.kind,
        "severity": finding.severity,
        "message": finding.message,
        "channel": finding.channel,
        "segment": finding.segment,
    }


def _finding_from_json(item: dict[str, Any]) -> Finding:
    severity = item["severity"]
    if severity not in ("note", "warning", "error"):
        raise ValueError(severity)
    return Finding(
        kind=str(item["kind"]),
        severity=cast(Any, severity),
        message=str(item["message"]),
        channel=str(item["channel"]),
        segment=str(item["segment"]),
    )
