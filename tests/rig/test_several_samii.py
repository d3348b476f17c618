"""SAMII driven at joints 2 and 3: eight responses from recordings made of the transfer matrices.

A periodic motion is known line by line: V = (I + F H)^-1 U with loops F around the inputs, and
Y = H V. H is the response of the sampled rig by transfer matrices alone.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from samii_rig.diagnose.data.measured import binned, measured
from samii_rig.identify.data import collect
from samii_rig.identify.parameters import space
from samii_rig.identify.predict import Predictor
from samii_rig.model.sampled import sampled_response
from samii_rig.record.convert import arrays
from samii_rig.record.response import decode, encode
from samii_rig.report.compare import model_curve
from samii_rig.rig.load import load_rig
from samii_rig.rig.schema import Parameter, Rig
from samii_rig.signal.estimate import estimate
from samii_rig.types import Channel, Complex, Recording, Segment

PERIOD = 10.0  # s
BAND = (0.6, 30.0)  # Hz
RATE = 500.0  # samples/s, the rig's
LOOP = np.array([[4.0, 0.0, 0.0, 0.0], [0.5, 0.0, 0.0, 0.0]])  # V/rad, of theta_2
NOISE = 1e-6  # of each output's rms, so that the estimate's own errors show
PERIODS = 3  # of each experiment, the first of which the estimate leaves out


def two_joints() -> Rig:
    """SAMII with a second source, before joint 3's spring, as `samii_joint_3` has it."""
    rig, _ = load_rig("samii")
    source = next(e for e in rig.element if e.name == "joint_2_source")
    gain = Parameter(value=0.6, unit="rad/(s V)", tolerance=0.05, source="[chosen] samii_joint_3")
    second = source.model_copy(update={"name": "joint_3_source", "input": "v_3", "K": gain})
    at = [e.name for e in rig.element].index("joint_3")
    first = rig.actuator[0]
    return rig.model_copy(
        update={
            "element": (*rig.element[:at], second, *rig.element[at:]),
            "actuator": (first, first.model_copy(update={"name": "v_3"})),
        }
    )


@pytest.fixture(scope="module")
def lines():
    """(line numbers of the band, H (n_freq, 4, 2) there)."""
    number = np.arange(round(BAND[0] * PERIOD), round(BAND[1] * PERIOD) + 1)
    return number, sampled_response(two_joints(), number / PERIOD)


