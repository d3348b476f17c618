"""The firmware's image, made for the chip or for the emulator."""

from __future__ import annotations

import functools
import shutil
import subprocess
import tempfile
from pathlib import Path

import pytest

from sim.wire.emulator import QEMU

BOARD = Path(__file__).resolve().parents[2] / "drivers" / "serial_node" / "board"
TOOLS = {"make": "make", "arm-none-eabi-gcc": "gcc-arm-none-eabi libnewlib-arm-none-eabi"}
# Which node a test holds: the simulated one, or the image in its place. The image's runs are whole
# kits in real time: pytest -m slow has them, tests/test_board.py some of each in the checks.
NODES = ["node", pytest.param("image", marks=pytest.mark.slow)]


def missing(emulated: bool) -> str:
    """What to install, "" if nothing."""
    tools = TOOLS | ({QEMU: "qemu-system-arm"} if emulated else {})
    packages = [package for tool, package in tools.items() if shutil.which(tool) is None]
    return f"apt install {' '.join(packages)}" if packages else ""


def made(out: Path, board: str, *numbers: str) -> Path:
    """`node.bin` of one board, with numbers of config.h; skips where a tool is missing."""
    if remedy := missing(board == "qemu"):
        pytest.skip(f"no firmware here: {remedy}")
    command = ["make", "-C", str(BOARD), f"board={board}", f"out={out}", *numbers]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return out / "node.bin"


@functools.cache
def _folder() -> tempfile.TemporaryDirectory:
    """It goes with this process."""
    return tempfile.TemporaryDirectory(prefix="samii_rig_image_")


@functools.cache
def image() -> Path:
    """The emulator's image."""
    return made(Path(_folder().name), "qemu")


def options(node: str) -> tuple[str, ...]:
    """Of `python -m sim.wire`, for a node of NODES."""
    return ("--image", str(image())) if node == "image" else ()
