"""`samii-rig recordings` and `samii-rig replay` as a person calls them."""

from __future__ import annotations

import json
from pathlib import Path
from unittest.mock import patch

import numpy as np
import pytest
from experiment_kit import shipped, simulate
from index_kit import lab, write_small
from record_kit import blocks, write_run

from samii_rig.cli import main
from samii_rig.index.remarks import set_tags
from samii_rig.record.reader import read_frequency_responses
from samii_rig.run.repeat import repeat


def call(capsys: pytest.CaptureFixture[str], *words: str | Path) -> tuple[int, str, str]:
    """Exit code, output, errors."""
    arguments = ["samii-rig", *map(str, words)]
    with patch("sys.argv", arguments), pytest.raises(SystemExit) as ended:
        main()
    said = capsys.readouterr()
    return int(ended.value.code or 0), said.out, said.err


def test_recordings_are_listed_newest_first(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    lab(tmp_path)
    set_tags(tmp_path / "a.mcap", ["paper"])
    code, out, _ = call(capsys, "recordings", tmp_path)
    lines = out.splitlines()
    assert code == 0
    assert [line.split()[2] for line in lines[:3]] == ["c.mcap", "march/b.mcap", "a.mcap"]
    assert "#paper" in lines[2]
    assert lines[3] == "3 recordings"


def test_recordings_are_found_by_what_is_asked(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    lab(tmp_path)
    asked = ("--rig", "samii", "--since", "2026-03-02", "--json")
    code, out, _ = call(capsys, "recordings", tmp_path, *asked)
    found = json.loads(out)
    assert (code, found["total"]) == (0, 1)
    assert found["recordings"][0]["reason"] == "a_tip over its limit"


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["nowhere"], "a folder of recordings"),
        ([".", "--since", "May"], "a day or time"),
        ([".", "--limit", "0"], "1 to 1000"),
    ],
)
def test_a_wrong_question_is_one_line_and_code_2(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    words: list[str],
    said: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    code, _, err = call(capsys, "recordings", *words)
    assert code == 2
    assert said in err
    assert err.count("\n") == 1


def test_a_recording_of_a_newer_version_is_one_line_and_code_2(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    with monkeypatch.context() as newer:
        newer.setattr("samii_rig.record.layout.FORMAT", "samii-rig recording 2")
        path = write_small(tmp_path / "new.mcap")
    for words in (("frf", path), ("replay", path)):
        code, _, err = call(capsys, *words)
        assert code == 2
        assert "written by a newer samii-rig" in err
        assert err.count("\n") == 1


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A short run with its frequency responses."""
    folder = tmp_path_factory.mktemp("run")
    with pytest.MonkeyPatch.context() as patched:
        patched.setenv("SAMII_RIG_STATE", str(folder))
        small = {"duration": 8.0, "ring_down": 2.0, "amplitudes": [0.25], "repeats": 2}
        rig, text, experiment = shipped("samii", "swept_sine", **small)
        return simulate(rig, text, experiment, folder / "run.mcap").path


def test_a_run_repeats_to_the_last_digit(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code, out, _ = call(capsys, "replay", run, "--check")
    assert code == 0
    assert "every digit as logged" in out
    n = sum(r.H.size for r in read_frequency_responses(run))
    assert repeat(run).numbers > 3 * n


def test_one_other_bit_is_found(
    run: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    stored = read_frequency_responses(run)
    H = stored[0].H
    H.real[3, 1, 0] = np.nextafter(H.real[3, 1, 0], np.inf)
    monkeypatch.setattr("samii_rig.run.repeat.read_frequency_responses", lambda path: stored)
    code, out, _ = call(capsys, "replay", run, "--check")
    assert code == 3
    assert "H at level 0.25 V: 1 of" in out
    assert call(capsys, "replay", run)[0] == 0
    found = json.loads(call(capsys, "replay", run, "--json")[1])
    assert (found["same"], len(found["differences"])) == (False, 1)


def test_a_recording_without_responses_has_nothing_to_compare(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    code, _, err = call(capsys, "replay", write_small(tmp_path / "x.mcap"), "--check")
    assert code == 2
    assert "no frequency response to compare with" in err


def test_responses_that_the_samples_do_not_give_are_said(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "made_up.mcap"
    write_run(path, blocks())
    code, _, _ = call(capsys, "replay", path, "--check")
    assert code != 0
