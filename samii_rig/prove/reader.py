"""The process that diagnoses a concealed trial: it sees recordings and their rig file, no truth.

Run as `python -m samii_rig.prove.reader TRUTH_FOLDER`: each line on standard input is a folder of
recordings; each line on standard output is the diagnosis of it, or {"error": why}. An audit hook
refuses to open anything below TRUTH_FOLDER; a process cannot take such a hook back.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any


def hide(folder: Path) -> None:
    """From now on nothing in this process opens a file below `folder`."""
    root = folder.resolve()

    def refuse(event: str, arguments: tuple[Any, ...]) -> None:
        if event not in ("open", "os.listdir", "os.scandir") or not arguments:
            return
        if isinstance(arguments[0], str | bytes) and arguments[0]:
            named = arguments[0] if isinstance(arguments[0], str) else arguments[0].decode()
            if root in (path := Path(named).resolve()).parents or path == root:
                raise PermissionError(f"{named}: the truth is not for the diagnosis")

    sys.addaudithook(refuse)


def diagnose_folder(folder: Path) -> dict[str, Any]:
    """The diagnosis of all recordings in a folder, by the rig file that they carry, and the
    evidence that its probability rests on."""
    from samii_rig.diagnose.batch import How, together
    from samii_rig.errors import InputError

    logs = sorted(folder.glob("*.mcap"))
    if not logs:
        raise InputError(str(folder), "", "no recording", "a folder with .mcap files")
    found = together(logs, How(gaps="model"))
    return {**found.plain(), "evidence": found.evidence}


def main() -> None:
    """Serve until standard input ends."""
    from samii_rig.errors import SamiiRigError

    hide(Path(sys.argv[1]))
    for line in sys.stdin:
        try:
            answer = diagnose_folder(Path(line.rstrip("\n")))
        except SamiiRigError as error:
            answer = {"error": str(error)}
        sys.stdout.write(json.dumps(answer) + "\n")
        sys.stdout.flush()


if __name__ == "__main__":
    main()
