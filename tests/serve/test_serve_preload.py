"""The process that the service copies: what it loads, and what it leaves to who needs it."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

ASKED = """
import samii_rig.serve.preload
from samii_rig.model.kernels import respond
print(len(respond._run.signatures))
"""


def test_kernels_that_are_not_compiled_yet_are_left_to_who_needs_them(tmp_path: Path) -> None:
    """To compile them takes a minute, in which the service could not be ended."""
    env = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path)}
    done = subprocess.run([sys.executable, "-c", ASKED], env=env, capture_output=True, text=True)
    assert (done.stdout.strip(), done.stderr) == ("0", "")
