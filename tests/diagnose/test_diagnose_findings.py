"""What is no physics: every single fault of a recording is told as itself, never as physics.

Sweeps of the simulated rig, made once; one fault is put into the recorded arrays of each test. The
rig that is diagnosed is the one that was simulated, so anything named would be wrong.
"""

from dataclasses import replace

import numpy as np
import pytest
from identify_kit import noiseless, samii, without_tolerances
from sweep_kit import swept
from table_kit import table_of

from samii_rig.diagnose.data import findings, wiring
from samii_rig.diagnose.diagnose import diagnose, table
from samii_rig.diagnose.physics.grid import grid
from samii_rig.diagnose.physics.model import Model
from samii_rig.diagnose.posed import in_poses, sorted_by_pose
from samii_rig.errors import EstimateError, InputError, SamiiRigError
from samii_rig.identify.bootstrap import redraw
from samii_rig.rig.load import load_rig
from samii_rig.signal.estimate import estimate
from samii_rig.types import Finding, Quality

LEVELS = (0.3, 0.5)
RIVALS = ("torsional_compliance", "velocity_feedback", "sensor_delay", "sensor_gain")
RATE = 500


def sweeps(level, seed):
    """Four sweeps at one level, each from rest to rest."""
    rig, text = load_rig("samii")
    return swept(rig, level, repeats=4, duration=8.0, ring_down=25.0, seed=seed, rig_toml=text)


@pytest.fixture(scope="module")
def sound():
    return [sweeps(level, 10 + i) for i, level in enumerate(LEVELS)]


@pytest.fixture(scope="module")
def rivals():
    return table_of(samii(), 0.8, 35.0, *RIVALS, "time_offset")


def faulty(runs, fault, which=None):
    """The runs, `fault` put into (copies of) the arrays of some of them."""
    out = []
    for i, run in enumerate(runs):
        own = replace(run, values=run.values.copy(), quality=run.quality.copy())
        out.append((fault(own) or own) if which is None or i in which else run)
    return out


def times(name, factor):
    def fault(run):
        run.values[:, run.column(name)] *= factor

    return fault


def swapped(a, b):
    def fault(run):
        i, j = run.column(a), run.column(b)
        run.values[:, [i, j]] = run.values[:, [j, i]]

    return fault


def dropped(sweep, count):
    def fault(run):
        a = run.segments[sweep].start + 2000
        keep = np.ones(len(run), bool)
        keep[a : a + count] = False
        return replace(
            run, time=run.time[keep], sequence=run.sequence[keep], values=run.values[keep],
            quality=run.quality[keep],
        )  # fmt: skip

    return fault


def lost(name, sweep):
    def fault(run):
        run.values[run.segments[sweep].start + 2000, run.column(name)] = np.nan

    return fault


def within(name, sweep, change):
    """`change` made to a channel in one sweep."""

    def fault(run):
        s = run.segments[sweep]
        x = run.values[s.start : s.stop, run.column(name)]
        x[:] = change(x)

    return fault


def frozen(x):
    return np.where((np.arange(x.size) > 2000) & (np.arange(x.size) < 4500), x[2000], x)


def knocked(x):
    k = np.arange(x.size) - 3000.0
    return x + 4.0 * np.where(k > 0, np.exp(-k / 80) * np.sin(2 * np.pi * 6 * k / RATE), 0.0)


def topped(name):
    def fault(run):
        x = run.values[:, run.column(name)]
        x[:] = np.clip(x, -0.7 * np.abs(x).max(), 0.7 * np.abs(x).max())

    return fault


def flagged(name):
    def fault(run):
        i = run.column(name)
        high = np.abs(run.values[:, i]) > 0.7 * np.abs(run.values[:, i]).max()
        run.quality[high, i] |= int(Quality.CLIPPED)

    return fault


def ahead(name, samples):
    def fault(run):
        i = run.column(name)
        run.values[:, i] = np.roll(run.values[:, i], -samples)

    return fault


def clocked(run):
    return replace(run, time=(run.time * 1.01).astype(np.int64))


def every(*faults):
    def fault(run):
        for one in faults:
            one(run)

    return fault


