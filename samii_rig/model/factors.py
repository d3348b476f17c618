"""What of a chain depends on s: the point elements' laws, the sources, beams as waves, branches.

All of it is computed here with numpy, once for all s of a call, and given to the kernels.
"""

from __future__ import annotations

from types import ModuleType

import numpy as np

from samii_rig.model import rod, timoshenko, transformer
from samii_rig.model.chain import LINE_AT, SOURCE_WIDTH, WIDTH, CompiledChain
from samii_rig.model.kernels import respond
from samii_rig.model.kernels.registers import Factors
from samii_rig.model.laws import LINE_FILTERS, POINTS, READINGS, SOURCE_LAWS
from samii_rig.types import Complex, Float

_TURN = np.array([1.0, -1.0, 1.0, -1.0])  # theta and V of a mirrored chain
TRANSFORMERS = ("gear", "spindle", "bend")


def bind(c: CompiledChain, s: Complex, slopes: bool = False, driven: bool = True) -> Factors:
    """What depends on s at s (n,); `slopes`: with derivatives for gradients; not `driven`: without
    the sources, which no pole of the chain depends on."""
    pars = c.system.pars
    jump = np.zeros((len(c.points), s.size), complex)
    jump_d = np.zeros((len(c.points) if slopes else 0, WIDTH, s.size), complex)
    for row, e in enumerate(c.points):
        law = POINTS[c.kinds[e]]
        jump[row] = law.value(s, pars[e])
        if slopes:
            d = law.slopes(s, pars[e])
            jump_d[row, : d.shape[0]] = d
    none = np.zeros((0, s.size), complex), np.zeros((0, SOURCE_WIDTH, s.size), complex)
    drive, drive_d = _drive(c, s, slopes) if driven else none
    return Factors(jump, _matrices(c, s), drive, jump_d, drive_d)


def _drive(c: CompiledChain, s: Complex, slopes: bool) -> tuple[Complex, Complex]:
    if not c.sources:  # the root of a branch: jumps of 1
        n = c.system.source.shape[0]
        return np.ones((n, s.size), complex), np.zeros((0, SOURCE_WIDTH, s.size), complex)
    drive = np.empty((len(c.sources), s.size), complex)
    slopes_of: list[Complex] = []
    for i, (kind, p, line) in enumerate(zip(c.sources, c.source_values, c.lines, strict=True)):
        law = SOURCE_LAWS[kind]
        drive[i] = law.value(s, p)
        d = law.relative(s, p) if slopes else np.zeros((0, s.size), complex)
        if line:
            passed, relative = LINE_FILTERS[line]
            drive[i] *= passed(s, p[LINE_AT:])
            if slopes:
                padded = np.zeros((SOURCE_WIDTH, s.size), complex)
                padded[: d.shape[0]] = d
                by_line = p[0] * relative(s, p[LINE_AT:])
                padded[LINE_AT : LINE_AT + len(by_line)] = by_line
                d = padded
        slopes_of.append(d)
    if len(slopes_of) == 1:
        return drive, slopes_of[0][None]
    drive_d = np.zeros((len(slopes_of), max(d.shape[0] for d in slopes_of), s.size), complex)
    for i, d in enumerate(slopes_of):
        drive_d[i, : d.shape[0]] = d
    return drive, drive_d


def _matrices(c: CompiledChain, s: Complex) -> Complex:
    out = np.zeros((len(c.waves), 2, timoshenko.ROWS, s.size), complex)
    branches = {e: inner for e, inner, _ in c.branches}
    for row, e in enumerate(c.waves):
        if e in branches:
            out[row] = _branch_matrix(impedance(branches[e], s))
        elif c.kinds[e] in TRANSFORMERS:
            out[row] = transformer.matrix(c.kinds[e], s, c.system.pars[e])
        else:
            out[row] = _law(c.kinds[e]).matrix(s, _pars(c, e))
    return out


def _pars(c: CompiledChain, e: int) -> Float:
    return timoshenko.full(c.kinds[e], c.system.pars[e])


def _law(kind: str) -> ModuleType:
    """The module with matrix, scaling and gradient of an element of waves."""
    return rod if kind == "rod" else timoshenko


def read(c: CompiledChain, s: Complex, H: Complex) -> None:
    """Let the sensors whose reading depends on their element read it, H (n, n_out, n_in)."""
    for sensor, law, e in c.readings:
        H[:, sensor] *= READINGS[law].value(s, c.system.pars[e])[:, None]


def read_slopes(c: CompiledChain, s: Complex, place: np.ndarray, H: Complex, dH: Complex) -> None:
    """`read` of H (n, n_out, n_in) and of dH (n, n_out, n_in, n_wanted); `place` : see
    `add_waves`."""
    for sensor, law, e in c.readings:
        dH[:, sensor] *= READINGS[law].value(s, c.system.pars[e])[:, None, None]
        for slope, slot in zip(READINGS[law].slopes(s, c.system.pars[e]), c.slots[e], strict=False):
            if place[slot] >= 0:
                dH[:, sensor, :, place[slot]] += H[:, sensor] * slope[:, None]
    read(c, s, H)


def impedance(inner: CompiledChain, s: Complex) -> Complex:
    """(n, 2, 2) moment and shear force that move a branch's root by w and theta."""
    Z = np.zeros((s.size, 2, 2), complex)
    if s.size:
        respond.response(inner.system, bind(inner, s), s, Z)
    return Z


