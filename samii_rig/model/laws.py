"""The laws of point elements and sources: what each does to the state, as data.

A point element adds to one state x times another, z+ = z- + e_i x(s) e_j^T z-, and is a row
(pair, law): `pair` names i and j, the law gives x at each s, its derivatives by the element's
parameters and, where x has poles, the factor that clears them from the characteristic
function. Only the four pairs of conjugate states keep the symplectic product (`elements.J`).

A source is a jump of the state by K f(s) v, and is a row (dual, sign, law): see `solve` for the
dual of a jump.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from samii_rig.model.kernels.registers import M_THETA, THETA_M, V_W, W_V
from samii_rig.types import Complex, Float

Clearing = tuple[Complex | float, Float | float]
"""A factor as mantissa exp(log)."""


def _clears_nothing(s: Complex, p: Float) -> Clearing:
    return 1.0, 0.0


@dataclass(frozen=True, slots=True)
class Law:
    """x(s) of a point element with parameters p, in the order of its class.

    value : (s (n,), p) -> (n,). slopes : -> (n_param, n), derivatives by p.
    clear : -> a factor that is entire and vanishes at the poles of x.
    """

    pair: int
    value: Callable[[Complex, Float], Complex]
    slopes: Callable[[Complex, Float], Complex]
    clear: Callable[[Complex, Float], Clearing] = _clears_nothing


@dataclass(frozen=True, slots=True)
class SourceLaw:
    """A jump by K f(s): f with parameters p, p[0] = K.

    dual : coefficients on w, theta, M, V of the sensor to which the jump is dual.
    relative : (s, p) -> (n_param, n), derivatives of K f by p, divided by f.
    """

    dual: tuple[float, float, float, float]
    value: Callable[[Complex, Float], Complex]
    relative: Callable[[Complex, Float], Complex]


@dataclass(frozen=True, slots=True)
class ReadingLaw:
    """x(s, p) by which a sensor reads a state, p the parameters of the element it stands on.

    value : (s (n,), p) -> (n,). slopes : -> (n_param, n), derivatives by p.
    """

    value: Callable[[Complex, Float], Complex]
    slopes: Callable[[Complex, Float], Complex]


def _inverse(z: Complex) -> Complex:
    # 0 at a pole itself: a response there is of no use, but D is asked for and needs no source.
    return np.divide(1.0, z, out=np.zeros_like(z), where=z != 0)


def _impedance(s: Complex, p: Float) -> Complex:
    return np.asarray(p[0] + p[1] * s)


def _compliance(s: Complex, p: Float) -> Complex:
    return _inverse(_impedance(s, p))


def _compliance_slopes(s: Complex, p: Float) -> Complex:
    x2 = _compliance(s, p) ** 2
    return np.stack([-x2, -s * x2])


def _clear_spring(s: Complex, p: Float) -> Clearing:
    if p[1] == 0:
        return 1.0, 0.0
    return _impedance(s, p) / (p[0] if p[0] > 0 else p[1]), 0.0


def _impedance_slopes(s: Complex, p: Float) -> Complex:
    return np.stack([np.ones_like(s), s])


def _oil(s: Complex, p: Float) -> Complex:
    return np.full_like(s, p[1] / p[0] ** 2)


def _oil_slopes(s: Complex, p: Float) -> Complex:
    D, C_h = p[0], p[1]
    return np.stack([np.full_like(s, -2 * C_h / D**3), np.full_like(s, 1 / D**2)])


@dataclass(frozen=True, slots=True)
class _Chambers:
    """1/k = N/D of a `schema.Cylinder` at each s, p = (A_1, A_2, V_1, V_2, B, leak):
    N = s + g S_0, D = B (S_2 s + g d^2/(V_1 V_2)), d = A_1 - A_2, g = B leak."""

    s: Complex
    p: Float

    def parts(self) -> tuple[Complex, Complex]:
        """N and D; without a leak 1 and B S_2, as s is in both."""
        a, b, V, W, B, leak = self.p[:6]
        S2 = a**2 / V + b**2 / W
        if leak == 0:
            return np.ones_like(self.s), np.full_like(self.s, B * S2)
        g = B * leak
        return self.s + g * (1 / V + 1 / W), B * (S2 * self.s + g * (a - b) ** 2 / (V * W))

    def slopes(self) -> Complex:
        """(6, n) of N/D."""
        a, b, V, W, B, leak = self.p[:6]
        s, g, d = self.s, B * leak, a - b
        S0, S2 = 1 / V + 1 / W, a**2 / V + b**2 / W
        N, E = s + g * S0, S2 * s + g * d**2 / (V * W)  # D = B E
        zero = np.zeros_like(s)
        one = np.ones_like(s)
        dN = np.stack([zero, zero, -g / V**2 * one, -g / W**2 * one, leak * S0 * one, B * S0 * one])
        far = d**2 / (V * W)
        dE = np.stack(
            [
                2 * a / V * s + 2 * g * d / (V * W),
                2 * b / W * s - 2 * g * d / (V * W),
                -((a / V) ** 2) * s - g * far / V,
                -((b / W) ** 2) * s - g * far / W,
                leak * far * one,
                B * far * one,
            ]
        )
        out = _inverse(B * E) * (dN - N * _inverse(E) * dE)
        out[4] -= N * _inverse(B * E) / B
        return np.asarray(out)


def _chambers(s: Complex, p: Float) -> Complex:
    N, D = _Chambers(s, p).parts()
    return np.asarray(-N * _inverse(D))


def _clear_chambers(s: Complex, p: Float) -> Clearing:
    _, D = _Chambers(s, p).parts()
    return D / (p[4] * (p[0] ** 2 / p[2] + p[1] ** 2 / p[3])), 0.0


def _constant(s: Complex, p: Float) -> Complex:
    return np.full_like(s, p[0])


def _constant_slopes(s: Complex, p: Float) -> Complex:
    return np.ones((1, s.size), complex)


@dataclass(frozen=True, slots=True)
class _Chamber:
    """p_k/V of a `schema.Cylinder`, V its push, k = 1 or 2: N/E with N = (A_1 s/V_1 + x) of the
    first, -(A_2 s/V_2 - x) of the second, E = S_2 s + x d, x = g d/(V_1 V_2), d = A_1 - A_2."""

    number: int

    def parts(self, s: Complex, p: Float) -> tuple[Complex, Complex]:
        """N and E; without x both over s, which is in both."""
        a, b, V, W, B, leak = p[:6]
        S2, x = a**2 / V + b**2 / W, B * leak * (a - b) / (V * W)
        at = s if x != 0 else np.ones_like(s)
        own = a / V if self.number == 1 else -b / W
        return np.asarray(own * at + x), np.asarray(S2 * at + x * (a - b))

    def value(self, s: Complex, p: Float) -> Complex:
        N, E = self.parts(s, p)
        return np.asarray(N * _inverse(E))

    def slopes(self, s: Complex, p: Float) -> Complex:
        """(6, n)."""
        a, b, V, W, B, leak = p[:6]
        zero, one, d = np.zeros_like(s), np.ones_like(s), a - b
        x = B * leak * d / (V * W)
        dx = [B * leak / (V * W), -B * leak / (V * W), -x / V, -x / W, x / B, B * d / (V * W)]
        first = self.number == 1
        own = [s / V, zero, -a * s / V**2, zero] if first else [zero, -s / W, zero, b * s / W**2]
        S2 = [2 * a / V * s, 2 * b / W * s, -((a / V) ** 2) * s, -((b / W) ** 2) * s]
        dd = [x, -x, 0.0, 0.0, 0.0, 0.0]
        N = (a / V if first else -b / W) * s + x
        E = (a**2 / V + b**2 / W) * s + x * d
        dN = np.stack([n + y * one for n, y in zip([*own, zero, zero], dx, strict=True)])
        dE = np.stack(
            [n + (y * d + more) * one for n, y, more in zip([*S2, zero, zero], dx, dd, strict=True)]
        )
        return np.asarray(_inverse(E) * (dN - N * _inverse(E) * dE))


def _flexibility(s: Complex, p: Float) -> Complex:
    """theta'/M of a beam, p = (EI, mu, L, eta, tau, ...)."""
    return _inverse(_modulus(s, p))


