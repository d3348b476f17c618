"""Experiments and drivers of other packages: what is wrong with them is one line and exit code 2.

Plan: whatever an experiment's plan(), setups() or conclude() raises or returns, and whatever a
driver's entry point does, names the entry point; nothing moves, and it never looks like success.
A number in a shipped experiment's file that no rig can be asked is refused by its field.
"""

from __future__ import annotations

import re
import sys
from dataclasses import replace
from importlib.metadata import EntryPoint
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any, Literal

import numpy as np
import pytest
from burst_kit import PLAN, RIG, SEGMENT
from conftest import ROOT
from fake_device import RIG as TEXT
from fake_device import FakeDevice
from pydantic import BaseModel

from experiments.driven import MOST_SAMPLES
from samii_rig.cli import main
from samii_rig.devices import opening
from samii_rig.errors import DeviceError, InputError
from samii_rig.rig.load import load_rig
from samii_rig.rig.schema import Rig
from samii_rig.run import experiments
from samii_rig.run.experiments import load_experiment, plan_of, shipped
from samii_rig.run.plugins import checked_plan
from samii_rig.run.setups import Conclusion, conclusion_of, setups_of

WHO = "entry point own = lab_package:Own"


class Own(BaseModel):
    """An experiment of a lab; what it does wrong is put in by a test."""

    experiment: Literal["own"]
    name: str = "own"

    def plan(self, rig: Rig) -> Any:
        return WRONG.plan()

    def setups(self, rig: Rig, rig_toml: str) -> Any:
        return WRONG.setups(rig, rig_toml)

    def conclude(self, rigs: Any, outcomes: Any, stem: Path) -> Any:
        return WRONG.conclude()


WRONG: Any = SimpleNamespace()


def raising(error: BaseException) -> Any:
    def call(*_: object) -> None:
        raise error

    return call


def opens(*_: object) -> Any:
    return WRONG.opened()


@pytest.fixture(autouse=True)
def lab(monkeypatch: pytest.MonkeyPatch) -> None:
    """A package that brings an experiment and a driver, both called own."""
    package = ModuleType("lab_package")
    Own.__module__ = "lab_package"
    package.Own, package.opens = Own, opens  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "lab_package", package)
    for room, group, what in ((experiments, "kinds", "Own"), (opening, "drivers", "opens")):
        known = getattr(room, group)()
        point = EntryPoint("own", f"lab_package:{what}", f"samii_rig.{group}")
        monkeypatch.setattr(room, group, lambda known=known, point=point: {**known, "own": point})
    WRONG.__dict__.clear()
    WRONG.plan = lambda: PLAN
    WRONG.setups = lambda rig, text: setups_of(None, rig, text)
    WRONG.conclude = lambda: Conclusion(())
    WRONG.opened = lambda: FakeDevice().open()


def own(tmp_path: Path) -> Path:
    path = tmp_path / "own.toml"
    path.write_text('experiment = "own"\n')
    return path


@pytest.mark.parametrize(
    "error", [SystemExit(0), SystemExit("bye"), RuntimeError("no\nidea"), GeneratorExit()]
)
@pytest.mark.parametrize("part", ["plan", "setups"])
def test_what_an_experiment_raises_is_a_line_with_its_name(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    part: str,
    error: BaseException,
) -> None:
    rig = tmp_path / "rig.toml"
    rig.write_text(TEXT)
    setattr(WRONG, part, raising(error))
    out = tmp_path / "out" / "run.mcap"
    command = ["run", own(tmp_path), "--rig", rig, "--out", out]
    monkeypatch.setattr(sys, "argv", ["samii-rig", *map(str, command)])
    with pytest.raises(SystemExit) as end:
        main()
    assert end.value.code == 2
    said = capsys.readouterr().err
    assert said.startswith(f"samii-rig: {WHO}: {part}(): raised {type(error).__name__}")
    assert said.count("\n") == 1
    assert not out.parent.exists()


def test_ctrl_c_in_an_experiment_is_still_ctrl_c(tmp_path: Path) -> None:
    WRONG.plan = raising(KeyboardInterrupt())
    experiment, _ = load_experiment(str(own(tmp_path)), RIG)
    with pytest.raises(KeyboardInterrupt):
        plan_of(experiment, RIG)


def with_segment(**changes: object) -> object:
    return replace(PLAN, segments=(replace(SEGMENT, **changes),))  # type: ignore[arg-type]


U = SEGMENT.u


