"""The plugin for pytest, and every example of docs/guide/ci.md in a project of its own.

Plan: it is found by its entry point and imports nothing heavy; the page's project passes as it is,
with the commands of its workflow and its container; what does not fit fails with the lines that
the page shows; nothing but a simulated rig is ever driven.
"""

from __future__ import annotations

import json
import re
import shutil
import tomllib
from pathlib import Path

import pytest
import yaml
from conftest import ROOT
from experiment_kit import SHORT, simulate
from few_kit import only
from plugin_kit import Done, passed, pytest_in

from samii_rig.pytest_plugin import _Asked, _simulated, assert_no_mismatch, assert_still_explained
from samii_rig.rig.load import load_rig, parse
from samii_rig.rig.schema import Device, Rig
from samii_rig.run.campaign import carry_out
from samii_rig.run.dryrun import predict
from samii_rig.run.order import RunOrder

PAGE = (ROOT / "docs" / "guide" / "ci.md").read_text(encoding="utf-8")
(SHOWN,) = re.findall(r"```text\n(.*?)```", PAGE, re.S)  # what a failing test shows
FILES = {name: text for _, name, text in re.findall(r"```(\w+) (\S+)\n(.*?)```", PAGE, re.S)}


def project(folder: Path, **more: str) -> Path:
    """The page's files, and others."""
    for name, text in {**FILES, **more}.items():
        (folder / name).write_text(text, encoding="utf-8")
    return folder


# Loading


def test_it_is_an_entry_point_that_imports_nothing_but_pytest(tmp_path):
    declared = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["entry-points"]
    assert declared["pytest11"] == {"samii_rig": "samii_rig.pytest_plugin"}
    (tmp_path / "test_foreign.py").write_text(
        "import json, sys\ndef test_nothing(): print('MODULES', json.dumps(sorted(sys.modules)))\n"
    )
    with_it = pytest_in(tmp_path, "-s", "--markers", "--collect-only")
    assert "@pytest.mark.samii_rig(rig='samii'" in with_it.stdout
    loaded = _modules(pytest_in(tmp_path, "-s"))
    without = _modules(pytest_in(tmp_path, "-s", plugin="no:samii_rig"))
    assert loaded - without == {"samii_rig", "samii_rig.display", "samii_rig.pytest_plugin"}


def _modules(done: Done) -> set[str]:
    passed(done, 1)
    (line,) = re.findall(r"MODULES (.*)", done.stdout)
    return {m for m in json.loads(line) if not m.startswith(("_pytest.", "pytest"))}


# The page


def test_the_project_of_the_page_passes_by_the_commands_of_its_workflow_and_container(
    tmp_path, run
):
    steps = yaml.safe_load(FILES["rig.yml"])["jobs"]["simulated"]["steps"]
    install, test = [step["run"] for step in steps if "run" in step]
    built, start = re.findall(r"^(?:RUN|CMD) (.*)$", FILES["Dockerfile"], re.M)
    assert install.endswith("pip install samii-rig pytest")
    assert built.endswith("pip install --no-cache-dir samii-rig pytest")
    assert json.loads(start) == test.split() == ["python", "-m", "pytest"]
    project(tmp_path, **{"bench.toml": load_rig("samii")[1]})
    (tmp_path / "recordings").mkdir()
    shutil.copy(run, tmp_path / "recordings")
    passed(pytest_in(tmp_path, "test_sweep.py", "test_recordings.py"), 2)
    assert {*FILES} == {p.name for p in tmp_path.iterdir() if p.is_file()} - {"bench.toml"}


@pytest.mark.real_time
def test_the_faults_of_the_page_end_their_runs(tmp_path):
    passed(pytest_in(project(tmp_path), "test_faults.py"), 2)


SERIAL = {"port": "/dev/ttyACM0", "output_counts_per_unit": 3276.8}


@pytest.mark.parametrize(
    ("driver", "own", "asked", "settings"),
    [
        ("simulated", {"pace": 2.0, "seed": 7}, {}, {"pace": 2.0, "seed": 7}),
        ("simulated", {"pace": 2.0}, {"wire": True}, {"seed": 1}),
        ("serial_node", SERIAL, {}, {"seed": 1}),
        ("serial_node", SERIAL, {"wire": True}, {"seed": 1, "node": SERIAL}),
        (
            "simulated",
            {"faults": ["lost"]},
            {"faults": "nan a_0", "settings": {"noise": False}},
            {"seed": 1, "noise": False, "faults": ("lost", "nan a_0")},
        ),
    ],
)
def test_the_device_of_the_file_is_replaced_by_a_simulated_one(driver, own, asked, settings):
    device = _simulated(Device(driver=driver, settings=own), _Asked(**asked))
    assert device.driver == ("simulated_node" if asked.get("wire") else "simulated")
    assert device.settings == settings


