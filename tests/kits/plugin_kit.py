"""pytest in a process of its own, with the plugin of samii-rig."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

Done = subprocess.CompletedProcess[str]


def pytest_in(folder: Path, *options: str, plugin: str = "samii_rig") -> Done:
    """pytest in a process of its own, with no other plugin."""
    env = {**os.environ, "PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1"}
    command = [sys.executable, "-m", "pytest", "-p", plugin, "-p", "no:cacheprovider", *options]
    return subprocess.run(command, cwd=folder, env=env, text=True, capture_output=True, check=False)


def passed(done: Done, n: int) -> None:
    assert done.returncode == 0, done.stdout + done.stderr
    assert f"{n} passed" in done.stdout
