"""Mode shapes (paper 1, Fig. 8 and 9): models with and without joint flexibility, measured
ones with intervals, and what could be the offset that the paper had to take off mode 1."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from samii_rig.fem.model import Fem
from samii_rig.identify.modal import Modes, estimate_modes
from samii_rig.model.tmm import Chain
from samii_rig.papers.measure import carried_out, thinned
from samii_rig.papers.result import Curve, Mark, Number, Panel, Picture, Result, between, shown
from samii_rig.papers.rigs import JOINTS, locked, lossless, samii
from samii_rig.papers.tables import tmm_hz
from samii_rig.rig.load import load_rig
from samii_rig.rig.schema import Acceleration, Beam, Rig, RigidLink
from samii_rig.types import Complex, Float

BESIDE = 1e-6  # relative distance from a natural frequency at which its shape is taken
POINTS = 41  # of a curve along the beam
GRAVITY = 9.80665  # m/s^2
SCAN: Mapping[str, tuple[str, float]] = {
    "b_1": ("beam", 1.5),
    "b_2": ("beam", 3.0),
    "j_1": ("link_0", 0.3302),
    "j_3": ("link_2", 0.4001),
}
"""Accelerometers of the scan beside a_0, a_1 (joint 2) and a_2 (tip): element, m along it."""
SWEEP = {"start_hz": 1.0, "stop_hz": 14.0, "duration": 16.0, "amplitudes": (0.5,)}
BAND = (1.1, 13.0)  # Hz in which modes are estimated
LINES = 150  # of the response that the modes are estimated from
ONE, TWO = 0, 1


@dataclass(frozen=True, slots=True)
class Shape:
    """A mode shape. x : (n,) m from the base; w : (n,) over the largest |w|; theta : (n,)
    slope in the same scale, 1/m; V_base : shear force at the base; hz."""

    hz: float
    x: Float
    w: Float
    theta: Float
    V_base: float


def starts(rig: Rig) -> dict[str, float]:
    """Where each element begins, m from the base."""
    out, x = {}, 0.0
    for e in rig.element:
        out[e.name] = x
        x += e.L.value if isinstance(e, Beam | RigidLink) else 0.0
    return out


def model_shape(rig: Rig, mode: int) -> Shape:
    """A mode shape of the transfer matrices without damping, both sides of every joint."""
    chain = Chain(lossless(rig))
    hz = float(tmm_hz(rig)[mode])
    beam = next(e for e in rig.element if isinstance(e, Beam))
    inner = {beam.name: tuple(np.linspace(0, beam.L.value, POINTS)[1:-1])}
    places = chain.places(inner)
    ports = [name for name, _ in places]
    port = ports.index("joint_2_source")
    s = 2j * np.pi * hz * np.array([1 + BESIDE, 1 - BESIDE])
    both = chain.field_at(s, [(port, "theta")], inner)[:, 0]
    # The difference of both sides of a pole leaves out what the other modes add to both.
    z = (both[0] - both[1]).real
    begin = starts(rig)
    x = np.array([begin[name] + at for name, at in places])
    size = z[np.argmax(np.abs(z[:, 0])), 0]
    return Shape(hz, x, z[:, 0] / size, z[:, 1] / size, float(z[0, 3] / size))


def fem_shape(rig: Rig, mode: int) -> tuple[Float, Float]:
    """(x, w) of a mode by finite elements, w over the largest."""
    fem = Fem(rig)
    places = fem.mechanism.places
    w = places.w @ fem.modes(mode + 1).shapes[:, mode]
    return places.x, np.asarray(w / w[np.argmax(np.abs(w))])


def scanned() -> tuple[Rig, str]:
    """SAMII with accelerometers along the beam and at the joints, and its file's text."""
    rig, text = load_rig("samii")
    first = next(s for s in rig.sensor if isinstance(s, Acceleration))
    more = tuple(
        first.model_copy(update={"name": name, "on": on, "position": at})
        for name, (on, at) in SCAN.items()
    )
    return rig.model_copy(update={"sensor": (*rig.sensor, *more)}), text


@dataclass(frozen=True, slots=True)
class Scan:
    """Measured shapes. x : (n,) m; modes : as estimated; outputs in the order of x; damped :
    (2, n) complex residues of the rig's own model at its poles."""

    x: Float
    outputs: tuple[str, ...]
    modes: Modes
    damped: Complex


