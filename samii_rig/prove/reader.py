"""The process that diagnoses a concealed trial: it sees recordings and their rig file, no truth.

Run as `python -m samii_rig.prove.reader TRUTH_FOLDER`: each line on standard input is a folder of
recordings; each line on standard output is {"answer": diagnosis, "seconds": process time}, or
{"error": why}. An audit hook refuses to open anything below TRUTH_FOLDER; a process cannot take
such a hook back.
"""

from __future__ import annotations

import json
import sys
import time
import traceback
from pathlib import Path
from typing import Any

from samii_rig.errors import SamiiRigError
from samii_rig.prove.trial import REFUSED


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
    found = together(logs, How())
    return {**found.plain(), "evidence": {**found.evidence, "sigma": found.sigma}}


def said(folder: Path) -> dict[str, Any]:
    """The answer with its process time in s; whatever ends the diagnosis instead, in words."""
    start = time.process_time()
    try:
        answer = diagnose_folder(folder)
    except SamiiRigError as error:  # it says why it has no answer: an answer as well
        none = {"verdict": REFUSED, "causes": [], "sites": [], "fit": {}, "evidence": {}}
        return {"answer": {**none, "why": str(error)}, "seconds": time.process_time() - start}
    except Exception as error:  # a diagnosis that breaks is a result, and ends no campaign
        where = traceback.extract_tb(error.__traceback__)[-1]
        what = f"{type(error).__name__} in {Path(where.filename).name}:{where.lineno}: {error}"
        return {"error": what, "seconds": time.process_time() - start}
    return {"answer": answer, "seconds": time.process_time() - start}


def main() -> None:
    """Serve until standard input ends."""
    hide(Path(sys.argv[1]))
    for line in sys.stdin:
        sys.stdout.write(json.dumps(said(Path(line.rstrip("\n")))) + "\n")
        sys.stdout.flush()


if __name__ == "__main__":
    main()
