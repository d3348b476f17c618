"""Processes that work for another do not outlive it."""

from __future__ import annotations

import subprocess
import sys

import pytest
from serve_kit import alive
from wait_kit import WITHIN, found

BEGUN = {
    "workers": "from samii_rig.workers import workers; w = workers(1); pool = w.__enter__()",
    "desk": "from samii_rig.serve.desk import Desk; pool = Desk()._open._all[0]",
}


@pytest.mark.parametrize("begun", BEGUN.values(), ids=BEGUN.keys())
def test_workers_end_with_who_is_killed(begun: str) -> None:
    """A pool's processes wait for work on a pipe that they hold open themselves."""
    program = f"import os\n{begun}\nprint(pool.submit(os.getpid).result(), flush=True)\ninput()"
    command = [sys.executable, "-c", program]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as killed:
        assert killed.stdout is not None
        worker = int(killed.stdout.readline())
        assert alive(worker)
        killed.kill()
        found(lambda: not alive(worker), WITHIN)
