"""Check an uploaded recording in a process that cannot do harm: little memory, little time.

`python -m samii_rig.serve.upload FILE` prints one line of JSON about it.
"""

from __future__ import annotations

import asyncio
import json
import resource
import sys
from pathlib import Path
from typing import Any

from samii_rig.errors import RecordingError

UPLOAD_MEMORY = 2 << 30  # bytes of address space; numpy and its libraries take 0.7 of them
CPU = 60  # s
COMMAND = ("-m", "samii_rig.serve.upload")  # of this Python
UPLOAD_WITHIN = 90.0  # s on the clock


async def checked(path: Path) -> dict[str, Any]:
    """What `verify` found; RecordingError if the recording is not whole, or cost too much."""
    process = await asyncio.create_subprocess_exec(
        sys.executable,
        *COMMAND,
        str(path),
        stdin=asyncio.subprocess.DEVNULL,
        stdout=asyncio.subprocess.PIPE,
        stderr=asyncio.subprocess.DEVNULL,
    )
    try:
        out, _ = await asyncio.wait_for(process.communicate(), UPLOAD_WITHIN)
    except TimeoutError as error:
        process.kill()
        await process.wait()
        raise RecordingError(f"it could not be checked in {UPLOAD_WITHIN:g} s") from error
    except asyncio.CancelledError:
        process.kill()
        raise
    try:
        found: dict[str, Any] = json.loads(out)
    except ValueError as error:
        limits = f"{CPU} s and {UPLOAD_MEMORY >> 30} GB"
        raise RecordingError(f"it could not be checked within {limits}") from error
    if found["status"] != "whole":
        raise RecordingError(f"it is not whole: {found['problem']}")
    return found


def main() -> None:
    """Entry point of the process."""
    resource.setrlimit(resource.RLIMIT_AS, (UPLOAD_MEMORY, UPLOAD_MEMORY))
    resource.setrlimit(resource.RLIMIT_CPU, (CPU, CPU))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    resource.setrlimit(resource.RLIMIT_FSIZE, (0, 0))
    from samii_rig.record.reader import read_frequency_responses, read_recording
    from samii_rig.record.verify import verify

    path = Path(sys.argv[1])
    found = verify(path)
    problem = found.problems[0] if found.problems else ""
    status: str = found.status
    if status == "whole":
        # What is shown later is read once here, where it may fail.
        try:
            read_recording(path)
            read_frequency_responses(path)
        except RecordingError as error:
            status, problem = "unreadable", str(error)
    problem = problem.replace(str(path), "the file")
    print(json.dumps({"status": status, "samples": found.samples, "problem": problem[:300]}))


if __name__ == "__main__":
    main()
