"""Frequency responses as files for other programs: CSV, NPZ, MATLAB, UFF 58.

A file is written beside its place and renamed when whole, so that nothing half-written is
ever found under its name. What each format can hold:

- NPZ, MAT: all of it, as arrays without pickle; as variables of MATLAB 5.
- CSV: all of it but the findings, one row a frequency, units in the names of the columns; gain
  and phase with their standard deviations in the last ones, for a spreadsheet.
- UFF 58: H (function type 4), coherence (6), of several inputs multiple (26) and partial coherence
  (21); the format has no place for a covariance.
"""

from __future__ import annotations

import contextlib
import os
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from samii_rig.errors import InputError
from samii_rig.record.convert import arrays, known_levels
from samii_rig.record.uff.channels import response_sets
from samii_rig.record.uff.file import write_uff
from samii_rig.signal.coherence import partial_coherence
from samii_rig.types import Float, FrequencyResponse


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
    output; amplitude of each input; even and odd distortion, noise of one repeat and distortion of
    one realisation where known; of several inputs the partial coherence of each entry; gain and
    phase of each entry, with standard deviations sqrt(C/2) and sqrt(C/2)/|H|.
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
    for what, level in known_levels(r).items():
        said = f"{what} distortion" if what in ("even", "odd") else what
        for i, y in enumerate(r.outputs):
            names.append(f"{said} {y.name} [1]")
            columns.append(level[:, i])
    if len(r.inputs) > 1:
        partial = partial_coherence(r).reshape(len(r.frequency), -1)
        names += [f"partial coherence {name} [1]" for name, _ in entries]
        columns += list(partial.T)
    for i, (name, unit) in enumerate(entries):
        gain = np.abs(flat[:, i])
        sd = np.sqrt(0.5 * r.covariance[:, i, i].real)
        with np.errstate(divide="ignore", invalid="ignore"):
            sd_phase = np.rad2deg(sd / gain)
        names += [f"gain {name} [{unit}]", f"sd gain {name} [{unit}]"]
        names += [f"phase {name} [deg]", f"sd phase {name} [deg]"]
        columns += [gain, sd, np.angle(flat[:, i], deg=True), sd_phase]
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
    write_uff(path, response_sets(response))


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask
