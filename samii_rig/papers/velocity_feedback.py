"""Intrinsic velocity feedback: paper 1, section IV-A; paper 2, section 4 and Fig. 5.

    T = g_v (g_a v - theta')                              (paper 1, eq. 18; paper 2, eq. 3)

In finite elements it is a torque at the joint. In transfer matrices it is an angular velocity
source in series with a torsional damper c = g_v (paper 1, section V-A):
theta' = g_a v + M/g_v, for the moment M in the chain is -T.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from samii_rig.fem.model import Fem
from samii_rig.identify.parameters import changed
from samii_rig.identify.velocity_feedback import GainCurves, curves
from samii_rig.identify.velocity_feedback import in_series as source_and_damper
from samii_rig.model.tmm import Chain
from samii_rig.papers.result import (
    Bode,
    Curve,
    Kind,
    Mark,
    Number,
    Panel,
    Picture,
    Result,
    between,
    bode_panels,
    shown,
)
from samii_rig.papers.rigs import G_V, SOURCE, collocated, rayleigh, samii
from samii_rig.rig.schema import Rig
from samii_rig.types import Complex, Float

NO_LAG = 1e9  # rad/s: eq. 18 has no lag
INTERACTION = (7.2, 8.0)  # Hz, where the papers see actuator and structure meet
AROUND = (4.5, 12.5)  # Hz, around mode 2, where the dip and the rise are read
ALPHA = 2.5e-3  # s, Rayleigh damping for which the dip is in the middle of 20 to 30 degrees
ALPHAS = (4e-3, 3e-3, 2.5e-3, 2e-3, 1e-3)  # s
SIZES = (20.0, 30.0)  # deg, of dip and rise
SAID = f"{SIZES[0]:g} to {SIZES[1]:g} deg"
GAINS = np.geomspace(10.0, 1e5, 81)  # N m s/rad
FEW = 4  # every so many of them by finite elements as well
MOVED = (0.01, 0.05)  # relative change of a natural frequency: "almost unaffected" is over


def in_series(rig: Rig, g_v: float) -> Rig:
    """The rig with velocity feedback in transfer matrices: the source, then a damper g_v.

    The encoder spans both: their sum is the rotation of the actuator.
    """
    fast = changed(collocated(rig), {(SOURCE, "p"): NO_LAG})
    return source_and_damper(fast, SOURCE, g_v)


def by_fem(rig: Rig, g_v: float) -> Fem:
    """The rig with velocity feedback in finite elements, encoder at the actuator."""
    return Fem(collocated(rig), feedback={SOURCE: (g_v, gain_of(rig))})


def dip_and_rise(f: Float, H: Complex, nominal: Complex) -> tuple[float, float, float, float]:
    """Lowest and highest phase over the `nominal` one, degrees, and where, Hz:
    (dip, dip_hz, rise, rise_hz)."""
    over = np.degrees(np.unwrap(np.angle(H / nominal)))
    over -= 360 * np.round(over[0] / 360)
    low, high = int(np.argmin(over)), int(np.argmax(over))
    return float(over[low]), float(f[low]), float(over[high]), float(f[high])


def figure_5() -> Result:
    """theta_2/v_2 with velocity feedback, encoder at the actuator, by both methods."""
    f = np.geomspace(0.5, 40.0, 1600)
    inside = (f > AROUND[0]) & (f < AROUND[1])
    nominal: Complex = np.asarray(gain_of(samii()) / (2j * np.pi * f), dtype=np.complex128)
    numbers: list[Number] = []
    bodes = []
    for colour, (name, rig) in enumerate(
        (
            ("the rig file's damping", samii()),
            (f"C = alpha K, alpha = {1e3 * ALPHA:g} ms", rayleigh(samii(), ALPHA)),
        )
    ):
        fem = by_fem(rig, G_V).response(f)[:, 0, 0]
        tmm = Chain(in_series(rig, G_V)).response(f)[:, 0, 0]
        dip, dip_hz, rise, rise_hz = dip_and_rise(f[inside], fem[inside], nominal[inside])
        chosen = colour == 1
        said = SAID if chosen else ""
        numbers += [
            between(f"phase dip, {name}", -dip, "deg", *SIZES, said)
            if chosen
            else shown(f"phase dip, {name}", -dip, "deg"),
            shown(f"at, {name}", dip_hz, "Hz", "mode 2" if chosen else "", 3),
            between(f"phase rise after it, {name}", rise, "deg", *SIZES, said)
            if chosen
            else shown(f"phase rise after it, {name}", rise, "deg"),
            shown(f"at, {name}", rise_hz, "Hz", "", 3),
            between(
                f"TMM against FEM, {name}",
                float(np.max(np.abs(tmm / fem - 1))),
                "of H",
                0.0,
                1e-3,
                digits=2,
            ),
        ]
        bodes += [
            Bode(f"FEM, {name}", f, fem, "broad", colour),
            Bode(f"TMM, {name}", f, tmm, "dashed", colour),
        ]
    marks = (Mark("7.2 to 8 Hz", *INTERACTION),)
    gain, phase = bode_panels(bodes, "rad/V", marks)
    numbers += _over_damping(f[inside], nominal[inside])
    return Result(
        tuple(numbers),
        (
            "The dip is followed by a rise of the same kind, whatever the damping: the shape that "
            "paper 2 rejects against the experiment, which has no rise.",
            "The size hangs on the damping of mode 2, which no paper prints.",
        ),
        (
            Picture(
                "p2-fig-5",
                f"Paper 2, Fig. 5: velocity feedback, g_v = {G_V:g}, encoder at the actuator",
                (gain, _from_90(phase)),
            ),
        ),
    )


def limits() -> Result:
    """g_v to infinity, and k to infinity, are the velocity source."""
    f = np.geomspace(0.5, 40.0, 200)
    rig = collocated(samii())
    fast = changed(rig, {(SOURCE, "p"): NO_LAG})
    held = Chain(fast).response(f)[:, :, 0]
    gains = np.array([1e3, 1e4, 1e5, 1e6, 1e7])
    by_g = np.array([_off(Chain(in_series(rig, g)).response(f)[:, :, 0], held) for g in gains])
    by_g_fem = np.array([_off(by_fem(rig, g).response(f)[:, :, 0], held) for g in gains])
    both = samii()
    pure = collocated(both)
    factors = np.array([1e0, 1e1, 1e2, 1e3, 1e4, 1e5])
    by_k = []
    for factor in factors:
        k = {("joint_2", "k"): 0.108e5 * factor}
        across = Chain(both).with_values(k).response(f)[:, :1, 0]
        at_source = Chain(pure).with_values(k).response(f)[:, :1, 0]
        by_k.append(_off(across, at_source))
    by_k_ = np.array(by_k)
    order_g = float(np.polyfit(np.log(gains[-3:]), np.log(by_g[-3:]), 1)[0])
    order_k = float(np.polyfit(np.log(factors[-3:]), np.log(by_k_[-3:]), 1)[0])
    panel_g = Panel(
        "g_v [N m s/rad]",
        "largest difference, of H",
        (
            Curve("TMM, source in series with damper", gains, by_g),
            Curve("FEM, eq. 18", gains, by_g_fem, "dashed", 1),
        ),
        "to the velocity source, all sensors",
        (Mark("Table II", G_V),),
        log_y=True,
        legend="upper right",
    )
    panel_k = Panel(
        "k over the rig file's k_a2",
        "",
        (Curve("TMM", factors, by_k_),),
        "theta_2 across both, to the encoder at the source",
        log_y=True,
    )
    return Result(
        (
            between("order of the difference in g_v", order_g, "", -1.02, -0.98, "-1"),
            between("order of the difference in k", order_k, "", -1.02, -0.98, "-1"),
            between("difference at g_v = 1e7", by_g[-1], "of H", 0, 1e-3, "0", 2),
            between("difference at k = 1e5 k_a2", by_k_[-1], "of H", 0, 1e-3, "0", 2),
        ),
        ("Both differences fall as the inverse of the parameter: both limits are the source.",),
        (
            Picture(
                "limits",
                "Limits: velocity feedback and spring-damper both end in the velocity source",
                (panel_g, panel_k),
                columns=2,
                width=8.0,
                height=3.2,
            ),
        ),
    )


def section_4a() -> Result:
    """Natural frequencies and damping over g_v: "almost unaffected", down to where?"""
    rig = collocated(samii())
    tmm = curves(rig, SOURCE, GAINS.tolist())
    fem = curves(rig, SOURCE, GAINS[::FEW].tolist(), by="fem")
    both = np.abs(fem.frequency_hz / tmm.frequency_hz[::FEW] - 1)
    most = between("TMM against FEM, frequencies, most", np.nanmax(both), "", 0.0, 1e-4, digits=1)
    return Result(
        (*_at_the_papers_gain(rig), *_where_it_leaves(tmm), most),
        (
            "The statement holds at the paper's own g_v and not much below it. Mode 2 leaves "
            "first, and is overdamped in the end.",
        ),
        (
            Picture(
                "p1-section-4a",
                "Paper 1, section IV-A: velocity feedback changes the damping, not the frequencies",
                _gain_panels((("TMM", tmm, "line"), ("FEM", fem, "points"))),
            ),
        ),
    )


def _at_the_papers_gain(rig: Rig) -> Iterator[Number]:
    """What g_v does to both modes, beside the velocity source."""
    table = curves(rig, SOURCE, [float(GAINS[-1]), G_V])
    for i in range(2):
        at = f"mode {i + 1} at g_v = {G_V:g}"
        change = 100 * abs(table.frequency_hz[1, i] / table.frequency_hz[0, i] - 1)
        what = f"{at}, change of frequency"
        yield between(what, change, "%", 0.0, 3.0, "almost unaffected", 2)
        damped = table.damping[1, i] / table.damping[0, i]
        what = f"{at}, damping over that of the velocity source"
        yield between(what, damped, "times", 1.2, np.inf, "modified", 3)


def _where_it_leaves(tmm: GainCurves) -> Iterator[Number]:
    """Down to which g_v the statement holds."""
    for i in range(2):
        for moved in MOVED:
            what = f"mode {i + 1} is {100 * moved:g} % away from the velocity source's below g_v"
            yield shown(what, tmm.leaves(i, moved), "N m s/rad", "", 3)
    gone = float(tmm.g_v[np.flatnonzero(~np.isnan(tmm.frequency_hz[:, 1]))[-1]])
    yield shown("mode 2 is overdamped below g_v", gone, "N m s/rad", "", 2)


def _gain_panels(both: Sequence[tuple[str, GainCurves, Kind]]) -> tuple[Panel, Panel]:
    """Frequency and damping of both modes over g_v, by each model."""
    marks = (Mark("g_v2 = 500", G_V), Mark("g_v3 = 150", 150.0))
    each = [(i, name, c, kind) for i in range(2) for name, c, kind in both]
    return (
        Panel(
            "g_v [N m s/rad]",
            "frequency over that of\nthe velocity source",
            tuple(
                Curve(f"mode {i + 1}, {name}", c.g_v, _over_first(c.frequency_hz[:, i]), kind, i)
                for i, name, c, kind in each
            ),
            "",
            (*marks, Mark("within 5 %", 0.95, 1.05, "y")),
            y_range=(0.8, 1.2),
            legend="upper right",
        ),
        Panel(
            "g_v [N m s/rad]",
            "damping ratio",
            tuple(Curve("", c.g_v, c.damping[:, i], kind, i) for i, _, c, kind in each),
            "",
            tuple(Mark("", m.low) for m in marks),
            log_y=True,
        ),
    )


def _over_first(values: Float) -> Float:
    return np.asarray(values / values[0])


def gain_of(rig: Rig) -> float:
    """g_a, rad/s per V: the K of the rig's source."""
    source = next(e for e in rig.element if e.kind == "angular_velocity_source")
    return source.K.value


def _off(H: Complex, other: Complex) -> float:
    """Largest difference of any output over its own peak."""
    return float(np.max(np.abs(H - other) / np.max(np.abs(other), axis=0)))


def _over_damping(f: Float, nominal: Complex) -> Sequence[Number]:
    """Dip and rise over the Rayleigh damping that is not printed."""
    out = []
    for alpha in ALPHAS:
        H = by_fem(rayleigh(samii(), alpha), G_V).response(f)[:, 0, 0]
        dip, _, rise, _ = dip_and_rise(f, H, nominal)
        out.append(shown(f"dip with alpha = {1e3 * alpha:g} ms", -dip, "deg", "", 3))
        out.append(shown(f"rise with alpha = {1e3 * alpha:g} ms", rise, "deg", "", 3))
    return out


def _from_90(phase: Panel) -> Panel:
    """The phase panel with a line at that of the integrator."""
    said = (
        Mark("1/s", -90.0, axis="y"),
        Mark("paper 2: dip of 20 to 30\u00b0", -120.0, -110.0, "y"),
        Mark("then a rise of 20 to 30\u00b0", -70.0, -60.0, "y"),
    )
    return replace(phase, marks=(*phase.marks, *said), y_step=15.0, y_range=(-125.0, -57.0))
