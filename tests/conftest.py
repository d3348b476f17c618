"""Fixtures that more than one test file needs."""

import os
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent


@pytest.fixture(scope="session")
def recordings() -> Path:
    """The folder of real recordings, which the repository does not hold."""
    folder = Path(os.environ.get("SAMII_RIG_RECORDINGS", ROOT.parent / "shared" / "recordings"))
    if not (folder / "sflr").is_dir():
        pytest.skip(f"no real recordings in {folder}; set SAMII_RIG_RECORDINGS to their folder")
    return folder / "sflr"
