"""Recordings and frequency responses as other Python libraries hold them.

The methods `to_numpy`, `to_xarray` and `to_control` of `Recording` and `FrequencyResponse` are
these. xarray is an extra: `pip install samii-rig[notebook]`.
"""

from __future__ import annotations

from types import ModuleType
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from samii_rig.errors import InputError
from samii_rig.signal.coherence import partial_coherence
from samii_rig.types import Channel, Float, FrequencyResponse, Recording

if TYPE_CHECKING:
    import control
    import xarray

Arrays = dict[str, NDArray[Any]]


def seconds(recording: Recording) -> Float:
    """(n,) s since the first sample."""
    time = recording.time
    return np.asarray((time - time[:1]) * 1e-9, dtype=np.float64)


def columns(recording: Recording) -> Arrays:
    """(n,) `time_s` and `sequence`, then every channel by its name, as a table wants them."""
    values = {c.name: recording.values[:, i] for i, c in enumerate(recording.channels)}
    return {"time_s": seconds(recording), "sequence": recording.sequence, **values}


def arrays(response: FrequencyResponse) -> Arrays:
    """All of a response, words too, as arrays that need no pickle."""
    r = response
    out: Arrays = {
        "frequency_hz": r.frequency,
        "H": r.H,
        "covariance": r.covariance,
        "dof": r.dof,
        "coherence": r.coherence,
        "input_rms": r.input_rms,
        "inputs": np.array([c.name for c in r.inputs]),
        "input_units": np.array([c.unit for c in r.inputs]),
        "outputs": np.array([c.name for c in r.outputs]),
        "output_units": np.array([c.unit for c in r.outputs]),
        "level": np.array(r.level),
        "level_unit": np.array(r.level_unit),
        "rate_hz": np.array(r.rate_hz),
        "n_averages": np.array(r.n_averages),
        "method": np.array(r.method),
        "why": np.array(r.why),
        "sources": np.array(r.sources, dtype=np.str_),
        "findings": np.array([f"{f.severity}: {f.message}" for f in r.findings], dtype=np.str_),
    }
    if len(r.inputs) > 1:
        out["partial_coherence"] = partial_coherence(r)
    if r.follow is not None:
        out |= {"followers": np.array([c.name for c in r.followers]), "follow": r.follow}
    return out | known_levels(r)


def known_levels(response: FrequencyResponse) -> dict[str, Float]:
    """What of `even`, `odd`, `noise` and `distortion` is known, (n_freq, n_out) each."""
    r = response
    every = {"even": r.even, "odd": r.odd, "noise": r.noise, "distortion": r.distortion}
    return {k: v for k, v in every.items() if v is not None}


def frd(response: FrequencyResponse) -> control.FrequencyResponseData:
    """`response` as python-control's FRD: the same outputs and inputs, by name, rad/s."""
    import control

    return control.FrequencyResponseData(
        np.moveaxis(response.H, 0, -1),
        2 * np.pi * response.frequency,
        inputs=[c.name for c in response.inputs],
        outputs=[c.name for c in response.outputs],
    )


def samples(recording: Recording) -> xarray.Dataset:
    """A variable a channel over `time` (s since the first sample), units and role as attributes.

    `sequence` counts the device's samples, `quality` is (time, channel) of `types.Quality`; how
    the run ended and the metadata are attributes of the whole.

    Raises InputError without xarray.
    """
    xr = _xarray()
    r = recording
    held = {
        c.name: ("time", r.values[:, i], _about(c) | {"role": c.role})
        for i, c in enumerate(r.channels)
    }
    made: xarray.Dataset = xr.Dataset(
        held | {"quality": (("time", "channel"), r.quality)},
        coords={
            "time": (
                "time",
                seconds(r),
                {
                    "units": "s",
                    "start_ns": int(r.time[0]) if len(r) else 0,
                    "wall_start_ns": int(r.wall_time[0]) if len(r) else 0,
                },
            ),
            "sequence": ("time", r.sequence),
            "channel": [c.name for c in r.channels],
        },
        attrs={
            **{f"note_{k}": v for k, v in r.metadata.items()},
            "rate_hz": r.rate_hz,
            "status": r.stop.status,
            "reason": r.stop.reason,
            "source": r.source,
        },
    )
    return made


def lines(response: FrequencyResponse) -> xarray.Dataset:
    """H (frequency, output, input), its standard deviation `sd` = sqrt(E|dH|^2), and the rest.

    `covariance` is (frequency, entry, other_entry), entries as `output/input`; units of an entry
    of H are those of `output_unit` over `input_unit`.

    Raises InputError without xarray.
    """
    xr = _xarray()
    r = response
    f, y, u = "frequency", "output", "input"
    entries = [f"{a.name}/{b.name}" for a in r.outputs for b in r.inputs]
    held: dict[str, Any] = {
        "H": ((f, y, u), r.H),
        "sd": ((f, y, u), np.sqrt(r.variance())),
        "covariance": ((f, "entry", "other_entry"), r.covariance),
        "dof": (f, r.dof),
        "coherence": ((f, y), r.coherence),
        "input_rms": ((f, u), r.input_rms),
    }
    held |= {k: ((f, y), v) for k, v in known_levels(r).items()}
    if len(r.inputs) > 1:
        held["partial_coherence"] = ((f, y, u), partial_coherence(r))
    made: xarray.Dataset = xr.Dataset(
        held,
        coords={
            f: (f, r.frequency, {"units": "Hz"}),
            y: [c.name for c in r.outputs],
            u: [c.name for c in r.inputs],
            "output_unit": (y, [c.unit for c in r.outputs]),
            "input_unit": (u, [c.unit for c in r.inputs]),
            "entry": entries,
            "other_entry": entries,
        },
        attrs={
            "level": r.level,
            "level_unit": r.level_unit,
            "rate_hz": r.rate_hz,
            "n_averages": r.n_averages,
            "method": r.method,
            "why": r.why,
            "sources": list(r.sources),
        },
    )
    return made


def _about(channel: Channel) -> dict[str, Any]:
    about = {"units": channel.unit, "long_name": channel.description}
    return {k: v for k, v in about.items() if v}


def _xarray() -> ModuleType:
    try:
        import xarray as xr
    except ModuleNotFoundError as error:
        expected = "it to be installed: pip install samii-rig[notebook]"
        raise InputError("to_xarray", "", error.name, expected) from error
    return xr
