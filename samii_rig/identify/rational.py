"""Rational models with common poles: vector fitting for a start, then least squares.

    G_k(s) = sum_m r_km/(s - a_m) + conjugates + e_k/s + d_k + h_k s

for each entry k of the response, poles common to all. The last three stand for an
integrating actuator and for what lies beyond the band. Residues enter in real numbers: a pair
of poles has the two functions 1/(s - a) + 1/(s - a*) and j/(s - a) - j/(s - a*).

Start: vector fitting (Gustavsen and Semlyen, IEEE Trans. Power Delivery 14, 1999), one QR an
entry (Deschrijver et al., IEEE Microwave Wireless Components Letters 18, 2008). It weighs
entries by themselves and is not a least squares estimate, so Gauss-Newton steps in noise units
with the full covariance follow; their covariance is that of the estimate.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from samii_rig.types import Complex, Float

RELOCATIONS = 12  # of the poles by vector fitting; a few are usual
NEWTON_STEPS = 20
NEWTON_END = 0.01  # change of chi-square at which Gauss-Newton ends: a tenth of a sigma at most
DAMPING = 0.01  # of the poles to begin with
NEW_DAMPING = 0.3  # of a pair put to the poles of a smaller fit
BEYOND = 1.5  # where it is put, over the highest frequency
SMOOTH = 15  # lines over which what is left is summed to find where most of it is
EXTRAS = 3  # functions 1/s, 1, s
RIDGE = 1e-13  # relative, added to the scaled normal equations: rounding of their digits


@dataclass(frozen=True, slots=True)
class Rational:
    """A fitted model; s is in units of `scale` rad/s within.

    pairs : (n_pair,) poles with Im > 0, each for its conjugate as well. real : (n_real,).
    coefficients : (p, 2 n_pair + n_real + EXTRAS) real, in the order of the functions.
    covariance : of all parameters: pairs (Re, Im by turns), real poles, then coefficients
        entry by entry.
    chi2 : sum of squares of the residuals in noise units.
    """

    scale: float
    pairs: Complex
    real: Float
    coefficients: Float
    covariance: Float
    chi2: float

    @property
    def n_poles(self) -> int:
        """Real parameters of the poles, which is their number."""
        return 2 * self.pairs.size + self.real.size

    def residues(self) -> Complex:
        """(p, n_pair) complex residues at `pairs`, in units of scale."""
        c = self.coefficients[:, : 2 * self.pairs.size]
        return np.asarray(c[:, 0::2] + 1j * c[:, 1::2])

    def evaluate(self, s: Complex) -> Complex:
        """(n, p) at s in units of scale."""
        return np.asarray(functions(s, self.pairs, self.real) @ self.coefficients.T)

    def slopes(self, s: Complex) -> Complex:
        """(n, p, n_poles) derivatives by the parameters of the poles."""
        n = self.coefficients.shape[0]
        out = np.zeros((s.size, n, self.n_poles), complex)
        R = self.residues()
        for m, a in enumerate(self.pairs):
            up = R[None, :, m] / (s[:, None] - a) ** 2
            down = R[None, :, m].conj() / (s[:, None] - a.conjugate()) ** 2
            out[:, :, 2 * m] = up + down
            out[:, :, 2 * m + 1] = 1j * (up - down)
        first = 2 * self.pairs.size
        for m, b in enumerate(self.real):
            out[:, :, first + m] = self.coefficients[None, :, first + m] / (s[:, None] - b) ** 2
        return out


def functions(s: Complex, pairs: Complex, real: Float, extras: bool = True) -> Complex:
    """(n, n_function) the partial fractions at s, and 1/s, 1, s."""
    columns = []
    for a in pairs:
        up, down = 1 / (s - a), 1 / (s - a.conjugate())
        columns += [up + down, 1j * (up - down)]
    columns += [1 / (s - b) for b in real]
    if extras:
        columns += [1 / s, np.ones_like(s), s]
    return np.stack(columns, axis=1)


def fit_rational(
    s: Complex,
    G: Complex,
    weight: Complex,
    scale: float,
    n_pairs: int,
    smaller: Rational | None = None,
) -> Rational:
    """Fit by `n_pairs` pairs of poles (vector fitting may turn pairs into real poles).

    s : (n,) rad/s over scale, on the imaginary axis. G : (n, p). weight : (n, p, p) that turns
    errors into uncorrelated ones of E|e|^2 = 2.
    smaller : a fit by one pair less. Noise leads vector fitting astray where poles are weak,
        so its poles and a new pair, beyond the band or where most is left, are tried too.
    """
    spread = np.geomspace(abs(s[0]), abs(s[-1]), n_pairs + 2)[1:-1]
    pairs, real = spread * (-DAMPING + 1j), np.zeros(0)
    own = 1 / np.sqrt(np.sum(np.abs(np.linalg.inv(weight)) ** 2, axis=2))
    for _ in range(RELOCATIONS):
        pairs, real = _relocated(s, G, own, pairs, real)
    starts = [(pairs, real)]
    if smaller is not None:
        left = (weight @ (G - smaller.evaluate(s))[:, :, None])[:, :, 0]
        power = np.convolve(np.sum(np.abs(left) ** 2, axis=1), np.ones(SMOOTH), mode="same")
        for size in (abs(s[int(np.argmax(power))]), BEYOND * abs(s[-1])):
            pair = size * (-NEW_DAMPING + 1j * np.sqrt(1 - NEW_DAMPING**2))
            starts.append((np.append(smaller.pairs, pair), smaller.real))
    return min(
        (_refined(s, G, weight, scale, *start) for start in starts), key=lambda fit: fit.chi2
    )


def _relocated(
    s: Complex, G: Complex, weight: Float, pairs: Complex, real: Float
) -> tuple[Complex, Float]:
    """Zeros of sigma(s) = 1 + sum c_m f_m(s), with sigma G fitted by the same poles."""
    whole = functions(s, pairs, real)
    poles = whole[:, :-EXTRAS]
    n, left = poles.shape[1], whole.shape[1]
    rows, rhs = [], []
    for k in range(G.shape[1]):
        w = weight[:, k : k + 1]
        A = np.hstack([w * whole, -w * G[:, k : k + 1] * poles])
        b = (w * G[:, k : k + 1])[:, 0]
        stacked = np.vstack([A.real, A.imag])
        size = np.linalg.norm(stacked, axis=0)
        Q, R = np.linalg.qr(stacked / size)
        rows.append(R[left:, left:] * size[left:])
        rhs.append(Q[:, left:].T @ np.concatenate([b.real, b.imag]))
    A = np.vstack(rows)
    size = np.linalg.norm(A, axis=0)
    c = np.linalg.lstsq(A / size, np.concatenate(rhs), rcond=None)[0] / size
    M, column = np.zeros((n, n)), np.zeros(n)
    for m, a in enumerate(pairs):
        M[2 * m : 2 * m + 2, 2 * m : 2 * m + 2] = [[a.real, a.imag], [-a.imag, a.real]]
        column[2 * m] = 2.0
    first = 2 * pairs.size
    M[range(first, n), range(first, n)] = real
    column[first:] = 1.0
    zeros = np.linalg.eigvals(M - np.outer(column, c))
    zeros = -np.abs(zeros.real) + 1j * zeros.imag
    return zeros[zeros.imag > 0], zeros[zeros.imag == 0].real


def _refined(
    s: Complex, G: Complex, weight: Complex, scale: float, pairs: Complex, real: Float
) -> Rational:
    """Gauss-Newton with halved steps, over poles and residues at once."""
    model = _linear(s, G, weight, scale, pairs, real)
    for _ in range(NEWTON_STEPS):
        J, r = _jacobian(model, s, G, weight)
        step = _solve(J, r)[: model.n_poles]
        better = None
        for part in (1.0, 0.5, 0.2, 0.05):
            pairs, real = _moved(model, part * step)
            if np.all(pairs.imag > 0):
                trial = _linear(s, G, weight, scale, pairs, real)
                if trial.chi2 < model.chi2:
                    better = trial
                    break
        if better is None:
            break
        gained = model.chi2 - better.chi2
        model = better
        if gained < NEWTON_END:
            break
    J, _ = _jacobian(model, s, G, weight)
    size = np.linalg.norm(J, axis=0)
    normal = (J / size).T @ (J / size) + RIDGE * np.eye(size.size)
    covariance = np.linalg.inv(normal) / np.outer(size, size)
    return Rational(scale, model.pairs, model.real, model.coefficients, covariance, model.chi2)


def _moved(model: Rational, step: Float) -> tuple[Complex, Float]:
    n = 2 * model.pairs.size
    return model.pairs + step[0:n:2] + 1j * step[1:n:2], model.real + step[n:]


def _linear(
    s: Complex, G: Complex, weight: Complex, scale: float, pairs: Complex, real: Float
) -> Rational:
    """The residues that fit best for given poles."""
    p = G.shape[1]
    A = _columns(functions(s, pairs, real), weight)
    b = (weight @ G[:, :, None])[:, :, 0]
    stacked, rhs = _stack(A), np.concatenate([b.reshape(-1).real, b.reshape(-1).imag])
    c = _solve(stacked, rhs)
    chi2 = float(np.sum((rhs - stacked @ c) ** 2))
    return Rational(scale, pairs, real, c.reshape(p, -1), np.zeros((0, 0)), chi2)


def _jacobian(model: Rational, s: Complex, G: Complex, weight: Complex) -> tuple[Float, Float]:
    poles = weight @ model.slopes(s)
    J = np.concatenate([poles, _columns(functions(s, model.pairs, model.real), weight)], axis=2)
    e = (weight @ (G - model.evaluate(s))[:, :, None]).reshape(-1)
    return _stack(J), np.concatenate([e.real, e.imag])


def _columns(F: Complex, weight: Complex) -> Complex:
    """(n, p, p n_function): entry k's functions through column k of the weight."""
    n, p = weight.shape[:2]
    return np.asarray((weight[:, :, :, None] * F[:, None, None, :]).reshape(n, p, -1))


def _stack(A: Complex) -> Float:
    flat = A.reshape(-1, A.shape[-1])
    return np.concatenate([flat.real, flat.imag])


def _solve(A: Float, b: Float) -> Float:
    """Least squares by scaled normal equations: the columns are few and well apart."""
    size = np.linalg.norm(A, axis=0)
    A = A / size
    return np.asarray(np.linalg.solve(A.T @ A + RIDGE * np.eye(size.size), A.T @ b) / size)
