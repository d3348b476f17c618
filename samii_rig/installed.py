"""What the installed packages declare as entry points.

To read it takes ten milliseconds, each time anew, and a run asks a dozen times. It is kept as long
as no folder that packages are found in changes: whoever installs one need not start anything again.
"""

from __future__ import annotations

import sys
from contextlib import suppress
from functools import lru_cache
from importlib import metadata
from pathlib import Path


def points(group: str) -> metadata.EntryPoints:
    """The entry points of a group."""
    folders = []
    for folder in sys.path:
        with suppress(OSError):  # in what is not there nothing is found
            state = Path(folder).stat()  # "" is where we are
            folders.append((folder, state.st_dev, state.st_ino, state.st_mtime_ns))
    return _points(group, tuple(folders))


@lru_cache(maxsize=8)  # twice as many as there are groups
def _points(group: str, folders: tuple[tuple[str, int, int, int], ...]) -> metadata.EntryPoints:
    """The same. folders : where packages are found, as they are now."""
    return metadata.entry_points(group=group)
