"""Responses that were kept without their recordings, diagnosed with all that they carry."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from identify_kit import noiseless, samii
from typer.testing import CliRunner

from samii_rig.cli.app import app
from samii_rig.diagnose.diagnose import diagnose
from samii_rig.errors import InputError
from samii_rig.identify.bootstrap import redraw
from samii_rig.record.derived import save_frequency_responses
from samii_rig.record.reader import read_saved_responses
from samii_rig.rig.load import load_rig
from samii_rig.types import FrequencyResponse

LINES = np.geomspace(0.5, 40.0, 160)


@pytest.fixture
def measured() -> FrequencyResponse:
    exact = noiseless(samii(), LINES)
    return redraw(exact, exact.H, np.random.default_rng(2), 10)


def test_they_are_diagnosed_by_the_rig_file_that_they_carry(
    measured: FrequencyResponse, tmp_path: Path
):
    path, text = tmp_path / "frf.mcap", load_rig("samii")[1]
    save_frequency_responses(path, [measured], [], rig_toml=text)
    saved = read_saved_responses(path)
    assert saved is not None
    assert saved.rig_toml == text
    np.testing.assert_array_equal(saved.responses[0].covariance, measured.covariance)
    done = CliRunner().invoke(app, ["diagnose", str(path)])
    assert done.exit_code == 0, done.output
    (first, *_) = diagnose(saved.responses, samii()).lines()
    assert first in " ".join(done.stdout.split())


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["--rig", "samii", "--output", "a_7"], "did you mean a_"),
        ([], "carry no rig file"),
        (["--rig", "samii", "--before", "FRF"], "compared by their samples"),
    ],
)
def test_what_cannot_be_done_with_them_is_said_in_one_line(
    words: list[str], expected: str, measured: FrequencyResponse, tmp_path: Path
):
    path, other = tmp_path / "frf.mcap", tmp_path / "other.mcap"
    for each in (path, other):
        save_frequency_responses(each, [measured], [])
    words = [str(other) if w == "FRF" else w for w in words]
    if "--before" in words:
        words = ["diagnose", *words, "--after", str(path)]
    else:
        words = ["diagnose", str(path), *words]
    done = CliRunner().invoke(app, words)
    assert isinstance(done.exception, InputError)
    assert expected in str(done.exception)
    assert "\n" not in str(done.exception)
