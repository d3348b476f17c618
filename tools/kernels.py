"""Compile, once, what is compiled: before test processes side by side each do it for themselves.

A short run on the simulated SAMII with its diagnosis uses the kernels of the model, the estimate,
the fit and the forces; a short trial of each concealed plant and a moment of a rig with two outputs
use those of the plants. Both need those of the model, which come first. Beside them pytest collects
the tests, for which it rewrites their assertions. All of it is kept beside the sources.
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

MODEL = """
import numpy as np
from samii_rig.model.sampled import sampled_response
from samii_rig.rig.load import load_rig

sampled_response(load_rig("one_mass")[0], np.array([1.0]))
"""
# Beside the run: of its kernels they use those of the model alone.
PLANTS = """
from pathlib import Path
from samii_rig.rig.load import load_rig
from sim.assumed_modes import trial
from sim.concealed.runs import Design
from sim.concealed.trial import make
from sim.rig import open_rig

short = Design(levels=(0.1,), bursts=1, burst=9.0, steps=1, periods=1, settle=1, period=2.0)
make("nothing", 1, Path("first"), load_rig("samii")[1], short)
trial.make("nothing", 1, Path("second"), load_rig("one_mass")[1], ("clean",))
# Last: what it has in common with the run is compiled there by now.
two = open_rig(load_rig("samii_two_joints")[0], {})
two.clock.sleep(0.1)
two.sensor.read()
"""


def main() -> int:
    """Compile in a folder that goes again, and collect; the exit code of a run that failed."""
    with tempfile.TemporaryDirectory() as name:
        path = Path(name) / "short.toml"
        path.write_text(SWEEP, encoding="utf-8")
        program = "from samii_rig.cli import main; main()"
        options = ("--rig", "samii", "--out", "short.mcap", "--seed", "1", "--no-report")
        if code := begun(name, "-c", MODEL).wait():
            return code
        both = [
            begun(name, "-c", program, "run", str(path), *options),
            begun(name, "-c", PLANTS),
        ]
        # What cannot be collected is no error here: the tests tell it, with the reason.
        root = Path(__file__).parent.parent
        collects = begun(root, "-m", "pytest", "--collect-only", "-p", "no:terminal")
        collects.wait()
        return max(process.wait() for process in both)


def begun(folder: str | Path, *words: str) -> subprocess.Popen[bytes]:
    """A program of Python that runs in a folder; what it prints is for nobody."""
    return subprocess.Popen([sys.executable, *words], cwd=folder, stdout=subprocess.DEVNULL)


if __name__ == "__main__":
    sys.exit(main())
