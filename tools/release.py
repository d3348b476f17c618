"""Build what is published, twice, and use it as somebody who has nothing else.

    python3 make.py release-check

Wheel and source archive are built from the checkout and again from that source archive: equal
bytes, or it fails. The wheel goes into an environment of its own, away from the checkout. There the
console command answers, pytest finds the plugin, and the service starts, answers and ends.
What passed is in dist/.
"""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import tarfile
import tempfile
import time
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import make

ROOT = Path(__file__).resolve().parent.parent
WITHIN = 120.0  # s; of any step on a loaded machine
# Whether the wheel holds its kernels is seen where they are run, not where they are compiled, which
# is the same everywhere and takes most of a minute of a core.
PLAIN = {"NUMBA_DISABLE_JIT": "1"}
PLUGIN_TEST = """
import pytest
import samii_rig

@pytest.mark.samii_rig(rig="one_mass")
def test_the_rig_is_a_simulation_of_the_wheel(rig):
    assert rig.device.driver == "simulated"
    assert {home!r} in samii_rig.__file__
"""


def said(*command: str | Path, cwd: Path, **env: str) -> str:
    """What a command prints; ends with what it said if it fails."""
    done = subprocess.run(
        [str(c) for c in command],
        cwd=cwd,
        env={**os.environ, **env},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        check=False,
        timeout=WITHIN,
    )
    if done.returncode:
        sys.exit(f"{done.stdout}\nrelease-check: {command[0]} ended with {done.returncode}")
    return done.stdout


def built(source: Path, out: Path, stamp: str) -> dict[str, Path]:
    """Wheel and source archive of a folder, by kind, with `stamp` as the time of every file."""
    command = (sys.executable, "-m", "hatchling", "build", "--directory", out)
    said(*command, cwd=source, SOURCE_DATE_EPOCH=stamp)
    (wheel,), (archive,) = out.glob("*.whl"), out.glob("*.tar.gz")
    return {"wheel": wheel, "source archive": archive}


def same_twice(folder: Path) -> dict[str, Path]:
    """Both, built from the checkout and from its own source archive; the bytes are the same."""
    stamp = said("git", "log", "-1", "--format=%ct", cwd=ROOT).strip()
    first = built(ROOT, folder / "first", stamp)
    with tarfile.open(first["source archive"]) as archive:
        if hasattr(tarfile, "data_filter"):
            archive.extractall(folder / "source", filter="data")
        else:  # Python before 3.11.4; the archive is our own
            archive.extractall(folder / "source")
    (source,) = (folder / "source").iterdir()
    (source / "PKG-INFO").unlink()  # no source: the build adds it
    second = built(source, folder / "second", stamp)
    for kind, path in first.items():
        if path.read_bytes() != second[kind].read_bytes():
            sys.exit(f"release-check: the {kind} built from the source archive has other bytes")
    return first


def fresh(wheel: Path, folder: Path) -> Path:
    """An environment with the wheel, its service and pytest; its folder of programs."""
    said(sys.executable, "-m", "venv", folder, cwd=ROOT)
    programs = folder / make.BIN.name
    make.install(programs / make.PYTHON.name, f"{wheel}[serve]", "pytest")
    return programs


def command_answers(programs: Path, home: Path) -> None:
    """The console command is there, and knows the rigs that the wheel holds."""
    version = said(programs / "samii-rig", "--version", cwd=home)
    if version.split() != ["samii-rig", wheel_version(programs, home)]:
        sys.exit(f"release-check: samii-rig --version says {version!r}")


def wheel_version(programs: Path, home: Path) -> str:
    """The version that the installed wheel states."""
    ask = "from importlib.metadata import version; print(version('samii-rig'))"
    return said(programs / "python", "-c", ask, cwd=home).strip()


def plugin_is_found(programs: Path, home: Path) -> None:
    """pytest finds the plugin by its entry point, and the plugin the wheel's rigs."""
    (home / "test_wheel.py").write_text(PLUGIN_TEST.format(home=str(programs.parent)))
    told = said(programs / "python", "-m", "pytest", "-q", home, cwd=home, **PLAIN)
    if "1 passed" not in told:
        sys.exit(f"{told}\nrelease-check: the plugin's test did not run")


def service_answers(programs: Path, home: Path) -> None:
    """The service starts, shows its page, and ends when it is told to."""
    options = ("--rig", "one_mass", "--folder", "runs", "--port", "0", "--stop-port", "0")
    process = subprocess.Popen(
        [programs / "samii-rig", "serve", *options],
        cwd=home,
        env={**os.environ, **PLAIN},
        stdout=subprocess.PIPE,
        text=True,
    )
    try:
        assert process.stdout is not None
        url = process.stdout.readline().split(": ", 1)[1].strip()
        with urllib.request.urlopen(url, timeout=WITHIN) as page:
            text = page.read().decode()
        if "<html" not in text:
            sys.exit(f"release-check: the service shows {text[:80]!r}")
    finally:
        process.send_signal(signal.SIGTERM)
        code = process.wait(WITHIN)
    if code not in (0, -signal.SIGTERM):
        sys.exit(f"release-check: the service ended with {code}")


@contextmanager
def step(what: str) -> Iterator[None]:
    """Say what was done, with its seconds."""
    began = time.monotonic()
    yield
    print(f"release-check: {what}: {time.monotonic() - began:.1f} s", flush=True)


def main() -> None:
    """Every step; what was built is kept if all of them pass."""
    with tempfile.TemporaryDirectory() as name:
        folder, home = Path(name), Path(name) / "home"
        home.mkdir()
        with step("wheel and source archive built twice, equal bytes"):
            files = same_twice(folder)
        with step("wheel installed in an environment of its own"):
            programs = fresh(files["wheel"], folder / "installed")
        with step("console command, pytest plugin, service"):
            command_answers(programs, home)
            plugin_is_found(programs, home)
            service_answers(programs, home)
        (ROOT / "dist").mkdir(exist_ok=True)
        for path in files.values():
            shutil.copy(path, ROOT / "dist")


if __name__ == "__main__":
    main()