FAULTS = {
    "a block dropped in one sweep": (dropped(1, 40), [0], "40 samples missing"),
    "a NaN": (lost("a_1", 2), [1], "1 samples of a_1 missing"),
    "two accelerometers swapped": (swapped("a_1", "a_2"), None, "a_1 and a_2 are swapped"),
    "swapped in one run": (swapped("a_0", "a_2"), [1], "swapped; taken for each other (at 0.5 V)"),
    "angle and acceleration swapped": (swapped("theta_2", "a_0"), None, "theta_2 and a_0 are swap"),
    "a sign": (times("a_1", -1), None, "a_1 has the wrong sign"),
    "a sign in one run": (times("theta_2", -1), [1], "wrong sign; turned round (at 0.5 V)"),
    "the command's sign": (times("v_2", -1), None, "v_2 is turned round"),
    "degrees": (times("theta_2", 57.29578), None, "degrees for radians"),
    "g": (times("a_1", 1 / 9.80665), None, "g for m/s^2"),
    "a rounded g": (times("a_1", 1 / 9.81), None, "g for m/s^2"),
    "metres for millimetres": (times("a_2", 1e-3), None, "milli for one"),
    "more than the converter can": (times("a_0", 1000), None, "outside its range"),
    "millivolts": (times("v_2", 1000), None, "v_2 is not in the unit of the rig file"),
    "one channel dead": (times("a_0", 0), None, "a_0 never changes"),
    "frozen in one sweep": (within("a_1", 1, frozen), [0], "a_1 stands still for"),
    "frozen in every sweep": (
        every(*(within("a_1", k, frozen) for k in range(4))), None, "a_1 left out at 0.3 V",
    ),
    "flat tops": (topped("a_2"), None, "a_2 is flat at its extreme"),
    "flat tops at one level": (topped("a_2"), [1], "a_2 left out at 0.5 V"),
    "clipped": (flagged("theta_2"), None, "theta_2 is at the end of its range"),
    "a knock": (within("a_2", 2, knocked), [0], "sweep 3 was disturbed at "),
    "a gain in one sweep": (within("a_1", 2, lambda x: 1.3 * x), [0], "does not repeat the others"),
    "a gain in one run": (times("a_1", 1.2), [1], "its gain was changed between the runs"),
    "a clock 1 % off": (clocked, None, "the clock says 495.05 Hz"),
    "a clock 1 % off in one run": (clocked, [0], "left out for their clock"),
    "a channel read early": (ahead("a_1", 1), None, "ahead of the other channels"),
    "one dead command": (times("v_2", 0), [1], "the input v_2 never moves; left out"),
}  # fmt: skip


@pytest.mark.parametrize("name", FAULTS)
def test_a_fault_is_told_as_itself_and_no_physics_is_named(name, sound, rivals):
    fault, which, words = FAULTS[name]
    responses = estimate(faulty(sound, fault, which), gaps="exclude")
    found = diagnose(responses, samii(), effects=rivals)
    assert any(words in text for text in found.not_physics), found.not_physics
    assert found.verdict == "no_mismatch"
    assert found.causes == ()


@pytest.mark.parametrize(("others", "told"), [(1.0, True), (0.9, False), (0.93, False)])
def test_a_gain_that_noise_hides_in_the_other_channels_is_no_channels_own(sound, others, told):
    """A command that was clipped makes all of them smaller; one channel shows it beyond noise."""
    quiet, loud = estimate(sound, gaps="exclude")
    noise = np.full(len(quiet.outputs), 40.0)
    noise[0] = 1.0
    covariance = [r.covariance * noise[:, None] * noise for r in (quiet, loud)]
    gain = np.full((len(noise), 1), others)
    gain[0] = 0.9
    quiet, loud = (
        replace(r, covariance=C, H=quiet.H * g)
        for r, C, g in zip((quiet, loud), covariance, (1.0, gain), strict=True)
    )
    found = findings.checked([quiet, loud], samii())
    assert any("its gain was changed between the runs" in said for said in found.remarks) == told
    assert [len(r.outputs) for r in found.responses] == [len(noise) - told] * 2


def test_levels_without_noise_are_told_of_no_gain_that_was_changed(sound):
    levels = [replace(r, covariance=np.zeros_like(r.covariance)) for r in estimate(sound)]
    found = findings.checked(levels, samii())
    assert not any("its gain was changed" in said for said in found.remarks)


