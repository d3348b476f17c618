"""A stiffness that is not the same all the time, in the likelihood of whole records."""

from __future__ import annotations

import json
import math
from copy import copy
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from concealed_kit import SAMII, SAMII_TOML
from cut_kit import DESIGN, cut_sweeps
from scipy import integrate, stats
from table_kit import Effects, table_of

from samii_rig.diagnose.diagnose import case_of, diagnose
from samii_rig.diagnose.fit.exact import NINETY
from samii_rig.diagnose.fit.explanations import Explanation
from samii_rig.diagnose.forces.laws import HARDENING
from samii_rig.diagnose.forces.paths import Span
from samii_rig.diagnose.forces.problem import ForceProblem
from samii_rig.diagnose.forces.search import ForceSearch
from samii_rig.diagnose.forces.swings import Swings
from samii_rig.diagnose.forces.variation import (
    SWINGS_STILL,
    BySpring,
    Variation,
    _less,
    _repeats_differ,
    _Taken,
    likelihood,
    of_its_own,
    variation,
)
from samii_rig.diagnose.forces.varying import (
    Modulation,
    PieceModulation,
    Springs,
    _between,
    piece_modulations,
    projected_back,
    uneven,
)
from samii_rig.diagnose.result import Diagnosis
from samii_rig.diagnose.verdict import by_record
from samii_rig.diagnose.verdict.by_record import on_records
from samii_rig.likelihood.inputs import MeterNoise
from samii_rig.likelihood.pieces import Command, Piece
from samii_rig.likelihood.unexplained import Unexplained
from samii_rig.record.reader import read_recording
from samii_rig.rig.load import load_rig
from samii_rig.signal.estimate import estimate
from samii_rig.types import Float, Recording
from sim.assumed_modes import styles, trial
from sim.assumed_modes.outside import OUTSIDE
from sim.assumed_modes.varying import VARYING

BAND = (0.5, 12.0)  # Hz, with the first two modes: what a diagnosis takes grows with its lines
FEW = Effects(lambda: table_of(SAMII, *BAND, "actuator_lag", "added_mass"))


def found_in(runs: list[Recording]) -> Diagnosis:
    return diagnose(estimate(runs, band=BAND), SAMII, band=BAND, runs=runs, effects=FEW)


def concealed(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    how: str,
    seed: int,
    *style: str,
    rig_toml: str = SAMII_TOML,
) -> tuple[dict[str, Any], list[Recording]]:
    """The truth of a trial of the second plant, and its recordings."""
    monkeypatch.setitem(trial.POOLS, "varying", {how: VARYING[how]})
    folder = trial.make("varying", seed, tmp_path, rig_toml, (*style, "clean"))
    (truth,) = json.loads((tmp_path / "truth" / f"varying_{seed}.json").read_text())["effects"]
    return truth, [read_recording(path) for path in sorted(folder.glob("*.mcap"))]


