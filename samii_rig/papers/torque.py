"""The torque experiments of paper 2, section 5: theta/M, M/v, theta/v (Fig. 8 to 10).

One rigid link on joint 2, hanging (vertical: J theta'' + m g r theta = M, eq. 4) or standing out
level (horizontal: J theta'' = M but for a constant, eq. 5). The link's data are not printed; they
stand, chosen, in the rig files samii_torque_vertical and samii_torque_horizontal.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from samii_rig.model.tmm import Chain
from samii_rig.papers.measure import continuous, recorded
from samii_rig.papers.result import (
    Bode,
    Label,
    Mark,
    Number,
    Panel,
    Picture,
    Result,
    between,
    bode_panels,
    shown,
)
from samii_rig.papers.spring_damper import first_order, laplace
from samii_rig.rig.load import load_rig
from samii_rig.rig.schema import Rig, RigidLink
from samii_rig.types import Complex, Float

GRID = np.geomspace(0.02, 30.0, 800)  # Hz
LOW = (0.02, 0.1)  # Hz, well below the pendulum's natural frequency
HIGH = (6.0, 12.0)  # Hz, well above it, and below the source's pole
STRAIGHT = 0.25  # largest deviation of a slope in a double logarithmic diagram from -1 or 1
ANGLE, MOMENT, SHAFT = "theta_2", "M_2", "joint_2"
CONFIGURATIONS = ("vertical", "horizontal")


@dataclass(frozen=True, slots=True)
class Setup:
    """One configuration, continuous responses to 1 V of theta and of M, which acts on the link:
    of the model on `GRID`, measured at `f`."""

    name: str
    rig: Rig
    theta: Complex
    M: Complex
    f: Float
    theta_measured: Complex
    M_measured: Complex


def model(name: str) -> tuple[Rig, Complex, Complex]:
    """(rig, theta/v, M/v) of the configuration `name` on `GRID`."""
    rig = load_rig(f"samii_torque_{name}")[0]
    chain = Chain(rig)
    theta = chain.response(GRID)[:, [s.name for s in rig.sensor].index(ANGLE), 0]
    shaft = next(i for i, (e, _) in enumerate(chain.places()) if e == SHAFT)
    # The chain's own M is what the link does to the shaft.
    return rig, theta, -chain.field(GRID)[:, 0, shaft, 2]


def measured(name: str) -> Setup:
    """The configuration with a simulated recording, at its loudest level."""
    rig, theta, M = model(name)
    response = recorded(f"samii_torque_{name}", "torque_test")
    seen = continuous(response, rig)[:, :, 0]
    outputs = [y.name for y in response.outputs]
    keep = response.frequency >= GRID[0]
    return Setup(
        name,
        rig,
        theta,
        M,
        response.frequency[keep],
        seen[keep, outputs.index(ANGLE)],
        -seen[keep, outputs.index(MOMENT)],
    )


def slope(f: Float, H: Complex, band: tuple[float, float]) -> float:
    """d log|H|/d log f over a band: -1 for 1/s, 1 for s."""
    inside = (f >= band[0]) & (f <= band[1])
    return float(np.polyfit(np.log(f[inside]), np.log(np.abs(H[inside])), 1)[0])


def closed_form(rig: Rig) -> tuple[float, float]:
    """(J, m g r) of the link about the joint, kg m^2 and N m/rad (0 where it stands out)."""
    link = next(e for e in rig.element if isinstance(e, RigidLink))
    J = link.I.value + link.m.value * link.r.value**2
    gravity = [e.k.value for e in rig.element if e.kind == "gravity_stiffness"]
    return J, sum(gravity)


def slopes() -> tuple[Number, ...]:
    """What the paper reads off Fig. 8 to 10, from the models alone."""
    each = (number for name in CONFIGURATIONS for number in _moments(name))
    return (*each, *_angles())


def _moments(name: str) -> tuple[Number, ...]:
    """The moment of one configuration: its slopes, and against the equation of motion."""
    rig, theta, M = model(name)
    J, k = closed_form(rig)
    s = 2j * np.pi * GRID
    first, said = (-1.0, "1/s") if k else (1.0, "s (eq. 5)")

    def of(band: str, at: tuple[float, float], want: float, said: str) -> Number:
        what = f"{name}: slope of M/v at {band} frequency"
        return between(what, slope(GRID, M, at), "", want - STRAIGHT, want + STRAIGHT, said, 3)

    motion = float(np.max(np.abs((M / theta) / (J * s**2 + k) - 1)))
    equation = f"{name}: M/theta against J s^2 + m g r (eq. {4 if k else 5}), most"
    return (
        of("low", LOW, first, said),
        of("high", HIGH, 1.0, "s"),
        between(equation, motion, "", 0.0, 1e-6, digits=1),
    )


def _angles() -> tuple[Number, ...]:
    """The angle in both configurations, and against the source alone."""
    (rig, theta, _), (_, other, _) = (model(name) for name in CONFIGURATIONS)
    source = next(e for e in rig.element if e.kind == "angular_velocity_source")
    eq_1 = first_order(laplace(GRID), source.K.value, source.p.value)
    differ = 100 * float(np.max(np.abs(theta / other - 1)))
    off = 100 * float(np.max(np.abs(theta / eq_1 - 1)[HIGH[1] > GRID]))
    what = "theta/v, vertical against horizontal, most"
    return (
        between(what, differ, "%", 0.0, 1.0, "the same", 2),
        between("theta/v against eq. 1 to 12 Hz, most", off, "%", 0.0, 10.0, "that of eq. 1", 2),
    )


def figures_8_9_10() -> Result:
    """theta/M, M/v and theta/v in both configurations, model over recording."""
    both = [measured(name) for name in CONFIGURATIONS]
    J, mgr = closed_form(both[0].rig)
    pendulum = float(np.sqrt(mgr / J) / (2 * np.pi))
    numbers = (
        *slopes(),
        *(_moment_measured(s) for s in both),
        shown("vertical: natural frequency of the pendulum", pendulum, "Hz", "", 3),
    )
    return Result(
        numbers,
        (
            "theta/M and M/v change with gravity, theta/v does not: the clearest relation of the "
            "three, and why gravity needs no place in the actuator's model.",
            "Level, a real link's gravity is a constant (eq. 5): the mean of M, no part of a "
            "frequency response.",
        ),
        (
            Picture(
                "p2-fig-8-9-10",
                "Paper 2, Fig. 8 to 10: the torque test, vertical and horizontal",
                _panels(both, pendulum),
                columns=3,
                width=11.0,
                height=5.0,
            ),
        ),
    )


def _moment_measured(s: Setup) -> Number:
    """M/v of the recording over that of the model, median of the gain from 0.5 to 12 Hz."""
    inside = (s.f > 5 * LOW[1]) & (s.f < HIGH[1])
    f = s.f[inside]
    model_M = np.interp(f, GRID, s.M.real) + 1j * np.interp(f, GRID, s.M.imag)
    off = 100 * float(np.median(np.abs(s.M_measured[inside] / model_M - 1)))
    what = f"{s.name}: measured M/v against the model, 0.5 to 12 Hz, median"
    return between(what, off, "%", 0.0, 5.0, "agree closely", 2, "found again")


def _panels(both: list[Setup], pendulum: float) -> tuple[Panel, ...]:
    """The three gains above the three phases; pendulum : its natural frequency, Hz, marked where
    the moment shows it."""
    gains: list[Panel] = []
    phases: list[Panel] = []
    for figure, what, unit, near in (
        (8, "theta/M", "rad/(N m)", 0.0),
        (9, "M/v", "N m/V", -90.0),
        (10, "theta/v", "rad/V", -90.0),
    ):
        marks = (Mark("pendulum", pendulum),) if figure < 10 else ()
        title = f"Fig. {figure}: {what}"
        gain, phase = _together(
            [bode_panels(_curves(s, i, what), unit, marks, title, near) for i, s in enumerate(both)]
        )
        gains.append(gain if figure == 8 else replace(gain, legend=None))
        phases.append(replace(phase, y_step=90.0, y_range=(-200.0, 110.0)))
    gains[1] = replace(gains[1], labels=_slope_labels(both))
    return (*gains, *phases)


def _together(pairs: list[tuple[Panel, Panel]]) -> tuple[Panel, Panel]:
    """One pair of panels with the curves of all: each configuration's points are turned to its
    own model."""
    gain, phase = (
        replace(column[0], curves=tuple(c for p in column for c in p.curves))
        for column in zip(*pairs, strict=True)
    )
    return gain, phase


def _curves(s: Setup, colour: int, what: str) -> tuple[Bode, Bode]:
    of_model = {"theta/M": s.theta / s.M, "M/v": s.M, "theta/v": s.theta}[what]
    of_data = {
        "theta/M": s.theta_measured / s.M_measured,
        "M/v": s.M_measured,
        "theta/v": s.theta_measured,
    }[what]
    return (
        Bode(f"{s.name}, measured (simulated rig)", s.f, of_data, "points", colour),
        Bode(f"{s.name}, model", GRID, of_model, "dashed" if colour else "line", colour),
    )


def _slope_labels(both: list[Setup]) -> tuple[Label, ...]:
    """The slopes that the paper names, at the curves of M/v."""
    low, high = float(np.sqrt(LOW[0] * LOW[1])), 15.0
    vertical = np.abs(both[0].M)
    return (
        Label("1/s", low, float(np.interp(low, GRID, vertical)), 14.0, 10.0),
        Label("s", high, float(np.interp(high, GRID, vertical)), -14.0, 6.0),
    )
