"""Runs of the compiled loop: records without noise for sizing, and with all of it for the files."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from samii_rig.types import Float
from sim.assumed_modes import kernel
from sim.assumed_modes.noise import Noise, coloured
from sim.assumed_modes.parts import Force, Setup
from sim.assumed_modes.plant import Plant, Push, plant
from sim.assumed_modes.sampled import Timeline, timeline

PIECE = 5e-4  # s, longest piece with a law: 100 a period of the fastest motion of 20 Hz
STIFF = 0.05  # largest k g of a law: how far its own force moves its place, for the iteration
MOST_STEPS = 64
# The same of a stop, which is not iterated: against it a place swings at w, and its period is wrong
# by (w h)^2/12 = k g/6 of itself. Where that asks for more, pieces of STOP_PIECE s are enough.
STOP_STIFF, STOP_PIECE = 4e-4, 1.25e-4
# s of rest under the disturbances before a record, to make them stationary: twice the time
# in which mode 1 of SAMII falls to 1/e.
SETTLE = 20.0

NUMBERS = {
    "cubic_stiffness": (kernel.CUBIC, ("k3",)),
    "backlash": (kernel.BACKLASH, ("k", "width")),
    "coulomb_friction": (kernel.FRICTION, ("T_c",)),
    "bouc_wen": (kernel.BOUC_WEN, ("T_y", "z_y", "beta", "gamma", "n")),
    "parametric": (kernel.PARAMETRIC, ("k", "depth_1", "w_1", "depth_2", "w_2")),
    "quadratic_damping": (kernel.DRAG, ("c2",)),
    "one_sided": (kernel.ONE_SIDED, ("dk",)),
    "end_stop": (kernel.STOP, ("k", "gap", "above", "below")),
    "flow_saturation": (kernel.FLOW, ("M_stall",)),
}
STATIC = {"valve_deadband": "width", "output_saturation": "limit"}


@dataclass(frozen=True, slots=True)
class Control:
    """The loops as they are closed, v = r - feedback y. feedback : (n_in, n_y), rate_hz :
    samples/s."""

    feedback: Float
    rate_hz: float


def ready(
    setup: Setup, control: Control, pushes: tuple[Push, ...] = ()
) -> tuple[Plant, kernel.Pieces]:
    """The plant and its pieces, fine enough for its laws."""
    dynamic = [f for f in setup.forces if f.law in NUMBERS]
    made = plant(replace(setup, forces=tuple(dynamic)), pushes)
    steps = 1 if not dynamic else int(np.ceil(1.0 / (control.rate_hz * PIECE) - 1e-9))
    while True:
        line = timeline(setup, made, control.rate_hz, steps)
        pieces = _pieces(made, line)
        each = list(zip(dynamic, pieces.g.max(axis=0).tolist(), strict=True))
        stiff = max((_slope(f) * g for f, g in each), default=0.0)
        hard = max((f.values["k"] * g for f, g in each if f.law == "end_stop"), default=0.0)
        followed = hard <= STOP_STIFF or line.h.max() <= 1.001 * STOP_PIECE
        if (stiff <= STIFF and followed) or steps >= MOST_STEPS:
            return made, pieces
        steps *= 2


def _slope(force: Force) -> float:
    """Largest stiffness of a law that is iterated in its usual range, in its place's unit."""
    v = force.values
    if force.law == "end_stop":
        return 0.0
    if force.law == "bouc_wen":
        return v["T_y"] / v["z_y"]
    return v.get("k", 0.0)


def _pieces(made: Plant, line: Timeline) -> kernel.Pieces:
    force = line.Gamma[:, :, made.n_in : made.n_in + made.n_law]
    moved = np.einsum("ij,pjk->pik", made.Z, force)
    i = np.arange(made.n_law)
    return kernel.Pieces(
        np.ascontiguousarray(line.Phi), np.ascontiguousarray(line.Gamma), line.new, line.read,
        line.late, line.wait, line.h, np.ascontiguousarray(made.C), np.ascontiguousarray(made.D),
        np.ascontiguousarray(made.Z),
        np.ascontiguousarray(moved[:, 2 * i, i]), np.ascontiguousarray(moved[:, 2 * i + 1, i]),
    )  # fmt: skip


