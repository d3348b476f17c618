"""A crack in the middle of a beam, in both plants: against the transfer matrices of two beams with
a spring between them, where it is drawn, and the truths that tell its position."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from concealed_kit import FREQUENCY, SAMII, SAMII_TOML, continuous, modelled
from scipy.linalg import eigh

from samii_rig.model.modes import natural_frequencies
from samii_rig.prove.trial import Truth
from samii_rig.rig.load import load_rig
from samii_rig.rig.schema import Acceleration, Beam, Parameter, Rig, TorsionalSpring
from samii_rig.types import Complex
from sim.assumed_modes import effects, trial
from sim.assumed_modes.parts import Attachment, Setup, setup_of
from sim.assumed_modes.plant import UnphysicalError, plant
from sim.assumed_modes.rigfile import text
from sim.assumed_modes.ritz import Mechanism
from sim.concealed import linear
from sim.concealed.assemble import assemble
from sim.concealed.draw import draw
from sim.concealed.effects import ROWS
from sim.concealed.parts import Description, described
from sim.concealed.runs import Design
from sim.concealed.scales import Dose
from sim.concealed.size import changed
from sim.concealed.trial import make

QUICK = Design(levels=(0.5,), burst=10.0, ring_down=3.0, bursts=2, period=2.0, settle=1, periods=1,
               steps=1)  # fmt: skip
CLOSE = 1e-4  # relative, at every line of every sensor
(NUMBER,) = (i for i, row in enumerate(ROWS) if row.along)


def beam_of(rig: Rig) -> Beam:
    (beam,) = (e for e in rig.element if isinstance(e, Beam))
    return beam


def gauged(rig: Rig, *shares: float) -> Rig:
    """The rig with accelerometers at these shares of its beam's length besides."""
    beam = beam_of(rig)
    one = next(s for s in rig.sensor if isinstance(s, Acceleration))
    more = [
        one.model_copy(update={"name": f"b_{i}", "on": beam.name, "position": share * beam.L.value})
        for i, share in enumerate(shares)
    ]
    return rig.model_copy(update={"sensor": (*rig.sensor, *more)})


def exact(value: float, unit: str) -> Parameter:
    return Parameter(value=value, unit=unit, source="test")


def cut(rig: Rig, x: float, k: float, c: float) -> Rig:
    """The rig with two beams for one and a spring between them, `x` m behind its upstream end."""
    beam = beam_of(rig)
    first = beam.model_copy(update={"name": "upstream", "L": exact(x, "m")})
    second = beam.model_copy(update={"L": exact(beam.L.value - x, "m")})
    spring = TorsionalSpring(
        kind="torsional_spring", name="crack", k=exact(k, "N m/rad"), c=exact(c, "N m s/rad")
    )

    def moved(s: Acceleration) -> Acceleration:
        if s.position > x:
            return s.model_copy(update={"position": s.position - x})
        return s.model_copy(update={"on": first.name})

    own = [isinstance(s, Acceleration) and s.on == beam.name for s in rig.sensor]
    sensors = [moved(s) if on else s for s, on in zip(rig.sensor, own, strict=True)]
    at = rig.element.index(beam)
    parts = (*rig.element[:at], first, spring, second, *rig.element[at + 1 :])
    return rig.model_copy(update={"element": parts, "sensor": tuple(sensors)})


def concealed(rig: Rig, x: float, k: float, c: float) -> Complex:
    """Continuous responses of the first plant, cracked."""
    cracked = described(rig)
    dose = Dose(1.0, np.random.default_rng(0), {"k": k, "c": c}, position=x)
    effect = linear.crack(cracked, beam_of(rig).name, dose)
    assert (effect.parameters, effect.position) == ({"k": k, "c": c}, x)
    return continuous(cracked, FREQUENCY)


def setup_with(rig: Rig, x: float, k: float, c: float) -> Setup:
    crack = Attachment("crack", beam_of(rig).name, x, {"k": k, "c": c})
    return setup_of(rig, {}).attached(crack)


