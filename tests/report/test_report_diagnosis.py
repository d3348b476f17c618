"""A diagnosis on the page: in words first, the suspect part marked, its law, before and after."""

import base64
import hashlib
import json
import re
from dataclasses import replace
from xml.etree import ElementTree

import numpy as np
import pytest
from identify_kit import noiseless, samii
from report_kit import Page, recorded

from samii_rig.diagnose.data.wiring import outputs_of
from samii_rig.diagnose.diagnose import diagnose
from samii_rig.diagnose.physics.channels import NOT_PHYSICS
from samii_rig.diagnose.physics.grid import grid
from samii_rig.diagnose.physics.insert import DISPLACEMENT
from samii_rig.diagnose.physics.model import Model
from samii_rig.diagnose.physics.vocabulary import hypotheses
from samii_rig.diagnose.result import Band, Cause, Diagnosis, Gap, Trace, Value
from samii_rig.errors import InputError
from samii_rig.identify.bootstrap import redraw
from samii_rig.report.diagnosis import words as words
from samii_rig.report.diagnosis.laws import JUMPS, jump_curve, seen
from samii_rig.report.diagnosis.models import strengths
from samii_rig.report.diagnosis.page import write_diagnosis
from samii_rig.report.diagnosis.plots import distance
from samii_rig.report.drawing import Suspect, draw
from samii_rig.report.page import Subject, write_report

F = np.geomspace(0.5, 40.0, 120)
EVERY = (0.0, np.inf)
TABLE = hypotheses(samii(), 0.5, 40.0)
SPRING, MASS = (8e3, 0.1), (20.0,)  # N m/rad and loss in mid band; kg


def effect(physics, site, variant=""):
    return next(e for e in TABLE if e.name == (physics, site) and variant in e.variant)


def at_port(physics, port, more=""):
    """The effect whose element stands at a port."""
    return next(
        e for e in TABLE if e.physics == physics and re.search(rf"_{port}{more}$", e.variant)
    )


def cause_of(one, unknowns, probability=0.99, equivalents=()):
    """What a diagnosis would say of an effect with these unknowns."""
    values = one.report(np.asarray(unknowns))
    found = {
        u.symbol: Value(float(v), u.unit, 0.95 * v, 1.05 * v)
        for u, v in zip(one.unknowns, values, strict=True)
    }
    return Cause(one.physics, one.site, probability, equivalents, found)


def with_effect(one, unknowns):
    """The rig with an effect at these unknowns, and its response."""
    model = Model(samii(), [one])
    x = np.concatenate([np.zeros(model.n_nominal), np.log(unknowns)])
    values = model.values(x)
    elements = tuple(
        e.model_copy(
            update={
                s: getattr(e, s).model_copy(update={"value": v})
                for (name, s), v in values.items()
                if name == e.name
            }
        )
        for e in model.built.element
    )
    n = len(samii().sensor)
    at = grid(samii(), F, np.arange(n), np.zeros(n, dtype=np.int64))
    H = model.response(x, at)[:, :, None]
    return model.built.model_copy(update={"element": elements}), replace(noiseless(samii(), F), H=H)


@pytest.fixture(scope="module")
def named():
    """A joint that gives more than the rig file says, as it was diagnosed."""
    spring = effect("torsional_compliance", "joint_1")
    exact = with_effect(spring, SPRING)[1]
    response = redraw(exact, exact.H, np.random.default_rng(1), 10)
    table = [e for e in TABLE if e.physics in ("torsional_compliance", "sensor_gain")]
    return diagnose([response], samii(), effects=table), response


def made(verdict="ambiguous", **changes):
    """A diagnosis put together by hand."""
    f = np.geomspace(1, 30, 20)
    mass = cause_of(at_port("added_mass", 8, "w"), MASS, 0.62, (("added_inertia", "link_1"),))
    other = cause_of(effect("torsional_compliance", "joint_1"), SPRING, 0.3)
    named = verdict in ("ambiguous", "named")
    found = Diagnosis(
        verdict=verdict,
        chi2_per_dof=40.0,
        threshold=1.1,
        bands=(Band("theta_2", 0.5, 1.0, 1.0), Band("a_0", 0.5, 1.0, 30.0)),
        sites=((mass.site, 0.62), ("joint_1", 0.3), ("theta_2", 0.05)) if named else (),
        causes=(mass,) if named else (),
        alternatives=(((other,), 0.3), ((mass, other), 0.06)) if named else (),
        nominal=(40.0, 41.0),
        with_causes=(1.05, 1.1),
        noise_floor=1.0,
        gap=Gap(0.998, 0.99, 1.004),
        not_physics=(),
        why="added mass at link_2 and torsional compliance at joint_1 are not distinguished",
        experiment="brace the rig behind link_1",
        outside=0.02,
        rig=with_effect(at_port("added_mass", 8, "w"), MASS)[0] if named else None,
        traces=(Trace("joint_1", "theta", "M", f, 1e-4 + 0j * f, 1e-5 + 0 * f, 3.1),),
    )
    return replace(found, **changes)


