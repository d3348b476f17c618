"""Pin every package: requirements with hashes, and the constraints of an installation without.

    python3 make.py lock             what pyproject.toml asks for now; pins that fit stay
    python3 make.py lock --upgrade   the newest of everything

`requirements.txt` is a plain installation, `requirements-dev.txt` all of it. Both hold on every
system and Python that the project names, and say no host: whoever installs has his own registry.
"""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
PINS = ROOT / "constraints.txt"
HEADER = "# Written by `python3 make.py lock`.\n"
# One version of a package for every Python is one to test; `--universal` adds the markers.
OPTIONS = (
    *("--quiet", "--universal", "--fork-strategy", "fewest", "--generate-hashes"),
    *("--no-annotate", "--no-header", "--no-emit-index-url"),
)


def compiled(constraints: Path | None, *more: str) -> str:
    """A requirements file for what pyproject.toml asks for, by uv."""
    held = () if constraints is None else ("--constraint", str(constraints))
    command = [sys.executable, "-m", "uv", "pip", "compile", "pyproject.toml", *OPTIONS, *held]
    done = subprocess.run(
        [*command, *more], cwd=ROOT, stdout=subprocess.PIPE, text=True, check=False
    )
    if done.returncode:
        sys.exit(done.returncode)
    return HEADER + done.stdout


def pins(requirements: str) -> list[str]:
    """`name==version`, with its marker, of every package in a requirements file."""
    return [
        f"{name}=={version}{f' ; {marker}' if marker else ''}"
        for name, version, marker in re.findall(
            r"^([\w.-]+)==([^\s;]+)(?: ; (.*?))? \\$", requirements, re.M
        )
    ]


def main(arguments: list[str]) -> None:
    """Write the three files; nothing is written if a package cannot be had."""
    if arguments not in ([], ["--upgrade"]):
        sys.exit(f"make.py lock: {' '.join(arguments)}: expected nothing, or --upgrade")
    everything = compiled(None if arguments else PINS, "--all-extras")
    constraints = HEADER + "".join(f"{pin}\n" for pin in pins(everything))
    PINS.write_text(constraints, encoding="utf-8")
    (ROOT / "requirements-dev.txt").write_text(everything, encoding="utf-8")
    (ROOT / "requirements.txt").write_text(compiled(PINS), encoding="utf-8")
    print(f"{len(pins(everything))} packages pinned")


if __name__ == "__main__":
    main(sys.argv[1:])