# What fails, and how


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two seconds of SAMII, four times."""
    path = tmp_path_factory.mktemp("run") / "last_month.mcap"
    simulate(*load_rig("samii"), SHORT.model_copy(update={"period": 2.0}), path)
    return path


def rigid() -> Rig:
    """SAMII with a first joint that does not give."""
    text = load_rig("samii")[1]
    joint = 'name = "joint_1"\nkind = "torsional_spring"\n'
    stiff, n = re.subn(
        joint + r"k = .*", joint + 'k = { value = 1e9, unit = "N m/rad", source = "rigid" }', text
    )
    assert n == 1
    return parse(Rig, stiff, "a rigid joint")


@pytest.fixture
def few(monkeypatch: pytest.MonkeyPatch) -> None:
    only(monkeypatch, ("torsional_compliance", "joint_1"), forced=False)


def test_a_rig_file_that_leaves_something_out_fails_with_the_lines_of_the_page(run, few):
    with pytest.raises(AssertionError) as failed:
        assert_no_mismatch(run, rigid())
    said = str(failed.value).splitlines()
    shown = SHOWN.splitlines()
    assert said[0] == shown[0].replace("run.mcap", run.name)
    assert [line[:14] for line in said[1 : len(shown)]] == [line[:14] for line in shown[1:]]
    assert "torsional compliance at joint_1, probability" in said[3]
    number = r"[\d.]+(e[+-]\d+)?"
    assert re.search(rf"chi-square  {number} per degree of freedom, threshold {number}", said[2])
    k = re.search(r"k = (\S+) N m/rad, 90 % interval (\S+) to (\S+)", failed.value.args[0])
    value, low, high = map(float, k.groups())
    assert low < value < high
    assert value == pytest.approx(1.36e4, rel=0.1)


def test_recordings_are_held_one_by_one_and_all_that_fail_are_named(run, few, tmp_path):
    shutil.copy(run, tmp_path / "a.mcap")
    (tmp_path / "b.mcap").write_bytes(run.read_bytes()[:2000])
    with pytest.raises(AssertionError, match=r"1 of 2 recordings .*\s+b\.mcap: "):
        assert_still_explained("samii", tmp_path)
    with pytest.raises(AssertionError, match=r"(?s)2 of 2 .*\na\.mcap: .*\nb\.mcap: "):
        assert_still_explained(rigid(), tmp_path)


def test_no_recording_is_not_a_pass(tmp_path):
    with pytest.raises(AssertionError, match="no recording in nothing"):
        assert_still_explained("samii")
    with pytest.raises(AssertionError, match=r"1 of 1 .*\s+lost\.mcap"):
        assert_still_explained("samii", tmp_path / "lost.mcap")


@pytest.mark.parametrize("folder", ["", "recordings"])
def test_a_project_that_has_no_recordings_yet_skips_and_says_where_they_go(folder, tmp_path):
    with pytest.raises(pytest.skip.Exception, match=r"no recording yet in .*put some \.mcap there"):
        assert_still_explained("samii", tmp_path / folder)


def test_a_run_that_tripped_explains_nothing(tmp_path):
    rig, text = load_rig("samii")
    tripping = rig.model_copy(update={"device": Device(settings={"faults": ["nan theta_2 2"]})})
    plan = SHORT.plan(rig)
    order = RunOrder(tripping, text, "", plan, predict(plan, rig))
    outcome = carry_out(order, tmp_path / "tripped.mcap")
    assert outcome.stop.status == "tripped"
    with pytest.raises(AssertionError, match=r"tripped\.mcap: the run tripped: .*v_2"):
        assert_no_mismatch(outcome.recording, rig)
    with pytest.raises(AssertionError, match="no recording in"):
        assert_still_explained(rig, tmp_path)


WRONG = """
import pytest
from samii_rig.rig.load import load_rig

mark = pytest.mark.samii_rig

@mark(wre=True)
def test_marker(rig): pass

@mark("no_such_rig")
def test_rig_file(rig): pass

@mark(faults="lots")
def test_fault(recording): pass

@mark(experiment="mode_scan")
def test_several_runs(recording): pass

class TestReal:
    @pytest.fixture
    def rig(self):
        real = {"driver": "serial_node", "settings": {"port": "/dev/null"}}
        return load_rig("samii")[0].model_copy(update={"device": Device(**real)})

    def test_real(self, recording): pass

@pytest.mark.parametrize("rig", ["samii", "sflr"], indirect=True)
def test_by_parameter(rig, request):
    assert rig.name.lower() in request.node.name
    assert rig.device.driver == "simulated"
""".replace("import load_rig\n", "import load_rig\nfrom samii_rig.rig.schema import Device\n")


def test_what_cannot_be_run_fails_with_one_line_each(tmp_path):
    (tmp_path / "test_wrong.py").write_text(WRONG, encoding="utf-8")
    done = pytest_in(tmp_path, "-q")
    assert "2 passed, 5 errors" in done.stdout, done.stdout
    for line in (
        "marker samii_rig: got an unexpected keyword argument 'wre'",
        "--rig is 'no_such_rig'; expected the path of a rig file or one of",
        "SAMII: device.settings.faults is 'lots'; expected one of lost, nan, stuck; did you mean",
        "is '12 runs'; expected an experiment of one run",
        "rig.device.driver is 'serial_node'; expected simulated or simulated_node: no test moves",
    ):
        assert line in done.stdout, done.stdout
    assert "Traceback" not in done.stdout
    assert "During handling" not in done.stdout
    assert "def recording" not in done.stdout