def page_of(tmp_path, found, response, **options):
    path = write_diagnosis(tmp_path / "d.html", found, [response], samii(), **options)
    assert list(tmp_path.iterdir()) == [path]
    text = path.read_text(encoding="utf-8")
    return text, Page(text)


def test_what_is_missing_at_the_joint_is_a_spring_within_its_bands(named):
    found, response = named
    assert found.verdict == "named"
    (s,) = strengths(found.causes[0], found.rig, [response], EVERY)
    known = s.sd < 0.5 * np.abs(s.x)
    assert known.mean() > 0.8
    off = np.abs(s.x - s.law)[known] / s.sd[known]
    assert np.sqrt(np.mean(off**2)) < 1.5
    assert np.median(np.abs(s.x[known])) == pytest.approx(1 / SPRING[0], rel=0.1)


# What is there, and the physics under whose name it is looked at: x(w) does not depend on that.
LOOKS = {
    "a mass as a spring to ground": (
        ("added_mass", "w"), MASS, ("ground_spring", "w"), (3e4, 0.1), lambda s: 20.0 * s**2),
    "a drive that gives way as a spring": (
        ("velocity_feedback", ""), (900.0,), ("torsional_compliance", ""), (1e4, 0.1),
        lambda s: 1 / (900.0 * s)),
    "oil as a spring": (
        ("hydraulic_compressibility", ""), (1e-14, 1e-6), ("torsional_compliance", ""), (1e4, 0.1),
        lambda s: 1e-14 / DISPLACEMENT**2 + 0 * s),
}  # fmt: skip


@pytest.mark.parametrize("case", LOOKS)
def test_what_is_found_at_a_place_does_not_depend_on_the_name_given_to_it(case):
    (there, a), values, (looked, b), guess, law = LOOKS[case]
    port = 5
    response = with_effect(at_port(there, port, a), values)[1]
    one = at_port(looked, port, b)
    (s,) = strengths(cause_of(one, guess), with_effect(one, guess)[0], [response], EVERY)
    expected = law(2j * np.pi * s.frequency)
    # A bin holds several lines, over which x of a wrong name changes a little.
    assert np.allclose(s.x, expected, rtol=0.08)
    right = cause_of(at_port(there, port, a), values)
    assert np.allclose(jump_curve(right, F), law(2j * np.pi * F))


def test_a_hanging_mass_is_a_mass_below_its_resonance_and_a_spring_above():
    cause = Cause(
        "attached_oscillator",
        "link_2",
        0.9,
        (),
        {
            "m": Value(2.0, "kg", 1, 3),
            "k": Value(800.0, "N/m", 1, 3),
            "c": Value(1.0, "N s/m", 1, 3),
        },
    )
    low, high = 0.01, 1000.0
    assert jump_curve(cause, np.array([low]))[0] == pytest.approx(
        2.0 * (2j * np.pi * low) ** 2, rel=1e-3
    )
    assert abs(jump_curve(cause, np.array([high]))[0]) == pytest.approx(
        abs(800.0 + 2j * np.pi * high), rel=1e-2
    )
    assert jump_curve(replace(cause, parameters={}), np.array([low])) is None


def test_every_point_of_the_table_has_its_law():
    points = {e.physics for e in TABLE if not e.factor and e.variant.startswith("added_")}
    assert points <= set(JUMPS)
    assert {e.physics for e in TABLE} - set(NOT_PHYSICS) <= set(words.PLAIN)


def test_a_delay_is_seen_as_a_factor_of_its_sensor():
    late = effect("sensor_delay", "a_1")
    tau = 2e-3
    exact = with_effect(late, (tau,))[1]
    rig = late.write(samii(), np.array([tau]))
    (s,) = strengths(cause_of(late, (tau,)), rig, [exact], EVERY)
    assert np.allclose(s.x, np.exp(-2j * np.pi * s.frequency * tau), rtol=0.02)


def test_every_level_has_its_own_points_so_that_a_change_with_amplitude_is_seen(tmp_path):
    port = at_port("added_mass", 8, "w")
    rig, light = with_effect(port, MASS)
    heavy = replace(with_effect(port, (1.5 * MASS[0],))[1], level=2.0)
    (a, b) = strengths(cause_of(port, MASS), rig, [light, heavy], EVERY)
    assert np.allclose(b.x / a.x, 1.5, rtol=0.02)
    assert (a.strength[0], b.strength[0]) == pytest.approx((1.0, 1.5), rel=0.01)
    path = write_diagnosis(tmp_path / "d.html", made(), [heavy, light], samii())
    figure = json.loads(Page(path.read_text(encoding="utf-8")).scripts["data-place-0"])
    assert {t.get("name") for t in figure["data"]} >= {"1 V", "2 V", "law of the named cause"}


