"""A sensor that sits elsewhere than the rig file says."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from table_kit import table_of

from samii_rig.diagnose.diagnose import diagnose
from samii_rig.diagnose.fit.refit import Fitted
from samii_rig.diagnose.fit.rigfile import explained
from samii_rig.diagnose.physics import elsewhere
from samii_rig.diagnose.physics.model import Model
from samii_rig.model.tmm import Chain
from samii_rig.record.reader import read_recording
from samii_rig.rig.load import load_rig, parse
from samii_rig.rig.schema import Rig
from samii_rig.signal.estimate import estimate
from sim.assumed_modes import styles, trial

BAND = (2.0, 200.0)  # Hz, with three modes of the strip
F = np.geomspace(*BAND, 40)


def strip(mid: float, laser: bool = False) -> str:
    """The strip on a shaker with an accelerometer at `mid` (m) along it, or a laser at its end."""
    _, text = load_rig("beam_on_shaker")
    more = f"""
[[sensor]]
name = "a_mid"
kind = "acceleration"
on = "strip"
position = {mid}
unit = "m/s^2"
noise_rms = 0.02
low = -500.0
high = 500.0
antialias = {{ order = 2, corner_hz = 400.0 }}
"""
    if laser:
        more += '\n[[sensor]]\nname = "x"\nkind = "displacement"\nafter = "strip"\nunit = "m"\n'
    return text.replace("[[actuator]]", f"{more}\n[[actuator]]")


def rig_of(text: str) -> Rig:
    return parse(Rig, text, "strip")


@pytest.mark.parametrize("there", [0.04, 0.15, 0.27])
def test_a_sensor_that_is_moved_shows_what_one_there_shows(there: float) -> None:
    rig = rig_of(strip(0.12))
    (effect,) = (e for e in elsewhere.effects(rig) if e.site == "a_mid")
    model = Model(rig, (effect,))
    x = np.append(np.zeros(model.n_nominal), there / 0.3)
    assert effect.report(np.exp(x[model.n_nominal :]))[0] == pytest.approx(there)
    got = model.chain.with_values(model.values(x)).response(F)
    want = Chain(rig_of(strip(there))).response(F)
    np.testing.assert_allclose(got, want, rtol=1e-6, atol=1e-9 * np.abs(want).max())


def test_the_new_rig_file_has_the_beam_in_one_piece_and_the_sensor_there() -> None:
    rig = rig_of(strip(0.12))
    stretched = rig_of(strip(0.12).replace('on = "tip_mass"', 'on = "strip"\nposition = 0.3'))
    for stated in (rig, stretched):
        (effect,) = (e for e in elsewhere.effects(stated) if e.site == "a_mid")
        model = Model(stated, (effect,))
        x = np.append(np.zeros(model.n_nominal), 0.19 / 0.3)
        new = explained(Fitted(model, x, 0.0, 0.0, np.zeros((0, model.n)), np.eye(model.n)))
        assert [e.name for e in new.element] == [e.name for e in stated.element]
        moved = next(s for s in new.sensor if s.name == "a_mid")
        assert (moved.on, moved.position) == ("strip", pytest.approx(0.19))
        got = Chain(new).response(F)
        want = model.chain.with_values(model.values(x)).response(F)
        np.testing.assert_allclose(got, want, rtol=1e-6, atol=1e-9 * np.abs(want).max())


def test_it_may_be_along_each_beam_that_ends_where_it_is() -> None:
    rig = rig_of(strip(0.12, laser=True))
    where = {(e.site, e.variant) for e in elsewhere.effects(rig)}
    assert {site for site, _ in where} == {"a_table", "a_mid", "a_tip", "x"}
    # The strip on both sides of the accelerometer that is on it.
    assert len([site for site, _ in where if site == "a_tip"]) == 2
    assert len([site for site, _ in where if site == "a_mid"]) == 1


def test_where_it_is_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """25 mm from where the file says, of a strip of 300."""
    monkeypatch.setattr(styles, "BUDGET", 20_000)  # samples
    folder = trial.make("nothing", 3, tmp_path, strip(0.125), ("multisine_once", "clean"))
    runs = [read_recording(path) for path in sorted(folder.glob("*.mcap"))]
    stated = rig_of(strip(0.15))
    few = table_of(stated, *BAND, "sensor_position", "sensor_gain", "added_mass", "sensor_lag")
    found = diagnose(estimate(runs), stated, runs=runs, effects=few)
    (cause,) = found.causes
    assert found.verdict == "named"
    assert (cause.physics, cause.site) == ("sensor_position", "a_mid")
    place = cause.parameters["position"]
    assert place.low < 0.125 < place.high
    assert place.high - place.low < 0.005