def scan() -> Scan:
    """Modes from a simulated recording with accelerometers at seven places."""
    rig, text = scanned()
    response = carried_out(rig, text, "swept_sine", changes=SWEEP)
    begin = starts(rig)
    where = {s.name: begin[s.on] + s.position for s in rig.sensor if isinstance(s, Acceleration)}
    names = tuple(sorted(where, key=where.__getitem__))
    few = thinned(response, len(response.frequency) // LINES)
    modes = estimate_modes(few, rig, band=BAND, outputs=names)
    chain, columns = Chain(rig), [[s.name for s in rig.sensor].index(n) for n in names]
    damped = []
    for mode in (ONE, TWO):
        s = modes.modes[mode].pole * np.array([1 + BESIDE, 1 - BESIDE])
        pole = _newton(chain, complex(s.mean()))
        H = chain.evaluate(pole * np.array([1 + BESIDE, 1 - BESIDE]))[:, columns, 0]
        damped.append(H[0] - H[1])
    return Scan(np.array([where[n] for n in names]), names, modes, np.array(damped))


def figures_8_9() -> Result:
    """Mode shapes with and without joint flexibility, and measured."""
    measured = scan()
    shapes = [model_shape(samii(), mode) for mode in (ONE, TWO)]
    numbers = [n for mode in (ONE, TWO) for n in _numbers(mode, shapes[mode], measured)]
    return Result(
        tuple(numbers), (), tuple(_picture(mode, shapes[mode], measured) for mode in (ONE, TWO))
    )


def _by_mesh(mode: int, shape: Shape) -> tuple[Float, Float]:
    """Places and displacements of the finite elements, with the sign of `shape`."""
    x, w = fem_shape(samii(), mode)
    return x, w * np.sign(w[-1] * shape.w[-1])


def _numbers(mode: int, shape: Shape, measured: Scan) -> Iterator[Number]:
    """What is said of one mode's shape."""
    begin, name = starts(samii()), f"mode {mode + 1}"
    x, w = _by_mesh(mode, shape)
    off = 100 * np.max(np.abs(np.interp(x, shape.x, shape.w) - w))
    yield between(f"{name}: FEM against TMM, most", off, "% of w", 0, 0.5, "", 1)
    for joint in ("joint_1", "joint_2"):
        change = 100 * abs(_slope_change(shape, begin[joint])) / float(np.abs(shape.theta).max())
        what = f"{name}: slope change at {joint}, of the largest slope"
        yield between(what, change, "%", 1.0, np.inf, "distinct", 3)
    w, half, truth = _scaled(measured, mode, shape)
    free = half > 0
    inside = 100 * float((np.abs(w - truth) <= half)[free].mean())
    what = f"{name}: measured places within their 90 % interval of the rig's own"
    yield shown(what, inside, "%", "", 3)
    median = 100 * float(np.median(half[free]))
    yield shown(f"{name}: half width of an interval, median", median, "% of w", "", 2)
    most = 100 * float(np.max(np.abs(truth - np.interp(measured.x, shape.x, shape.w))))
    yield shown(f"{name}: damped shape against undamped, most", most, "% of w", "", 2)


def _picture(mode: int, shape: Shape, measured: Scan) -> Picture:
    """One mode's displacement and slope, by both models, with perfect joints, and measured."""
    begin = starts(samii())
    joints = ("joint_1", "joint_2", "joint_3")
    other = model_shape(locked(samii(), JOINTS), mode)
    at_0 = [np.interp(begin["link_0"], one.x, one.w) for one in (other, shape)]
    sign = np.sign(at_0[0]) * np.sign(at_0[1])
    w, half, _ = _scaled(measured, mode, shape)
    panel = Panel(
        "distance from the base [m]",
        "w over its largest",
        (
            Curve(f"TMM, joints flexible, {shape.hz:.3f} Hz", shape.x, shape.w, "broad", 0),
            Curve("FEM, joints flexible", *_by_mesh(mode, shape), "dashed", 0),
            Curve(f"TMM, perfect joints, {other.hz:.3f} Hz", other.x, sign * other.w, "line", 1),
            Curve("measured, 90 % interval", measured.x, w, "points", 2, w - half, w + half),
        ),
        "",
        tuple(Mark(joint.replace("_", " "), begin[joint]) for joint in joints),
        log_x=False,
        legend="upper left",
    )
    slopes = Panel(
        "distance from the base [m]",
        "slope [1/m]",
        (
            Curve("", shape.x, shape.theta, "line", 0),
            Curve("", other.x, sign * other.theta, "line", 1),
        ),
        "",
        tuple(Mark("", begin[joint]) for joint in joints),
        log_x=False,
        weight=0.6,
    )
    return Picture(
        f"p1-fig-{8 + mode}",
        f"Paper 1, Fig. {8 + mode}: mode {mode + 1}, the slope changes at joints 1 and 2",
        (panel, slopes),
    )


@dataclass(frozen=True, slots=True)
class Offset:
    """What a cause does to a measured mode shape. constant : mean of what it adds at the
    robot's accelerometers, of the largest w; spread : half its range there; both in percent."""

    cause: str
    mode: int
    constant: float
    spread: float


def offset() -> Result:
    """Causes of a constant added to mode 1: their size in both modes."""
    shapes = [model_shape(samii(), m) for m in (ONE, TWO)]
    robot = starts(samii())["link_0"]
    numbers: list[Number] = []
    found: list[Offset] = []
    for mode, shape in enumerate(shapes):
        on = shape.x >= robot - 1e-9
        omega = 2 * np.pi * shape.hz
        # a = s^2 w + g theta: with s^2 = -omega^2 the shape seems to be w - g theta/omega^2.
        tilt = -GRAVITY / omega**2 * shape.theta[on]
        found.append(_offset("accelerometers that tilt with the links, a + g theta", mode, tilt))
        drive = _operating(samii(), shape)
        found.append(_offset("the motion at 1.7 and 7.4 Hz in place of the mode", mode, drive[on]))
    tilts = found[::2]
    stiff = abs(shapes[ONE].V_base / (tilts[ONE].constant / 100))
    for mode, shape in enumerate(shapes):
        moved = -shape.V_base / stiff * np.ones(2)
        found.append(_offset("a support that gives way sideways", mode, moved))
    for o in sorted(found, key=lambda o: o.cause):
        name = f"{o.cause}: mode {o.mode + 1}"
        said = "an offset" if o.mode == ONE else "none told"
        numbers += [
            shown(f"{name}, constant on the robot", o.constant, "% of w", said, 2),
            shown(f"{name}, departure from a constant", o.spread, "% of w", "", 1),
        ]
    ratio = abs(tilts[ONE].constant / tilts[TWO].constant)
    numbers.append(
        between("tilt: offset of mode 1 over that of mode 2", ratio, "times", 2.0, np.inf, "", 2)
    )
    panels = tuple(_added(shape, mode, stiff, robot) for mode, shape in enumerate(shapes))
    return Result(
        tuple(numbers),
        (
            "An accelerometer turns with what it is fixed to and feels gravity. In mode 1 the "
            "robot turns nearly as one body, so that what tilt adds is nearly a constant there; in "
            "mode 2 it is several times smaller. Of the three causes it is the one that looks "
            "like an offset in mode 1 and like nothing in mode 2.",
            "A steady motion at 1.7 Hz is not the mode either: what it adds is as large, but no "
            "constant. A support that gives way adds one to mode 2 as well, and a larger one.",
            "Which of them it was in the paper cannot be known: it prints neither the size nor the "
            "sign of its offset.",
        ),
        (
            Picture(
                "p1-offset",
                "Paper 1, Fig. 8: what three causes add to the measured mode shapes",
                panels,
                columns=2,
                width=9.0,
                height=3.6,
            ),
        ),
    )


def _added(shape: Shape, mode: int, stiff: float, robot: float) -> Panel:
    """What each cause adds to a mode shape along the chain, percent of its largest w."""
    tilt = -GRAVITY / (2 * np.pi * shape.hz) ** 2 * shape.theta
    causes = (
        ("tilt: a + g theta", tilt),
        ("steady motion in place of the mode", _operating(samii(), shape)),
        ("support gives way (scaled to tilt)", np.full(shape.x.size, -shape.V_base / stiff)),
    )
    return Panel(
        "distance from the base [m]",
        "added [% of the largest w]",
        tuple(Curve(name, shape.x, 100 * w, "line", i) for i, (name, w) in enumerate(causes)),
        f"mode {mode + 1}",
        (Mark("robot", robot, float(shape.x[-1])),),
        log_x=False,
        y_range=(-5.0, 5.0),
        legend="upper left" if mode == ONE else None,
    )


def _offset(cause: str, mode: int, added: Float) -> Offset:
    return Offset(cause, mode, 100 * float(added.mean()), 50 * float(added.max() - added.min()))


def _operating(rig: Rig, shape: Shape) -> Float:
    """What a steady motion at the natural frequency shows beside the mode: over its largest w."""
    beam = next(e for e in rig.element if isinstance(e, Beam))
    inner = {beam.name: tuple(np.linspace(0, beam.L.value, POINTS)[1:-1])}
    w = Chain(rig).field([shape.hz], positions=inner)[0, 0, :, 0]
    top = int(np.argmax(np.abs(shape.w)))
    return np.asarray((w / w[top]).real - shape.w / shape.w[top])


def _newton(chain: Chain, s: complex) -> complex:
    """The chain's pole near s."""
    for _ in range(8):
        mantissa, log_scale = chain.characteristic(s * np.array([1, 1 + BESIDE, 1 - BESIDE]))
        value = mantissa * np.exp(log_scale - log_scale[0])
        s -= complex(value[0] * 2 * BESIDE * s / (value[1] - value[2]))
    return s


def _slope_change(shape: Shape, x: float) -> float:
    """Slope behind the joint at x less that before it."""
    at = np.flatnonzero(np.abs(shape.x - x) < 1e-9)
    return float(shape.theta[at[-1]] - shape.theta[at[0]])


def _scaled(measured: Scan, mode: int, shape: Shape) -> tuple[Float, Float, Float]:
    """(n,) measured w, half width of its 90 % interval and the damped model's w, all in the
    scale of `shape` at the place of the reference accelerometer."""
    m = measured.modes.modes[mode]
    order = [measured.modes.outputs.index(n) for n in measured.outputs]
    reference = measured.outputs.index(measured.modes.outputs[m.reference])
    size = float(np.interp(measured.x[reference], shape.x, shape.w))
    sd = np.sqrt(m.shape_covariance[order, 0, 0])
    truth = (measured.damped[mode] / measured.damped[mode][reference]).real
    return size * m.shape[order].real, 1.645 * abs(size) * sd, size * truth
