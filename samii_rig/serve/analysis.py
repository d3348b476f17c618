"""The service's side of what is known of a run while it goes on: see `analyst`.

A run may be allowed to end once its diagnosis is certain. It is when the same answer was given
twice in a row, each time with a probability above `CERTAIN` and from repeats; that nothing is
missing counts only once every level of the plan was measured. The run then ends at the end of the
segment that goes on, where its reference has come down to rest by itself.
"""

from __future__ import annotations

import json
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path
from typing import Any

from samii_rig.serve.job import LOG, RESPONSES, SO_FAR, Job

CERTAIN = 0.95
IN_A_ROW = 2
COMMAND = ("-m", "samii_rig.serve.analyst")  # of this Python


class Analysis:
    """Keeps an analyst for the run that goes on. recordings : the folder of the recordings."""

    def __init__(self, recordings: Path) -> None:
        self._recordings = recordings
        self._job: Job | None = None
        self._process: subprocess.Popen[bytes] | None = None
        self._read: dict[str, tuple[int, dict[str, Any]]] = {}
        self._answers: list[str] = []

    def turn(self, job: Job | None) -> None:
        """Look after the analyst of the job that runs, None if none does."""
        if job is None or self._job is None or job.id != self._job.id:
            self.close()
            self._job = job
        if job is None:
            return
        if self._process is None and job.request.diagnosis and job.written.phase == "running":
            with (job.folder / LOG).open("ab") as log:
                self._process = subprocess.Popen(
                    [sys.executable, *COMMAND, str(job.folder), str(self._recordings)],
                    stdin=subprocess.PIPE,  # that it ends when we do
                    stdout=log,
                    stderr=log,
                )
        new = self._newer(SO_FAR)
        if new is not None:
            self._answers.append(_answer(new))

    def close(self) -> None:
        """The run is over, or the service ends."""
        if self._process is not None:
            assert self._process.stdin is not None
            self._process.stdin.close()
            self._process.kill()
            self._process.wait()
        self._process, self._job = None, None
        self._read, self._answers = {}, []

    @property
    def certain(self) -> str:
        """The answer that is certain, "" while none is."""
        last = self._answers[-IN_A_ROW:]
        return last[0] if len(last) == IN_A_ROW and len(set(last)) == 1 else ""

    def state(self) -> dict[str, Any]:
        """What is told to everybody who looks: a word that changes with the responses and their
        age in s, the diagnosis with its own, and whether the analyst is gone."""
        diagnosis = dict(self._read.get(SO_FAR, (0, {}))[1])
        if diagnosis:
            diagnosis["age_s"] = round(time.time() - diagnosis["time"], 1)
            diagnosis["certain"] = self.certain
            diagnosis["next_toml"] = bool(diagnosis["next_toml"])
        seen, age = 0, 0.0
        if self._job is not None:
            with suppress(OSError):
                seen = (self._job.folder / RESPONSES).stat().st_mtime_ns
                age = round(time.time() - 1e-9 * seen, 1)
        return {
            "responses": str(seen),
            "responses_age_s": age,
            "diagnosis": diagnosis or None,
            "failed": self._process is not None and self._process.poll() is not None,
        }

    def _newer(self, name: str) -> dict[str, Any] | None:
        """What a file of the analyst says, if it says something new."""
        assert self._job is not None
        path = self._job.folder / name
        with suppress(OSError, ValueError):
            written = path.stat().st_mtime_ns
            if written != self._read.get(name, (0, {}))[0]:
                found: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
                self._read[name] = (written, found)
                return found
        return None


def _answer(found: dict[str, Any]) -> str:
    """What a diagnosis says, in a line, if it is certain of it; "" otherwise."""
    if not found["repeats"] or not found.get("probability", 0.0) > CERTAIN:
        return ""
    if found["verdict"] == "no_mismatch":
        return "nothing is missing" if found["levels"] >= found["of_levels"] else ""
    if found["verdict"] != "named":
        return ""
    return " and ".join(f"{c['physics']} at {c['site']}" for c in found["causes"])