def _modulus(s: Complex, p: Float) -> Complex:
    # The loss factor changes sign with Im s, so that the response of a real input is real.
    return np.asarray(p[0] * (1 + 1j * np.where(s.imag < 0, -p[3], p[3]) + s * p[4]))


def _flexibility_slopes(s: Complex, p: Float) -> Complex:
    x = _flexibility(s, p)
    sign = np.where(s.imag < 0, -1.0, 1.0)
    zero = np.zeros_like(s)
    return np.stack([-x / p[0], zero, zero, -1j * sign * p[0] * x**2, -s * p[0] * x**2])


SMALL_LINE = 1e-3  # |G|^2 below which series replace quotients of G; their error is |G|^6/1e4


@dataclass(frozen=True, slots=True)
class _Line:
    """A hydraulic line at each s, p = (D, L, A, rho, B, R): see `schema.HydraulicLine`.

    G = sqrt(q), q = L^2 (rho s/A + R) A s/B. All functions are even in G.
    t = tanh(G)/G, dt its derivative by q; h = 1/cosh(G), dh = d log h/dq.
    """

    s: Complex
    p: Float

    @property
    def q(self) -> Complex:
        _, L, A, rho, B, R = self.p[:6]
        return np.asarray(L**2 * (rho * self.s / A + R) * A * self.s / B)

    def q_slopes(self) -> Complex:
        """dq by D, L, A, rho, B, R, (6, n)."""
        s = self.s
        _, L, A, _, B, R = self.p[:6]
        q, zero = self.q, np.zeros_like(s)
        return np.stack(
            [zero, 2 * q / L, L**2 * R * s / B, L**2 * s**2 / B, -q / B, L**2 * A * s / B]
        )

    def tanh(self) -> tuple[Complex, Complex, Complex]:
        """tanh(G)/G, its derivative by q, and 1/cosh(G)."""
        q = self.q
        series = np.abs(q) < SMALL_LINE
        G = np.sqrt(np.where(series, 1.0, q))
        E = np.exp(-2 * G)  # Re G >= 0
        t = (1 - E) / (1 + E) / G
        h = 2 * np.exp(-G) / (1 + E)
        dt = (h**2 - t) / (2 * np.where(series, 1.0, q))
        small = np.where(series, q, 0.0)
        t = np.where(series, 1 - small / 3 + 2 * small**2 / 15 - 17 * small**3 / 315, t)
        dt = np.where(series, -1 / 3 + 4 * small / 15 - 17 * small**2 / 105, dt)
        h = np.where(series, 1 - small / 2 + 5 * small**2 / 24 - 61 * small**3 / 720, h)
        return np.asarray(t), np.asarray(dt), np.asarray(h)