def test_the_rest_is_diagnosed_once_a_unit_is_mended(sound, rivals):
    late = every(times("theta_2", 57.29578), ahead("a_2", -2))
    found = diagnose(estimate(faulty(sound, late)), samii(), effects=rivals)
    assert any("degrees for radians" in text for text in found.not_physics)
    assert found.verdict == "named"
    (cause,) = found.causes
    assert (cause.physics, cause.site) == ("sensor_delay", "a_2")
    assert cause.parameters["tau"].value == pytest.approx(4e-3, rel=0.02)


def test_a_sweep_cut_while_it_rings_is_no_physics(sound, rivals):
    run = sound[1]
    cut = tuple(replace(s, stop=s.start + 10 * RATE) for s in run.segments)
    found = diagnose(estimate([replace(run, segments=cut)]), samii(), effects=rivals)
    assert any("still moves by" in text for text in found.not_physics)
    assert found.verdict in ("no_mismatch", "unknown")


def test_one_sweep_alone_is_too_little_to_name_anything(sound, rivals):
    alone = replace(sound[1], segments=sound[1].segments[:1])
    (late,) = faulty([alone], ahead("a_1", -3))
    few = [e for e in rivals if e.physics == "sensor_delay"]
    found = diagnose(estimate([late]), samii(), effects=few)
    assert found.verdict == "ambiguous"
    assert any("nothing was repeated" in text for text in found.not_physics)
    assert "repeat each run" in found.experiment


def test_of_two_repeats_that_differ_neither_is_trusted(sound):
    two = replace(sound[0], segments=sound[0].segments[:2])
    (wrong,) = faulty([two], within("a_1", 1, lambda x: 1.3 * x))
    with pytest.raises(EstimateError, match="a third repeat would tell"):
        estimate([wrong])
    said = sorted_by_pose([wrong], [0.0], estimate)[0].responses
    assert len(said) == 2
    (told,) = [
        f.message for f in said[0].findings if f.kind == "repeat" and "by itself" in f.message
    ]
    assert told.endswith("each was estimated by itself")


# Bad input, on drawn responses

LINES = np.geomspace(0.8, 35.0, 120)


def drawn(seed=1, **changes):
    """A measurement of the rig itself."""
    exact = noiseless(samii(), LINES)
    return replace(redraw(exact, exact.H, np.random.default_rng(seed), 10), **changes)


def test_a_rig_file_without_tolerances_is_diagnosed_and_told(rivals):
    found = diagnose([drawn()], without_tolerances(samii()), effects=rivals)
    assert found.verdict == "no_mismatch"
    assert any("gives no tolerance" in text for text in found.not_physics)


def test_what_is_missing_in_a_rig_file_without_tolerances_is_found(rivals):
    """With nothing to refit, on lines that are fitted and on lines that decide."""
    soft = next(e for e in rivals if e.name == ("torsional_compliance", "joint_2_source"))
    model = Model(samii(), [soft])
    n = len(samii().sensor)
    at = grid(samii(), LINES, np.arange(n), np.zeros(n, dtype=np.int64))
    x = np.append(np.zeros(model.n_nominal), np.log([5e4, 0.05]))
    H = model.response(x, at)[:, :, None]
    runs = [
        replace(redraw(drawn(), H, np.random.default_rng(seed), 10), method=method)
        for seed, method in ((2, "burst (drawn)"), (3, "periodic (drawn)"))
    ]
    found = diagnose(runs, without_tolerances(samii()), effects=rivals)
    assert found.verdict == "named"
    assert ("torsional_compliance", "joint_2_source") in [(c.physics, c.site) for c in found.causes]


def test_a_rig_of_one_sensor_without_tolerances_too():
    rig = samii().model_copy(update={"sensor": samii().sensor[:1]})
    one = wiring.outputs_of(drawn(), [0])
    few = [e for e in table(rig, 0.8, 35.0) if e.physics in RIVALS]
    found = diagnose([one], without_tolerances(rig), effects=few)
    assert found.verdict == "no_mismatch"
    assert any("only theta_2 was recorded" in text for text in found.not_physics)


def test_a_line_that_holds_no_number_is_left_out(rivals):
    H = drawn().H.copy()
    H[7] = np.nan
    found = diagnose([drawn(H=H)], samii(), effects=rivals)
    assert np.isfinite(found.chi2_per_dof)
    assert any("1 lines hold no number" in text for text in found.not_physics)