def assumed_modes(rig: Rig, x: float, k: float, c: float) -> Complex:
    """The same of the second plant."""
    made = plant(setup_with(rig, x, k, c))
    eye = np.eye(len(made.A))
    s = 2j * np.pi * FREQUENCY
    B, D = made.B[:, 0], made.D[:, 0]
    return np.array([made.C @ np.linalg.solve(z * eye - made.A, B) + D for z in s])


Answers = Callable[[Rig, float, float, float], Complex]
SOFT = pytest.mark.parametrize("softness", [0.03, 1.0])  # that of the whole beam is 1
SHARES = pytest.mark.parametrize("share", [0.2, 0.5, 0.8])


@SOFT
@SHARES
@pytest.mark.parametrize(("of", "name", "gauges"), [
    # Of the beam of SFLR in finite elements an accelerometer would show the rounding of its poles.
    (concealed, "samii", (0.35, 0.7)), (concealed, "sflr", ()),
    (assumed_modes, "samii", (0.35, 0.7)), (assumed_modes, "sflr", (0.35, 0.7)),
    (assumed_modes, "beam_on_shaker", (0.35, 0.7)),
])  # fmt: skip
def test_a_cracked_beam_answers_as_two_with_a_spring_between_them(
    of: Answers, name: str, gauges: tuple[float, ...], share: float, softness: float
) -> None:
    rig = gauged(load_rig(name)[0], *gauges)
    beam = beam_of(rig)
    k = beam.EI.value / beam.L.value / softness
    crack = (share * beam.L.value, k, 2e-3 * k)
    expected = modelled(text(cut(rig, *crack)), FREQUENCY)
    # An accelerometer's response has zeros: there it is held against what the sensor shows most.
    most = np.abs(expected).max(axis=0)
    assert np.max(np.abs(of(rig, *crack) - expected) / most) < CLOSE
    assert np.max(np.abs(modelled(text(rig), FREQUENCY) - expected) / most) > 0.02


@SOFT
@SHARES
@pytest.mark.parametrize("name", ["samii", "samii_braced", "sflr", "beam_on_shaker"])
def test_natural_frequencies_of_a_kinked_beam_are_those_of_the_transfer_matrices(
    name: str, share: float, softness: float
) -> None:
    rig, _ = load_rig(name)
    beam = beam_of(rig)
    k = beam.EI.value / beam.L.value / softness
    crack = (share * beam.L.value, k, 0.0)
    expected = natural_frequencies(cut(rig, *crack), 0.1, 200.0).hz
    mech = Mechanism(setup_with(rig, *crack))
    free = np.ix_(mech.free, mech.free)
    found = np.sqrt(np.abs(eigh(mech.K[free], mech.M[free], eigvals_only=True))) / (2 * np.pi)
    # Twelve shapes and a kink follow SFLR's sixth mode, at 190 Hz, less well than the others.
    np.testing.assert_allclose(found[: expected.size], expected, rtol=2e-4)


def test_a_cracked_beam_is_divided_as_another_one_like_it() -> None:
    cracked = described(SAMII)
    effect = linear.crack(cracked, "beam", Dose(1.0, np.random.default_rng(0)))
    longer = changed(cracked, "beam", "L", 1.0001)
    like, own = assemble(longer, assemble(cracked)), assemble(longer)
    for name in "MCK":
        np.testing.assert_array_equal(getattr(like, name), getattr(own, name))
    assert effect.position in [x for x, *_ in own.inside["beam"]]


def test_an_angle_across_a_beam_has_the_jump_once() -> None:
    """Of a crack within it, and of an end that gives."""
    turned = []
    for put in (linear.crack, linear.compliance):
        bent = described(SAMII)
        k = 1e-6 * bent.part("beam").values["EI"]  # beside it the beam is rigid
        bent.sensors[0].across = ("beam",)
        put(bent, "beam", Dose(1.0, np.random.default_rng(0), {"k": k, "c": 0.0}))
        turned.append(_angle_over_moment(bent) * k)
    assert turned == pytest.approx([1.0, 1.0], rel=1e-4)


