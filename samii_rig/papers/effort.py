"""Generality and effort (paper 1, section V): both methods side by side, measured."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass
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
from samii_rig.types import Float

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


@dataclass(frozen=True, slots=True)
class Measured:
    """What both methods cost, and the errors that it buys.

    meshes, error : (n,) beam elements and relative error of mode 4 with them; order : of their
    convergence. off : (n,) largest relative error of the response. build, solve : (n,) ms.
    kept : (len(KEPT),) error to TOP_HZ of the reduction, over the peak. fem : of ELEMENTS.
    tmm_build, tmm_solve : ms of the transfer matrices.
    """

    meshes: Float
    error: Float
    order: float
    off: Float
    build: Float
    solve: Float
    kept: Float
    fem: Fem
    tmm_build: float
    tmm_solve: float

    @classmethod
    def now(cls) -> Measured:
        """On this machine."""
        chain = Chain(samii())
        truth = chain.response(GRID)
        fems = [Fem(samii(), n) for n in MESHES]
        fem = Fem(samii(), ELEMENTS)
        inside = GRID[GRID <= TOP_HZ]
        full = fem.response(inside)
        left = [np.abs(reduce(fem, n).response(inside) - full) for n in KEPT]
        return cls(
            *order_of_convergence(),
            off=np.array([np.max(np.abs(f.response(GRID) / truth - 1)) for f in fems]),
            build=np.array([_ms(partial(Fem, samii(), n)) for n in MESHES]),
            solve=np.array([_ms(partial(f.response, GRID)) for f in fems]),
            kept=np.array([np.max(x / np.abs(full).max(axis=0)) for x in left]),
            fem=fem,
            tmm_build=_ms(lambda: Chain(samii())),
            tmm_solve=_ms(lambda: chain.response(GRID)),
        )


def section_5() -> Result:
    """Time to build and to solve, and the error that it buys."""
    measured = Measured.now()
    return Result(
        (*_errors(measured), *_times(measured)),
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
                _panels(measured),
                columns=3,
                width=11.0,
                height=3.4,
            ),
        ),
    )


def _errors(m: Measured) -> tuple[Number, ...]:
    at, four = MESHES.index(ELEMENTS), 100 * m.kept[KEPT.index(4)]
    return (
        between("FEM: order of convergence, mode 4", m.order, "", *CONVERGENCE, digits=2),
        between("FEM: error of mode 4, 15 elements", m.error[at], "", 0.0, 1e-5, digits=1),
        between(
            "FEM: error of the response to 50 Hz, 15 elements", m.off[at], "of H", 0, 1e-3, digits=1
        ),
        shown("FEM: coordinates and multipliers", sum(m.fem.size), "", "89 d.o.f.", 2),
        shown("TMM: size of the matrix", 4, "", "4 x 4", 1),
        between("FEM, 4 flexible modes: error to 10 Hz", four, "% of peak", 0, 5, digits=2),
        shown("FEM, 16 flexible modes: error to 10 Hz", 100 * m.kept[-1], "% of peak", "", 2),
    )


def _times(m: Measured) -> tuple[Number, ...]:
    at = MESHES.index(ELEMENTS)
    each = {
        "FEM: build, 15 elements": m.build[at],
        "TMM: build": m.tmm_build,
        "FEM: 400 frequencies, 15 elements": m.solve[at],
        "TMM: 400 frequencies": m.tmm_solve,
        "FEM: all undamped modes, 15 elements": _ms(m.fem.modes),
        "TMM: natural frequencies to 60 Hz": _ms(lambda: Conservative(samii(), BAND).frequencies()),
        "FEM: reduction to 4 flexible modes": _ms(lambda: reduce(m.fem)),
    }
    return tuple(shown(name, ms, "ms", "", 2) for name, ms in each.items())


def _panels(m: Measured) -> tuple[Panel, ...]:
    h4 = np.abs(m.error[0]) * (m.meshes / m.meshes[0]) ** -4.0
    return (
        Panel(
            "beam elements",
            "relative error",
            (
                Curve("mode 4", m.meshes, np.abs(m.error), "points", 0),
                Curve("response to 50 Hz, most", m.meshes, m.off, "points", 1),
                Curve("h⁴", m.meshes, h4, "dashed", 2),
            ),
            "what a finer mesh buys",
            log_y=True,
            legend="lower left",
        ),
        Panel(
            "time for 400 frequencies [ms]",
            "relative error of the response",
            (Curve("", m.solve, m.off, "points", 1),),
            "what it costs",
            marks=(Mark(f"TMM, exact: {m.tmm_solve:.1g} ms", m.tmm_solve),),
            labels=(
                Label("2 elements", m.solve[0], m.off[0], -14.0, 0.0),
                Label("60", m.solve[-1], m.off[-1], -14.0, 0.0),
            ),
            log_y=True,
            x_range=(min(m.tmm_solve, *m.solve) / 2, 4 * max(m.solve)),
        ),
        Panel(
            "flexible modes kept",
            "error to 10 Hz [% of the peak]",
            (Curve("", np.array(KEPT, dtype=float), 100 * m.kept, "points", 3),),
            "component-mode reduction (eq. 13, 14)",
            log_x=False,
            labels=(Label("the paper's 4", 4.0, 100 * float(m.kept[KEPT.index(4)]), 12.0, 12.0),),
        ),
    )


def _ms(call: Callable[[], object]) -> float:
    times = []
    for _ in range(REPEATS):
        start = time.perf_counter()
        call()
        times.append(time.perf_counter() - start)
    return 1e3 * statistics.median(times)
