"""Random chains, and the count of Wittrick and Williams: what the tests of modes share."""

import numpy as np
from fem_kit import SOURCE, chain
from hypothesis import strategies as st

from samii_rig.rig.schema import Beam, Rig, RigidLink, TorsionalSpring

positive = st.floats(0.3, 3.0)


@st.composite
def chains(draw: st.DrawFn, damped: bool = False) -> Rig:
    """Two beams, two joints and two bodies in this order, on any base and with any tip."""
    a = [draw(positive) for _ in range(14)]
    c = draw(st.floats(0.001, 0.05)) if damped else 0.0
    base = draw(st.sampled_from(["clamped", "pinned", "free"]))
    tip = draw(st.sampled_from(["clamped", "pinned", "free"]))
    return chain(
        ("first", "beam", {"EI": 40 * a[0], "mu": a[1], "L": 0.5 * a[2], "tau": c * 0.01}),
        ("joint_1", "torsional_spring", {"k": 60 * a[3], "c": c}),
        SOURCE,
        ("link_1", "rigid_link", {"L": 0.3 * a[4], "r": 0.1 * a[5], "m": a[6], "I": 0.02 * a[7]}),
        ("joint_2", "torsional_spring", {"k": 80 * a[8], "c": c}),
        ("last", "beam", {"EI": 30 * a[9], "mu": a[10], "L": 0.4 * a[11]}),
        ("link_2", "rigid_link", {"L": 0.2 * a[12], "r": 0.1, "m": a[13], "I": 0.03}),
        base=base,
        tip=tip,
    )


def wittrick_williams(rig: Rig, omega: float) -> int:
    """How many natural frequencies lie below omega, rad/s (Wittrick and Williams 1971).

    The negative eigenvalues of the dynamic stiffness, and the natural frequencies of each beam
    with its ends clamped. Assembled here by itself: no matrix and no root of the chain's.
    """
    parts: list[tuple[np.ndarray, np.ndarray]] = []  # row block, stiffness
    n, inside = 16, 0
    next_free = iter(range(n))

    def unit() -> np.ndarray:
        row = np.zeros(n)
        row[next(next_free)] = 1.0
        return row

    w = np.zeros(n) if rig.base != "free" else unit()
    theta = np.zeros(n) if rig.base == "clamped" else unit()
    for e in rig.element:
        if isinstance(e, Beam):
            new = (unit(), unit())
            k, clamped = _beam(e, omega)
            inside += clamped
            parts.append((np.array([w, theta, *new]), k))
            w, theta = new
        elif isinstance(e, TorsionalSpring):
            new_theta = unit()
            parts.append((np.array([new_theta - theta]), np.array([[e.k.value]])))
            theta = new_theta
        elif isinstance(e, RigidLink):
            centre = w + e.r.value * theta
            inertia = np.diag([e.m.value, e.I.value])
            parts.append((np.array([centre, theta]), -(omega**2) * inertia))
            w = w + e.L.value * theta
    rows = [w] if rig.tip != "free" else []
    rows += [theta] if rig.tip == "clamped" else []
    used = next(next_free)
    K = sum(block[:, :used].T @ k @ block[:, :used] for block, k in parts)
    if rows:
        held = np.array(rows)[:, :used]
        basis = np.linalg.svd(held)[2][len(rows) :].T
        K = basis.T @ K @ basis
    return inside + int(np.sum(np.linalg.eigvalsh(K) < 0))


def _beam(e: Beam, omega: float) -> tuple[np.ndarray, int]:
    """Dynamic stiffness on [w1, theta1, w2, theta2]; natural frequencies below, ends clamped."""
    EI, L = e.EI.value, e.L.value
    b = (e.mu.value * omega**2 / EI) ** 0.25 * L
    S, s, C, c = np.sinh(b), np.sin(b), np.cosh(b), np.cos(b)
    d = 1 - C * c
    F = EI / L**3 * b / d
    a1, a2, a3 = b**2 * (S * c + C * s), b * S * s * L, b**2 * (S + s)
    a4, a5, a6 = b * (C - c) * L, (C * s - S * c) * L**2, (S - s) * L**2
    k = F * np.array([[a1, a2, -a3, a4], [a2, a5, -a4, a6], [-a3, -a4, a1, -a2], [a4, a6, -a2, a5]])
    i = int(b // np.pi)
    return k, i - int((1 - (-1) ** i * np.sign(d)) / 2)
