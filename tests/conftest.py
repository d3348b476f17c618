"""Fixtures that more than one test file needs."""

import gc
import os
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from itertools import count
from pathlib import Path

import pytest
from hypothesis import settings

# One thread for linear algebra: matrices are small, and threads that wait for each other on a busy
# machine take thirty times as long, whether they run in real time or beside it. Read when numpy is
# imported.
for library in ("OMP", "OPENBLAS", "MKL"):
    os.environ.setdefault(f"{library}_NUM_THREADS", "1")
ROOT = Path(__file__).resolve().parent.parent
# What runs a device in real time, on ports whose names the system gives out again.
KITS = {"wire_kit", "can_kit", "faults_kit"}
# Files with tests of half a minute: first, so that at the end no worker is left with one alone.
LONG = {
    "test_notebooks.py",
    "test_serve_browser.py",
    "test_serve_run.py",
    "test_serve_sofar.py",
    "test_serve_foxglove.py",
    "test_serve_keyboard.py",
    "test_diagnose_records.py",
    "test_diagnose_forces.py",
    "test_forces_varying.py",
    "test_papers_story.py",
}
# How long an example takes is the machine's affair. The examples are the same in every run, so that
# a change is judged by what it changed; HYPOTHESIS_PROFILE=explore draws new ones.
settings.register_profile("same", deadline=None, derandomize=True)
settings.register_profile("explore", deadline=None)
settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "same"))


# Four thousand tests are half a million objects, all in use. To look through them for garbage takes
# half a second, in which no thread of the process runs: longer than a device waits for its host.
gc.disable()


def pytest_collection_finish() -> None:
    """From here on only what the tests make is looked through, as in a run: run/priority.py."""
    gc.freeze()
    gc.enable()
    gc.unfreeze = _unfreeze_seldom


# Runs after which what is frozen is looked through: what each leaves is a rig and a plan, not its
# samples, and a look takes 60 ms.
RUNS_TOGETHER = 50
_unfreeze, _runs = gc.unfreeze, count(1)


def _unfreeze_seldom() -> None:
    """In the place of `gc.unfreeze`, which a run calls when it ends: it would give back the half a
    million objects too, to be looked through in every test from then on."""
    if next(_runs) % RUNS_TOGETHER == 0:
        _unfreeze()
        gc.collect()
        gc.freeze()


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Who uses a device in real time is a test in real time; the longest files come first."""
    items.sort(key=lambda item: item.path.name not in LONG)
    for item in items:
        here = vars(item.getparent(pytest.Module).obj)  # type: ignore[union-attr]
        used = {getattr(thing, "__module__", "") for thing in here.values()}
        if KITS & used:
            item.add_marker("real_time")
        if item.get_closest_marker("real_time") and not _in_real_time(item.path):
            raise pytest.UsageError(f"{item.nodeid}: in real time; its file must name the kit")


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """Who asks for tests in real time alone need not import the other nine in ten: 5 s."""
    file = collection_path.name.startswith("test_") and collection_path.suffix == ".py"
    alone = config.option.markexpr.startswith("real_time")
    return True if alone and file and not _in_real_time(collection_path) else None


def _in_real_time(path: Path) -> bool:
    text = path.read_text("utf-8")
    return any(word in text for word in (*KITS, "mark.real_time"))


@pytest.hookimpl(wrapper=True, tryfirst=True)
def pytest_runtest_protocol(item: pytest.Item) -> Iterator[None]:
    """A device in real time, its host and its test come before the rest of the machine's work, as
    they would at a bench. Processes that the test starts inherit it."""
    if item.get_closest_marker("real_time") is None or sys.platform == "win32":
        return (yield)
    with _one_at_a_time(), _first():
        return (yield)


@contextmanager
def _first() -> Iterator[None]:
    """Before other processes, if the user may ask for it; who may not has the machine as it is.

    Not by a real-time priority: a test also computes, and Linux takes a processor from who has such
    a priority for 50 ms of each second that he fills; longer than a device waits for its host.
    """
    before = os.getpriority(os.PRIO_PROCESS, 0)
    with suppress(PermissionError):
        os.setpriority(os.PRIO_PROCESS, 0, -10)  # a share of 9 to 1 beside each ordinary process
    try:
        yield
    finally:
        os.setpriority(os.PRIO_PROCESS, 0, before)


@contextmanager
def _one_at_a_time() -> Iterator[None]:
    """Side by side they would be late for each other, and one could open the port that another has
    just pulled."""
    import fcntl

    run = os.environ.get("PYTEST_XDIST_TESTRUNUID", str(os.getpid()))
    with (Path(tempfile.gettempdir()) / f"samii_rig_tests_{run}.lock").open("w") as turn:
        fcntl.flock(turn, fcntl.LOCK_EX)
        yield


@pytest.fixture(scope="session")
def recordings() -> Path:
    """The folder of real recordings, which the repository does not hold."""
    folder = Path(os.environ.get("SAMII_RIG_RECORDINGS", ROOT.parent / "shared" / "recordings"))
    if not (folder / "sflr").is_dir():
        pytest.skip(f"no real recordings in {folder}; set SAMII_RIG_RECORDINGS to their folder")
    return folder / "sflr"


@pytest.fixture(autouse=True)
def own_state(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> None:
    """No test latches a fault in the user's own folder, or finds one there."""
    if "SAMII_RIG_STATE" not in os.environ:
        monkeypatch.setenv("SAMII_RIG_STATE", str(tmp_path_factory.mktemp("state")))
