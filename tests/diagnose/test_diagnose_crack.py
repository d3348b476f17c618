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
from samii_rig.diagnose.physics.along import cut, stretches
from samii_rig.diagnose.physics.effect import Effect
from samii_rig.diagnose.physics.model import Model
from samii_rig.errors import InputError
from samii_rig.model.tmm import Chain
from samii_rig.record.reader import read_recording
from samii_rig.rig.load import load_rig, parse
from samii_rig.rig.schema import BEAMS, Rig, Rod
from samii_rig.signal.estimate import estimate
from samii_rig.types import Complex
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


def along_a_body(rig: Rig) -> list[Effect]:
    every = table_of(rig, *BAND, "torsional_compliance", "translational_compliance")
    return [e for e in every if e.unknowns[-1].symbol == "position"]


def with_crack(rig: Rig, k: float, c: float, share: float) -> tuple[Effect, Fitted]:
    """The one crack that a rig may have, and a fit at these values and this share of its body."""
    (effect,) = along_a_body(rig)
    model = Model(rig, (effect,))
    u = math.exp(share)
    loss = c / effect.report(np.array([k, 1.0, u]))[1]
    x = np.append(np.zeros(model.n_nominal), np.log([k, loss, u]))
    return effect, Fitted(model, x, 0.0, 0.0, np.zeros((0, model.n)), np.eye(model.n))


def answer(fitted: Fitted) -> Complex:
    return fitted.model.chain.with_values(fitted.model.values(fitted.x)).response(F)


def test_a_crack_is_a_spring_between_two_pieces_in_the_model_and_in_the_new_rig_file() -> None:
    _, text = load_rig("beam_on_shaker")
    rig = rig_of(text)
    effect, fitted = with_crack(rig, K, C, AT / 0.3)
    unknowns = np.exp(fitted.x[fitted.model.n_nominal :])
    assert effect.report(unknowns) == pytest.approx([K, C, AT])
    want = Chain(rig_of(cracked(text))).response(F)
    np.testing.assert_allclose(answer(fitted), want, rtol=1e-6, atol=1e-9 * np.abs(want).max())
    new = explained(fitted)
    np.testing.assert_allclose(Chain(new).response(F), want, rtol=1e-6, atol=1e-9)


ROD = """name = "spring"
kind = "rod"
EA = { value = 600.0, unit = "N", source = "made" }
mu = { value = 1.0, unit = "kg/m", source = "made" }
L = { value = 100.0, unit = "mm", source = "made" }

"""
CRACK_IN_ROD = """[[element]]
name = "crack"
kind = "spring"
k = { value = 2000.0, unit = "N/m", source = "made" }
c = { value = 0.3, unit = "N s/m", source = "made" }

[[element]]
"""


def on_a_rod() -> str:
    """The shipped mass on a rod in the place of its spring."""
    _, text = load_rig("one_mass")
    a, b = text.index('name = "spring"'), text.index('[[element]]\nname = "mass"')
    return text[:a] + ROD + text[b:]


def test_a_crack_stands_along_beams_and_rods_and_on_no_rigid_link() -> None:
    for text, physics in (
        (load_rig("beam_on_shaker")[1], "torsional_compliance"),
        (load_rig("samii")[1], "torsional_compliance"),
        (on_a_rod(), "translational_compliance"),
    ):
        rig = rig_of(text)
        bodies = {e.name: e for e in rig.element}
        some = along_a_body(rig)
        assert {e.physics for e in some} == {physics}
        assert all(isinstance(bodies[e.site], (*BEAMS, Rod)) for e in some)


def test_a_crack_in_a_rod_is_a_spring_between_two_pieces() -> None:
    text = on_a_rod()
    _, fitted = with_crack(rig_of(text), 2000.0, 0.3, 0.3)  # 30 mm of 100
    front = ROD.replace('"spring"', '"front"').replace("100.0", "30.0")
    pieces = front + CRACK_IN_ROD + ROD.replace("100.0", "70.0")
    want = Chain(rig_of(text.replace(ROD, pieces))).response(F)
    np.testing.assert_allclose(answer(fitted), want, rtol=1e-6, atol=1e-9 * np.abs(want).max())


ACROSS = """
[[sensor]]
name = "turn"
kind = "relative_angle"
across = ["strip"]
unit = "rad"
"""


def test_sensors_see_a_beam_that_was_cut_as_a_whole() -> None:
    """An angle across it, an accelerometer in its middle and one at its end."""
    _, text = load_rig("beam_on_shaker")
    more = text.replace("[[actuator]]", f"{ACROSS}\n[[actuator]]")
    like = text[text.index('[[sensor]]\nname = "a_tip"') : text.index("[[actuator]]")]
    for at in (0.15, 0.3):
        own = like.replace('"a_tip"', '"a_on"')
        own = own.replace('on = "tip_mass"', f'on = "strip"\nposition = {at}')
        rig = rig_of(more.replace("[[actuator]]", f"{own}[[actuator]]", 1))
        want = Chain(rig).response(F)
        cracks = along_a_body(rig)
        assert len(cracks) == (2 if at < 0.3 else 1)
        for effect in cracks:
            model = Model(rig, (effect,))
            stiff = np.log([effect.unknowns[0].high, 1e-4, math.exp(0.4)])
            x = np.append(np.zeros(model.n_nominal), stiff)
            got = model.chain.with_values(model.values(x)).response(F)
            np.testing.assert_allclose(got, want, rtol=1e-5, atol=1e-6 * np.abs(want).max())


def test_a_sensor_that_is_put_where_a_beam_may_be_cut_is_refused() -> None:
    _, text = load_rig("beam_on_shaker")
    rig = rig_of(text)
    (stretch,) = stretches(rig, rig.element[1])
    like = next(s for s in rig.sensor if s.name == "a_tip")
    there = like.model_copy(update={"name": "a_on", "on": "strip", "position": 0.15})
    with pytest.raises(InputError, match="a_on"):
        cut(rig.model_copy(update={"sensor": (*rig.sensor, there)}), stretch, rig.element[2])


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
