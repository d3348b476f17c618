"""Modes from responses: the model's poles, zeros and shapes, with intervals that hold them."""

import numpy as np
import pytest
from identify_kit import drawn, noiseless, samii
from rich.console import Console

from samii_rig.errors import InputError
from samii_rig.identify.conservative import Conservative
from samii_rig.identify.modal import estimate_modes
from samii_rig.identify.table import modes_table
from samii_rig.model.realise import realise


@pytest.fixture(scope="module")
def poles():
    p = realise(samii()).poles
    p = p[(p.imag > 0) & (np.abs(p) < 2 * np.pi * 40)]
    return p[np.argsort(np.abs(p))]


@pytest.fixture(scope="module")
def found():
    return estimate_modes(drawn(samii(), 3, n=200), samii())


def test_without_noise_the_poles_are_those_of_the_chain(poles):
    like = noiseless(samii(), np.geomspace(0.5, 40, 150), relative=1e-4)
    modes = estimate_modes(like, samii(), n_pairs=6).modes
    assert len(modes) == len(poles) == 3
    for mode, pole in zip(modes, poles, strict=True):
        assert abs(mode.pole / pole - 1) < 1e-5


def test_several_modes_at_once_each_with_its_interval(found, poles):
    assert found.fit.holds
    assert len(found.modes) == 3
    for mode, pole in zip(found.modes, poles, strict=True):
        f, zeta = abs(pole) / 2 / np.pi, -pole.real / abs(pole)
        assert abs(mode.frequency_hz.value - f) < 4 * mode.frequency_hz.sd
        assert abs(mode.damping.value - zeta) < 4 * mode.damping.sd
        assert mode.frequency_hz.sd < 0.002 * f


def test_intervals_of_frequencies_and_damping_hold_the_truth(poles):
    inside = []
    for seed in range(8):
        modes = estimate_modes(drawn(samii(), seed, n=100), samii(), n_pairs=5).modes
        for mode, pole in zip(modes, poles, strict=True):
            low, high = mode.frequency_hz.interval()
            inside.append(low < abs(pole) / 2 / np.pi < high)
            low, high = mode.damping.interval()
            inside.append(low < -pole.real / abs(pole) < high)
    assert 0.8 < np.mean(inside) < 0.98


def test_the_zeros_of_the_base_are_found(found):
    chain = Conservative(samii(), (0.2, 60.0))
    for output in ("theta_2", "a_0", "a_2"):
        wanted = chain.damped(chain.zeros(output), output)
        for z in wanted[wanted < 30]:
            near = min(found.zeros_of(output), key=lambda x: abs(x.frequency_hz.value - z))
            assert abs(near.frequency_hz.value - z) < 4 * near.frequency_hz.sd + 1e-3 * z


def test_the_shape_of_mode_1_is_that_of_the_chain(found):
    chain = Conservative(samii(), (0.2, 60.0))
    f1 = float(chain.frequencies()[0])
    ratio = found.shape_ratio(0, "a_0", "a_1")
    # Damping turns the shape by a per mille: it is not that of the undamped chain to the digit.
    assert ratio.value == pytest.approx(chain.shape_ratio(f1, "a_0", "a_1"), rel=5e-3)
    assert 0 < ratio.sd < 0.01
    mode = found.modes[0]
    assert mode.shape[mode.reference] == 1


def test_a_mode_that_is_not_there_is_not_called_one(found):
    names = [round(m.frequency_hz.value) for m in found.modes]
    assert names == [2, 7, 22]


def test_the_table_shows_modes_and_zeros(found):
    console = Console(width=160, record=True)
    console.print(modes_table(found))
    text = console.export_text()
    assert "1.70" in text
    assert "Zeros" in text


@pytest.mark.parametrize(
    ("act", "words"),
    [
        (lambda m: estimate_modes(drawn(samii(), n=30), samii(), n_pairs=90), "modes for 30 lines"),
        (lambda m: estimate_modes(drawn(samii(), n=3), samii()), "more lines"),
        (lambda m: m.zeros_of("a_9"), "one of theta_2"),
        (lambda m: m.shape_ratio(9, "a_0", "a_1"), "0 to 2"),
        (lambda m: m.shape_ratio(0, "a_0", "a_9"), "a_9"),
    ],
)
def test_what_is_asked_wrongly_is_said_in_one_line(found, act, words):
    with pytest.raises(InputError, match=words):
        act(found)
