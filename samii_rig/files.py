"""Files of this machine: opened without waiting for anybody, and looked at before work is done.

A pipe or a socket that bears the name of a recording would hold whoever opens it for ever; a place
that cannot be written to costs nothing if it is found out first.
"""

from __future__ import annotations

import contextlib
import errno
import io
import os
import stat
import tempfile
from pathlib import Path

from samii_rig.errors import InputError, RecordingError

# What the disk says, and not the name of a file; some systems lack the quota's.
DISK_ERRORS = frozenset(
    getattr(errno, name) for name in ("ENOSPC", "EIO", "EFBIG", "EDQUOT") if hasattr(errno, name)
)


class SpecialFileError(OSError):
    """There is something at this path, and it is no file."""


def open_file(path: Path) -> io.BufferedReader:
    """A file to read. OSError, at once, for what cannot be opened or is no file but a pipe, a
    socket or a device."""
    # Without it, opening a pipe waits for one who writes to it.
    flags = os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0)
    try:
        handle = os.open(path, flags)
    except OSError as error:
        if error.errno == errno.ENXIO:
            raise SpecialFileError(errno.ENXIO, "it is a socket, not a file") from error
        raise
    try:
        mode = os.fstat(handle).st_mode
        if stat.S_ISDIR(mode):
            raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR))
        if not stat.S_ISREG(mode):
            raise SpecialFileError(errno.EINVAL, "it is a pipe or a device, not a file")
        return os.fdopen(handle, "rb")
    except BaseException:
        os.close(handle)
        raise


def require_file(path: Path) -> None:
    """RecordingError unless there is something at `path`, and no folder."""
    if path.is_dir():
        raise RecordingError(f"{path} is a folder; expected a recording, as {path}/*.mcap")
    if not path.exists():
        raise RecordingError(f"{path} is not there; expected a recording")


def reason(error: OSError) -> str:
    """What went wrong with a file, in words that follow "cannot be read:"."""
    return error.strerror or str(error)


def check_file(option: str, path: Path) -> None:
    """InputError unless a file can be written as `path`; leaves nothing behind."""
    if path.is_dir():
        raise InputError(option, "", str(path), "the name of a file; this is a folder")
    if path.exists() and not path.is_file():
        raise InputError(option, "", str(path), "the name of a file; this is a pipe or a device")
    if not path.parent.is_dir():
        expected = f"a name in a folder that exists; {path.parent} does not"
        raise InputError(option, "", str(path), expected)
    _probe(option, path, path.parent)


def check_folder(option: str, path: Path) -> None:
    """InputError unless files can be written into the folder `path`, which may have to be made;
    leaves nothing behind."""
    there = next(p for p in (path.absolute(), *path.absolute().parents) if p.exists())
    if not there.is_dir():
        which = "this is a file" if there == path.absolute() else f"{there} is a file"
        raise InputError(option, "", str(path), f"a folder to write to; {which}")
    _probe(option, path, there)


def make_folder(option: str, path: Path) -> None:
    """The folder `path`, made if it is not there; InputError where that cannot be."""
    check_folder(option, path)
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        expected = f"a folder that can be made ({reason(error)})"
        raise InputError(option, "", str(path), expected) from error


def _probe(option: str, path: Path, folder: Path) -> None:
    """Only writing tells: rights, a file system that is for reading, one that is no disk."""
    try:
        with contextlib.closing(tempfile.TemporaryFile(dir=folder)):
            pass
    except OSError as error:
        expected = f"a place that can be written to ({folder}: {reason(error)})"
        raise InputError(option, "", str(path), expected) from error
