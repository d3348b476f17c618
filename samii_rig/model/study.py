"""Parameter studies: a chain's modes over a grid of its parameters, here or on a cluster.

varied = [vary(rig, "joint_1.k=6800:27200:21:log")]
with workers(scheduler="tcp://host:8786") as executor:
    found = study(rig_toml, varied, (0.0, 50.0), executor)
found.hz, found.ratio                       # (n_points, n_modes)
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace

import numpy as np

from samii_rig.errors import InputError, SamiiRigError
from samii_rig.model.modes import Poles, determinant
from samii_rig.model.poles import find_poles
from samii_rig.model.realise import search_region
from samii_rig.model.tmm import Chain
from samii_rig.model.vary import MOST_POINTS
from samii_rig.model.vary import Varied as Varied
from samii_rig.model.vary import vary as vary
from samii_rig.rig.load import parse
from samii_rig.rig.schema import Key, Rig
from samii_rig.types import Complex, Float, Int

TOGETHER = 8  # points that are one piece of work
AT_REST = 1e-6  # Re s over the edge of the search, below which a pole is not called unstable

Point = tuple[list[tuple[int, float, float]], str]  # (number, Hz, ratio) of each mode; the note


@dataclass(frozen=True, slots=True)
class Study:
    """Modes of a chain over the full grid of the varied parameters, the last one fastest.

    point : (n_points, n_varied) values. number : (n_modes,) of each mode, counted at each point
        from the lowest pair of poles, so that two modes which cross swap numbers.
    hz, ratio : (n_points, n_modes) |s|/(2 pi) and -Re s/|s| of the pair; nan outside the band.
    note : of each point, "" or why it is unstable or has no answer.
    """

    rig: str
    band: tuple[float, float]
    varied: tuple[Varied, ...]
    point: Float
    number: Int
    hz: Float
    ratio: Float
    note: tuple[str, ...]

    def sensitivity(self, of: Float) -> Float:
        """(n_modes, n_varied) % by which `of`, hz or ratio, grows for 1 % more of a parameter, or
        for 1 % of its range where that holds 0.

        Least squares of the logarithms over the whole grid; nan for what is not above 0
        everywhere, and for a mode at too few points.
        """
        out = np.full((self.number.size, len(self.varied)), np.nan)
        x = np.ones((len(self.point), 1 + len(self.varied)))
        for i, v in enumerate(self.varied):
            p = self.point[:, i]
            x[:, 1 + i] = np.log(np.abs(p)) if v.one_sign else p / (v.values[-1] - v.values[0])
        for m, y in enumerate(of.T):
            known = np.isfinite(y)
            if (y[known] > 0).all() and np.linalg.matrix_rank(x[known]) == x.shape[1]:
                out[m] = np.linalg.lstsq(x[known], np.log(y[known]))[0][1:]
        return out


def study(
    rig_toml: str,
    varied: Sequence[Varied],
    band: tuple[float, float],
    executor: Executor,
    progress: Callable[[int, int], None] = lambda _done, _all: None,
) -> Study:
    """The modes in the band (Hz) at every point; the same wherever the executor is.

    Raises InputError for a band that is none, a parameter named twice, too many points.
    """
    rig = parse(Rig, rig_toml, "the rig file")
    keys = [v.key for v in varied]
    if not (math.isfinite(band[1]) and 0 <= band[0] < band[1]):
        raise InputError("--band", "", band, "two frequencies from 0 Hz on, the lower one first")
    if len(set(keys)) < len(keys):
        raise InputError("--vary", "", [v.name for v in varied], "each parameter once")
    count = math.prod(len(v.values) for v in varied)
    if count > MOST_POINTS:
        raise InputError("--vary", "", f"{count:,} points", f"at most {MOST_POINTS:,}")
    grid = np.meshgrid(*(v.values for v in varied), indexing="ij")
    point = np.stack([x.ravel() for x in grid], axis=1)
    waiting = [
        executor.submit(_some, rig_toml, keys, point[i : i + TOGETHER], band)
        for i in range(0, count, TOGETHER)
    ]
    found: list[Point] = []
    for future in waiting:
        found += future.result()
        progress(len(found), count)
    numbers = sorted({number for modes, _ in found for number, _, _ in modes})
    hz, ratio = np.full((2, count, len(numbers)), np.nan)
    for row, (modes, _) in enumerate(found):
        for number, f, zeta in modes:
            hz[row, numbers.index(number)], ratio[row, numbers.index(number)] = f, zeta
    note = tuple(said for _, said in found)
    return Study(rig.name, band, tuple(varied), point, np.array(numbers, int), hz, ratio, note)


def _some(
    rig_toml: str, keys: Sequence[Key], points: Float, band: tuple[float, float]
) -> list[Point]:
    chain = Chain(parse(Rig, rig_toml, "the rig file"))
    some: list[Point] = []
    near = None
    for row in points:
        point, near = _one(chain, dict(zip(keys, map(float, row), strict=True)), band, near)
        some.append(point)
    return some


def _one(
    chain: Chain, values: dict[Key, float], band: tuple[float, float], near: Complex | None
) -> tuple[Point, Complex | None]:
    """A point of the grid, and its poles, which are close to those of the next. near : those of the
    one before, None where there is none."""
    try:
        here = chain.with_values(values)
        region = search_region(here.rig, band[1])
        # An unstable pole may lie far right of the axis.
        found = find_poles(determinant(here), replace(region, right=region.top), near)
    except SamiiRigError as error:
        return ([], str(error).removeprefix("with_values: ")), None
    p = Poles(found.poles, found.multiplicity, {}, found)
    times = p.multiplicity * p.oscillating
    modes = [
        (number, float(f), float(zeta))
        for number, (f, zeta) in enumerate(
            zip(np.repeat(p.hz, times), np.repeat(p.ratio, times), strict=True), 1
        )
        if band[0] <= f <= band[1]
    ]
    worst = p.pole[p.pole.real.argmax()] if p.pole.size else 0j
    unstable = worst.real > AT_REST * region.top
    note = f"unstable: pole at {worst:.6g} rad/s" if unstable else ""
    return (modes, note), found.poles
