"""The report says what the data say, in words first, and needs nothing from elsewhere."""

import base64
import hashlib
import io
import json
import math
import re
from dataclasses import replace
from types import SimpleNamespace
from xml.etree import ElementTree

import numba
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from report_kit import MODES, Page, measured, model, recorded
from rich.console import Console

from samii_rig.diagnose.data.wiring import outputs_of
from samii_rig.errors import InputError
from samii_rig.model import kernels
from samii_rig.progress import Counted
from samii_rig.report.canvas import halved, packed, restored
from samii_rig.report.compare import ModelCurve, compare
from samii_rig.report.decimate import thin
from samii_rig.report.drawing import draw
from samii_rig.report.facts import names
from samii_rig.report.figures import bode_figure, save_figure
from samii_rig.report.modes import modes_of_all, rows, sentences
from samii_rig.report.page import Subject, write_report
from samii_rig.report.summary import LiveProgress, dry_run_summary, progress_line, summary, working
from samii_rig.report.verdicts import verdicts
from samii_rig.rig.load import load_rig
from samii_rig.run.dryrun import DryRun
from samii_rig.run.expected import BandError
from samii_rig.run.margins import Margin
from samii_rig.types import Finding, StopRecord


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    folder = tmp_path_factory.mktemp("report")
    rig, _ = load_rig("samii")
    path = write_report(
        folder / "r.html",
        Subject([recorded(lost=3)], [measured(2.0, seed=1), measured(1.0)], rig, model(0.6)),
    )
    assert list(folder.iterdir()) == [path]
    text = path.read_text(encoding="utf-8")
    assert len(text.encode()) < 3_000_000
    return text, Page(text)


def test_nothing_is_asked_of_anyone(page):
    _, parsed = page
    assert parsed.addresses
    assert all(address.startswith("#") for address in parsed.addresses)
    assert {address[1:] for address in parsed.addresses} <= set(parsed.ids)
    assert len(parsed.ids) == len(set(parsed.ids))
    assert "default-src 'none'" in parsed.policy
    assert "http" not in parsed.policy


def test_the_policy_lets_exactly_the_pages_own_scripts_run(page):
    text, parsed = page
    scripts = re.findall(r"<script>(.*?)</script>", text, flags=re.DOTALL)
    hashes = {base64.b64encode(hashlib.sha256(s.encode()).digest()).decode() for s in scripts}
    assert hashes == set(re.findall(r"'sha256-([^']+)'", parsed.policy))
    assert not re.search(r"<[^>]+ on(load|click|error)=", text)


def test_the_verdicts_stand_first(page):
    _, parsed = page
    said = parsed.text
    assert "The model differs from the measurement" in said
    assert "gain 0.600" in said
    assert "2 of 2 responses differ" in said
    assert "3 of 6,003 samples missing" in said
    assert said.index("The model differs") < said.index("Gain, phase, coherence")


def test_every_figure_has_data(page):
    _, parsed = page
    figures = {k: json.loads(v) for k, v in parsed.scripts.items() if k.startswith("data-")}
    assert {k.split("-")[1] for k in figures} == {"bode", "time", "spectrum"}
    for name, figure in figures.items():
        for traces in [s["data"] for s in figure["sets"]] if "sets" in figure else [figure["data"]]:
            assert traces, name
            for trace in traces:
                x = restored(trace["x"])
                assert np.isfinite(x).sum() > 2 or trace["name"] == "samples missing", name


def test_one_panel_has_every_response_in_both_views(page):
    """Two outputs, by gain and by the model over them; each with its own axes."""
    text, parsed = page
    sets = json.loads(parsed.scripts["data-bode"])["sets"]
    assert [s["name"] for s in sets] == ["theta_2/v_2"] * 2 + ["a_0/v_2"] * 2
    assert all(s["data"] and s["layout"]["height"] > 300 for s in sets)
    assert text.count('<svg class="chain"') <= 1


