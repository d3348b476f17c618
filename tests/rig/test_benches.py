"""The small benches that ship: each is driven for some seconds, and the diagnosis of its recording
says that nothing is missing; what is then concealed in the two masses is named."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from experiment_kit import simulate

from samii_rig.diagnose.diagnose import diagnose, table
from samii_rig.fem.model import Fem
from samii_rig.model.realise import realise
from samii_rig.model.tmm import Chain
from samii_rig.record.reader import read_recording
from samii_rig.report.drawing import draw
from samii_rig.rig.load import load_rig, parse
from samii_rig.rig.schema import Rig
from samii_rig.run.experiments import load_experiment
from samii_rig.signal.estimate import estimate
from samii_rig.types import Recording

BENCHES = (
    "one_mass",
    "two_masses",
    "three_masses",
    "beam_on_shaker",
    "flexible_joint",
    "carriage",
    "cylinder",
    "spindle_drive",
)


def swept(rig: Rig, text: str, truth: Rig, folder: Path) -> Recording:
    """The shipped sweep of `rig` on the simulated `truth`, as a recording of the rig file."""
    experiment, _ = load_experiment("swept_sine", rig)
    simulate(truth, text, experiment, folder / "run.mcap")
    return replace(read_recording(folder / "run.mcap"), rig_toml=text)


@pytest.mark.parametrize("name", BENCHES)
def test_transfer_matrices_finite_elements_and_partial_fractions_agree(name: str) -> None:
    rig, _ = load_rig(name)
    f = np.geomspace(0.5, 150.0, 60)
    H = Chain(rig).response(f)
    size = np.abs(H).max(axis=0)
    assert np.max(np.abs(Fem(rig, elements=40).response(f) - H) / size) < 1e-6
    assert realise(rig).error.max() < 1e-6


@pytest.mark.parametrize("name", BENCHES)
def test_of_a_bench_as_its_file_says_nothing_is_missing(name: str, tmp_path: Path) -> None:
    rig, text = load_rig(name)
    found = diagnose(estimate([swept(rig, text, rig, tmp_path)]), rig)
    assert found.verdict == "no_mismatch"
    assert found.plain()["causes"] == []


BAND = (0.5, 50.0)  # Hz, wider than the sweep
RIVALS = ("added_mass", "ground_spring", "viscous_damping", "attached_oscillator", "sensor_gain")
HOLDER = '[[element]]\nname = "holder"\nkind = "ground_spring"\nk = { value = 1.5, unit = "N/mm", '


@pytest.mark.parametrize(
    ("old", "new", "physics", "site", "symbol", "value"),
    [
        ("value = 800.0", "value = 950.0", "added_mass", "mass_2", "m", 0.15),
        (
            '[[sensor]]\nname = "x_1"',
            HOLDER + 'source = "[chosen]" }\n\n[[sensor]]\nname = "x_1"',
            "ground_spring",
            "mass_2",
            "k",
            1500.0,
        ),
    ],
)
def test_a_mass_and_a_spring_concealed_in_the_two_masses_are_named(
    old: str, new: str, physics: str, site: str, symbol: str, value: float, tmp_path: Path
) -> None:
    rig, text = load_rig("two_masses")
    assert text.count(old) == 1
    truth = parse(Rig, text.replace(old, new), "truth.toml")
    few = [e for e in table(rig, *BAND) if e.physics in RIVALS]
    found = diagnose(estimate([swept(rig, text, truth, tmp_path)]), rig, effects=few).plain()
    assert found["verdict"] == "named"
    (cause,) = found["causes"]
    assert (cause["physics"], cause["site"]) == (physics, site)
    measured = cause["parameters"][symbol]
    assert measured["low"] < value < measured["high"]
    assert measured["value"] == pytest.approx(value, rel=0.03)


@pytest.mark.parametrize("name", BENCHES)
def test_a_drawing_names_every_part_and_shows_values_as_written(name: str) -> None:
    rig, _ = load_rig(name)
    svg = draw(rig)
    for part in (*rig.element, *rig.sensor):
        assert f"{part.name}" in svg
    if name == "two_masses":
        assert "12 N/mm" in svg
        assert "800 g" in svg
