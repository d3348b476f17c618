"""What the tests of the concealed plant share: it without noise, and rig files with an addition."""

from __future__ import annotations

import re

import numpy as np

from samii_rig.model.sampled import sensor_response
from samii_rig.model.tmm import Chain
from samii_rig.rig.load import load_rig, parse
from samii_rig.rig.schema import Rig
from samii_rig.types import Complex, Float
from sim.concealed.integrate import INNER, Loop, run, tabulate
from sim.concealed.modes import poles_of
from sim.concealed.parts import Description

SAMII, SAMII_TOML = load_rig("samii")
FREQUENCY = np.geomspace(0.4, 50.0, 60)


def loop(sensors: int, kp: float = 0.0, drives: int = 1) -> Loop:
    """Converters that round and clip nothing; each drive is centred by the sensor of its number."""
    wide, far, none = np.full(sensors, np.inf), np.full(drives, 1e9), np.zeros(drives)
    return Loop(
        np.arange(drives), np.full(drives, kp), -far, far, none, -wide, wide, np.zeros(sensors),
        none, np.full(drives, np.inf),
    )  # fmt: skip


def driven(
    plant: Description, u: Float, kp: float = 0.0, inner: int = INNER
) -> tuple[Float, Float, Float]:
    """v (n, d), sensors and the probes' peaks without noise; u (n, d), or (n,) for one drive."""
    m, d = len(plant.sensors), len(plant.drives)
    tables = tabulate(poles_of(plant), plant, inner)
    u = u.reshape(-1, d)
    push, error = np.zeros(len(u)), np.zeros((len(u), m))
    return run(tables, loop(m, kp, d), u, np.zeros_like(u), push, error)


def settled(plant: Description, u: Float, periods: int, kp: float = 0.0) -> tuple[Float, Complex]:
    """(lines Hz, response) from the last of many periods of u, lines where it is driven."""
    n = u.size
    v, y, _ = driven(plant, np.tile(u, periods), kp)
    U, V, Y = np.fft.rfft(u), np.fft.rfft(v[-n:, 0]), np.fft.rfft(y[-n:], axis=0)
    lines = np.flatnonzero(np.abs(U) > 1e-6 * np.abs(U).max())
    return lines * plant.rate_hz / n, Y[lines] / V[lines, None]


def continuous(plant: Description, f: Float) -> Complex:
    """(n_freq, n_sensor) response of the plant's poles, without hold and pure delays."""
    poles = poles_of(plant)
    return poles.continuous(2j * np.pi * f)[:, : poles.delay.size, 0]


def modelled(toml: str, f: Float) -> Complex:
    """The same of the transfer matrix model of a rig file."""
    rig = parse(Rig, toml, "test")
    ideal = [s.model_copy(update={"delay": 0.0}) for s in rig.sensor]
    return Chain(rig).response(f)[:, :, 0] * sensor_response(ideal, f)


def added(toml: str, after: str, element: str, *, spanned_by: str = "") -> str:
    """A rig file with one more element, which the encoder across `spanned_by` spans too."""
    start = toml.index(f'name = "{after}"')
    at = toml.index("\n[[", start)
    toml = toml[:at] + f'\n[[element]]\nname = "hidden"\n{element}\n' + toml[at:]
    if spanned_by:
        toml = re.sub(rf'across = \["{spanned_by}"', f'across = ["{spanned_by}", "hidden"', toml)
    return toml


def quantity(symbol: str, value: float, unit: str) -> str:
    """A line of a rig file."""
    return f'{symbol} = {{ value = {value!r}, unit = "{unit}", source = "test" }}\n'