def _line(s: Complex, p: Float) -> Complex:
    D, L, A, _, B, _ = p[:6]
    return np.asarray(A * L / (B * D**2) * _Line(s, p).tanh()[0])


def _line_slopes(s: Complex, p: Float) -> Complex:
    D, L, A, _, B, _ = p[:6]
    line = _Line(s, p)
    t, dt, _ = line.tanh()
    C = A * L / (B * D**2)
    out = C * dt * line.q_slopes()
    out[0] -= 2 * C * t / D
    out[1] += C * t / L
    out[2] += C * t / A
    out[4] -= C * t / B
    return np.asarray(out)


def _clear_line(s: Complex, p: Float) -> Clearing:
    """cosh(G)."""
    G = np.sqrt(_Line(s, p).q)
    return np.exp(1j * G.imag) * (1 + np.exp(-2 * G)) / 2, G.real


def line_filter(s: Complex, p: Float) -> Complex:
    """(n,) 1/cosh(G) at s (n,), rad/s: the part of a flow that arrives at a line's blocked end.
    p : the line's parameters in the schema's order."""
    return _Line(s, p).tanh()[2]


def line_filter_relative(s: Complex, p: Float) -> Complex:
    """(6, n) derivatives of log(1/cosh G) by the line's parameters: -tanh(G)/(2 G) dq."""
    line = _Line(s, p)
    return np.asarray(-line.tanh()[0] / 2 * line.q_slopes())


