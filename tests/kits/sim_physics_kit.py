"""What tests of the sim physics share."""

import numpy as np

PERIOD = 10_000  # samples


LINES = np.arange(2, PERIOD // 10 + 1, 7)  # to 50 Hz at 500 samples/s


def multisine(periods, amplitude, seed=1):
    rng = np.random.default_rng(seed)
    X = np.zeros(PERIOD // 2 + 1, dtype=complex)
    X[LINES] = np.exp(2j * np.pi * rng.random(LINES.size))
    one = np.fft.irfft(X)
    return np.tile(one * amplitude / np.abs(one).max(), periods)


def last_period(values):
    return np.fft.rfft(values[-PERIOD:], axis=0)[LINES]