def experiment(U: Complex, lines, loop: np.ndarray, rng: np.random.Generator, name: str):
    """A recording of periods in which the references are U (n_freq, 2)."""
    number, H = lines
    n = round(PERIOD * RATE)
    V = np.linalg.solve(np.eye(2) + loop @ H, U[:, :, None])
    columns = np.concatenate([U, V[:, :, 0], (H @ V)[:, :, 0]], axis=1)
    spectrum = np.zeros((n // 2 + 1, 8), complex)
    spectrum[number] = columns
    one = np.fft.irfft(spectrum, n, axis=0)
    values = np.tile(one, (PERIODS, 1))
    rms = one[:, 4:].std(axis=0)
    noise = NOISE * rms * rng.normal(size=(len(values), 4))
    values[:, 4:] += noise
    values[:, 2:4] -= noise @ loop.T  # what the loops make of it at once
    rig = two_joints()
    channels = [Channel(f"u_{k}", "V", "reference") for k in (2, 3)]
    channels += [Channel(a.name, a.unit, "command") for a in rig.actuator]
    channels += [Channel(s.name, s.unit, "sensor") for s in rig.sensor]
    count = np.arange(len(values), dtype=np.int64)
    return Recording(
        tuple(channels),
        RATE,
        (count * round(1e9 / RATE)).astype(np.int64),
        count,
        values,
        np.zeros(values.shape, np.uint8),
        (Segment("periods", "periodic", 0, len(values), 0.5, "V"),),
        source=name,
    )


def within(found, lines):
    """Largest relative and angular (degrees) deviation of any of the eight entries."""
    number, H = lines
    at = np.searchsorted(number, np.round(found.frequency * PERIOD).astype(int))
    ratio = found.H / H[at]
    return np.abs(np.abs(ratio) - 1).max(), np.abs(np.degrees(np.angle(ratio))).max()


@pytest.mark.parametrize("loop", [0 * LOOP, LOOP], ids=["open loop", "closed loop"])
def test_multisines_together_give_the_eight_responses_of_the_transfer_matrices(lines, loop):
    rng, number = np.random.default_rng(4), lines[0]
    made = []
    for k in range(2):
        U = np.exp(2j * np.pi * rng.random((number.size, 2)))
        for sign in (1, -1):
            made.append(experiment(U * [1, sign], lines, loop, rng, f"{k}, {sign}"))
    (found,) = estimate(made)
    assert found.H.shape == (number.size, 4, 2)
    assert [c.name for c in found.outputs] == ["theta_2", "a_0", "a_1", "a_2"]
    gain, angle = within(found, lines)
    assert gain < 0.002
    assert angle < 0.2


@pytest.mark.parametrize("loop", [0 * LOOP, LOOP], ids=["open loop", "closed loop"])
def test_sweeps_one_after_the_other_give_the_same_eight(lines, loop):
    rng, number = np.random.default_rng(5), lines[0]
    # The phase of a linear sweep over the band within a period.
    phase = -np.pi * (number - number[0]) ** 2 / (number[-1] - number[0])
    made = []
    for i in range(2):
        U = np.zeros((number.size, 2), complex)
        U[:, i] = np.exp(1j * phase)
        made.append(experiment(U, lines, loop, rng, f"input {i}"))
    (found,) = estimate(made)
    gain, angle = within(found, lines)
    assert found.frequency.size == number.size
    assert gain < 0.002
    assert angle < 0.2


def of_one_joint(lines, level=1.0):
    """A recording in which v_2 is driven; v_3 has a reference that rests, and a loop."""
    rng, number = np.random.default_rng(6), lines[0]
    U = np.zeros((number.size, 2), complex)
    U[:, 0] = level * np.exp(2j * np.pi * rng.random(number.size))
    made = experiment(U, lines, LOOP, rng, "one joint")
    names = {"u_2": "u_v_2", "u_3": "u_v_3"}
    channels = tuple(replace(c, name=names.get(c.name, c.name)) for c in made.channels)
    return replace(made, channels=channels)


def test_of_one_joint_driven_the_other_is_said_not_to_be_excited(lines):
    """v_3 moves, as its loop feeds back what v_2 does: no column of it is estimated, and that of
    v_2 is the transfer matrices' with this loop closed."""
    made = of_one_joint(lines)
    (found,) = estimate([made])
    number, H = lines
    assert [c.name for c in found.inputs] == ["v_2"]
    assert [c.name for c in found.outputs] == ["theta_2", "a_0", "a_1", "a_2"]
    assert found.covariance.shape == (found.frequency.size, 4, 4)
    assert np.linalg.eigvalsh(found.covariance).min() > 0
    assert [c.name for c in found.followers] == ["v_3"]
    at = np.searchsorted(number, np.round(found.frequency * PERIOD).astype(int))
    moved = -LOOP[1, 0] * H[at, 0, 0] / (1 + LOOP[1, 0] * H[at, 0, 1])  # v_3 = -F theta_2
    assert np.allclose(found.follow[:, 0, 0], moved, rtol=2e-3)
    closed = H[at, :, 0] + H[at, :, 1] * moved[:, None]
    assert np.abs(found.H[:, :, 0] / closed - 1).max() < 0.002
    assert np.abs(H[at, :, 0] / closed - 1).max() > 0.02  # the loop shows
    (note,) = [f for f in found.findings if f.kind == "closed_loop"]
    assert note.message.startswith("v_3 was not excited, its loop alone moved it")
    assert (note.severity, note.channel) == ("note", "v_3")
    (named,) = estimate([made], input="v_2")
    assert np.array_equal(named.H, found.H)


def test_a_model_is_held_against_it_with_that_loop_closed(lines):
    """By the report, by `identify` and by the lines of `diagnose`, which fit both columns."""
    (found,) = estimate([of_one_joint(lines)])
    rig = two_joints()
    curve = model_curve(rig, [found])
    assert np.abs(curve.like(found) / found.H - 1).max() < 0.002
    data = collect([found], rig)
    (own,) = Predictor(rig, data, space(rig, ["joint_3.k"])).response(np.zeros(1))
    assert np.abs(own / data.lines[0].H - 1).max() < 0.01  # but for the aliases
    fitted = measured([found], rig)
    at, where = fitted.frequency, list(zip(fitted.sensor, fitted.actuator, strict=True))
    H = sampled_response(rig, at)
    truth = np.stack([H[:, s, a] for s, a in where], axis=1)
    assert {a for _, a in where} == {0, 1}
    open_loop = truth * np.array([a == 0 for _, a in where])
    assert fitted.per_dof(truth) * 100 < fitted.per_dof(open_loop)
    # Bins of lines know the sum of both columns alone, and no direction of it is made up.
    few = binned(fitted, truth, bins=20)
    left = truth[np.searchsorted(at, few.frequency)]
    assert few.per_dof(left) * 100 < few.per_dof(left * np.array([a == 0 for _, a in where]))


def test_a_recording_keeps_what_was_not_excited(lines):
    (found,) = estimate([of_one_joint(lines)])
    again = decode(encode(found))
    assert again.followers == found.followers
    assert np.array_equal(again.follow, found.follow)
    assert arrays(found)["followers"].tolist() == ["v_3"]
