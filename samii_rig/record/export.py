"""Frequency responses as files for other programs: CSV, NPZ, MATLAB, UFF 58.

A file is written beside its place and renamed when whole, so that nothing half-written is
ever found under its name. What each format can hold:

- NPZ, MAT: all of it, as arrays without pickle; as variables of MATLAB 5.
- CSV: all of it but the findings, one row a frequency, units in the names of the columns.
- UFF 58: H (function type 4), coherence (6); the format has no place for a covariance.
"""

from __future__ import annotations

import contextlib
import io
import os
import tempfile
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from samii_rig.errors import InputError
from samii_rig.record.convert import arrays
from samii_rig.types import Channel, Complex, Float, FrequencyResponse

# Codes of the universal file format, data set 58.
_FRF, _COHERENCE = 4, 6
_FREQUENCY, _ACCELERATION, _UNKNOWN = 18, 12, 0
_PLUS_X, _PLUS_Z_ROTATION = 1, 6
# The format writes an uneven abscissa in single precision (E13.5, 5 digits after the
# point); an even one as start and step. Beyond this relative deviation it is uneven.
_EVEN = 1e-9


def export_response(path: Path | str, response: FrequencyResponse) -> Path:
    """Write `response` in the format that the suffix of `path` names: .csv, .npz, .mat, .uff.

    Raises
    ------
    InputError : another suffix, or a place that cannot be written to.
    """
    path = Path(path)
    writers: dict[str, Callable[[Path, FrequencyResponse], None]] = {
        ".csv": _write_csv,
        ".npz": _write_npz,
        ".mat": _write_mat,
        ".uff": _write_uff,
        ".unv": _write_uff,
    }
    if path.suffix.lower() not in writers:
        raise InputError("export", "suffix", path.suffix, f"one of {', '.join(writers)}")
    with replacing(path) as part:
        writers[path.suffix.lower()](part, response)
    return path


@contextlib.contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """A file beside `path` to write to; takes its place when the block ends well.

    Raises
    ------
    InputError : the folder does not exist or cannot be written to.
    """
    try:
        handle, name = tempfile.mkstemp(
            dir=path.parent, prefix=f".{path.stem[:40]}-", suffix=path.suffix
        )
    except OSError as error:
        raise InputError(str(path), "", error.strerror, "a folder that can be written") from error
    os.close(handle)
    part = Path(name)
    try:
        yield part
        with part.open("rb") as stream:
            os.fsync(stream.fileno())
        part.chmod(0o666 & ~_umask())
        part.replace(path)
    except IsADirectoryError as error:
        raise InputError(str(path), "", "a folder", "the path of a file") from error
    finally:
        part.unlink(missing_ok=True)


def table(response: FrequencyResponse) -> tuple[list[str], Float]:
    """Names with units and values (n_freq, n_columns) of the CSV file.

    Columns: frequency; real and imaginary part of each entry of H, outputs first; the
    covariance C = E[dH dH^H] of the entries in that order, its upper triangle, real and
    imaginary part (the diagonal is real); its degrees of freedom; coherence of each
    output; amplitude of each input; even and odd distortion where known.
    """
    r = response
    entries = [(f"{y.name}/{u.name}", f"{y.unit}/{u.unit}") for y in r.outputs for u in r.inputs]
    names = ["frequency [Hz]"]
    columns = [r.frequency]
    flat = r.H.reshape(len(r.frequency), -1)
    for i, (name, unit) in enumerate(entries):
        names += [f"Re H {name} [{unit}]", f"Im H {name} [{unit}]"]
        columns += [flat[:, i].real, flat[:, i].imag]
    for i, (a, unit_a) in enumerate(entries):
        for j, (b, unit_b) in enumerate(entries[i:], i):
            names.append(f"Re C {a}, {b} [({unit_a}) ({unit_b})]")
            columns.append(r.covariance[:, i, j].real)
            if j > i:
                names.append(f"Im C {a}, {b} [({unit_a}) ({unit_b})]")
                columns.append(r.covariance[:, i, j].imag)
    names.append("degrees of freedom [1]")
    columns.append(r.dof)
    for i, y in enumerate(r.outputs):
        names.append(f"coherence {y.name} [1]")
        columns.append(r.coherence[:, i])
    for i, u in enumerate(r.inputs):
        names.append(f"amplitude {u.name} [{u.unit}]")
        columns.append(r.input_rms[:, i])
    for what, level in (("even", r.even), ("odd", r.odd)):
        if level is not None:
            for i, y in enumerate(r.outputs):
                names.append(f"{what} distortion {y.name} [1]")
                columns.append(level[:, i])
    return names, np.column_stack(columns)


