"""What is in a record beside response and noise."""

from __future__ import annotations

import numpy as np
import pytest

from samii_rig.likelihood import nuisance
from samii_rig.likelihood.pieces import Piece
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
@pytest.mark.parametrize("kind", ["jump", "turn"])
def test_an_edge_between_two_samples_is_known_but_for_its_size_and_instant(kind: str, tau: float):
    s = 2j * np.pi * np.arange(N // 2 + 1) / N
    k = np.arange(5, int(0.44 * N))
    # Of a band's spectrum, folded: what is sampled of a jump or a turn at AT + tau, less its own.
    of = 1 if kind == "jump" else 2
    others = 2j * np.pi * np.array([i for i in range(-3000, 3001) if i])
    beyond = sum(np.exp(-(s[k] + o) * (AT + tau)) / (s[k] + o) ** of for o in others)
    impulse = np.fft.irfft(response(s))[:, None]
    piece = Piece("steps", np.zeros(N), np.zeros((N, 1)), 0, (), edges=((AT, 0), (AT + 1, 0)))
    shapes = nuisance.edges(piece, k, impulse)
    assert shapes.shape == (k.size, 1, 4)
    left = fraction_of(response(s[k]) * beyond, shapes)
    assert left < 0.01
    assert left < fraction_of(response(s[k]) * beyond, impulses(piece, k, impulse)) / 2


def impulses(piece: Piece, k: Int, impulse: Float) -> Complex:
    """An impulse at each edge."""
    alone = [
        nuisance.edges(Piece("one", piece.r, piece.z, 0, (), edges=((at, 0),)), k, impulse)
        for at, _ in piece.edges
    ]
    return np.concatenate(alone, axis=2)
