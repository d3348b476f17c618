"""Compile, once, what numba compiles: before test processes side by side each do it for themselves.

A short run on the simulated SAMII with its diagnosis uses the kernels of the model, the estimate,
the fit and the forces. They are kept beside their sources.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from pathlib import Path

SWEEP = """
experiment = "swept_sine"
name = "short"
actuator = "v_2"
unit = "V"
drive = "output"
sweep = "logarithmic"
start_hz = 1.0
stop_hz = 30.0
duration = 4.0
ramp = 0.5
lead_in = 0.5
ring_down = 4.0
amplitudes = [0.1, 0.2]
repeats = 1
order = "by_level"
seed = 1
"""


def main() -> int:
    """Run it in a folder that goes again; its exit code."""
    with tempfile.TemporaryDirectory() as name:
        path = Path(name) / "short.toml"
        path.write_text(SWEEP, encoding="utf-8")
        program = "from samii_rig.cli import main; main()"
        options = ("--rig", "samii", "--out", "short.mcap", "--seed", "1", "--no-report")
        done = subprocess.run(
            [sys.executable, "-c", program, "run", str(path), *options],
            cwd=name,
            stdout=subprocess.DEVNULL,
            check=False,
        )
        return done.returncode


if __name__ == "__main__":
    sys.exit(main())