def test_a_mismatch_of_a_recording_ends_with_the_command_that_diagnoses_it(page, tmp_path):
    _, parsed = page
    said = parsed.text.split("The figures need JavaScript")[0].rstrip()
    assert said.endswith("samii-rig diagnose run_1.mcap")
    path = write_report(tmp_path / "r.html", Subject([recorded()], [measured()], model=model()))
    assert "samii-rig diagnose" not in Page(path.read_text(encoding="utf-8")).text


@pytest.mark.parametrize(
    "values",
    [np.geomspace(1e-6, 10.0, 400), np.linspace(-3.0, 4.0, 400), np.array([np.nan, 1.0, np.nan])],
    ids=["decades", "even", "holes"],
)
def test_half_of_the_bytes_keep_what_can_be_seen(values):
    """A step of 16 bit is a hundredth of a pixel of a diagram of 655 px."""
    half = halved(packed(values))
    assert len(half["q"]) < 0.6 * len(packed(values)["bdata"])
    again = restored(half)
    assert np.array_equal(np.isnan(again), np.isnan(values))
    put = np.log if half["log"] else np.asarray
    span = np.ptp(put(values[np.isfinite(values)]))
    assert np.nanmax(np.abs(put(again) - put(values.astype("f4")))) <= 1e-5 * span + 1e-12


def test_text_from_files_cannot_become_markup(tmp_path):
    evil = "</script><script>alert(1)</script><img src=http://x/y>"
    recording = replace(recorded(600), metadata={"operator": evil}, source=evil)
    response = measured(n=60, findings=(Finding("gap", "warning", evil, evil, evil),))
    rig, _ = load_rig("sflr")
    rig = rig.model_copy(update={"name": evil, "description": evil})
    path = write_report(tmp_path / "r.html", Subject([recording], [response], rig, model()))
    parsed = Page(path.read_text(encoding="utf-8"))
    assert all(address.startswith("#") for address in parsed.addresses)
    assert "alert(1)" in parsed.text


def test_a_report_of_a_recording_alone_and_of_a_response_alone(tmp_path):
    alone = write_report(tmp_path / "a.html", Subject([recorded()], [])).read_text(encoding="utf-8")
    assert "No response was estimated" in alone
    response = write_report(tmp_path / "b.html", Subject([], [measured()])).read_text(
        encoding="utf-8"
    )
    assert "The response is measured" in response


ODD = {
    "noise known for certain": {"dof": np.full(50, np.inf)},
    "no noise at all": {"covariance": np.zeros((50, 2, 2), complex)},
    "a line at 0 Hz": {"frequency": np.linspace(0.0, 10.0, 50)},
    "levels mixed": {"level": math.nan},
    "an output that is dead": {"H": np.zeros((50, 2, 1), complex)},
    "a single degree of freedom": {"dof": np.ones(50)},
}


@pytest.mark.parametrize("case", ODD)
def test_odd_responses_are_shown_all_the_same(tmp_path, case):
    response = replace(measured(n=50), **ODD[case])
    write_report(tmp_path / "r.html", Subject([], [response], model=model()))
    assert case
    printed(summary([], [response], model()))
    bode_figure([response], model())


@pytest.mark.parametrize("order", [1, -1])
def test_a_level_may_lack_a_sensor_that_was_unsound_there(tmp_path, order):
    whole, less = measured(1.0), outputs_of(measured(2.0, seed=1), [1])
    both = [whole, less][::order]
    page = write_report(tmp_path / "r.html", Subject([], both, model=model(0.6)))
    sets = json.loads(Page(page.read_text(encoding="utf-8")).scripts["data-bode"])["sets"]
    levels = {s["name"]: {t["name"] for t in s["data"] if "name" in t} for s in sets}
    assert "2 V" not in levels["theta_2/v_2"]
    assert {"1 V", "2 V"} <= levels["a_0/v_2"]
    said = printed(summary([], both, model(0.6)))
    assert said.count("a_0/v_2 [") == 2
    assert said.count("theta_2/v_2 [") == 1
    figure = bode_figure(both, model())
    drawn = [
        {line.get_label(): line.get_color() for line in axis.lines} for axis in figure.axes[:2]
    ]
    assert [sum(label.endswith(" V") for label in labels) for labels in drawn] == [1, 2]
    assert drawn[0]["1 V"] == drawn[1]["1 V"] != drawn[1]["2 V"]
    legend = [text.get_text() for text in figure.axes[0].get_legend().get_texts()]
    assert legend[:2] == ["1 V", "2 V"]
    assert "amplitude" in said