def test_a_level_that_does_not_fit_between_two_that_agree_is_left_out():
    other = drawn(2, H=drawn(2).H * np.linspace(0.9, 1.1, LINES.size)[:, None, None])
    levels = [replace(r, level=x) for x, r in ((0.2, drawn(1)), (0.4, other), (0.8, drawn(3)))]
    clean = findings.checked(levels, samii())
    assert [r.level for r in clean.responses] == [0.2, 0.8]
    assert any("the runs at 0.4 V do not fit between" in text for text in clean.remarks)


def test_levels_that_a_nonlinear_rig_would_have_are_all_kept():
    bend = np.sin(LINES)[:, None, None]
    levels = [
        replace(drawn(i, H=drawn(i).H * (1 + 0.03 * i * bend)), level=float(i)) for i in (1, 2, 3)
    ]
    assert len(findings.checked(levels, samii()).responses) == 3


@pytest.mark.parametrize(
    ("responses", "rig", "band", "words"),
    [
        (lambda: [drawn()], "sflr", None, "those of SFLR: theta, a"),
        (lambda: [drawn(rate_hz=1000.0)], "samii", None, "the rig's rate, 500 Hz"),
        (lambda: [drawn()], "samii", (100.0, 200.0), "0.8 to 35 Hz was measured"),
        (lambda: [drawn()], "samii", (5.0, 2.0), "0.8 to 35 Hz was measured"),
        (list, "samii", None, "at least one frequency response"),
    ],
)
def test_what_does_not_belong_together_is_refused_in_one_line(responses, rig, band, words):
    with pytest.raises(SamiiRigError) as raised:
        diagnose(responses(), load_rig(rig)[0], band=band, effects=[])
    assert isinstance(raised.value, InputError)
    assert words in str(raised.value)
    assert "\n" not in str(raised.value)


def test_a_coarse_sensor_that_a_loop_is_closed_around_is_left_out_where_most_records_hide_it():
    """What the loop made of it stands in the command; nothing is said of the sensor itself."""
    rig = samii()
    lines = np.geomspace(0.8, 35.0, 60)
    others = [s.name for s in rig.sensor if s.name != "theta_2"]
    coarse = Finding("resolution", "warning", "theta_2 moves by 0.3 of its step", "theta_2")
    small = replace(noiseless(rig, lines, others), findings=(coarse,))
    large = noiseless(rig, lines, [*others, "theta_2"])
    hidden, read = findings.checked([small], rig), findings.checked([small, large], rig)
    assert hidden.hidden == {"theta_2"}
    assert set(hidden.sensors(rig)) == set(others)
    assert any(said.startswith("theta_2 is left out") for said in hidden.remarks)
    table = [e for e in table_of(rig, 0.8, 35.0, "sensor_delay") if e.site in ("theta_2", "a_1")]
    assert {e.site for e in hidden.competing(table)} == {"a_1"}
    # Where half of them show it, the others are left out.
    assert read.hidden == set()
    assert "theta_2" in read.sensors(rig)
    assert coarse in read.samples
    assert {e.site for e in read.competing(table)} == {"theta_2", "a_1"}


def test_two_recordings_that_differ_are_diagnosed_and_that_they_do_is_told(rivals):
    runs = [sweeps(0.5, seed) for seed in (31, 32)]
    runs = [replace(r, segments=r.segments[:1], source=f"run_{i}") for i, r in enumerate(runs)]
    runs = faulty(runs, times("a_1", 1.3), {1})
    with pytest.raises(EstimateError, match="a third repeat would tell"):
        estimate(runs)
    each = sorted_by_pose(runs, [0.0, 0.0], estimate)
    found = in_poses(each, samii(), effects=rivals)
    assert found.verdict in ("no_mismatch", "unknown")
    (told,) = (text for text in found.not_physics if "and not by noise" in text)
    assert told.endswith("each was estimated by itself")
    assert any("run_1 as if of another state" in text for text in found.not_physics)


def test_the_same_file_twice_is_refused_all_the_same():
    run = sweeps(0.5, 31)
    run = replace(run, segments=run.segments[:1], source="run_0")
    with pytest.raises(EstimateError, match="the same file twice"):
        sorted_by_pose([run, replace(run, source="run_1")], [0.0, 0.0], estimate)
