#!/usr/bin/env python3
"""Set up and run, with nothing but Python 3.11+ (and git, which brought you this).

    python3 make.py demo     the main job on the simulated SAMII, from sweep to report
    python3 make.py check    every check: lint, types, import layers, site, what is published, tests

and for those who carry the project on:

    python3 make.py docs           the site, in dist/docs; without a network
    python3 make.py release-check  build what is published, and use it as a stranger would
    python3 make.py lock           pin every package, with hashes
    python3 make.py licences       the licence of every package
    python3 make.py sbom           a CycloneDX bill of materials, in dist/
    python3 make.py audit          the pinned packages against the known vulnerabilities of PyPI

Each makes a virtual environment in .venv on first use, with the versions that constraints.txt
pins. Anything after the command is handed on: to `samii-rig run`, to pytest, to the tool.
"""

import hashlib
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack, suppress
from pathlib import Path
from subprocess import STDOUT
from tempfile import TemporaryFile

ROOT = Path(__file__).resolve().parent
VENV = ROOT / ".venv"
BIN = VENV / ("Scripts" if os.name == "nt" else "bin")
PYTHON = BIN / ("python.exe" if os.name == "nt" else "python")
EVERYTHING = "[dev,docs,release]"  # that a plain installation leaves out
PIP = ("-m", "pip", "--quiet", "--disable-pip-version-check", "install")
UV = BIN / ("uv.exe" if os.name == "nt" else "uv")
SITE: list[str | Path] = [
    *(PYTHON, "-m", "sphinx", "--fresh-env", "--fail-on-warning", "--keep-going", "--quiet"),
    *("-c", "docs", ".", "dist/docs"),
]
# Trust the machine's certificates: a network may have its own. Which name counts: uv's version.
TRUST = {"UV_SYSTEM_CERTS": "1", "UV_NATIVE_TLS": "1"}
# A check starts hundreds of processes; without kept bytecode each compiles 1,600 modules, 2 s.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
UV_PATIENCE = "20"  # s; pip is there when uv's way is closed, so nobody waits for uv for minutes


def run(*command: str | Path, quiet: bool = False, env: dict[str, str] | None = None) -> int:
    """Run a command in the checkout; its exit code."""
    words, out = [str(c) for c in command], subprocess.DEVNULL if quiet else None
    try:
        done = subprocess.run(
            words, cwd=ROOT, check=False, env={**os.environ, **(env or {})}, stdout=out, stderr=out
        )
    except FileNotFoundError:
        return 127
    return done.returncode


def call(*command: str | Path) -> None:
    """Run a command in the checkout; end with its exit code if it fails."""
    if code := run(*command):
        sys.exit(code)


def setup(extra: str) -> None:
    """Make .venv and install the project, unless that is done for these very files."""
    pinned = (ROOT / "pyproject.toml").read_bytes() + (ROOT / "constraints.txt").read_bytes()
    state = hashlib.sha256(pinned + sys.version.encode()).hexdigest()
    # The development set holds the plain one, so it serves both.
    stamps = {name: VENV / f"installed{name}" for name in ("", EVERYTHING)}
    if any(s.exists() and s.read_text() == state for n, s in stamps.items() if extra in n):
        return
    began = time.monotonic()
    environment()
    install(PYTHON, "--editable", f".{extra}")
    stamps[extra].write_text(state)
    say(f".venv is ready after {time.monotonic() - began:.0f} s")


def say(line: str) -> None:
    """One line about what is done."""
    print(f"make.py: {line}", flush=True)


def environment() -> None:
    """A .venv of this very Python that has pip; what an earlier attempt left unfinished goes."""
    asked = "import pip, sys; sys.exit([sys.version, sys.prefix] != sys.argv[1:])"
    if run(PYTHON, "-c", asked, sys.version, VENV, quiet=True) == 0:
        return
    say(f"making .venv with Python {sys.version.split()[0]}")
    shutil.rmtree(VENV, ignore_errors=True)
    if run(sys.executable, "-m", "venv", VENV):
        shutil.rmtree(VENV, ignore_errors=True)
        sys.exit(
            "make.py: this Python cannot make a virtual environment; "
            "install its venv module (Debian and Ubuntu: apt install python3-venv)"
        )


def install(python: Path, *what: str) -> None:
    """Install for a Python by uv (seconds), and where its way is closed by pip (minutes)."""
    what = ("--constraint", "constraints.txt", *what)
    if not UV.exists():
        short = ("--retries", "1", "--timeout", UV_PATIENCE, "--constraint", "constraints.txt")
        run(PYTHON, *PIP, *short, "uv", quiet=True)
    if UV.exists():
        say("installing by uv (10 to 60 s, once)")
        uv = (UV, "pip", "install", "--quiet", "--python", python)
        if run(*uv, *what, env={**TRUST, "UV_HTTP_TIMEOUT": UV_PATIENCE}) == 0:
            return
        say("uv could not; what it says stands above. pip is asked instead")
    say("installing by pip (one to three minutes, once)")
    if code := run(python, *PIP, *what):
        say("nothing was kept that could not be used: the same command tries again")
        sys.exit(code)