def _branch_matrix(Z: Complex) -> Complex:
    """M+ = M- - Z (w, theta), in the form of `timoshenko.matrix`."""
    U = np.zeros((Z.shape[0], 4, 4), complex)
    U[:] = np.eye(4)
    U[:, 2:, :2] = -Z
    back = 2 * np.eye(4) - U
    out = np.zeros((2, timoshenko.ROWS, Z.shape[0]), complex)
    for side, u in enumerate((U, _TURN[:, None] * back * _TURN)):
        out[side, :16] = timoshenko.SORT.ravel()[:, None]
        out[side, 16:32] = (u @ timoshenko.SORT).reshape(-1, 16).T
    out[:, 32:] = 1.0
    return out


def add_waves(
    c: CompiledChain, s: Complex, place: np.ndarray, z: Complex, zh: Complex, dH: Complex
) -> None:
    """Add to dH what the parameters of beams as waves and of branches do.

    place (n_param + 1,) : where in dH each parameter's derivative goes, -1 for nowhere.
    z, zh : as returned by `respond.gradient`.
    """
    x = c.system
    branches = {e: (inner, first) for e, inner, first in c.branches}
    for row, e in enumerate(c.waves):
        if e in branches:
            inner, first = branches[e]
            slots = np.arange(first, first + len(inner.parameters))
        else:
            slots = c.slots[e]
        to = place[slots]
        if to.max(initial=-1) < 0:
            continue
        if e in branches:
            by = _branch_gradient(inner, s, z[row], zh[row])
        elif c.kinds[e] in TRANSFORMERS:
            by = transformer.gradient(c.kinds[e], x.pars[e], z[row], zh[row])
        else:
            by = _law(c.kinds[e]).gradient(s, _pars(c, e), z[row], zh[row])
        for m in np.flatnonzero((to >= 0) & (slots >= 0)):
            for source, (_, actuator) in enumerate(x.source):
                dH[:, :, actuator, to[m]] += x.source_c[source, 4] * by[m, :, :, source]


def _branch_gradient(inner: CompiledChain, s: Complex, z: Complex, zh: Complex) -> Complex:
    """(n_param, n, n_sensor, n_source): -zh^T J dU z with dU = -dZ, see `gradient`."""
    n = len(inner.parameters)
    _, dZ = differentiate(inner, s, np.append(np.arange(n), -1), n, 2, 2)
    dM = np.einsum("nkp,nkb->pnb", dZ[:, 0], z[:, :2])
    dV = np.einsum("nkp,nkb->pnb", dZ[:, 1], z[:, :2])
    w, theta = zh[:, 0, :, None], zh[:, 1, :, None]
    return np.asarray(w * dV[:, :, None] - theta * dM[:, :, None])


def differentiate(
    c: CompiledChain, s: Complex, place: np.ndarray, n_wanted: int, n_out: int, n_in: int
) -> tuple[Complex, Complex]:
    """H (n, n_out, n_in) and dH (..., n_wanted) of a compiled chain, `place` as in `add_waves`.

    The loads of gravity are parameters too while it is computed; what they depend on passes on.
    """
    by_load = np.zeros((c.weight.size if c.weight else 0, n_wanted))
    if len(by_load):
        wanted = np.flatnonzero(place[:-1] >= 0)
        by_load[:, place[wanted]] = c.load_slopes()[:, wanted]
        place = np.concatenate([place[:-1], n_wanted + np.arange(len(by_load)), [-1]])
    H = np.zeros((s.size, n_out, n_in), complex)
    dH = np.zeros((*H.shape, n_wanted + len(by_load)), complex)
    if s.size:
        f = bind(c, s, slopes=True)
        slots = place[c.slots]
        for e, inner, first in c.branches:
            # Not a place of its own: only that the states at the branch are wanted.
            slots[e, 0] = place[first : first + len(inner.parameters)].max()
        z, zh = respond.gradient(c.system, f, s, slots, place[c.source_slots], H, dH)
        add_waves(c, s, place, z, zh, dH)
    if len(by_load):
        dH = dH[..., :n_wanted] + dH[..., n_wanted:] @ by_load
    return H, dH


def clearing(c: CompiledChain, s: Complex) -> tuple[Complex, Float]:
    """mantissa exp(log), (n,) each, which clears the poles of point elements and branches from D at
    s (n,), rad/s."""
    mantissa, log = np.ones_like(s), np.zeros(s.size)
    for e in c.poles:
        factor, more = POINTS[c.kinds[e]].clear(s, c.system.pars[e])
        mantissa, log = mantissa * factor, log + more
    for _, inner, _ in c.branches:
        factor, more = characteristic(inner, s, True)
        mantissa, log = mantissa * factor, log + more
    return mantissa, log


def characteristic(c: CompiledChain, s: Complex, clear: bool) -> tuple[Complex, Float]:
    """D = mantissa exp(log), (n,) each, of a compiled chain at s (n,), rad/s: see
    `tmm.Chain.characteristic`."""
    mantissa, log = np.zeros(s.size, complex), np.zeros(s.size)
    if not s.size:
        return mantissa, log
    respond.characteristic(c.system, bind(c, s, driven=False), s, mantissa, log)
    branches = {e for e, _, _ in c.branches}
    for e in c.waves:
        if e not in branches and c.kinds[e] not in TRANSFORMERS:
            factor, more = _law(c.kinds[e]).scaling(s, _pars(c, e))
            mantissa, log = mantissa * factor, log + more
    if not clear:
        return mantissa, log
    factor, more = clearing(c, s)
    mantissa, log = mantissa * factor, log + more
    size = np.abs(mantissa)
    safe = np.where(size > 0, size, 1.0)
    return np.asarray(mantissa / safe), np.asarray(log + np.log(safe))
