"""The guide's bench of two masses does what the guide says, from its files alone."""

import re
from pathlib import Path

import pytest
from conftest import ROOT
from experiment_kit import simulate

from samii_rig.diagnose.diagnose import diagnose
from samii_rig.errors import InputError
from samii_rig.model.modes import natural_frequencies
from samii_rig.record.reader import read_recording
from samii_rig.rig.load import parse, shipped
from samii_rig.rig.schema import Rig
from samii_rig.rig.schema.elements import AXIAL
from samii_rig.run.experiments import load_experiment
from samii_rig.signal.estimate import estimate

GUIDE = (ROOT / "docs" / "guide" / "rig.md").read_text("utf-8")
OWN = (ROOT / "docs" / "guide" / "rig-own.md").read_text("utf-8")
FILES = dict(re.findall(r"^```toml (\S+)\n(.*?)^```$", GUIDE, re.DOTALL | re.MULTILINE))
BENCH = FILES["bench.toml"]


def told(old: str, new: str) -> str:
    assert BENCH.count(old) == 1
    with pytest.raises(InputError) as caught:
        parse(Rig, BENCH.replace(old, new), "bench.toml")
    return str(caught.value)


def test_the_bench_has_the_natural_frequencies_and_the_mistakes_that_are_told() -> None:
    hz = natural_frequencies(parse(Rig, BENCH, "bench.toml"), 1.0, 60.0).hz
    assert " Hz and ".join(f"{x:.1f}" for x in hz) + " Hz" in GUIDE
    assert told('unit = "g"', 'unit = "mm"') in GUIDE
    assert told('input = "v"', 'input = "u"') in GUIDE


def test_a_heavier_mass_is_named_as_the_guide_says(tmp_path: Path) -> None:
    rig = parse(Rig, BENCH, "bench.toml")
    (tmp_path / "sweep.toml").write_text(FILES["sweep.toml"])
    experiment, _ = load_experiment(str(tmp_path / "sweep.toml"), rig)
    heavier = parse(Rig, BENCH.replace("value = 800.0", "value = 950.0"), "heavier.toml")
    for truth, says in (
        (rig, '"Nothing is missing"'),
        (heavier, "Left out: added mass at mass_2 (m = 0.15 kg)."),
    ):
        path = tmp_path / f"{says[1:5]}.mcap"
        simulate(truth, BENCH, experiment, path)
        found = diagnose(estimate([read_recording(path)]), rig)
        assert found.lines()[0].startswith(says.strip('"'))
        assert says in GUIDE


def test_the_guide_holds_the_heavier_recording_alone_against_the_file() -> None:
    """With the first one beside it no single cause explains both."""
    made = re.search(r"--rig heavier.toml --out (\S+)", GUIDE)
    assert made
    assert f"samii-rig diagnose {made[1]} --rig bench.toml" in GUIDE


def test_the_files_to_start_from_are_where_the_guide_copies_them_from() -> None:
    copied = re.findall(r"^    cp (\S+) \S+$", OWN, re.MULTILINE)
    assert len(copied) == 2
    assert all((ROOT / path).is_file() for path in copied)


def test_every_bench_and_kind_of_the_tables_exists() -> None:
    benches = re.findall(r"^\| (`\w+`(?:, `\w+`)*) \| a? ?\w", OWN, re.MULTILINE)
    names = [name for cell in benches for name in re.findall(r"`(\w+)`", cell)]
    assert {n for n in shipped() if not n.startswith(("samii", "sflr"))} <= set(names)
    words = {w for kind in AXIAL for w in kind.model_fields["kind"].annotation.__args__}  # type: ignore[union-attr]
    for word in words - {"lumped_mass", "translational_spring", "translational_ground_spring"}:
        assert f"`{word}`" in OWN, word
