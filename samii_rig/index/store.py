"""The index of a folder of recordings: what is there, found in milliseconds.

It holds nothing of its own: `refresh` makes all of it again from the recordings and the remarks
beside them, and does so by itself when the file is damaged, missing or of another version.
"""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

from samii_rig.errors import InputError
from samii_rig.files import check_folder
from samii_rig.index.database import COLUMNS, Database, UnsoundError, entry_of, row_of
from samii_rig.index.entry import Entry, identity, is_recording, read_entry
from samii_rig.index.query import Query
from samii_rig.index.remarks import SUFFIX as REMARKS

PRIVATE = ".samii-rig"  # folder in the folder of recordings, for what can be made again
FILE = "index.sqlite"
BATCH = 200  # recordings in one transaction: what a kill can cost is read again

T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class Found:
    """One page of an answer, newest first. total : how many there are in all."""

    entries: tuple[Entry, ...]
    total: int


@dataclass(frozen=True, slots=True)
class Refreshed:
    """What a refresh did. rebuilt : the file was damaged or of another version."""

    recordings: int
    read: int
    removed: int
    rebuilt: bool


class Index:
    """The recordings below `folder`; any number of processes may work with it at once.

    InputError if there is no such folder. Methods raise RecordingError if the index cannot be
    written.
    """

    def __init__(self, folder: Path, private: Path | None = None) -> None:
        """private : where the index is kept, in place of a folder of its own in `folder`."""
        if not folder.is_dir():
            raise InputError("FOLDER", "", str(folder), "a folder of recordings")
        self.folder = folder
        self._database = Database((private or folder / PRIVATE) / FILE)

    def refresh(self, progress: Callable[[int, int], None] | None = None) -> Refreshed:
        """Bring the index up to date with the folder.

        Reads what is new or changed and forgets what is gone. progress : called with how many
        recordings were read, of how many.
        """
        rebuilt = not self._database.sound()
        if rebuilt:
            self._database.discard()
        return self._sound(lambda: self._refresh(rebuilt, progress))

    def _refresh(self, rebuilt: bool, progress: Callable[[int, int], None] | None) -> Refreshed:
        # In this order: what another process adds meanwhile must not seem to be gone.
        with self._database.opened() as connection:
            known = dict(connection.execute("SELECT path, stamp FROM recording"))
        there = dict(_stamps(self.folder))
        changed = [path for path, stamp in there.items() if known.get(path) != stamp]
        gone = [path for path in known if path not in there]
        if gone:
            with self._database.transaction() as connection:
                connection.executemany("DELETE FROM recording WHERE path = ?", zip(gone))
        read = 0
        for at in range(0, len(changed), BATCH):
            rows = list(self._rows(changed[at : at + BATCH], there))
            with self._database.transaction() as connection:
                marks = ", ".join("?" * len(COLUMNS))
                connection.executemany(f"REPLACE INTO recording VALUES ({marks})", rows)
            read += len(rows)
            if progress is not None:
                progress(min(at + BATCH, len(changed)), len(changed))
        return Refreshed(len(there), read, len(gone), rebuilt)

    def _rows(self, paths: list[str], stamps: dict[str, str]) -> Iterator[tuple[str | int, ...]]:
        for path in paths:
            try:
                # The stamp is older than what is read: a change meanwhile is seen next time.
                yield row_of(read_entry(self.folder, path), stamps[path])
            except OSError:
                continue  # it went away; the next refresh forgets it

    def update(self, path: str) -> Entry | None:
        """Read one recording again, after its remarks changed; None if it is gone."""
        stamp = _stamp(self.folder, path)
        rows = list(self._rows([path], {path: stamp})) if stamp else []

        def write() -> Entry | None:
            with self._database.transaction() as connection:
                if not rows:
                    connection.execute("DELETE FROM recording WHERE path = ?", (path,))
                    return None
                marks = ", ".join("?" * len(COLUMNS))
                connection.execute(f"REPLACE INTO recording VALUES ({marks})", rows[0])
                return entry_of(str(rows[0][COLUMNS.index("entry")]))

        return self._sound(write)

    def search(self, query: Query) -> Found:
        """Recordings that fit, newest first; InputError for a wrong time or limit."""
        where, values = query.where()
        limit, offset = query.page()

        def ask() -> Found:
            with self._database.opened() as connection:
                found = [
                    id_
                    for (id_,) in connection.execute(
                        f"SELECT id FROM recording WHERE {where} ORDER BY started DESC, path",
                        values,
                    )
                ]
                page = found[offset : offset + limit]
                marks = ", ".join("?" * len(page))
                rows = dict(
                    connection.execute(
                        f"SELECT id, entry FROM recording WHERE id IN ({marks})", page
                    )
                )
                # One that another process removed meanwhile is left out.
                entries = tuple(entry_of(rows[id_]) for id_ in page if id_ in rows)
                return Found(entries, len(found))

        return self._sound(ask)

    def get(self, id_: str) -> Entry | None:
        """The recording of this id; None if there is none."""

        def ask() -> Entry | None:
            with self._database.opened() as connection:
                row = connection.execute(
                    "SELECT entry FROM recording WHERE id = ?", (id_,)
                ).fetchone()
                return None if row is None else entry_of(row[0])

        return self._sound(ask)

    def path_of(self, entry: Entry) -> Path:
        """The file of an entry, which lies in the folder itself, whatever links lead to.

        InputError if it does not.
        """
        path = (self.folder / entry.path).resolve()
        if identity(entry.path) != entry.id or not path.is_relative_to(self.folder.resolve()):
            raise InputError("recording", "", entry.id, "a file in the folder")
        return path

    def words(self) -> dict[str, tuple[str, ...]]:
        """What rigs, experiments, operators, statuses and verdicts there are."""

        def ask() -> dict[str, tuple[str, ...]]:
            with self._database.opened() as connection:
                return {
                    column: tuple(
                        word
                        for (word,) in connection.execute(
                            f"SELECT DISTINCT {column} FROM recording ORDER BY 1"
                        )
                        if word
                    )
                    for column in ("rig", "experiment", "operator", "status", "verdict")
                }

        return self._sound(ask)

    def _sound(self, work: Callable[[], T]) -> T:
        """Do it; if the file proves to be damaged, make it anew and do it again."""
        try:
            return self._once(work)
        except UnsoundError:
            self._database.discard()
            self._once(lambda: self._refresh(True, None))
            return self._once(work)

    def _once(self, work: Callable[[], T]) -> T:
        try:
            return work()
        except (ValueError, TypeError) as error:
            raise UnsoundError(str(error)) from error


@contextmanager
def index_for_reading(folder: Path) -> Iterator[Index]:
    """The index of a folder; of one that cannot be written to, a copy that is forgotten after."""
    try:
        check_folder("FOLDER", folder / PRIVATE)
    except InputError:
        with tempfile.TemporaryDirectory() as place:
            # What another has indexed there need not be read again; what is unsound is made anew.
            with suppress(OSError):
                shutil.copy(folder / PRIVATE / FILE, place)
            yield Index(folder, Path(place))
    else:
        yield Index(folder)


def _stamps(folder: Path) -> Iterator[tuple[str, str]]:
    """Place and stamp of every recording below `folder`. Links to folders are not followed."""
    waiting = [""]
    while waiting:
        below = waiting.pop()
        found: dict[str, os.stat_result] = {}
        try:
            with os.scandir(folder / below) as items:
                for item in items:
                    if item.is_dir(follow_symlinks=False):
                        if not item.name.startswith("."):
                            waiting.append(f"{below}{item.name}/")
                    elif is_recording(item.name) or item.name.endswith(REMARKS):
                        found[item.name] = item.stat(follow_symlinks=False)
        except OSError:
            continue  # went away, or is not for us to read
        for name, stat in found.items():
            if is_recording(name):
                yield f"{below}{name}", _stamped(stat, found.get(name + REMARKS))


def _stamp(folder: Path, path: str) -> str:
    """The stamp of one recording, "" if it is not there."""
    try:
        stat = (folder / path).lstat()
    except OSError:
        return ""
    try:
        beside = (folder / (path + REMARKS)).lstat()
    except OSError:
        beside = None
    return _stamped(stat, beside)


def _stamped(stat: os.stat_result, beside: os.stat_result | None) -> str:
    own = f"{stat.st_ino} {stat.st_mtime_ns} {stat.st_size}"
    return own if beside is None else f"{own} {beside.st_ino} {beside.st_mtime_ns} {beside.st_size}"
