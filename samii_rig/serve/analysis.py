"""The service's side of what is known of a run while it goes on: see `analyst`.

A run may be allowed to end once its diagnosis is certain. It is when the same answer was given
twice in a row, each time with a probability above `CERTAIN` and from repeats; that nothing is
missing counts only once every level of the plan was measured. The run then ends at the end of the
segment that goes on, where its reference has come down to rest by itself.
"""

from __future__ import annotations

import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path
from typing import Any

from samii_rig.errors import RecordingError
from samii_rig.serve.job import DOING, LOG, RESPONSES, SO_FAR, Job
from samii_rig.serve.shared import get

CERTAIN = 0.95
IN_A_ROW = 2
COMMAND = ("-m", "samii_rig.serve.analyst")  # of this Python


class Analysis:
    """Keeps an analyst for the run that goes on. recordings : the folder of the recordings."""

    def __init__(self, recordings: Path) -> None:
        self._recordings = recordings
        self._job: Job | None = None
        self._process: subprocess.Popen[bytes] | None = None
        self._read: tuple[int, dict[str, Any]] = (0, {})
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
        self._look()

    def close(self) -> None:
        """The run is over, or the service ends."""
        if self._process is not None:
            assert self._process.stdin is not None
            self._process.stdin.close()
            self._process.kill()
            self._process.wait()
        self._process, self._job = None, None
        self._read, self._answers = (0, {}), []

    @property
    def certain(self) -> str:
        """The answer that is certain, "" while none is."""
        last = self._answers[-IN_A_ROW:]
        return last[0] if len(last) == IN_A_ROW and len(set(last)) == 1 else ""

    def state(self) -> dict[str, Any]:
        """What is told to everybody who looks: a word that changes with the responses and their
        age in s, the diagnosis with its own, and whether the analyst is gone."""
        diagnosis = dict(self._read[1])
        if diagnosis:
            diagnosis["age_s"] = _age(diagnosis["time"])
            diagnosis["certain"] = self.certain
            diagnosis["next_toml"] = bool(diagnosis.get("next_toml"))
        seen, age = 0, 0.0
        if self._job is not None:
            with suppress(OSError):
                seen = (self._job.folder / RESPONSES).stat().st_mtime_ns
                age = _age(1e-9 * seen)
        return {
            "responses": str(seen),
            "responses_age_s": age,
            "diagnosis": diagnosis or None,
            "doing": self._tried(),
            "failed": self._process is not None and self._process.poll() is not None,
        }

    def _tried(self) -> str:
        """What the diagnosis tries that is being made, "" where none is or nothing can be read."""
        if self._job is not None and self._job.written.phase == "running":
            with suppress(OSError, RecordingError, LookupError):
                return str(get(self._job.folder / DOING)["doing"])
        return ""

    def _look(self) -> None:
        """Take in what the analyst says, if it says something new that can be read."""
        assert self._job is not None
        path = self._job.folder / SO_FAR
        with suppress(OSError, RecordingError, LookupError, TypeError, ValueError):
            written = path.stat().st_mtime_ns
            if written != self._read[0]:
                found = get(path)
                answer = _answer(found)
                self._read = (written, {**found, "time": float(found["time"])})
                self._answers.append(answer)


def _age(written: float) -> float:
    """s since then; 0 where the clock was set back meanwhile."""
    return max(0.0, round(time.time() - written, 1))


def _answer(found: dict[str, Any]) -> str:
    """What a diagnosis says, in a line, if it is certain of it; "" otherwise."""
    if not found["repeats"] or not found.get("probability", 0.0) > CERTAIN:
        return ""
    if found["verdict"] == "no_mismatch":
        return "nothing is missing" if found["levels"] >= found["of_levels"] else ""
    if found["verdict"] != "named":
        return ""
    return " and ".join(f"{c['physics']} at {c['site']}" for c in found["causes"])