def test_what_cannot_be_reported(tmp_path):
    path = tmp_path / "r.html"
    with pytest.raises(InputError, match="expected a recording or a response"):
        write_report(path, Subject([], []))
    with pytest.raises(InputError, match="spectrogram channel is 'x'"):
        write_report(path, Subject([recorded()], []), spectrogram_channel="x")
    (u,) = measured().inputs
    other = replace(measured(), inputs=(replace(u, name="v_9"),))
    with pytest.raises(InputError, match="the same in all responses"):
        write_report(path, Subject([], [measured(), other]))
    with pytest.raises(InputError, match="expected the shape"):
        ModelCurve("m", np.arange(3.0), np.ones((3, 2), complex), ("a", "b"), ("u",))
    assert not list(tmp_path.iterdir())


def test_the_truth_agrees_and_a_wrong_gain_does_not():
    right = compare(measured(n=2000), model())
    # 10 % of the lines lie outside a 90 % region of the truth.
    assert all(c.outside == pytest.approx(0.10, abs=0.03) for c in right)
    assert all(c.gain == pytest.approx(1.0, abs=0.005) for c in right)
    (wrong, _) = compare(measured(n=2000), model(0.5), (1.0, 24.0))
    assert wrong.gain == pytest.approx(0.5, abs=0.005)
    assert not wrong.agrees
    assert wrong.first_hz == pytest.approx(1.0, rel=0.01)
    assert "gain 0.5" in wrong.sentence()
    assert "1\u201324 Hz" in wrong.sentence()


def test_a_run_that_was_tripped_is_said_first():
    tripped = replace(recorded(), stop=StopRecord("tripped", "theta_2 over 0.35 rad"))
    first = verdicts([tripped], [measured()], [])[0]
    assert first.mark == "bad"
    assert "theta_2 over 0.35 rad" in first.text


def test_findings_are_gathered_by_kind_and_name_files_without_folders():
    gaps = [Finding("gap", "error", f"/some/lab/run_{k}.mcap, sweep: 1 missing") for k in (1, 2)]
    worn = Finding("clipping", "warning", "a_0 clips.")
    (said,) = verdicts([], [measured(findings=(*gaps, worn))], [])[-1:]
    assert said.mark == "bad"
    assert said.text == "run_1.mcap, sweep: 1 missing (and 1 more of this kind). a_0 clips."


def test_a_gain_that_changes_with_level_is_called_so():
    same = verdicts([], [measured(1.0), measured(2.0, seed=1)], [])
    assert "does not depend" in " ".join(v.title for v in same)
    changed = verdicts([], [measured(1.0), measured(2.0, seed=1, gain=1.2)], [])
    (said,) = [v for v in changed if "changes with the amplitude" in v.title]
    assert "not linear" in said.text


def test_the_table_holds_the_modes_with_intervals_and_noise_has_none(page):
    _, parsed = page
    shown = modes_of_all([measured(relative=0.01)], None)
    found = [m.frequency_hz for m in shown[0].found.modes]
    for hz in MODES:
        near = min(found, key=lambda x: abs(x.value - hz))
        assert abs(near.value - hz) < 4 * near.sd < 0.01 * hz
    assert all("\u00b1" in row["frequency"] for row in rows(shown))
    assert "Damping ratio" in parsed.text
    flat = replace(measured(), H=np.zeros_like(measured().H) + noise(measured().H.shape))
    flat = replace(flat, covariance=np.repeat(np.eye(2)[None] + 0j, 500, axis=0))
    nothing = modes_of_all([flat], None)
    assert rows(nothing) == []
    assert "no mode stands above the noise" in " ".join(sentences(nothing))


