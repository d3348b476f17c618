#!/usr/bin/env python3
"""Set up and run, with nothing but Python 3.11+ (and git, which brought you this).

    python3 make.py demo     the main job on the simulated SAMII, from sweep to report
    python3 make.py check    every check: lint, types, import layers, tests
    python3 make.py audit    the pinned packages against the known vulnerabilities of PyPI

The first two make a virtual environment in .venv on first use, with the versions that
constraints.txt pins. Anything after the command is handed on: to `samii-rig run` or to pytest.
"""

import hashlib
import os
import shutil
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parent
VENV = ROOT / ".venv"
BIN = VENV / ("Scripts" if os.name == "nt" else "bin")


def call(*command: str | Path) -> None:
    """Run a command in the checkout; end with its exit code if it fails."""
    code = subprocess.run([str(c) for c in command], cwd=ROOT, check=False).returncode
    if code:
        sys.exit(code)


def setup(extra: str) -> None:
    """Make .venv and install the project, unless that is done for these very files."""
    pinned = (ROOT / "pyproject.toml").read_bytes() + (ROOT / "constraints.txt").read_bytes()
    state = hashlib.sha256(pinned + sys.version.encode()).hexdigest()
    # The development set holds the plain one, so it serves both.
    stamps = {name: VENV / f"installed{name}" for name in ("", "[dev]")}
    if any(s.exists() and s.read_text() == state for n, s in stamps.items() if extra in n):
        return
    print("setting up .venv (once; one to three minutes) ...", flush=True)
    if not (BIN / "python").exists() and not (BIN / "python.exe").exists():
        made = subprocess.run([sys.executable, "-m", "venv", str(VENV)], check=False)
        if made.returncode:
            shutil.rmtree(VENV, ignore_errors=True)
            sys.exit(
                "make.py: this Python cannot make a virtual environment; "
                "install its venv module (Debian and Ubuntu: apt install python3-venv)"
            )
    python = BIN / "python"
    pip = [python, "-m", "pip", "--quiet", "--disable-pip-version-check"]
    call(*pip, "install", "--constraint", "constraints.txt", "--editable", f".{extra}")
    stamps[extra].write_text(state)


def demo(arguments: list[str]) -> None:
    """Sweep the simulated SAMII, estimate, lay the model over it, write the report."""
    setup("")
    call(BIN / "samii-rig", "run", *(arguments or ["swept_sine", "--rig", "samii"]))


def check(arguments: list[str]) -> None:
    """Lint, types, import layers, tests; stops at the first that fails."""
    setup("[dev]")
    call(BIN / "ruff", "check", ".")
    call(BIN / "ruff", "format", "--check", ".")
    call(BIN / "mypy")
    call(BIN / "lint-imports")
    workers = str(min(os.cpu_count() or 1, 4))
    call(BIN / "pytest", "-q", "-n", workers, "--durations=10", *arguments)


def audit(arguments: list[str]) -> None:
    """Look every pinned package up; fails for a vulnerability, and for a package not looked up."""
    place = VENV / "audit"
    python = place / BIN.name / "python"
    call(sys.executable, "-m", "venv", place)
    call(python, "-m", "pip", "--quiet", "--disable-pip-version-check", "install", "pip-audit>=2.9")
    pinned = ("--requirement", "constraints.txt", "--no-deps", "--disable-pip")
    call(python, "-m", "pip_audit", "--strict", *pinned, *arguments)


COMMANDS = {"demo": demo, "check": check, "audit": audit}

if __name__ == "__main__":
    if sys.version_info < (3, 11):
        sys.exit(f"make.py: this is Python {sys.version.split()[0]}; expected 3.11 or newer")
    if len(sys.argv) < 2 or sys.argv[1] not in COMMANDS:
        sys.exit(__doc__)
    COMMANDS[sys.argv[1]](sys.argv[2:])
