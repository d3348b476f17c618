"""Fixtures that more than one test file needs."""

import os
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
# What runs a device or a service in real time, on ports whose names the system gives out again.
KITS = {"wire_kit", "can_kit", "faults_kit", "serve_kit"}
# Whose fixtures take so long that both halves of the tests must not make them anew.
TOGETHER = {"test_mode_scan", "test_modal", "test_control", "test_papers"}


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Tests of real time run one after another: side by side they would be late for each other,
    and one could open the port that another has just pulled. So do those of one costly fixture."""
    for item in items:
        here = vars(item.getparent(pytest.Module).obj)  # type: ignore[union-attr]
        if KITS & {getattr(thing, "__module__", "") for thing in here.values()}:
            item.add_marker(pytest.mark.xdist_group("real time"))
        elif item.path.stem in TOGETHER:
            item.add_marker(pytest.mark.xdist_group(item.path.stem))


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
