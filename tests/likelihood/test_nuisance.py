"""What is in a record beside response and noise."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from scipy import signal, special

from samii_rig.likelihood import nuisance
from samii_rig.likelihood.algebra import Shrinking, as_real
from samii_rig.likelihood.complete import Complete
from samii_rig.likelihood.inputs import BESIDE_TURN
from samii_rig.likelihood.pieces import Piece, _cut_off
from samii_rig.likelihood.rows import Rows
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


EVERY, LINES = 5, np.arange(5, int(0.44 * N))


def left_by(u: Float) -> tuple[Float, Complex, Float, tuple[Float, ...]]:
    """Of a rig with a mode above half the rate, of which every fifth sample was recorded, under an
    input u (n EVERY,): what was recorded of u, the lines that a response up to half the rate leaves
    of what the rig does, its answer to an impulse, and `nuisance.folding`."""
    many = 8 * N
    modes = [(0.12, 0.01), (0.8, 0.003)]  # of the record's rate, damping
    A = np.zeros((4, 4))
    for i, (f, zeta) in enumerate(modes):
        w = 2 * np.pi * f / EVERY
        A[2 * i : 2 * i + 2, 2 * i : 2 * i + 2] = [[0.0, w], [-w, -2 * zeta * w]]
    B = np.array([[0.0], [1.0], [0.0], [1.0]])
    C = np.array([[1.0, 0.0, 0.3, 0.0]])
    rig = signal.cont2discrete((A, B, C, np.zeros((1, 1))), 1.0)
    once = np.zeros(N * EVERY)
    once[0] = 1.0
    z, fine = (signal.dlsim(rig, x)[1][:, 0] for x in (u, once))
    r = u[::EVERY]
    # In the band, of a record that is long enough, beyond it nothing.
    f = np.arange(many // 2 + 1) / many
    turn = np.exp(2j * np.pi * f / EVERY)
    H = np.array([(rig[2] @ np.linalg.solve(x * np.eye(4) - rig[0], rig[1]))[0, 0] for x in turn])
    H *= special.erfc((2 * f - 1) / 0.03) / 2
    impulse = np.fft.irfft(H)[:, None]
    e = np.fft.rfft(z[::EVERY] - np.fft.irfft(H * np.fft.rfft(r, many))[:N])[LINES]
    return r, e, impulse, nuisance.folding(impulse, fine[:, None], EVERY)


def shapes_of(r: Float, at: range, impulse: Float, folded: tuple[Float, ...] = ()) -> Complex:
    """Of edges around some samples."""
    edges = tuple((i, 0) for i in at)
    piece = Piece("steps", r, np.zeros((N, 1)), 0, (), edges=edges)
    return nuisance.edges(piece, LINES, impulse, folded)


@pytest.mark.parametrize("late", [0, 1, 4])
def test_what_an_edge_excites_above_half_the_rate_folds_back(late: int) -> None:
    u = np.zeros(N * EVERY)
    u[AT * EVERY + late :] = 1.0
    r, e, impulse, folded = left_by(u)
    around = range(AT - 1, AT + 2)
    both = fraction_of(e, shapes_of(r, around, impulse, folded))
    assert both < 0.01
    assert fraction_of(e, shapes_of(r, around, impulse)) > 10 * both


@pytest.mark.parametrize("late", [-0.5, 2.0])
def test_of_a_sweep_that_turns_near_half_the_rate_more_folds_back(late: float) -> None:
    n = np.abs(np.arange(N * EVERY) - AT * EVERY - late)
    u = np.sin(2 * np.pi * 0.37 / EVERY * n + 0.9) * np.exp(-((n / (EVERY * N / 10)) ** 2))
    r, e, impulse, folded = left_by(u)
    two = fraction_of(e, shapes_of(r, range(AT, AT + 2), impulse, folded))
    beside = range(AT - BESIDE_TURN, AT + 2 + BESIDE_TURN)
    assert fraction_of(e, shapes_of(r, beside, impulse, folded)) < two / 5


def impulses(piece: Piece, k: Int, impulse: Float) -> Complex:
    """An impulse at each edge."""
    alone = [
        nuisance.edges(Piece("one", piece.r, piece.z, 0, (), edges=((at, 0),)), k, impulse)
        for at, _ in piece.edges
    ]
    return np.concatenate(alone, axis=2)


def test_all_lines_count_as_in_the_noise_of_sensors_and_of_a_measured_force() -> None:
    """Of what `split` gives, the square is that of lines in both noises: also where a part of it is
    along what the force's noise does."""
    rng = np.random.default_rng(2)
    n, q, b = 40, 2, 3
    X, A, e = (
        rng.normal(size=s) + 1j * rng.normal(size=s) for s in ((n, 2 * b), (n, q, 4), (n, q))
    )
    flat = as_real(A.reshape(-1, 4))
    whole = Complete(
        SimpleNamespace(), rows_of_lines(e), as_real(X), np.tile(np.eye(q), (n, 1, 1)),
        ((np.arange(n), Shrinking.of(flat, np.ones(4))),), factor_of(X, flat, q), likely=True,
    )  # fmt: skip
    both = np.eye(2 * n * q) + flat @ flat.T
    want = as_real(e.ravel()) @ np.linalg.solve(both, as_real(e.ravel()))
    parts = whole.split(e)
    assert parts @ parts == pytest.approx(want)


def rows_of_lines(e: Complex) -> Rows:
    at = np.arange(len(e))
    return Rows((), e, (), (), at + 1.0, at, np.zeros(len(e), int), at)


def factor_of(X: Complex, flat: Float, q: int) -> Float:
    """Of the products of all changes' columns, sensor by sensor, in both noises."""
    n, size = X.shape
    columns = np.zeros((n, q, q * size), complex)
    for c in range(q):
        columns[:, c, c * size : (c + 1) * size] = X
    every = as_real(columns.reshape(n * q, -1))
    left = every - flat @ np.linalg.solve(np.eye(flat.shape[1]) + flat.T @ flat, flat.T @ every)
    return np.linalg.cholesky(every.T @ left).T


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