def test_a_shear_spring_of_positive_stiffness_is_shown_positive():
    trace = made().traces[0]
    assert np.all(seen(trace).real > 0)
    assert np.all(seen(replace(trace, jump="w", by="V")).real < 0)


def test_the_verdict_stands_first_and_the_cause_with_its_interval(named, tmp_path):
    found, response = named
    _, parsed = page_of(tmp_path, found, response, recordings=[recorded()], title="what is it")
    said = parsed.text
    assert "Left out of the model: torsional compliance at joint_1" in said
    # Green is for nothing missing alone: what is left out is found, and the model is not well.
    assert words.banner(found).mark == "found"
    (k,) = [v for s, v, _ in words.named(found.causes[0]).parameters if s == "k"]
    assert k in said
    assert "kN m/rad" in k
    order = ["Left out of", "Chain of SAMII", "what is missing, each", "Measured with 90"]
    assert [said.index(x) for x in order] == sorted(said.index(x) for x in order)
    figures = {k: json.loads(v) for k, v in parsed.scripts.items() if k.startswith("data-")}
    assert {k.split("-")[1] for k in figures} == {"place", "fit"}
    names = {t.get("name") for t in figures["data-fit"]["sets"][0]["data"]}
    assert {"refitted nominal model", "with the causes"} <= names


def test_after_is_at_the_noise_and_before_is_not(named, tmp_path):
    found, response = named
    _, parsed = page_of(tmp_path, found, response)
    (far,) = re.findall(r"theta_2/v_2 ([\d.]+) \u2192 ([\d.]+) times the noise", parsed.text)
    assert float(far[0]) > 5
    assert float(far[1]) == pytest.approx(1.0, abs=0.25)
    assert np.all(distance([response], curve_of(response), ("theta_2", "v_2"))[1] < 0.2)


def test_a_level_that_lacks_a_sensor_has_its_place_on_the_page(named, tmp_path):
    found, response = named
    less = outputs_of(replace(response, level=2 * response.level), [1])
    path = write_diagnosis(tmp_path / "d.html", found, [response, less], samii())
    sets = json.loads(Page(path.read_text(encoding="utf-8")).scripts["data-fit"])["sets"]
    drawn = [{t["name"] for t in s["data"] if "name" in t} for s in sets]
    assert len(drawn[1]) == len(drawn[0]) + 1


def curve_of(response):
    """The measurement itself as a model."""
    from samii_rig.report.compare import ModelCurve

    names = tuple(c.name for c in response.outputs), tuple(c.name for c in response.inputs)
    return ModelCurve("itself", response.frequency, response.H, *names)


def test_nothing_is_asked_of_anyone_and_only_its_own_scripts_run(named, tmp_path):
    text, parsed = page_of(tmp_path, *named)
    assert all(address.startswith("#") for address in parsed.addresses)
    assert {address[1:] for address in parsed.addresses} <= set(parsed.ids)
    assert len(parsed.ids) == len(set(parsed.ids))
    assert "default-src 'none'" in parsed.policy
    scripts = re.findall(r"<script>(.*?)</script>", text, flags=re.DOTALL)
    hashes = {base64.b64encode(hashlib.sha256(s.encode()).digest()).decode() for s in scripts}
    assert hashes == set(re.findall(r"'sha256-([^']+)'", parsed.policy))


def test_rivals_stand_with_the_reason_why_they_lost(tmp_path):
    found = made()
    rows = words.rivals(found)
    assert [r["probability"] for r in rows] == ["62 %", "30 %", "6 %", "2 %"]
    assert rows[0]["why"] == "chosen"
    assert "2.1 times less probable" in rows[1]["why"]
    assert "a part of any law at joint_1 leaves 3.10" in rows[1]["why"]
    assert "1 more part" in rows[2]["why"]
    assert "any law" not in rows[2]["why"]
    _, parsed = page_of(tmp_path, found, noiseless(samii(), F))
    for part in ("Most likely left out", "brace the rig behind link_1", "or here", "30 %"):
        assert part in parsed.text


