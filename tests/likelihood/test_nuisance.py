"""What is in a record beside response and noise."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import signal, special

from samii_rig.likelihood import nuisance
from samii_rig.likelihood.pieces import Piece, _cut_off
from samii_rig.types import Complex, Float, Int

N, AT = 1024, 500


def fraction_of(e: Complex, shapes: Complex) -> float:
    """Of the lines e (n,), the part that no shapes (n, 1, m) explain."""
    columns = np.concatenate([shapes[:, 0].real, shapes[:, 0].imag])
    goal = np.concatenate([e.real, e.imag])
    left = goal - columns @ np.linalg.lstsq(columns, goal, rcond=None)[0]
    return float(np.linalg.norm(left) / np.linalg.norm(goal))


def response(s: Complex) -> Complex:
    return 1 / (s**2 + 0.05 * s + 0.6)


@pytest.mark.parametrize("tau", [0.1, 0.37, 0.8])
@pytest.mark.parametrize("kind", ["jump", "turn", "wave"])
def test_an_edge_between_two_samples_is_known_but_for_its_size_and_instant(kind: str, tau: float):
    s = 2j * np.pi * np.arange(N // 2 + 1) / N
    k = np.arange(5, int(0.44 * N))
    # Of a band's spectrum, folded: what is sampled of a jump, a turn or an oscillation of 0.4 of
    # the rate that begins at AT + tau, less its own.
    w = 0.8j * np.pi
    spectrum = {
        "jump": lambda z: 1 / z,
        "turn": lambda z: 1 / z**2,
        "wave": lambda z: z / (z**2 - w**2),
    }[kind]
    others = 2j * np.pi * np.array([i for i in range(-3000, 3001) if i])
    beyond = sum(np.exp(-(s[k] + o) * (AT + tau)) * spectrum(s[k] + o) for o in others)
    impulse = np.fft.irfft(response(s))[:, None]
    piece = Piece("steps", np.zeros(N), np.zeros((N, 1)), 0, (), edges=((AT, 0), (AT + 1, 0)))
    shapes = nuisance.edges(piece, k, impulse)
    assert shapes.shape == (k.size, 1, 7)
    left = fraction_of(response(s[k]) * beyond, shapes)
    assert left < 0.001
    assert left < fraction_of(response(s[k]) * beyond, impulses(piece, k, impulse)) / 2


@pytest.mark.parametrize("late", [0, 1, 4])
def test_what_an_edge_excites_above_half_the_rate_folds_back(late: int) -> None:
    """Of a rig with a mode there, of which every fifth sample was recorded."""
    every, many, k = 5, 8 * N, np.arange(5, int(0.44 * N))
    modes = [(0.12, 0.01), (0.8, 0.003)]  # of the record's rate, damping
    A = np.zeros((4, 4))
    for i, (f, zeta) in enumerate(modes):
        w = 2 * np.pi * f / every
        A[2 * i : 2 * i + 2, 2 * i : 2 * i + 2] = [[0.0, w], [-w, -2 * zeta * w]]
    B = np.array([[0.0], [1.0], [0.0], [1.0]])
    C = np.array([[1.0, 0.0, 0.3, 0.0]])
    rig = signal.cont2discrete((A, B, C, np.zeros((1, 1))), 1.0)
    u = np.zeros(N * every)
    u[AT * every + late :] = 1.0
    once = np.zeros(N * every)
    once[0] = 1.0
    z, fine = (signal.dlsim(rig, x)[1][:, 0] for x in (u, once))
    r = u[::every]
    # In the band, of a record that is long enough, beyond it nothing.
    f = np.arange(many // 2 + 1) / many
    turn = np.exp(2j * np.pi * f / every)
    H = np.array([(rig[2] @ np.linalg.solve(x * np.eye(4) - rig[0], rig[1]))[0, 0] for x in turn])
    H *= special.erfc((2 * f - 1) / 0.03) / 2
    impulse = np.fft.irfft(H)[:, None]
    e = np.fft.rfft(z[::every] - np.fft.irfft(H * np.fft.rfft(r, many))[:N])[k]
    piece = Piece("steps", r, np.zeros((N, 1)), 0, (), edges=((AT - 1, 0), (AT, 0), (AT + 1, 0)))
    edges = nuisance.edges(piece, k, impulse)
    folded = nuisance.folding(impulse, fine[:, None], every)
    both = nuisance.edges(piece, k, impulse, folded)
    assert fraction_of(e, both) < 0.01
    assert fraction_of(e, edges) > 10 * fraction_of(e, both)


def impulses(piece: Piece, k: Int, impulse: Float) -> Complex:
    """An impulse at each edge."""
    alone = [
        nuisance.edges(Piece("one", piece.r, piece.z, 0, (), edges=((at, 0),)), k, impulse)
        for at, _ in piece.edges
    ]
    return np.concatenate(alone, axis=2)


def test_between_its_last_samples_an_input_depends_on_those_behind_them():
    """What a record's end cuts off still shows before it, at a rate that is not the rig's own."""
    many, k = 8 * N, np.arange(5, int(0.44 * N))
    s = 2j * np.pi * np.arange(many // 2 + 1) / many
    rng = np.random.default_rng(4)
    narrow = np.where(np.abs(s) < 2 * np.pi * 0.42, 1.0, 0.0)
    going_on = np.fft.irfft(narrow * np.fft.rfft(rng.standard_normal(many)))
    going_on[many // 2 :] = 0.0  # so that it has died out where it begins
    cut = np.where(np.arange(many) < N, going_on, 0.0)
    # What the filter that stands for the input's own makes of both.
    wide = special.erfc((np.abs(s) / np.pi - 1) / 0.03) / 2
    H = wide * response(s)
    e = np.fft.irfft(H * np.fft.rfft(going_on - cut))[:N]
    piece = Piece("cut", cut[:N], np.zeros((N, 1)), 0, (), edges=tuple(_cut_off(cut[:N])))
    assert piece.edges == ((N - 1, 0), (N, 0))
    shapes = nuisance.edges(piece, k, np.fft.irfft(H)[:, None])
    lines = np.fft.rfft(e)[k]
    assert fraction_of(lines, shapes) < 0.02
    assert _cut_off(np.zeros(N)) == []