def _clear_lump(s: Complex, p: Float) -> Clearing:
    """1 + 2 zeta s/omega + s^2/omega^2 of a `schema.LumpedLine`, p = (D, C_h, omega, zeta)."""
    w, zeta = p[2:4]
    return np.asarray(1 + 2 * zeta * s / w + (s / w) ** 2), 0.0


def _lump(s: Complex, p: Float) -> Complex:
    return np.asarray(p[1] / p[0] ** 2 * _inverse(np.asarray(_clear_lump(s, p)[0])))


def _lump_slopes(s: Complex, p: Float) -> Complex:
    x = _lump(s, p)
    by_w, by_zeta = _of_lump(s, p)
    N = _clear_lump(s, p)[0]
    return np.stack([-2 * x / p[0], x / p[1], -x * by_w / N, -x * by_zeta / N])


def _of_lump(s: Complex, p: Float) -> tuple[Complex, Complex]:
    """Derivatives of 1 + 2 zeta s/omega + s^2/omega^2 by omega and zeta."""
    w, zeta = p[2:4]
    return -2 * s * (zeta / w**2 + s / w**3), 2 * s / w


def _lump_filter(s: Complex, p: Float) -> Complex:
    """(1 + 2 zeta s/omega)/(1 + 2 zeta s/omega + s^2/omega^2)."""
    w, zeta = p[2:4]
    return np.asarray((1 + 2 * zeta * s / w) * _inverse(np.asarray(_clear_lump(s, p)[0])))


def _lump_filter_relative(s: Complex, p: Float) -> Complex:
    """(4, n) derivatives of its logarithm by the line's parameters."""
    w, zeta = p[2:4]
    numerator, N = 1 + 2 * zeta * s / w, _clear_lump(s, p)[0]
    by_w, by_zeta = _of_lump(s, p)
    zero = np.zeros_like(s)
    return np.stack(
        [
            zero,
            zero,
            -2 * zeta * s / w**2 / numerator - by_w / N,
            2 * s / w / numerator - by_zeta / N,
        ]
    )


# By kind of line: what arrives at its vane of the flow into it, and the derivatives of its log.
LINE_FILTERS = {
    "hydraulic_line": (line_filter, line_filter_relative),
    "lumped_line": (_lump_filter, _lump_filter_relative),
}

_ACROSS = Law(
    W_V, lambda s, p: -_compliance(s, p), lambda s, p: -_compliance_slopes(s, p), _clear_spring
)
_TO_GROUND = Law(V_W, lambda s, p: -_impedance(s, p), lambda s, p: -_impedance_slopes(s, p))
# By kind of element, parameters in the order of its class.
POINTS: dict[str, Law] = {
    "torsional_spring": Law(THETA_M, _compliance, _compliance_slopes, _clear_spring),
    **dict.fromkeys(("translational_spring", "spring", "damper"), _ACROSS),
    "torsional_ground_spring": Law(M_THETA, _impedance, _impedance_slopes),
    **dict.fromkeys(("translational_ground_spring", "ground_spring", "ground_damper"), _TO_GROUND),
    "cylinder": Law(W_V, _chambers, lambda s, p: -_Chambers(s, p).slopes(), _clear_chambers),
    "gravity_stiffness": Law(M_THETA, _constant, _constant_slopes),
    "oil_column": Law(THETA_M, _oil, _oil_slopes),
    "hydraulic_line": Law(THETA_M, _line, _line_slopes, _clear_line),
    "lumped_line": Law(THETA_M, _lump, _lump_slopes, _clear_lump),
}