def _write_csv(path: Path, response: FrequencyResponse) -> None:
    names, values = table(response)
    head = [
        f"# method: {response.method} ({response.why})",
        f"# level: {response.level:g} {response.level_unit}; averages: {response.n_averages}; "
        f"rate: {response.rate_hz:g} Hz",
        *(f"# source: {source}" for source in response.sources),
    ]
    with path.open("w", encoding="utf-8", newline="") as stream:
        stream.writelines(" ".join(line.split()) + "\n" for line in head)
        stream.write(",".join(f'"{name}"' for name in names) + "\n")
        np.savetxt(stream, values, fmt="%.17g", delimiter=",")


def _write_npz(path: Path, response: FrequencyResponse) -> None:
    with path.open("wb") as stream:
        np.savez_compressed(stream, allow_pickle=False, **arrays(response))


def _write_mat(path: Path, response: FrequencyResponse) -> None:
    from scipy.io import savemat

    savemat(str(path), arrays(response), do_compression=True, oned_as="column")


def _write_uff(path: Path, response: FrequencyResponse) -> None:
    import pyuff

    r = response
    sets = []
    for i, y in enumerate(r.outputs):
        for j, u in enumerate(r.inputs):
            unit = f"{y.unit}/{u.unit}"
            sets.append(_uff_set(r, _FRF, r.H[:, i, j], (i, y), (j, u), unit))
        sets.append(_uff_set(r, _COHERENCE, r.coherence[:, i], (i, y), (0, r.inputs[0]), ""))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        file = pyuff.UFF(str(path))
        with contextlib.redirect_stdout(io.StringIO()):  # it reports its errors by print
            for number, one in enumerate(sets):
                file.write_sets(one, mode="overwrite" if number == 0 else "add")


def _uff_set(
    r: FrequencyResponse,
    kind: int,
    data: Complex | Float,
    response: tuple[int, Channel],
    reference: tuple[int, Channel],
    unit: str,
) -> dict[str, object]:
    (i, y), (j, u) = response, reference
    what = "FRF" if kind == _FRF else "Coherence"
    f = r.frequency
    step = (f[-1] - f[0]) / (len(f) - 1) if len(f) > 1 else 0.0
    even = len(f) > 1 and bool(np.all(np.abs(np.diff(f) / step - 1) < _EVEN))
    return {
        "type": 58,
        "binary": 0,
        "func_type": kind,
        "id1": f"{what} {y.name}/{u.name}"[:80],
        "id2": f"level {r.level:g} {r.level_unit}, {r.n_averages} averages"[:80],
        "id3": "NONE",
        "id4": (f"method {' '.join(r.method.split())}")[:80],
        "id5": "NONE",
        "ver_num": 0,
        "load_case_id": 0,
        "rsp_ent_name": y.name[:10],
        "rsp_node": i + 1,
        "rsp_dir": _direction(y),
        "ref_ent_name": u.name[:10],
        "ref_node": j + 1,
        "ref_dir": _direction(u),
        "ord_data_type": 4 if kind == _COHERENCE else 6,
        "num_pts": len(f),
        "abscissa_spacing": int(even),
        "abscissa_min": float(f[0]) if even else 0.0,
        "abscissa_inc": float(step) if even else 0.0,
        "z_axis_value": 0.0,
        "abscissa_spec_data_type": _FREQUENCY,
        "abscissa_axis_lab": "Frequency",
        "abscissa_axis_units_lab": "Hz",
        "ordinate_spec_data_type": _ACCELERATION if y.unit == "m/s^2" else _UNKNOWN,
        "ordinate_axis_lab": what,
        "ordinate_axis_units_lab": unit[:20] or "NONE",
        "orddenom_spec_data_type": _UNKNOWN,
        "z_axis_spec_data_type": _UNKNOWN,
        "x": f,
        "data": data,
    }


def _direction(channel: Channel) -> int:
    """Direction code: an angle turns about +Z, an acceleration goes along +X, else scalar."""
    return {"rad": _PLUS_Z_ROTATION, "m/s^2": _PLUS_X}.get(channel.unit, 0)


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask
