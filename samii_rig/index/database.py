"""The file of the index: how it is opened, how it is known to be sound, how a row is kept."""

from __future__ import annotations

import json
import sqlite3
import sys
import zlib
from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import IO, Any

from samii_rig.errors import RecordingError
from samii_rig.index.entry import Entry

if sys.platform != "win32":
    import fcntl

VERSION = 2  # of the tables below; a file of another one is made anew
# All that is searched stands in the index `searched` too, in the order of an answer, so that a
# search reads that alone.
BUSY = 20.0  # s that one waits for another's transaction
COLUMNS = (
    "id",
    "path",
    "stamp",
    "started",
    "rig",
    "experiment",
    "operator",
    "status",
    "verdict",
    "tags",
    "text",
    "entry",
    "crc",
)
SCHEMA = f"""
CREATE TABLE recording (
  id TEXT PRIMARY KEY, path TEXT NOT NULL UNIQUE, stamp TEXT NOT NULL, started TEXT NOT NULL,
  rig TEXT NOT NULL, experiment TEXT NOT NULL, operator TEXT NOT NULL, status TEXT NOT NULL,
  verdict TEXT NOT NULL, tags TEXT NOT NULL, text TEXT NOT NULL, entry TEXT NOT NULL,
  crc INTEGER NOT NULL
) WITHOUT ROWID;
CREATE INDEX searched ON recording
  (started DESC, path, rig, experiment, operator, status, verdict, tags, text);
PRAGMA user_version = {VERSION};
"""


class UnsoundError(Exception):
    """The file is damaged, or not one of ours: it is to be made anew. Never leaves this room."""


def row_of(entry: Entry, stamp: str) -> tuple[str | int, ...]:
    """What is kept of an entry, in the order of `COLUMNS`; the last is a checksum of the others.

    SQLite notices a damaged page, but not a letter that became another one.
    """
    e = entry
    tags = f"\n{chr(10).join(t.lower() for t in e.tags)}\n"
    words = (e.path, e.rig, e.experiment, e.operator, e.status, e.verdict, e.reason, e.notes)
    text = "\n".join((*words, *e.tags)).lower()
    values = (
        *(e.id, e.path, stamp, e.started, e.rig, e.experiment, e.operator, e.status, e.verdict),
        *(tags, text, json.dumps(asdict(e))),
    )
    return (*values, _check(values))


def entry_of(text: str) -> Entry:
    """The inverse, of the column `entry`."""
    found = json.loads(text)
    fields: dict[str, Any] = {k: tuple(v) if isinstance(v, list) else v for k, v in found.items()}
    return Entry(**fields)


def _check(values: tuple[str, ...]) -> int:
    return zlib.crc32("\x1f".join(values).encode("utf-8", "surrogatepass"))


class Database:
    """The file, opened for each piece of work and closed after it.

    Whoever works on it holds a shared lock, whoever makes it anew holds it alone, so that no file
    is taken away from under a process that has it open.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._lock = path.with_suffix(".lock")

    @contextmanager
    def opened(self) -> Iterator[sqlite3.Connection]:
        """A connection; UnsoundError if the file proves to be damaged, RecordingError if the folder
        cannot be written."""
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            with self._lock.open("a") as lock:
                _hold(lock, alone=False)
                if not self._there():
                    _hold(lock, alone=True)
                    self._create()
                    _hold(lock, alone=False)
                with closing(self._connect()) as connection:
                    yield connection
        except OSError as error:
            raise RecordingError(f"{self.path} cannot be written: {error.strerror}") from error
        except sqlite3.DatabaseError as error:
            raise _named(error, self.path) from error

    def _there(self) -> bool:
        return self.path.exists() and self.path.stat().st_size > 0

    def _create(self) -> None:
        """Make the tables, if nobody did meanwhile."""
        if not self._there():
            with closing(sqlite3.connect(self.path, isolation_level=None)) as connection:
                connection.execute("PRAGMA journal_mode = WAL")
                connection.executescript(f"BEGIN;{SCHEMA}COMMIT;")

    def _connect(self) -> sqlite3.Connection:
        connection = sqlite3.connect(self.path, timeout=BUSY, isolation_level=None)
        try:
            (version,) = connection.execute("PRAGMA user_version").fetchone()
            if version != VERSION:
                raise UnsoundError(f"version {version}")
            connection.execute("PRAGMA synchronous = NORMAL")
        except BaseException:
            connection.close()
            raise
        return connection

    @contextmanager
    def transaction(self) -> Iterator[sqlite3.Connection]:
        """A connection that writes all or nothing."""
        with self.opened() as connection:
            connection.execute("BEGIN IMMEDIATE")
            yield connection
            connection.execute("COMMIT")

    def sound(self) -> bool:
        """Every page and every row is as it was written."""
        try:
            with self.opened() as connection:
                if connection.execute("PRAGMA integrity_check(1)").fetchone() != ("ok",):
                    return False
                rows = connection.execute(f"SELECT {', '.join(COLUMNS)} FROM recording")
                return all(_check(row[:-1]) == row[-1] for row in rows)
        except (UnsoundError, TypeError, UnicodeError):
            return False

    def discard(self) -> None:
        """Take the file away, once nobody works on it; it is made anew by the next who comes."""
        try:
            with self._lock.open("a") as lock:
                _hold(lock, alone=True)
                for end in ("", "-wal", "-shm"):
                    self.path.with_name(self.path.name + end).unlink(missing_ok=True)
        except OSError as error:
            raise RecordingError(f"{self.path} cannot be written: {error.strerror}") from error


def _hold(lock: IO[str], *, alone: bool) -> None:
    """Hold the lock, with others or alone, until its file is closed."""
    if sys.platform != "win32":
        fcntl.flock(lock, fcntl.LOCK_EX if alone else fcntl.LOCK_SH)


def _named(error: sqlite3.DatabaseError, path: Path) -> Exception:
    """What an error of SQLite means: the disk's fault, or a damaged file."""
    disk = ("locked", "disk", "readonly", "unable to open")
    if isinstance(error, sqlite3.OperationalError) and any(w in str(error) for w in disk):
        return RecordingError(f"{path} cannot be used: {error}")
    return UnsoundError(str(error))