def test_a_spring_that_swings_is_named_with_its_place_how_fast_and_by_how_much(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A plant of another kind, under noise that says nothing of when it swings, and of which the
    nominal model leaves no more than noise. As long as that noise is what it does, it is less than
    what its neighbour would do."""
    rig, text = load_rig("two_masses")
    # With the first two modes in it: twice as many lines take twice as long, and what swings has no
    # more to show on them.
    monkeypatch.setattr(styles, "HIGH_HZ", (15.0, 15.0))
    truth, runs = concealed(tmp_path, monkeypatch, "in time", 5, "random", rig_toml=text)
    few = table_of(rig, *BAND, "actuator_lag", "added_mass")
    closer = _Taken.closer

    def watched(taken: _Taken, best: Explanation, seen: Modulation | None = None) -> bool:
        """What one that is known still misses looks like another beside it."""
        before = taken.swings
        more = closer(taken, best, seen)
        if before.hz.size:
            assert taken.swings.hz.size == before.hz.size or before.left < SWINGS_STILL
        return more

    monkeypatch.setattr(_Taken, "closer", watched)
    found = diagnose(estimate(runs), rig, runs=runs, effects=few)
    assert truth["site"] == "spring_1"
    assert found.verdict == "named"
    (cause,) = found.causes
    assert (cause.physics, cause.site) == ("stiffness_variation", truth["site"])
    for symbol, near in (("depth", 0.1), ("f", 0.01)):
        true = truth["parameters"][symbol]["value"]
        told = cause.parameters[symbol]
        assert told.value == pytest.approx(true, rel=near)
        assert told.low is not None
        assert told.high is not None
        assert told.low < told.value < told.high
    assert found.gap.low > 0  # on lines that it was not fitted to
    assert found.lines()[0].startswith("Left out: stiffness variation at ")


def test_a_joint_that_differs_from_run_to_run_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Sweeps, cut off where they end: a clamp that differs by 3 %, 40 noise units."""
    truth, runs = concealed(tmp_path, monkeypatch, "between runs", 5, "cut")
    asked: list[tuple[BySpring, int]] = []

    def watched(seen: BySpring, files: int) -> Variation | None:
        asked.append((seen, files))
        return variation(seen, files)

    monkeypatch.setattr(by_record, "variation", watched)
    # Where no linear response explains all records no pair does, and nothing is left for one.
    monkeypatch.setattr(by_record, "_disagree", lambda _: True)
    monkeypatch.setattr(by_record, "_beside_pairs", None)
    found = found_in(runs)
    assert found.verdict in ("named", "ambiguous")
    (cause,) = found.causes
    assert (cause.physics, cause.site) == ("stiffness_variation", truth["site"])
    spread = cause.parameters["spread"]
    assert spread.low is not None
    assert spread.high is not None
    assert spread.low < truth["parameters"]["spread"]["value"] < spread.high
    assert not found.states
    # Nor is it told of a rig whose parameters it drives to where they cannot be. All that was told
    # of it comes from one question, so no second diagnosis is needed.
    (question,) = asked
    monkeypatch.setattr("samii_rig.diagnose.forces.variation.unlikely", lambda _: True)
    assert variation(*question) is None


def test_a_spring_that_is_stiffer_to_one_side_has_a_stop_that_it_touches_at_rest(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It swings as the motion does, which of a multisine is a few lines: it was told as that."""
    monkeypatch.setitem(
        trial.POOLS, "outside", {"one_sided_stiffness": OUTSIDE["one_sided_stiffness"]}
    )
    rig, text = load_rig("two_masses")
    monkeypatch.setattr(styles, "BUDGET", 50_000)  # samples: half as many show it as well
    folder = trial.make("outside", 4, tmp_path, text, ("multisine_once", "clean"))
    (truth,) = json.loads((tmp_path / "truth" / "outside_4.json").read_text())["effects"]
    runs = [read_recording(path) for path in sorted(folder.glob("*.mcap"))]
    found = diagnose(estimate(runs), rig, runs=runs)
    assert found.verdict == "named"
    (cause,) = found.causes
    assert (cause.physics, cause.site) == ("end_stop", truth["site"])
    k, dk = cause.parameters["k"], truth["parameters"]["dk"]["value"]
    assert k.low < dk < k.high
    x_1 = [c.name for c in runs[0].channels].index("x_1")
    assert cause.parameters["gap"].value < 0.02 * float(np.ptp(runs[0].values[:, x_1]))


def search_in(folder: Path, band: tuple[float, float] | None) -> ForceSearch:
    runs = cut_sweeps(folder, design=DESIGN)
    linear = on_records(case_of(estimate(runs, band=band), SAMII, band, FEW, runs))
    assert linear is not None
    return ForceSearch(linear)


@pytest.fixture(scope="module")
def nothing(tmp_path_factory: pytest.TempPathFactory) -> ForceSearch:
    """In the band of the sweep: in a narrower one motion above it is left out."""
    return search_in(tmp_path_factory.mktemp("nothing"), None)


@pytest.fixture(scope="module")
def narrow(tmp_path_factory: pytest.TempPathFactory) -> ForceSearch:
    return search_in(tmp_path_factory.mktemp("narrow"), BAND)


def test_what_a_force_adds_to_the_lines_is_turned_round_exactly(nothing: ForceSearch) -> None:
    rng, paths = np.random.default_rng(1), nothing.paths
    span, piece = paths.spans[0], nothing.levels.records.pieces[0]
    k = nothing.levels.records.lines(piece).k
    spring = next(e.force for e in nothing.forces if e.force and e.force.law is HARDENING)
    ports = paths.ports(spring.place, of_speed=False)
    assert ports is not None
    force = rng.standard_normal(span.decay.size) * span.alive
    some = rng.standard_normal((2, k.size, ports.sensors[0].shape[1]))
    lines = some[0] + 1j * some[1]
    added = span.lines(span.damped(force), ports.sensors[0], k)
    back = projected_back(span, ports.sensors[0], k, lines, span.times)
    assert force @ back == pytest.approx(float(np.sum(lines.conj() * added).real), rel=1e-9)


def test_under_noise_alone_every_frequency_has_chi_square_of_two_freedoms(
    narrow: ForceSearch,
) -> None:
    """Noise that is white in the likelihood's own units, at the lines of real records."""
    rng, paths = np.random.default_rng(2), narrow.paths
    left = narrow.unexplained(narrow.nominal.fitted)
    f, each, sides = (0.05, 0.1, 0.4, 1.6, 6.4), [], []
    for spring in (e.force for e in narrow.forces if e.force and e.force.law is HARDENING):
        ports = paths.ports(spring.place, of_speed=False)
        assert ports is not None
        motion = paths.motion(spring.place, of_speed=False)
        for _ in range(40):
            noise = [
                replace(
                    x,
                    white=rng.standard_normal(x.white.shape)
                    + 1j * rng.standard_normal(x.white.shape),
                )
                for x in left
            ]
            parts = zip(paths.spans, motion, ports.sensors, noise, strict=True)
            pieces = [PieceModulation.of(*one) for one in parts]
            between = _between(pieces)
            sides.append(uneven(pieces))
            modulations = [np.sum([one.exact(hz) for one in pieces], axis=0) for hz in f]
            each += [[(between.chi2, between.free, 0.0), *modulations]]
    chi2, free, _ = np.moveaxis(np.array(each), 2, 0)
    rows = sum(len(x.white) for x in left)
    assert set(free[:, 0]) == {rows - 1}
    assert set(free[:, -1]) == {2 * rows}
    unit = (chi2 - free) / np.sqrt(2 * free)
    assert np.max(np.abs(np.mean(unit, axis=0))) < 0.3, np.mean(unit, axis=0)
    assert np.max(np.abs(np.var(unit, axis=0) - 1)) < 0.5, np.var(unit, axis=0)
    # The larger of two that have one freedom each and are alike.
    assert 0.8 < np.mean(sides) < 1.9
    assert np.max(sides) < stats.chi2.isf(0.01 / len(sides), 1)


def test_where_nothing_is_missing_every_stiffness_is_constant(nothing: ForceSearch) -> None:
    assert variation(BySpring.of(nothing, nothing.nominal), 3) is None


def test_what_a_swing_adds_in_time_is_what_it_adds_to_the_lines(nothing: ForceSearch) -> None:
    paths, span = nothing.paths, nothing.paths.spans[0]
    left = nothing.unexplained(nothing.nominal.fitted)[0]
    spring = next(e.force for e in nothing.forces if e.force and e.force.law is HARDENING)
    ports = paths.ports(spring.place, of_speed=False)
    assert ports is not None
    phi = paths.motion(spring.place, of_speed=False)[0]
    piece = PieceModulation.of(span, phi, ports.sensors[0], left)
    changes = np.zeros((len(left.white), 3))
    changes[0] = 0.0, 3.0, 4.0
    still = np.zeros_like(ports.back[0])  # a motion that the change does not change
    added = piece.added(changes, [0.4], still, [1.0] * len(left.white))
    assert added.shape == (len(left.white), span.samples, ports.sensors[0].shape[1])
    assert not added[1:].any()
    lines = np.fft.rfft(added[0], axis=0)[left.k] / np.sqrt(span.samples)
    force = phi * (changes[0] @ np.array(piece._waves([0.4])))
    same = span.lines(span.damped(force), ports.sensors[0], left.k) / span.times
    assert np.linalg.norm(lines - same) < 1e-6 * np.linalg.norm(same)


def test_the_motion_that_a_swing_changes_is_that_of_a_spring_that_swings() -> None:
    """A mass on a spring that swings by a tenth, 1.5 times as much as its damping lets be small,
    against an integration in time of m x'' + c x' + (k - dk(t)) x = v, its input held."""
    m, c, k, rate, hz, depth = 1.0, 4.0, 900.0, 100.0, 0.7, 0.1
    rng = np.random.default_rng(3)
    v = rng.standard_normal(1000)
    told = Command(v, 1.0, (MeterNoise(),))
    piece = Piece("held", v, np.zeros((v.size, 1)), 0, (), commands=(told,))
    span = Span.of(piece, [told], rate, rate / 4)

    def moved(soft: float) -> Float:
        def motion(t: float, y: Float) -> list[float]:
            dk = soft * k * np.cos(2 * np.pi * hz * t)
            force = v[min(int(t * rate + 1e-9), v.size - 1)]
            return [y[1], (force - c * y[1] - (k - dk) * y[0]) / m]

        y, out = np.zeros(2), []
        for i in range(v.size):  # from one edge of the input to the next
            out.append(y[0])
            ends = (i / rate, (i + 1 - 1e-6) / rate)
            y = integrate.solve_ivp(motion, ends, y, rtol=1e-9, atol=1e-12).y[:, -1]
        return np.array(out)

    back = 1 / (m * span.s**2 + c * span.s + k)
    held = (1 - np.exp(-span.s / rate)) / (span.s / rate)
    phi = span.motion((back * held)[:, None])
    n_line = 40
    left = Unexplained(
        np.arange(5, 5 + n_line), np.ones((n_line, 1, 1)), np.zeros((1, n_line, 1), complex)
    )
    one = PieceModulation.of(span, phi, back[:, None], left)
    changes = np.array([[0.0, depth * k, 0.0]])
    added = one.added(changes, [hz], back, [1.0])[0, :, 0]
    born = one.added(changes, [hz], np.zeros_like(back), [1.0])[0, :, 0]
    true = moved(depth) - moved(0.0)
    assert np.linalg.norm(added - true) < 0.02 * np.linalg.norm(true)
    assert np.linalg.norm(born - true) > 0.2 * np.linalg.norm(true)


def test_intervals_of_two_swings_hold_in_nine_of_ten(narrow: ForceSearch) -> None:
    """Frequencies and depths of two swings as far apart as a record resolves twice, one of them of
    two periods a record, each of another phase in every record, under noise that is white in the
    likelihood's own units."""
    rng, paths, covered = np.random.default_rng(11), narrow.paths, []
    left = narrow.unexplained(narrow.nominal.fitted)
    spring = next(e.force for e in narrow.forces if e.force and e.force.law is HARDENING)
    ports = paths.ports(spring.place, of_speed=False)
    assert ports is not None
    motion = paths.motion(spring.place, of_speed=False)
    parts = list(zip(paths.spans, motion, ports.sensors, strict=True))
    longest = max(span.samples / span.rate_hz for span in paths.spans)
    hz = np.array([2.1, 4.2]) / longest
    noise = [np.zeros(x.white.shape, complex) for x in left]
    plain = [
        PieceModulation.of(*one, replace(x, white=z))
        for one, x, z in zip(parts, left, noise, strict=True)
    ]
    known = [[one.exact(f)[2] for one in plain] for f in hz]
    depths = np.array([14.0, 9.0]) / np.sqrt([sum(x) for x in known])  # noise units

    def less(one: PieceModulation, x: Float, at: list[float]) -> PieceModulation:
        lines = [
            one.span.lines(one.span.damped(e), one.sensors, one.left.k) / one.span.times
            for e in one.phi * (x @ np.array(one._waves(at)))
        ]
        white = one.left.white - np.einsum("nij,rnj->rni", one.left.root, np.stack(lines))
        return PieceModulation.of(one.span, one.phi, one.sensors, replace(one.left, white=white))

    records = [[c.part for c in piece.commands] for piece in narrow.levels.records.pieces]
    for _ in range(40):
        pieces = []
        for one in plain:
            shape = one.left.white.shape
            white = rng.standard_normal(shape) + 1j * rng.standard_normal(shape)
            true = np.zeros((len(white), 5))
            turned = rng.uniform(0, 2 * np.pi, 2)
            true[0, 1::2] = depths * np.cos(turned) * one.times[0]
            true[0, 2::2] = depths * np.sin(turned) * one.times[0]
            noisy = replace(one, left=replace(one.left, white=white))
            pieces.append(less(noisy, -true, hz.tolist()))
        swings = Swings.none([one.times.size for one in plain])
        for f in hz:
            swings = swings.beside(f + rng.uniform(-0.2, 0.2) / longest)
        here = pieces
        for _ in range(4):
            swings = swings.closer(here, 1 / longest)
            here = [
                less(one, x, swings.hz.tolist())
                for one, x in zip(pieces, swings.changes, strict=True)
            ]
        for j in range(2):
            _, low, high = swings.depth(j, here, records)
            covered += [
                low < depths[j] < high,
                abs(swings.hz[j] - hz[j]) < NINETY * math.sqrt(swings.off[j, j]),
            ]
    low, high = stats.binom.ppf([0.005, 0.995], len(covered), 0.9)
    assert low <= np.sum(covered) <= high, np.sum(covered)


def swinging(nothing: ForceSearch, site: str, hz: float, depth: float) -> ForceSearch:
    """The same on records of a rig in which a spring swings."""
    place = next(
        e.force.place for e in nothing.forces if e.force and e.force.law is HARDENING and
        e.site == site
    )  # fmt: skip
    k, made = nothing.paths.scale((site, "k")), []
    pieces = piece_modulations(nothing, place, nothing.unexplained(nothing.nominal.fitted))
    ports = nothing.paths.ports(place, of_speed=False)
    assert ports is not None
    for one, piece, back in zip(pieces, nothing.levels.records.pieces, ports.back, strict=True):
        changes = np.zeros((one.times.size, 3))
        changes[0, 1] = -depth * k * one.times[0]
        parts = [c.part for c in piece.commands]
        made.append(_less(piece, -one.added(changes, [hz], back, parts)))
    records = replace(nothing.levels.records, pieces=tuple(made))
    return nothing.on(replace(nothing.levels, records=records), nothing.nominal.fitted)


@pytest.mark.slow  # half a minute of a core
def test_a_swing_that_is_put_into_the_records_is_taken_out_again(nothing: ForceSearch) -> None:
    """By as much as it was put in, to first order in all else that is refitted."""
    hz, depth = 0.7, 0.02
    records = swinging(nothing, "joint_2", hz, depth)
    found = variation(BySpring.of(records, replace(nothing.nominal)), 3)
    assert found is not None
    # Each with the noise that it leaves: what has the swing for noise is far less likely.
    assert found.likelihood > of_its_own(records, nothing.nominal) + 100.0
    assert found.sites[0][0] == "joint_2"
    told = found.parameters["depth"]
    assert told.low is not None
    assert told.high is not None
    assert told.value == pytest.approx(depth, abs=2 * (told.high - told.low))
    assert found.parameters["f"].value == pytest.approx(hz, rel=0.02)
    assert found.inside
    assert found.after[0] < found.before[0]


@pytest.mark.slow  # a minute of a core
def test_which_spring_swings_is_decided_without_the_swing_in_the_noise(
    nothing: ForceSearch, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A neighbour that explains nearly as much while what varies stands in the noise, and is looked
    at first, is not the one."""
    strongest, seen = Springs.strongest, []

    def neighbour_first(*args: Any) -> list[tuple[str, Modulation]]:
        found = strongest(*args)
        seen.append([site for site, _ in found])
        return [*found[1::-1], *found[2:]]

    monkeypatch.setattr(Springs, "strongest", neighbour_first)
    found = variation(
        BySpring.of(swinging(nothing, "joint_2", 1.0, 0.0028), replace(nothing.nominal)), 3
    )
    assert seen[0][:2] == ["joint_2", "joint_1"]
    assert found is not None
    (site, sure), (other, _) = found.sites[:2]
    assert (site, other) == ("joint_2", "joint_1")
    assert sure > 0.99
    assert found.parameters["f"].value == pytest.approx(1.0, rel=0.01)


def test_what_is_gone_once_the_rig_moves_as_it_is_fitted_does_not_vary(
    narrow: ForceSearch, monkeypatch: pytest.MonkeyPatch
) -> None:
    found = iter(2 * [[("joint_2", Modulation(0.7, 40.0, 6, 1e-6))]])  # then in its own noise
    monkeypatch.setattr(Springs, "strongest", lambda *_: next(found, []))
    assert variation(BySpring.of(narrow, replace(narrow.nominal)), 3) is None


def test_a_stiffness_is_weighed_in_the_noise_that_its_explanation_leaves(
    narrow: ForceSearch,
) -> None:
    """Not in that of another fit, which all that tells it anew would gain on."""
    problem, nominal = narrow.problem, narrow.nominal
    assert isinstance(problem, ForceProblem)
    noise = problem.reduced.noise
    noise = replace(noise, about=9 * noise.about)
    loud = copy(narrow)
    loud.problem = replace(problem, reduced=replace(problem.reduced, noise=noise))
    usual = likelihood(narrow, nominal.fitted)
    assert likelihood(loud, nominal.fitted) < usual - 1000.0
    own = BySpring.of(loud, nominal).in_own_noise()
    assert likelihood(own.search, own.best.fitted) == pytest.approx(usual, abs=1.0)


def shown_by(each: list[tuple[float, float]]) -> Modulation:
    """A modulation of two phases in each of some records. each : chi-square, known."""
    rows = np.array([(chi2, 2.0, known) for chi2, known in each])
    return Modulation(3.0, float(rows[:, 0].sum()), 2 * len(rows), 1.0, each=rows)


def test_records_that_show_a_swing_alike_weigh_it_as_a_whole() -> None:
    alike = shown_by([(12.0, 0.3), (9.0, 0.3), (15.0, 0.3)])
    chi2, n = 36.0, 6
    closed = (chi2 - n - n * math.log(chi2 / n)) / 2 - math.log(alike.trials)
    assert alike.evidence == pytest.approx(closed, abs=0.01)


def test_what_only_records_have_that_hardly_show_it_is_no_swing() -> None:
    shown, hardly = 1e-3, 1e-5
    swing = shown_by([(20.0, shown), (25.0, shown), (2.0, hardly), (3.0, hardly)])
    other = shown_by([(2.0, shown), (3.0, shown), (20.0, hardly), (25.0, hardly)])
    assert other.chi2 == swing.chi2
    assert swing.evidence > 10 > other.evidence


@pytest.mark.parametrize("in_time", [True, False])
def test_repeats_of_one_input_differ_by_what_swings_and_not_by_a_law_of_the_motion(
    nothing: ForceSearch, in_time: bool
) -> None:
    """Of both the sum of all repeats holds as much."""
    rng, paths, hz = np.random.default_rng(9), nothing.paths, 0.4
    left = nothing.unexplained(nothing.nominal.fitted)
    spring = next(e.force for e in nothing.forces if e.force and e.force.law is HARDENING)
    ports = paths.ports(spring.place, of_speed=False)
    assert ports is not None
    motion = paths.motion(spring.place, of_speed=False)
    pieces = []
    for span, phi, sensors, x in zip(paths.spans, motion, ports.sensors, left, strict=True):
        t = np.arange(phi.size) * (span.samples / span.n / span.rate_hz)
        force = phi * np.cos(2 * np.pi * hz * t)
        added = span.lines(span.damped(force), sensors, x.k)
        added *= 12 / np.linalg.norm(np.einsum("nij,nj->ni", x.root, added))
        noise = rng.standard_normal((2, 3, *x.white.shape[1:]))  # a sum of three, and differences
        white = noise[0] + 1j * noise[1]
        rows = range(len(white)) if in_time else range(1)
        for row in rows:
            white[row] += np.einsum("nij,nj->ni", x.root, added)
        pieces.append(PieceModulation.of(span, phi, sensors, replace(x, white=white)))
    assert _repeats_differ(pieces, hz) is in_time
