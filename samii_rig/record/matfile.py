"""MATLAB files, read in a process of its own.

scipy's reader trusts the lengths and types that a file states: one flipped byte in three
hundred ends the whole process (segmentation fault, scipy 1.17). An import must say that a
file is damaged instead, so the reader may die alone.
"""

from __future__ import annotations

import io
import subprocess
import sys
import warnings
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from samii_rig.errors import InputError

_VERSION_73 = 3  # exit codes of the reading process
_DAMAGED = 4
_TIMEOUT = 300.0  # s, for files of gigabytes


def load(path: Path, names: list[str]) -> dict[str, NDArray[np.generic]]:
    """Those of the variables `names` that the file holds and that are plain arrays; without
    names, all of these.

    Raises
    ------
    InputError : the file is damaged, is no MATLAB file, or is of version 7.3 (HDF5).
    """
    command = [sys.executable, "-m", "samii_rig.record.matfile", str(path), *names]
    try:
        done = subprocess.run(command, capture_output=True, timeout=_TIMEOUT, check=False)
    except subprocess.TimeoutExpired as error:
        raise InputError(str(path), "", f"unread after {_TIMEOUT:g} s", "a MATLAB file") from error
    if done.returncode == _VERSION_73:
        raise InputError(str(path), "", "version 7.3", "a file saved with -v7")
    if done.returncode != 0:
        said = done.stderr.decode("utf-8", "replace").strip().splitlines()
        why = said[-1] if said and done.returncode == _DAMAGED else "damaged"
        raise InputError(str(path), "", why, "a MATLAB file")
    with np.load(io.BytesIO(done.stdout), allow_pickle=False) as arrays:
        return dict(arrays)


def _main(path: str, names: list[str]) -> int:
    from scipy import io as scipy_io

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            content = scipy_io.loadmat(path, variable_names=names or None)
    except NotImplementedError:
        return _VERSION_73
    except Exception as error:  # the parser raises anything on a damaged file
        sys.stderr.write(" ".join(str(error).split()) or type(error).__name__)
        return _DAMAGED
    arrays = {n: np.asarray(content[n]) for n in names or content if n in content}
    plain = {n: a for n, a in arrays.items() if a.dtype.kind in "fiubc"}
    buffer = io.BytesIO()
    np.savez(buffer, allow_pickle=False, **plain)
    sys.stdout.buffer.write(buffer.getvalue())
    return 0


if __name__ == "__main__":
    sys.exit(_main(sys.argv[1], sys.argv[2:]))
