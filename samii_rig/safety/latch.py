"""What outlives a program: who drives a rig now, and a FAULT until a person has cleared it.

One folder for each user: SAMII_RIG_STATE, else $XDG_STATE_HOME/samii-rig, else
~/.local/state/samii-rig. In it, by the rig's name and its driver's, NAME.lock is held by the
program that drives the rig, and NAME.json holds the fault, and who cleared the last one. A rig on
simulated time hurts nobody and has neither.
"""

from __future__ import annotations

import contextlib
import json
import os
import re
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import IO

from samii_rig.devices.protocols import OpenRig
from samii_rig.errors import DeviceError, GateError, InputError

if sys.platform != "win32":
    import fcntl

LONGEST = 60  # characters of a program's command line that are shown


@dataclass(frozen=True, slots=True)
class Fault:
    """Why a rig must not move until a person has looked. time : UTC, ISO 8601."""

    reason: str
    time: str
    program: str


@dataclass(frozen=True, slots=True)
class Cleared:
    """Who took a fault back, when, and why that is safe."""

    person: str
    reason: str
    time: str
    fault: str


class Latch:
    """The state of one rig behind one driver: its simulated twin is another.

    folder : of all rigs of this user, made when something is to be written.
    """

    def __init__(self, rig_name: str, driver: str = "", folder: Path | None = None) -> None:
        self._name = rig_name
        self._folder = folder or state_folder()
        # Names that differ only in what a file's name cannot hold are one rig: the safe way.
        slug = re.sub(r"[^a-z0-9]+", "_", f"{rig_name} {driver}".lower()).strip("_") or "rig"
        self._file, self._lock = self._folder / f"{slug}.json", self._folder / f"{slug}.lock"

    @property
    def fault(self) -> Fault | None:
        """The fault that is latched; one that cannot be read is a fault too."""
        found = self._read()
        try:
            return Fault(**found["fault"]) if found.get("fault") else None
        except TypeError:
            return self._unreadable()

    @property
    def cleared(self) -> Cleared | None:
        """How the last fault was cleared; None before the first."""
        try:
            return Cleared(**self._read()["cleared"])
        except (KeyError, TypeError):
            return None

    def refuse(self) -> None:
        """GateError while a fault is latched."""
        fault = self.fault
        if fault is not None:
            raise GateError(
                f"{self._name} is in FAULT since {fault.time}: {fault.reason}; look at the rig, "
                f"then samii-rig clear-fault --rig ... --name YOURS --reason WHY_IT_IS_SAFE"
            )

    def set(self, reason: str) -> None:
        """Latch a fault; one that is latched already stays, being the first cause.

        DeviceError if that cannot be written.
        """
        if self.fault is None:
            self._write({"fault": asdict(Fault(reason, _now(), _program(os.getpid())))})

    def clear(self, person: str, reason: str) -> Cleared:
        """Take the fault back on a person's word; InputError without a name and a reason, or
        if there is no fault."""
        for option, text in (("--name", person), ("--reason", reason)):
            if not text.strip():
                raise InputError("clear-fault", option, text, "who clears it, and why that is safe")
        fault = self.fault
        if fault is None:
            raise InputError("clear-fault", "", self._name, "a rig with a fault; it has none")
        cleared = Cleared(person, reason, _now(), fault.reason)
        self._write({"fault": None, "cleared": asdict(cleared)})
        return cleared

    @contextmanager
    def held(self, device: OpenRig) -> Iterator[None]:
        """The rig for this program alone; DeviceError names the one that has it already."""
        if device.metadata.get("clock") == "simulated":
            yield
            return
        with contextlib.closing(self._opened()) as file:
            if not _locked(file):
                file.seek(0)
                holder = file.read().strip() or "another program"
                raise DeviceError(f"{self._name}: driven by {holder}; end that program first")
            file.truncate(0)
            file.write(f"process {os.getpid()} ({_program(os.getpid())})\n")
            file.flush()
            yield
            # The lock goes with the file; the name in it would be wrong from then on.
            file.truncate(0)

    def _opened(self) -> IO[str]:
        try:
            self._folder.mkdir(parents=True, exist_ok=True)
            return self._lock.open("a+", encoding="utf-8")
        except OSError as error:
            raise DeviceError(
                f"{self._lock}: {error.strerror}; expected a file that can be written, where "
                "programs tell each other which rig they drive"
            ) from error

    def _read(self) -> dict[str, dict[str, str]]:
        try:
            found = json.loads(self._file.read_text(encoding="utf-8"))
        except FileNotFoundError:
            return {}
        except (OSError, ValueError):
            return {"fault": asdict(self._unreadable())}
        return found if isinstance(found, dict) else {"fault": asdict(self._unreadable())}

    def _unreadable(self) -> Fault:
        return Fault(f"the latch {self._file} cannot be read", "an unknown time", "")

    def _write(self, found: dict[str, object]) -> None:
        """Whole or not at all, also when the power goes."""
        try:
            self._folder.mkdir(parents=True, exist_ok=True)
            handle, name = tempfile.mkstemp(dir=self._folder)
            with os.fdopen(handle, "w", encoding="utf-8") as file:
                json.dump({**self._read(), **found}, file, indent=1)
                file.flush()
                os.fsync(file.fileno())
            Path(name).replace(self._file)
        except OSError as error:
            raise DeviceError(f"the fault could not be latched: {error}") from error


def state_folder() -> Path:
    """Where the state of this user's rigs is kept."""
    if given := os.environ.get("SAMII_RIG_STATE"):
        return Path(given)
    base = os.environ.get("XDG_STATE_HOME") or os.environ.get("LOCALAPPDATA")
    return Path(base or Path.home() / ".local" / "state") / "samii-rig"


def _locked(file: IO[str]) -> bool:
    if sys.platform == "win32":
        import msvcrt

        try:
            msvcrt.locking(file.fileno(), msvcrt.LK_NBLCK, 1)
        except OSError:
            return False
        return True
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        return False
    return True


def _now() -> str:
    return datetime.now(UTC).isoformat(timespec="seconds")


def _program(pid: int) -> str:
    """The command line of a process, as far as the system tells."""
    try:
        words = Path(f"/proc/{pid}/cmdline").read_bytes().split(b"\0")
        return b" ".join(words).decode("utf-8", "replace").strip()[:LONGEST]
    except OSError:
        return " ".join(sys.argv)[:LONGEST]