def noise(shape):
    """Circular noise of variance 1."""
    rng = np.random.default_rng(3)
    return (rng.standard_normal(shape) + 1j * rng.standard_normal(shape)) / np.sqrt(2)


@settings(max_examples=50)
@given(st.lists(st.floats(-1e6, 1e6), min_size=1, max_size=400), st.integers(1, 60))
def test_thinning_keeps_every_extreme(values, pixels):
    y = np.array(values)
    t, thinned = thin(np.arange(len(y), dtype=float), y, pixels)
    assert thinned.max() == y.max()
    assert thinned.min() == y.min()
    assert (np.diff(t) >= 0).all()
    assert len(t) <= max(len(y), 2 * pixels)


@pytest.mark.parametrize("name", ["samii", "samii_braced", "samii_torque_vertical", "sflr"])
def test_the_drawing_names_every_part(name):
    rig, _ = load_rig(name)
    texts = [e.text for e in ElementTree.fromstring(draw(rig)).iter("text")]
    assert {e.name for e in rig.element} <= set(texts)
    assert all(any(t.startswith(s.name) for t in texts) for s in rig.sensor)
    assert rig.base in texts


def test_figures_for_a_paper(tmp_path):
    figure = bode_figure([measured(1.0, n=100), measured(2.0, n=100)], model())
    assert save_figure(tmp_path / "bode.png", figure).stat().st_size > 20_000
    text = save_figure(tmp_path / "bode.svg", figure).read_text(encoding="utf-8")
    assert "theta_2/v_2 [rad/V]" in text
    assert "transfer matrices" in text
    with pytest.raises(InputError, match="suffix"):
        save_figure(tmp_path / "bode.bmp", figure)


def printed(thing, **options):
    console = Console(file=io.StringIO(), width=110, **options)
    console.print(thing)
    return console.file.getvalue()


def test_the_terminal_says_the_same():
    modes = modes_of_all([measured(1.0)], None)
    said = printed(summary([recorded()], [measured(1.0)], model(0.6), modes=modes))
    assert "The model differs from the measurement" in said
    assert "\u00d7 0.600" in said
    assert "2.3" in said


def test_a_dry_run_says_its_margins_and_errors():
    margin = Margin("theta_2", "limit", "rad", 0.28, 0.35, "frame", "sweep_4", 4.0, "V", 5.0)
    over = replace(margin, channel="a_0", unit="m/s^2", predicted=33.0, limit=30.0)
    band = BandError("theta_2", 4.0, "V", 1.0, 2.0, 1e-5, 0.013)
    peaks_ = np.zeros((1, 1))

    def run(*margins):
        return DryRun(95.0, 95.0, ("v_2",), ("V",), peaks_, 0.0, margins, (band,))

    def shown(*margins):
        return printed(dry_run_summary(run(*margins)))

    said = shown(over, margin)
    for part in ("95 s", "33 m/s\u00b2", "-10 %", "20 %", "OVER"):
        assert part in said
    assert "1.3 %" not in said  # it is refused: nothing will be measured
    said = shown(margin)
    for part in ("1\u20132 Hz", "1.3 %"):
        assert part in said
    assert "OVER" not in said
    assert "not seen" not in said
    band = replace(band, relative=1.1e38)  # the noise is all that will be there
    margin = replace(margin, segment="swept_sine_beam_on_shaker_1_2")
    said = printed(dry_run_summary(replace(run(margin), bands=(band,))))
    assert "not seen" in said
    assert "e+" not in said
    assert "shaker_1_2" in said  # what tells one segment from the next


