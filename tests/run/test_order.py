"""The order of a run: command line and service get the same refusals, and nobody a way around."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest
from serve_kit import sweep
from typer.testing import CliRunner

from samii_rig.cli.app import app
from samii_rig.devices import opening
from samii_rig.errors import DiskError, InputError, LimitError
from samii_rig.rig.load import load_rig
from samii_rig.run import campaign, space
from samii_rig.run.order import Order, refuse
from samii_rig.serve import questions

RIG, RIG_TOML = load_rig("samii")
SOFT, HARD = sweep(), sweep().replace("[0.02]", "[9.0]")


def ordered(text: str) -> Order:
    return Order.written(text, "experiment.toml", RIG, RIG_TOML)


@pytest.fixture
def nothing_opens(monkeypatch: pytest.MonkeyPatch) -> None:
    def never(*_: object) -> None:
        raise AssertionError("a device was opened")

    monkeypatch.setattr(campaign, "open_device", never)


@pytest.mark.usefixtures("nothing_opens")
def test_command_line_and_service_refuse_a_run_in_the_same_words(tmp_path: Path) -> None:
    file = tmp_path / "hard.toml"
    file.write_text(HARD)
    with pytest.raises(LimitError) as refused:
        ordered(HARD).run(0).predict().refuse(tmp_path / "run.mcap")
    said = str(refused.value)
    assert questions.dry_run(RIG_TOML, "", HARD)["refused"] == said
    result = CliRunner().invoke(app, ["run", str(file), "--out", str(tmp_path / "run.mcap")])
    assert str(result.exception) == said


@pytest.mark.usefixtures("nothing_opens")
def test_command_line_and_service_predict_the_same(tmp_path: Path) -> None:
    file = tmp_path / "soft.toml"
    file.write_text(SOFT)
    result = CliRunner().invoke(app, ["run", str(file), "--dry-run", "--json"])
    said = json.loads(result.output)["dry_run"]
    (asked,) = questions.dry_run(RIG_TOML, "", SOFT)["runs"]
    for ours, theirs in zip(said["margins"], asked["margins"], strict=True):
        assert ours.items() <= theirs.items()  # which says why the limit is as it is, too
    assert asked["duration_s"] == said["duration_s"]


@pytest.mark.usefixtures("nothing_opens")
def test_an_order_that_would_break_a_limit_opens_nothing(tmp_path: Path) -> None:
    """Whoever forgets to refuse it: the run itself does."""
    with pytest.raises(LimitError, match="largest level that would not"):
        campaign.carry_out(ordered(HARD).run(0).predict(), tmp_path / "run.mcap")
    assert not list(tmp_path.iterdir())


def test_what_the_driver_could_not_run_is_refused_to_both(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuses(rig: object) -> None:
        raise InputError("rig file", "device.settings", 1, "another")

    monkeypatch.setattr(opening, "check_device", refuses)
    with pytest.raises(InputError, match="expected another"):
        questions.dry_run(RIG_TOML, "", SOFT)
    result = CliRunner().invoke(app, ["run", "swept_sine", "--dry-run"])
    assert "expected another" in str(result.exception)


def test_a_disk_without_room_for_all_runs_refuses_the_first(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = ordered(SOFT).run(0).predict()
    needed = space.recording_bytes(run.plan, RIG)
    free = type("Disk", (), {"total": 1 << 40, "free": int(1.5 * needed)})
    monkeypatch.setattr(space.shutil, "disk_usage", lambda folder: free)
    refuse([run], tmp_path / "run.mcap")
    with pytest.raises(DiskError):
        refuse([run, replace(run, operator="Ada")], tmp_path / "run.mcap")


def test_any_end_of_a_line_is_a_line_break() -> None:
    assert ordered(SOFT.replace("\n", "\r\n")).experiment_toml == SOFT