def test_what_has_no_name_is_shown_without_a_law(tmp_path):
    found = made("unknown", outside=1.0, sites=(("a_1", 0.1),))
    _, parsed = page_of(tmp_path, found, noiseless(samii(), F))
    assert "Something is missing that has no name here" in parsed.text
    assert "do not tell where" in parsed.text
    assert "if it is here" in parsed.text
    assert words.banner(found).causes == ()
    held = made("unknown", outside=1.0, sites=(("a_1", 0.9),))
    assert "most likely at a_1 (90 %)" in words.banner(held).text


def test_nothing_missing_and_what_is_not_physics_are_said_apart():
    fine = made("no_mismatch", chi2_per_dof=1.0, nominal=(1.0, 1.0), with_causes=(1.0, 1.0))
    assert words.banner(fine).mark == "good"
    assert "Nothing is missing" in words.banner(fine).title
    swapped = made("no_mismatch", not_physics=("the channels a_0 and a_1 are swapped",))
    said = words.banner(swapped)
    assert said.mark == "warning"
    assert said.text.startswith("The channels a_0 and a_1 are swapped. With that, the model fits")
    assert said.facts[0][1] == "41 \u2192 1.10"
    worse = replace(swapped, with_causes=(5.0, 5.0))
    assert "With that" not in words.banner(worse).text


def test_a_body_has_no_response_of_one_part(tmp_path):
    soft = cause_of(effect("beam_property", "beam", "EI"), (0.8,))
    found = made("named", causes=(soft,), rig=samii())
    _, parsed = page_of(tmp_path, found, noiseless(samii(), F))
    assert "beam property at beam: it is no linear part at one place" in parsed.text


def test_it_is_a_section_of_the_report(tmp_path):
    response = noiseless(samii(), F)
    path = write_report(tmp_path / "r.html", Subject([], [response], samii()), diagnosis=made())
    said = Page(path.read_text(encoding="utf-8")).text
    order = [
        "Diagnosis: ambiguous",
        "The response is measured",
        "the bands hold the true value",
        "Marked: how",
    ]
    assert [said.index(x) for x in order] == sorted(said.index(x) for x in order)
    with pytest.raises(InputError, match="its rig and responses"):
        write_report(tmp_path / "s.html", Subject([], [response]), diagnosis=made())


def test_what_cannot_be_shown(tmp_path):
    with pytest.raises(InputError, match="suffix"):
        write_diagnosis(tmp_path / "d.txt", made(), [noiseless(samii(), F)], samii())
    with pytest.raises(InputError, match="those that were diagnosed"):
        write_diagnosis(tmp_path / "d.html", made(), [], samii())
    assert not list(tmp_path.iterdir())


def test_text_from_files_cannot_become_markup(tmp_path):
    evil = "</script><script>alert(1)</script><img src=http://x/y>"
    found = made(not_physics=(evil,), why=evil, experiment=evil)
    _, parsed = page_of(tmp_path, found, noiseless(samii(), F), title=evil)
    assert all(address.startswith("#") for address in parsed.addresses)
    assert "alert(1)" in parsed.text


def test_the_drawing_marks_what_is_suspect_in_words_too():
    marks = {"joint_1": Suspect("98 %", 0.98, True), "a_1": Suspect("2 %", 0.02, False)}
    drawing = ElementTree.fromstring(draw(samii(), marks))
    texts = [e.text for e in drawing.iter("text")]
    assert "98 %" in texts
    assert "a_1 [m/s\u00b2] 2 %" in texts
    assert "Suspect: joint_1 98 %, a_1 2 %" in drawing.find("title").text
    halos = [e for e in drawing.iter("rect") if "halo" in e.get("class", "")]
    assert [e.get("class") for e in halos] == ["halo chosen"]


@pytest.mark.parametrize(
    ("value", "said"),
    [
        (Value(20100.0, "N m/rad", 19000.0, 21200.0),
         ("20.1\u00a0kN m/rad", "19 to 21.2\u00a0kN m/rad")),
        (Value(0.0021, "s", 0.0020, 0.0022), ("2.1\u00a0ms", "2 to 2.2\u00a0ms")),
        (Value(0.56, "1", 0.5, 0.6), ("0.56", "0.5 to 0.6")),
        (Value(1e-14, "m^5/N", 9e-15, 1.1e-14),
         ("1.00\u00b710\u207b\u00b9\u2074\u00a0m\u2075/N",
          "9.00\u00b710\u207b\u00b9\u2075 to 1.10\u00b710\u207b\u00b9\u2074\u00a0m\u2075/N")),
    ],
)  # fmt: skip
def test_values_have_one_prefix_and_their_unit(value, said):
    assert words.quantity(value) == said


def test_no_probability_is_said_to_be_certain():
    assert words.percent(1.0) == "over 99.9 %"
    assert words.percent(0.0) == "under 0.1 %"
    assert words.percent(0.995) == "99.5 %"
    assert words.percent(0.5) == "50 %"
