"""A crack: a compliance in the middle of a beam or a rod."""

from __future__ import annotations

import math
import re
from pathlib import Path

import numpy as np
import pytest
from table_kit import table_of

from samii_rig.diagnose.diagnose import diagnose
from samii_rig.diagnose.fit.refit import Fitted
from samii_rig.diagnose.fit.rigfile import explained
from samii_rig.diagnose.physics.effect import Effect
from samii_rig.diagnose.physics.model import Model
from samii_rig.model.tmm import Chain
from samii_rig.record.reader import read_recording
from samii_rig.rig.load import load_rig, parse
from samii_rig.rig.schema import BEAMS, Rig, Rod
from samii_rig.signal.estimate import estimate
from sim.assumed_modes import styles, trial

BAND = (2.0, 200.0)  # Hz, with three modes of the strip
F = np.geomspace(*BAND, 40)
AT, K, C = 0.11, 40.0, 1e-3  # m, N m/rad, N m s/rad


def rig_of(text: str) -> Rig:
    return parse(Rig, text, "strip")


def cracked(text: str) -> str:
    """The same rig with a strip of two pieces and a spring between them."""
    at = text.index('[[element]]\nname = "strip"')
    whole = text[at : text.index("[[", at + 2)]
    own = re.sub(r"tolerance = [\d.]+, ", "", whole)  # both pieces are of one bar
    spring = f"""[[element]]
name = "crack"
kind = "torsional_spring"
k = {{ value = {K}, unit = "N m/rad", source = "made" }}
c = {{ value = {C}, unit = "N m s/rad", source = "made" }}

"""
    front = own.replace('"strip"', '"front"').replace("300.0", f"{1e3 * AT}")
    return text.replace(whole, front + spring + own.replace("300.0", f"{300 - 1e3 * AT}"))


def along_the_strip(rig: Rig) -> Effect:
    every = table_of(rig, *BAND, "torsional_compliance")
    (effect,) = (e for e in every if e.site == "strip" and e.unknowns[-1].symbol == "position")
    return effect


def test_a_crack_is_a_spring_between_two_pieces_in_the_model_and_in_the_new_rig_file() -> None:
    _, text = load_rig("beam_on_shaker")
    rig = rig_of(text)
    effect = along_the_strip(rig)
    model = Model(rig, (effect,))
    u = math.exp(AT / 0.3)
    loss = C / effect.report(np.array([K, 1.0, u]))[1]
    x = np.append(np.zeros(model.n_nominal), np.log([K, loss, u]))
    assert effect.report(np.exp(x[model.n_nominal :])) == pytest.approx([K, C, AT])
    want = Chain(rig_of(cracked(text))).response(F)
    got = model.chain.with_values(model.values(x)).response(F)
    np.testing.assert_allclose(got, want, rtol=1e-6, atol=1e-9 * np.abs(want).max())
    new = explained(Fitted(model, x, 0.0, 0.0, np.zeros((0, model.n)), np.eye(model.n)))
    np.testing.assert_allclose(Chain(new).response(F), want, rtol=1e-6, atol=1e-9)


ROD = """name = "spring"
kind = "rod"
EA = { value = 600.0, unit = "N", source = "made" }
mu = { value = 1.0, unit = "kg/m", source = "made" }
L = { value = 100.0, unit = "mm", source = "made" }

"""


def test_a_crack_stands_along_beams_and_rods_and_on_no_rigid_link() -> None:
    _, one_mass = load_rig("one_mass")
    spring = one_mass[
        one_mass.index('name = "spring"') : one_mass.index('[[element]]\nname = "mass"')
    ]
    for text, physics in (
        (load_rig("beam_on_shaker")[1], "torsional_compliance"),
        (load_rig("samii")[1], "torsional_compliance"),
        (one_mass.replace(spring, ROD), "translational_compliance"),
    ):
        rig = rig_of(text)
        bodies = {e.name: e for e in rig.element}
        every = table_of(rig, *BAND, "torsional_compliance", "translational_compliance")
        some = [e for e in every if e.unknowns[-1].symbol == "position"]
        assert {e.physics for e in some} == {physics}
        assert all(isinstance(bodies[e.site], (*BEAMS, Rod)) for e in some)


def test_a_crack_is_found_at_its_place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(styles, "BUDGET", 20_000)  # samples
    _, text = load_rig("beam_on_shaker")
    folder = trial.make("nothing", 3, tmp_path, cracked(text), ("multisine_once", "clean"))
    runs = [read_recording(path) for path in sorted(folder.glob("*.mcap"))]
    rig = rig_of(text)
    few = table_of(
        rig, *BAND, "torsional_compliance", "beam_property", "added_mass", "added_inertia"
    )
    found = diagnose(estimate(runs), rig, runs=runs, effects=few, band=BAND)
    (cause,) = found.causes
    assert found.verdict == "named"
    assert (cause.physics, cause.site) == ("torsional_compliance", "strip")
    for symbol, true in (("position", AT), ("k", K)):
        got = cause.parameters[symbol]
        assert got.low is not None
        assert got.high is not None
        assert got.low < true < got.high
        assert got.high - got.low < 0.25 * true
