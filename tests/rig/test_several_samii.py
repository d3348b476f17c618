"""SAMII driven at joints 2 and 3: eight responses from recordings made of the transfer matrices.

A periodic motion is known line by line: V = (I + F H)^-1 U with loops F around the inputs, and
Y = H V. H is the response of the sampled rig by transfer matrices alone.
"""

from __future__ import annotations

import numpy as np
import pytest

from samii_rig.model.sampled import sampled_response
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
