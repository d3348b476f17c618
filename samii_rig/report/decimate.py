"""Long time series as few points as a screen can show, with nothing tall left out."""

from __future__ import annotations

import numpy as np

from samii_rig.types import Float, Int


def envelope(values: Float, pixels: int) -> tuple[Int, Int]:
    """Indices (low, high) of the smallest and the largest value in each of `pixels` bins.

    values : (n,), n > 0. Both results are (min(pixels, n),). NaN loses against any number.
    """
    n = len(values)
    edges = np.linspace(0, n, min(pixels, n) + 1).astype(np.int64)
    size = int(np.diff(edges).max())
    at = edges[:-1, None] + np.arange(size)
    inside = at < edges[1:, None]
    at = np.where(inside, at, edges[:-1, None])  # repeat the first: it changes no extremum
    bins = values[at]
    low = np.argmin(np.where(np.isnan(bins), np.inf, bins), axis=1)
    high = np.argmax(np.where(np.isnan(bins), -np.inf, bins), axis=1)
    rows = np.arange(len(at))
    return at[rows, low], at[rows, high]


def thin(time: Float, values: Float, pixels: int) -> tuple[Float, Float]:
    """A curve of at most 2 * `pixels` points whose drawn outline is that of the whole."""
    if len(values) <= 2 * pixels:
        return time, values
    low, high = envelope(values, pixels)
    at = np.sort(np.stack([low, high], axis=1), axis=1).reshape(-1)
    return time[at], values[at]
