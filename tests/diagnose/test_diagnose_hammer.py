"""A hammer whose force was measured, and an accelerometer where it strikes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hammer_kit import RATE, RIG, TOML, diagnosed, struck
from scipy import signal
from table_kit import Effects, table_of
from two_masses_kit import random_command

from samii_rig.diagnose.diagnose import case_of
from samii_rig.diagnose.fit.records import Whole
from samii_rig.diagnose.forces.laws import HARDENING
from samii_rig.diagnose.forces.model import ForceModel
from samii_rig.diagnose.forces.paths import TransferPaths
from samii_rig.diagnose.forces.place import Place
from samii_rig.diagnose.forces.table import effect, forces
from samii_rig.diagnose.physics.effect import Unknown
from samii_rig.diagnose.physics.model import Model
from samii_rig.errors import InputError
from samii_rig.likelihood.inputs import calibrated
from samii_rig.rig.load import parse
from samii_rig.rig.schema import Rig
from samii_rig.signal.estimate import estimate

FEW = Effects(lambda: table_of(RIG, 1.0, 450.0, "input_not_held", "ground_spring", "added_mass"))


def test_nothing_is_missing_with_a_sensor_at_the_drive_point() -> None:
    """Held between samples, the force acts in no sample of its own: 7e4 times the noise."""
    found = diagnosed(struck(1))
    assert found.verdict == "no_mismatch"
    assert 0.85 < found.chi2_per_dof < found.threshold
    assert found.not_physics[0].startswith("F was not held between samples")


def test_a_spring_to_the_ground_has_its_value() -> None:
    found = diagnosed(struck(2, kg=3000.0), FEW)
    (cause,) = found.causes
    assert (found.verdict, cause.physics, cause.site) == ("named", "ground_spring", "floor_2")
    k = cause.parameters["k"]
    assert k.value == pytest.approx(3000.0, rel=0.02)


def test_without_a_filter_nothing_is_named_and_that_is_told() -> None:
    found = diagnosed(struck(4, filtered=False), FEW)
    assert found.causes == ()
    assert any("without an anti-aliasing filter" in words for words in found.not_physics)


def test_what_a_hammer_shows_between_hits_drives_nothing() -> None:
    run = struck(5)
    F = run.values[:, 0]
    own, meter = calibrated(F, 0.0)
    between = own == np.median(own)
    assert np.mean(between) > 0.95
    assert np.max(np.abs(F[between])) < 0.12  # N, six times its noise
    np.testing.assert_array_equal(own[~between], F[~between])
    assert meter.shown == meter.on_samples == pytest.approx(0.02, rel=0.1)
    assert meter.left == pytest.approx(0.02 * np.sqrt(np.mean(~between)), rel=0.1)
    assert meter.folds < 0.01


STATED = parse(Rig, TOML.replace("high = 1000.0", "high = 1000.0\nheld = false"), "frame")


@pytest.mark.parametrize("seed", [6, 7])
def test_noise_of_the_force_while_a_pulse_lasts_is_no_cause(seed: int) -> None:
    """Accelerometers show what the model answers to 0.1 N: 1.8 and 1.6 times their noise, if that
    is taken for force."""
    found = diagnosed(struck(seed, of_force=0.1), effects=(), rig=STATED)
    assert found.verdict == "no_mismatch"
    assert 0.8 < found.chi2_per_dof < found.threshold


def test_one_high_pass_of_all_sensors_is_one_cause() -> None:
    """Couplers of 1 Hz at both accelerometers, which the rig file does not state."""
    run = struck(9)
    b, a = signal.bilinear([1.0, 0.0], [1.0, 2 * np.pi], RATE)
    run.values[:, 1:] = signal.lfilter(b, a, run.values[:, 1:], axis=0)
    few = Effects(lambda: table_of(STATED, 1.0, 450.0, "sensor_highpass", "ground_spring"))
    found = diagnosed(run, few, STATED)
    (cause,) = found.causes
    assert (cause.physics, cause.site) == ("sensor_highpass", "every sensor")
    assert cause.parameters["corner"].value == pytest.approx(1.0, rel=0.05)
    assert found.rig is not None
    assert [s.highpass_hz for s in found.rig.sensor] == [cause.parameters["corner"].value] * 2


def test_what_all_sensors_have_is_one_s_where_that_alone_was_recorded() -> None:
    run = struck(9)
    few = run.channels[:2], run.values[:, :2], run.quality[:, :2]
    one = replace(run, channels=few[0], values=few[1], quality=few[2])
    both, alone = (
        {e.site for e in case_of(estimate([r], gaps="auto"), STATED, None, None, [r]).search.table
         if e.physics == "sensor_highpass"}
        for r in (run, one)
    )  # fmt: skip
    assert "every sensor" in both
    assert "every sensor" not in alone


def test_beside_a_force_no_high_pass_of_every_sensor_is_tried() -> None:
    """It stands before the input, and would change what drives the force."""
    every = next(e for e in table_of(STATED, 1.0, 450.0) if e.site == "every sensor")
    place = Place("joint", ("columns_1",), slides=True)
    force = effect(HARDENING, place, "columns_1", "", (Unknown("k3", "N/m^3", 1.0, 9.0, (3.0,)),))
    with pytest.raises(InputError, match="every sensor"):
        ForceModel(STATED, (every, force))


def test_a_force_that_a_cell_measured_has_no_valve_before_it() -> None:
    model = Model(STATED)
    paths = TransferPaths(Whole.of([struck(8)], STATED), model, np.zeros(model.n))
    physics = {e.physics for e in forces(STATED, paths)}
    assert "cubic_stiffness" in physics
    assert not {"valve_deadband", "output_saturation"} & physics


def test_a_lower_level_between_two_of_a_higher_is_no_rest() -> None:
    step = 0.3e-3
    v = random_command(20_000, 0.1, 4)
    v[9000:10_500] *= 10.0
    own, meter = calibrated(v, step)
    assert np.isnan(meter.folds)
    assert np.std((own - v)[:8900]) < 0.05 * np.std(v[:8900])