# By what a sensor reads of its element.
READINGS: dict[str, ReadingLaw] = {
    "strain": ReadingLaw(_flexibility, _flexibility_slopes),
    "chamber_1": ReadingLaw(_Chamber(1).value, _Chamber(1).slopes),
    "chamber_2": ReadingLaw(_Chamber(2).value, _Chamber(2).slopes),
}


def _late(s: Complex, tau: float) -> Complex | float:
    return np.exp(-s * tau) if tau > 0 else 1.0


def _first(s: Complex, p: Float) -> Complex:
    """Paper 2, eq. (1): p = K, p, tau."""
    f = s + p[1]
    f *= s
    np.divide(p[1], f, out=f, where=f != 0)  # in place, as it counts in the time of a response
    return np.asarray(f if p[2] == 0 else f * _late(s, p[2]))


def _first_relative(s: Complex, p: Float) -> Complex:
    K = p[0]
    return np.stack([np.ones_like(s), K / p[1] * s / (s + p[1]), -K * s])


def _second(s: Complex, p: Float) -> Complex:
    """Paper 2, eq. (2): p = K, omega, zeta, tau."""
    w = p[1]
    return np.asarray(w**2 * _inverse(s * (s**2 + 2 * p[2] * w * s + w**2)) * _late(s, p[3]))


def _second_relative(s: Complex, p: Float) -> Complex:
    K, w, zeta = p[0], p[1], p[2]
    N = s**2 + 2 * zeta * w * s + w**2
    return np.stack(
        [np.ones_like(s), K * (2 / w - (2 * zeta * s + 2 * w) / N), -2 * K * w * s / N, -K * s]
    )


def _effort(s: Complex, p: Float) -> Complex:
    """Torque or force: p = K, p (infinite for no lag), tau."""
    return np.asarray(_inverse(1 + s / p[1]) * _late(s, p[2]))


def _effort_relative(s: Complex, p: Float) -> Complex:
    K = p[0]
    return np.stack([np.ones_like(s), K * s / p[1] ** 2 / (1 + s / p[1]), -K * s])


def _second_at_rest(s: Complex, p: Float) -> Complex:
    """omega^2/(s^2 + 2 zeta omega s + omega^2): p = K, omega, zeta, tau."""
    return np.asarray(p[1] ** 2 * _table(s, p))


def _second_at_rest_relative(s: Complex, p: Float) -> Complex:
    K, w = p[0], p[1]
    relative = _table_relative(s, p)
    relative[1] += 2 * K / w
    return relative


def _table(s: Complex, p: Float) -> Complex:
    """1/(s^2 + 2 zeta omega s + omega^2): p = K, omega, zeta (both 0 for no suspension), tau."""
    return np.asarray(_inverse(s**2 + 2 * p[2] * p[1] * s + p[1] ** 2) * _late(s, p[3]))


def _table_relative(s: Complex, p: Float) -> Complex:
    K, w, zeta = p[0], p[1], p[2]
    N = s**2 + 2 * zeta * w * s + w**2
    return np.stack([np.ones_like(s), -K * (2 * zeta * s + 2 * w) / N, -2 * K * w * s / N, -K * s])


_ANGLE = (0.0, 0.0, -1.0, 0.0)  # theta jumps by +1
_WAY = (0.0, 0.0, 0.0, 1.0)  # w jumps by +1
SOURCE_LAWS: dict[str, SourceLaw] = {
    "angular_velocity_source": SourceLaw(_ANGLE, _first, _first_relative),
    "angular_velocity_source_2": SourceLaw(_ANGLE, _second, _second_relative),
    "torque_source": SourceLaw((0.0, -1.0, 0.0, 0.0), _effort, _effort_relative),  # M by -1
    "force_source": SourceLaw((-1.0, 0.0, 0.0, 0.0), _effort, _effort_relative),  # V by +1
    "displacement_source": SourceLaw(_WAY, _second_at_rest, _second_at_rest_relative),
    "velocity_source": SourceLaw(_WAY, _first, _first_relative),
    "acceleration_source": SourceLaw(_WAY, _table, _table_relative),
}