def _laws(setup: Setup) -> kernel.Laws:
    dynamic = [f for f in setup.forces if f.law in NUMBERS]
    value = np.zeros((len(dynamic), kernel.N_VALUES))
    for row, f in zip(value, dynamic, strict=True):
        names = NUMBERS[f.law][1]
        row[: len(names)] = [f.values[name] for name in names]
    law = np.array([NUMBERS[f.law][0] for f in dynamic], dtype=np.int64)
    drives = [d.name for d in setup.drives]
    on = [drives.index(f.on) if f.on in drives else 0 for f in dynamic]
    return kernel.Laws(law, value, np.array(on, dtype=np.int64))


def _controller(setup: Setup, control: Control, *, ideal: bool) -> kernel.Controller:
    static = {(f.law, f.on): f.values[STATIC[f.law]] for f in setup.forces if f.law in STATIC}
    actuators = [d.actuator for d in setup.drives]
    n = len(actuators)
    return kernel.Controller(
        np.ascontiguousarray(control.feedback),
        np.zeros(n) if ideal else np.array([a.resolution for a in actuators]),
        np.full(n, -np.inf) if ideal else np.array([a.low for a in actuators]),
        np.full(n, np.inf) if ideal else np.array([a.high for a in actuators]),
        np.array([static.get(("valve_deadband", a.name), 0.0) for a in actuators]),
        np.array([static.get(("output_saturation", a.name), 0.0) for a in actuators]),
    )


def clean(setup: Setup, control: Control, r: Float) -> Float:
    """(n, n_y) samples of a run from rest under r (n, n_in): no noise, no rounding, no limits but
    the laws'."""
    made, pieces = ready(setup, control)
    n_y = len(made.C)
    endless = np.full(n_y, np.inf)
    ideal = kernel.Converters(np.zeros(n_y), -endless, endless, np.zeros(n_y))
    y, _ = kernel.run(
        pieces, _laws(setup), _controller(setup, control, ideal=True), ideal,
        np.ascontiguousarray(r), np.zeros((len(r), n_y)), np.zeros((len(r), 0)),
        np.zeros(len(made.A)), 0.0,
    )  # fmt: skip
    return np.asarray(y)


def recorded(
    setup: Setup, control: Control, noise: Noise, r: Float, rng: np.random.Generator
) -> tuple[Float, Float]:
    """Samples (n, n_y) as the converters show them, and commands (n, n_in), of a run under
    r (n, n_in) with all noise."""
    made, pieces = ready(setup, control, noise.pushes)
    rest = round(SETTLE * control.rate_hz)
    r = np.concatenate([np.zeros((rest, r.shape[1])), r])
    n, n_y, rate = len(r), len(made.C), control.rate_hz
    errors = rng.standard_normal((n, n_y)) * noise.white
    for i in range(n_y):
        if noise.wander[i] > 0:
            errors[:, i] += noise.wander[i] * coloured(rng, noise.wander_hz, rate, n)
    t = np.arange(n) / rate
    errors += noise.hum * np.sin(2 * np.pi * noise.hum_hz * t[:, None] + noise.hum_phase)
    if noise.spikes > 0:
        struck = rng.random((n, n_y)) < noise.spikes / rate
        errors += struck * rng.standard_normal((n, n_y)) * noise.spike
    push = [
        rms * coloured(rng, corner, rate, n)
        for rms, corner in zip(noise.push_rms, noise.push_corner, strict=True)
    ]
    s = setup.sensors
    converters = kernel.Converters(
        np.array([x.resolution for x in s]),
        np.array([x.low for x in s]),
        np.array([x.high for x in s]),
        noise.offset,
    )
    y, v = kernel.run(
        pieces, _laws(setup), _controller(setup, control, ideal=False), converters,
        r, errors, np.ascontiguousarray(np.array(push).reshape(-1, n).T), np.zeros(len(made.A)),
        -SETTLE,
    )  # fmt: skip
    return y[rest:], v[rest:]
