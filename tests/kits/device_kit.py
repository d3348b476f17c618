"""Drivers in a package of their own, as a lab adds one: every process that is started finds it."""

from __future__ import annotations

import os
from pathlib import Path

# The rig of another file, simulated: the rig file that runs it may leave something out.
CONCEALED = """
from samii_rig.rig.load import load_rig
from sim.rig import open_rig as simulated

def open_rig(rig, settings):
    settings = dict(settings)
    return simulated(load_rig(settings.pop("truth"))[0], settings)
"""
# The serial node; how late each sleep of the loop ended, ms, is a file when the process ends.
TIMED = """
import atexit, time
import numpy as np
from drivers.serial_node import open_rig as node

def open_rig(rig, settings):
    settings, late = dict(settings), []
    path = settings.pop("late")
    device = node(rig, settings)
    sleeps = device.clock.sleep

    def sleep(seconds):
        due = time.monotonic() + max(0.0, seconds)
        sleeps(seconds)
        late.append(1e3 * (time.monotonic() - due))

    device.clock.sleep = sleep
    atexit.register(lambda: np.save(path, late))
    return device
"""


def installed(folder: Path, name: str, source: str) -> str:
    """Install `source` as the driver `name`; the PYTHONPATH with which it is found."""
    info = folder / f"{name}-1.dist-info"
    info.mkdir(parents=True)
    (folder / f"{name}_package.py").write_text(source)
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1\n")
    (info / "entry_points.txt").write_text(
        f"[samii_rig.devices]\n{name} = {name}_package:open_rig\n"
    )
    return os.pathsep.join(p for p in (str(folder), os.environ.get("PYTHONPATH", "")) if p)