def _angle_over_moment(bent: Description) -> float:
    """Static angle across the beam by a moment at its end, the chain cut off behind it."""
    s = assemble(bent)
    row = s.ends["beam"][1] - s.starts["beam"][1]
    free = np.delete(np.arange(s.M.shape[0]), list(s.driven.values()))
    moved = np.linalg.solve(s.K[np.ix_(free, free)], row[free])
    return float(row[free] @ moved)


def clear(positions: list[float | None]) -> None:
    """That positions along SAMII's beam are spread over its middle, clear of one at its half."""
    share = np.array(positions, float) / beam_of(SAMII).L.value
    assert share.min() == pytest.approx(0.15, abs=0.01)
    assert share.max() == pytest.approx(0.85, abs=0.01)
    assert np.abs(share - 0.5).min() > 0.02
    assert np.histogram(share, 5, (0.15, 0.85))[0].min() > 0.12 * share.size


def test_the_concealed_plant_draws_cracks_clear_of_ends_and_sensors() -> None:
    rig = gauged(SAMII, 0.5)
    doses = [Dose(1.0, np.random.default_rng(seed)) for seed in range(300)]
    clear([linear.crack(described(rig), "beam", dose).position for dose in doses])


def test_half_of_the_assumed_modes_compliances_are_cracks_clear_of_ends_and_sensors() -> None:
    setup, rng = setup_of(gauged(SAMII, 0.5), {}), np.random.default_rng(0)
    drafts = [effects.compliance(rng, setup) for _ in range(600)]
    cracks = [d for d in drafts if d.position is not None]
    assert len(cracks) / len(drafts) == pytest.approx(0.5, abs=0.06)
    assert {(d.physics, d.site, d.also) for d in cracks} == {("torsional_compliance", "beam", ())}
    clear([d.position for d in cracks])
    (crack,) = cracks[0].put(setup, 1e-6).attachments
    assert (crack.kind, crack.on, crack.x) == ("crack", "beam", cracks[0].position)
    assert crack.values["k"] == pytest.approx(1e6)


def test_a_crack_beyond_the_end_of_a_beam_that_a_refit_shortens_is_refused() -> None:
    setup = setup_with(SAMII, 3.7, 1e5, 100.0)
    with pytest.raises(UnphysicalError):
        plant(setup.with_value("beam", "L", 3.0))


def test_the_concealed_plant_s_truth_tells_where_the_crack_is(tmp_path: Path) -> None:
    folder = make("one", NUMBER, tmp_path, SAMII_TOML, QUICK)
    record = json.loads((tmp_path / "truth" / f"{folder.name}.json").read_text())
    (effect,) = record["effects"]
    assert 0.15 < effect["position"] / record["values"]["beam.L"] < 0.85
    assert record["size"] > 0.5
    (hidden,) = Truth.of(record).effects
    assert hidden.name == ("torsional_compliance", "beam")
    assert set(hidden.parameters) == {"k", "c"}
    again = draw("one", NUMBER, SAMII_TOML, QUICK)
    assert again.effects[0].position == effect["position"]
    # What is not along its site has no position.
    assert draw("one", 0, SAMII_TOML, QUICK).effects[0].position is None


def test_the_assumed_modes_truth_tells_where_the_crack_is(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(effects, "LINEAR", {"torsional_compliance": effects.compliance})
    monkeypatch.setattr(effects, "CRACKED", 1.0)
    monkeypatch.setattr(trial, "FORCES", {})
    rig, _ = load_rig("sflr")
    truth = trial.conceal("one", 1, rig, ("clean", "single"), seconds=20.0).truth([])
    (effect,) = truth["effects"]
    assert (effect["physics"], effect["site"]) == ("torsional_compliance", "beam")
    assert 0.15 < effect["position"] / beam_of(rig).L.value < 0.85
    assert set(effect["parameters"]) == {"k", "c"}
    assert effect["also"] == []
    assert effect["sigma"] >= 2.4