def demo(arguments: list[str]) -> None:
    """Sweep the simulated SAMII, estimate, lay the model over it, write the report."""
    setup("")
    call(BIN / "samii-rig", "run", *(arguments or ["swept_sine", "--rig", "samii"]))


def check(arguments: list[str]) -> None:
    """Lint, types, import layers, site, what is published, tests; stops at the first that fails."""
    setup(EVERYTHING)
    call(BIN / "ruff", "check", ".")
    call(BIN / "ruff", "format", "--check", ".")
    codes = side_by_side(
        [PYTHON, "-m", "tools.kernels"],
        [PYTHON, "-m", "tools.release"],
        SITE,
        [BIN / "lint-imports"],
        [BIN / "mypy"],
    )
    if failed := next(filter(None, codes), 0):
        sys.exit(failed)
    tests(arguments)


def tests(arguments: list[str]) -> None:
    """All tests: those in real time one after another, the others side by side.

    A virtual machine that fills all its processors is held for up to 100 ms at a time, longer than
    a device waits for its host. So the others leave one processor free until those in real time
    have ended; where there is one alone they come after.
    """
    # One more than cores: a test of the service waits for its processes most of the time.
    side_by = min(os.cpu_count() or 1, 4) + 1
    pytest: list[str | Path] = [BIN / "pytest", "-q", "--durations=10"]
    workers = ["-n", str(side_by), "--dist", "worksteal"]  # neighbours stay together: one fixture
    if arguments:
        call(*pytest, *workers, *arguments)
        return
    real_time = [*pytest, "-m", "real_time and not slow"]
    others = [*pytest, *workers, "-m", "not real_time and not slow"]
    if len(cpus()) > 1:
        failed, late = side_by_side(others, real_time, but=min(cpus()))
    else:
        late, failed = run(*real_time), run(*others)
    if late or failed:
        sys.exit(late or failed)


def cpus() -> set[int]:
    """The processors that this process may choose from."""
    return os.sched_getaffinity(0) if hasattr(os, "sched_getaffinity") else {0}


def side_by_side(*commands: Sequence[str | Path], but: int | None = None) -> list[int]:
    """Run commands at once; the last prints as it goes, each other when it ends. Their exit
    codes. but : a processor that the others leave to the last, as long as it runs."""
    codes, running = [], []
    with ExitStack() as stack:
        for command in commands[:-1]:
            said = stack.enter_context(TemporaryFile("w+", encoding="utf-8"))
            words = [str(word) for word in command]
            process = subprocess.Popen(words, cwd=ROOT, stdout=said, stderr=STDOUT)
            if but is not None:
                keep_to(process.pid, cpus() - {but})
            running.append((command, process, said))
        last = run(*commands[-1])
        if but is not None:
            for _, process, _ in running:
                keep_to(process.pid, cpus())
        for command, process, said in running:
            code = process.wait()
            said.seek(0)
            print(said.read(), end="", flush=True)
            if code:
                say(f"{' '.join(Path(str(w)).name for w in command)}: exit code {code}")
            codes.append(code)
    return [*codes, last]


def keep_to(pid: int, processors: set[int]) -> None:
    """Let a process and all that it has started run on these alone."""
    for thread in Path("/proc", str(pid), "task").glob("*"):
        with suppress(OSError):  # it has ended
            os.sched_setaffinity(int(thread.name), processors)
            for child in (thread / "children").read_text().split():
                keep_to(int(child), processors)


def docs(arguments: list[str]) -> None:
    """Build the site whole; a warning is an error, so that no page is lost and no link is dead."""
    setup(EVERYTHING)
    shutil.rmtree(ROOT / "dist" / "docs", ignore_errors=True)
    call(*SITE, *arguments)
    say(f"the site is {ROOT / 'dist' / 'docs' / 'docs' / 'index.html'}")


def tool(name: str) -> Callable[[list[str]], None]:
    """A command that is a file in tools/."""

    def command(arguments: list[str]) -> None:
        setup(EVERYTHING)
        call(PYTHON, "-m", f"tools.{name}", *arguments)

    return command


COMMANDS = {
    "demo": demo,
    "check": check,
    "lock": tool("lock"),
    "licences": tool("licences"),
    "sbom": tool("sbom"),
    "audit": tool("audit"),
    "release-check": tool("release"),
    "docs": docs,
}

if __name__ == "__main__":
    if sys.version_info < (3, 11):
        sys.exit(f"make.py: this is Python {sys.version.split()[0]}; expected 3.11 or newer")
    if len(sys.argv) < 2 or sys.argv[1] not in COMMANDS:
        sys.exit(__doc__)
    COMMANDS[sys.argv[1]](sys.argv[2:])
