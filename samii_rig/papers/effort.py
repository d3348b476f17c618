"""Generality and effort (paper 1, section V): both methods side by side, measured."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from functools import partial

import numpy as np

from samii_rig.fem.model import Fem
from samii_rig.fem.reduce import reduce
from samii_rig.identify.conservative import Conservative
from samii_rig.model.tmm import Chain
from samii_rig.papers.result import (
    Curve,
    Label,
    Mark,
    Number,
    Panel,
    Picture,
    Result,
    between,
    shown,
)
from samii_rig.papers.rigs import samii
from samii_rig.papers.tables import BAND, ELEMENTS

MESHES = (2, 4, 8, 15, 30, 60)
GRID = np.geomspace(0.1, 50.0, 400)  # Hz
REPEATS = 5
MODE = 3  # the fourth, the one that a coarse mesh feels most
CONVERGENCE = (3.5, 4.5)  # order of a Hermite beam with a consistent mass is 4
KEPT = (2, 4, 6, 8, 12, 16)  # flexible modes of the reduction
TOP_HZ = 10.0


def order_of_convergence() -> tuple[np.ndarray, np.ndarray, float]:
    """(elements, relative error of mode 4 against the transfer matrices, order)."""
    exact = Conservative(samii(), BAND).frequencies()[MODE]
    meshes = np.array(MESHES, dtype=float)
    error = np.array(
        [Fem(samii(), n).modes(MODE + 1).frequency_hz[MODE] / exact - 1 for n in MESHES]
    )
    few = meshes <= ELEMENTS
    order = -float(np.polyfit(np.log(meshes[few]), np.log(error[few]), 1)[0])
    return meshes, error, order


def section_5() -> Result:
    """Time to build and to solve, and the error that it buys."""
    truth = Chain(samii()).response(GRID)
    meshes, error, order = order_of_convergence()
    build, solve, off = [], [], []
    for n in MESHES:
        fem = Fem(samii(), n)
        build.append(_ms(partial(Fem, samii(), n)))
        solve.append(_ms(partial(fem.response, GRID)))
        off.append(float(np.max(np.abs(fem.response(GRID) / truth - 1))))
    chain = Chain(samii())
    tmm_build, tmm_solve = _ms(lambda: Chain(samii())), _ms(lambda: chain.response(GRID))
    fem = Fem(samii(), ELEMENTS)
    roots = _ms(lambda: Conservative(samii(), BAND).frequencies())
    fem_roots = _ms(fem.modes)
    at = MESHES.index(ELEMENTS)
    coordinates, multipliers = fem.size
    inside = GRID[GRID <= TOP_HZ]
    full = fem.response(inside)
    kept = np.array(
        [
            np.max(np.abs(reduce(fem, n).response(inside) - full) / np.abs(full).max(axis=0))
            for n in KEPT
        ]
    )
    numbers: list[Number] = [
        between("FEM: order of convergence, mode 4", order, "", *CONVERGENCE, digits=2),
        between("FEM: error of mode 4, 15 elements", error[at], "", 0.0, 1e-5, digits=1),
        between(
            "FEM: error of the response to 50 Hz, 15 elements", off[at], "of H", 0, 1e-3, digits=1
        ),
        shown("FEM: coordinates and multipliers", coordinates + multipliers, "", "89 d.o.f.", 2),
        shown("TMM: size of the matrix", 4, "", "4 x 4", 1),
        between(
            "FEM, 4 flexible modes: error to 10 Hz",
            100 * kept[KEPT.index(4)],
            "% of peak",
            0,
            5,
            digits=2,
        ),
        shown("FEM, 16 flexible modes: error to 10 Hz", 100 * kept[-1], "% of peak", "", 2),
    ]
    for name, ms in (
        ("FEM: build, 15 elements", build[at]),
        ("TMM: build", tmm_build),
        ("FEM: 400 frequencies, 15 elements", solve[at]),
        ("TMM: 400 frequencies", tmm_solve),
        ("FEM: all undamped modes, 15 elements", fem_roots),
        ("TMM: natural frequencies to 60 Hz", roots),
        ("FEM: reduction to 4 flexible modes", _ms(lambda: reduce(fem))),
    ):
        numbers.append(shown(name, ms, "ms", "", 2))
    panels = (
        Panel(
            "beam elements",
            "relative error",
            (
                Curve("mode 4", meshes, np.abs(error), "points", 0),
                Curve("response to 50 Hz, most", meshes, np.array(off), "points", 1),
                Curve("h⁴", meshes, np.abs(error[0]) * (meshes / meshes[0]) ** -4.0, "dashed", 2),
            ),
            "what a finer mesh buys",
            log_y=True,
            legend="lower left",
        ),
        Panel(
            "time for 400 frequencies [ms]",
            "relative error of the response",
            (Curve("", np.array(solve), np.array(off), "points", 1),),
            "what it costs",
            marks=(Mark(f"TMM, exact: {tmm_solve:.1g} ms", tmm_solve),),
            labels=(
                Label("2 elements", solve[0], off[0], -14.0, 0.0),
                Label("60", solve[-1], off[-1], -14.0, 0.0),
            ),
            log_y=True,
            x_range=(min(tmm_solve, min(solve)) / 2, 4 * max(solve)),
        ),
        Panel(
            "flexible modes kept",
            "error to 10 Hz [% of the peak]",
            (Curve("", np.array(KEPT, dtype=float), 100 * kept, "points", 3),),
            "component-mode reduction (eq. 13, 14)",
            log_x=False,
            labels=(Label("the paper's 4", 4.0, 100 * float(kept[KEPT.index(4)]), 12.0, 12.0),),
        ),
    )
    return Result(
        tuple(numbers),
        (
            "Both give the same numbers here. Finite elements pay for generality with a matrix and "
            "a mesh; transfer matrices have no mesh, but take branches and loops only as elements.",
            "The paper's 89 degrees of freedom are not broken down; ours count 45 coordinates and "
            "11 multipliers, for axial motion is left out "
            "(docs/method/fem.md has a count that gives 89).",
        ),
        (
            Picture(
                "p1-section-5",
                "Paper 1, section V: finite elements and transfer matrices, error against cost",
                panels,
                columns=3,
                width=11.0,
                height=3.4,
            ),
        ),
    )


def _ms(call: Callable[[], object]) -> float:
    times = []
    for _ in range(REPEATS):
        start = time.perf_counter()
        call()
        times.append(time.perf_counter() - start)
    return 1e3 * statistics.median(times)