def test_a_dry_run_has_one_row_a_channel_and_tells_a_bound_from_a_peak():
    margin = Margin("v_2", "limit", "V", 1.53, 5.0, "half", "sweep_4", 4.0, "V", 5.0)
    rows = (
        margin,
        replace(margin, what="rate", unit="V/s", predicted=900.0, limit=2000.0),
        replace(margin, channel="a_1", what="range", unit="m/s^2", predicted=45.0, limit=50.0),
        replace(margin, channel="a_1", what="range", unit="m/s^2", predicted=44.0, limit=50.0),
    )
    rows = tuple(sorted(rows, key=lambda m: m.margin))
    peaks_ = np.array([[0.9], [1.02]])
    said = printed(dry_run_summary(DryRun(9.0, 9.0, ("v_2",), ("V",), peaks_, 0.0, rows, ())))
    lines = [line.split()[0] for line in said.splitlines()[2:] if line.strip()]
    assert lines == ["a_1", "v_2"]
    assert "45 m/s" in said
    assert "900 V/s" in said
    alone = printed(dry_run_summary(DryRun(9.0, 9.0, ("v_2",), ("V",), peaks_, 0.0, (margin,), ())))
    assert "\u2264 1.53 V, peak 1.02" in alone


def test_levels_of_two_units_and_rows_of_two_experiments_are_told_apart():
    a, b = measured(0.5), replace(measured(0.5), method="stepped")
    c = replace(measured(0.2), level_unit="rad")
    assert names([a, b, c]) == ["0.5 V, burst", "0.5 V, stepped", "0.2 rad"]
    twice = [replace(a, sources=(f"runs/{name}.mcap",)) for name in ("x", "y")]
    assert names(twice) == ["0.5 V, burst, x", "0.5 V, burst, y"]
    run = recorded()
    in_rad = replace(run, segments=tuple(replace(s, level=0.2, unit="rad") for s in run.segments))
    assert any(" V and 0.2 rad, " in v.text for v in verdicts([run, in_rad], [a], ()))
    # The levels of two units say nothing of the rig's linearity.
    assert not any("amplitude" in v.title for v in verdicts([run], [a, c], ()))
    told = {row["level"] for row in rows(modes_of_all([a, b, c], None))}
    assert told == set(names([a, b, c]))
    # Each row has the model's ratio of its own measurement.
    half = replace(b, H=2 * b.H)
    shown = printed(summary([run], [a, half], model()))
    assert "\u00d7 1.00" in shown
    assert "\u00d7 0.50" in shown


def report(segment, frequency=3.2):
    return SimpleNamespace(
        segment=segment,
        n_segments=9,
        name="sweep",
        level=2.0,
        unit="V",
        time_left=41.0,
        frequency=frequency,
        worst_channel="theta_2",
        worst_margin=0.31,
    )


def test_progress_lives_on_a_terminal_and_is_one_line_a_segment_elsewhere():
    assert "at rest at 2 V" in printed(progress_line(report(3, math.nan), 90.0))
    terminal = Console(file=io.StringIO(), width=100, force_terminal=True)
    with LiveProgress(terminal, 90.0) as show:
        show(report(3))
    said = re.sub(r"\x1b\[[0-9;]*m", "", terminal.file.getvalue())
    for part in ("3/9", "54 %", "41 s left", "3.20 Hz at 2 V", "theta_2, 31 % left"):
        assert part in said
    plain = Console(file=io.StringIO(), width=100)
    with LiveProgress(plain, 90.0) as show:
        for segment in (1, 1, 1, 2):
            show(report(segment))
    assert plain.file.getvalue().splitlines() == [
        "1/9 sweep, 2 V, 41 s left",
        "2/9 sweep, 2 V, 41 s left",
    ]


def test_who_waits_sees_what_is_tried_and_that_kernels_are_compiled():
    said = Console(file=io.StringIO(), width=40)  # a log's lines are not wrapped
    with working("diagnosis", console=said) as say:
        say("what is missing")
        for tried in range(50):
            say(Counted("what is missing", tried, 50, within="round 1"))  # each soon after
        assert kernels.__doc__  # it hears the compiler from then on
        numba.njit(lambda x: x + 1)(1)
        say("what cannot be distinguished")
    stages = [line.partition(" (after")[0] for line in said.file.getvalue().splitlines()]
    assert stages == [
        "diagnosis ...",
        "diagnosis: what is missing ...",
        "diagnosis: compiling the model's kernels, once a machine: one minute or two that no time "
        "to the end counts ...",
        "diagnosis: what cannot be distinguished ...",
    ]