@pytest.mark.parametrize(
    ("plan", "words"),
    [
        (None, "returned NoneType; expected a Plan"),
        ([PLAN], "returned list"),
        (1j, "returned complex"),
        (replace(PLAN, segments=()), "segments is ()"),
        (replace(PLAN, segments=None), "segments is None"),
        (replace(PLAN, segments=("burst",)), "segments[0] is 'burst'; expected a PlannedSegment"),
        (
            replace(PLAN, centring_sensor="psi"),
            "is 'psi'; expected a name of pendulum, one of theta",
        ),
        (replace(PLAN, actuator=None), "actuator is None; expected a name of pendulum, one of v"),
        (replace(PLAN, rate_hz="500"), "rate_hz is '500'"),
        (replace(PLAN, kp=float("nan")), "kp is nan"),
        (with_segment(u=list(U)), "segments[0].u"),
        (with_segment(u=U.astype(complex)), "segments[0].u"),
        (with_segment(u=U[:-1]), "segments[0].theta_ref"),
        (with_segment(u=np.where(U > 0, np.nan, U)), "an array of finite floats"),
        (with_segment(frequency=None), "segments[0].frequency is None"),
        (with_segment(band_hz=(20.0, 2.0)), "the lower frequency first"),
        (with_segment(band_hz="all"), "two frequencies in Hz"),
        (with_segment(kind="sweep"), "kind is 'sweep'; expected one of burst"),
        (with_segment(level=None), "a finite level"),
        (with_segment(recorded=(10, 5)), "a first and a last sample"),
        (with_segment(dwell=1), "dwell is 1"),
    ],
)
def test_what_is_no_plan_is_named(plan: object, words: str, tmp_path: Path) -> None:
    WRONG.plan = lambda: plan
    experiment, _ = load_experiment(str(own(tmp_path)), RIG)
    with pytest.raises(InputError) as wrong:
        plan_of(experiment, RIG)
    assert str(wrong.value).startswith(WHO)
    assert words in str(wrong.value)


def test_what_is_no_setup_and_no_conclusion_is_named(tmp_path: Path) -> None:
    experiment, _ = load_experiment(str(own(tmp_path)), RIG)
    for setups in ((), (1,), None):
        WRONG.setups = lambda rig, text, setups=setups: setups
        with pytest.raises(InputError, match=r"lab_package:Own: setups\(\)"):
            setups_of(experiment, RIG, TEXT)
    WRONG.conclude = lambda: ("all well",)
    with pytest.raises(InputError, match=r"conclude\(\) is .*; expected a Conclusion"):
        conclusion_of(experiment, [], [], tmp_path)  # type: ignore[arg-type]


def broken(**parts: object) -> object:
    return replace(FakeDevice().open(), **parts)  # type: ignore[type-var]


@pytest.mark.parametrize(
    ("opened", "words"),
    [
        (raising(SystemExit(0)), "raised SystemExit: 0"),
        (raising(ImportError("no such library")), "raised ImportError: no such library"),
        (lambda: None, "returned NoneType; expected an OpenRig"),
        (lambda: broken(actuator=None), "actuator is None; expected what has all of a Actuator"),
        (lambda: broken(clock=1), "all of a Clock"),
        (lambda: broken(metadata={"serial": 7}), "metadata is {'serial': 7}"),
    ],
)
def test_a_driver_that_breaks_its_promise_is_named(opened: Any, words: str) -> None:
    WRONG.opened = opened
    rig = RIG.model_copy(update={"device": RIG.device.model_copy(update={"driver": "own"})})
    with pytest.raises(InputError) as wrong:
        opening.open_device(rig, {})
    assert str(wrong.value).startswith("entry point own = lab_package:opens")
    assert words in str(wrong.value)


def test_a_driver_that_ends_the_program_when_closed_is_a_failed_device() -> None:
    device: Any = SimpleNamespace(close=raising(SystemExit(0)))
    with pytest.raises(DeviceError, match="did not close: SystemExit: 0"):
        opening.close_device(device)


NAMES = sorted(shipped())


@pytest.mark.parametrize("name", NAMES)
def test_no_number_in_an_experiment_file_is_too_large_or_too_small_for_a_line(name: str) -> None:
    rig, _ = load_rig("samii")
    experiment: Any
    experiment, _ = load_experiment(name, load_rig("sflr")[0] if "sflr" in name else rig)
    given = experiment.model_dump(exclude_unset=True)
    for field, value in given.items():
        if isinstance(value, bool) or not isinstance(value, int | float | tuple):
            continue
        for extreme in (1e308, 5e-324, 1e-200, 1e18, 2**70, 0, -1):
            row = tuple(extreme for _ in value) if isinstance(value, tuple) else extreme
            try:
                changed = type(experiment).model_validate({**given, field: row})
            except ValueError:
                continue
            try:
                plan = checked_plan(changed.plan(rig), rig, name)
            except InputError:
                continue  # refused by its field
            assert plan.duration * plan.rate_hz <= 1.1 * MOST_SAMPLES, (field, extreme)


def test_the_kind_of_the_page_runs_by_the_file_of_the_page(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    page = (ROOT / "docs" / "guide" / "add-experiment.md").read_text("utf-8")
    code, _, file = re.findall(r"```(?:python|toml)\n(.*?)```", page, re.S)
    package = ModuleType("my_lab.chirps")
    monkeypatch.setitem(sys.modules, "my_lab", ModuleType("my_lab"))
    monkeypatch.setitem(sys.modules, "my_lab.chirps", package)
    exec(compile(code, "chirps.py", "exec"), vars(package))
    point = EntryPoint("chirps", "my_lab.chirps:Chirps", "samii_rig.experiments")
    known = experiments.kinds()
    monkeypatch.setattr(experiments, "kinds", lambda: {**known, "chirps": point})
    (tmp_path / "first.toml").write_text(file)
    rig = load_rig("samii")[0]
    plan = plan_of(load_experiment(str(tmp_path / "first.toml"), rig)[0], rig)
    (segment,) = plan.segments
    assert (segment.u[0], segment.u[-1]) == (0.0, 0.0)
    assert np.abs(segment.u).max() == pytest.approx(0.1, rel=0.01)
