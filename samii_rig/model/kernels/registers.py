"""Where the kernels keep what: the rows of the register file, a compiled chain, a block's work."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from samii_rig.model.kernels.lanes import LANES, part
from samii_rig.types import Complex, Float, Int

# Register rows. X: w1 theta1 M1 V1 w2 M2 V2 (complex) and theta2, which is 0 between elements.
X = 0
X_ROWS = 14
THETA2 = 14
# The change of basis over a beam, B11 B12 B21 B22 (complex). Over a spring it is the
# exchange where FLAG is 1, then column 1 times SCALE, then column 2 less RHO times column 1.
B = 16
SCALE = 24
FLAG = 25
RHO = 26
B_ROWS = 12
S = 28  # s and s^2
Y = 32  # a second X (with theta2) and B, for lanes on either side of the beams' threshold
BEAM = 60
BEAM_ROWS = 49
# Rows from BEAM on, for long beams: E1 E2 R E1E2 E1^2 E2^2 (complex, 0-11), sign of Im beta
# (12), scales in (13-18) and out (19-24). For both: a = L^2/EI and 1/a (25-28). For short
# beams: c0 c1 c2 c3 q c1 q c2 q c3 (29-42). For the characteristic function the phase of
# E1 E2 and -log of its modulus.
PHASE = BEAM + 43
DECAY = BEAM + 45
IS_LONG = BEAM + 46
BETA4 = BEAM + 47
BETA = BEAM + 31  # until the series overwrite it
NUMERATOR = BEAM + BEAM_ROWS
FREE = NUMERATOR + 2
ALPHA, GAMMA, FACTOR = FREE, FREE + 4, FREE + 8
Z = FREE + 10  # w theta M V of a solution behind an element, then in front of it
ZH = FREE + 26  # the same of a sensor's dual solution
OUT = FREE + 42
RESULT = FREE + 44  # up to five complex results
K = FREE + 54  # scratch, then ten complex integrals of a short beam
ROWS = FREE + 76

# Factors of a sensor's terms: 1, s^2, the compliance of a spring or hinge, s.
ONE, ACCELERATION, COMPLIANCE, VELOCITY = 0, 1, 2, 3

# Columns change places when column 2 has a pivot more than 100 times that of column 1:
# seldom, and then at most two digits are lost (threshold pivoting, as in sparse LU).
EXCHANGE = 100.0**2
HUGE = 1e60  # columns are rescaled when the square of a pivot leaves 1/HUGE to HUGE

# From SPRING on an element changes the basis. A JUMP has one of the pairs of `laws` but
# THETA_M, which is a HINGE; WAVES is any 4x4 matrix in the form of `timoshenko`.
IDENTITY, LINK, SPRING, HINGE, JUMP, BEAM_KIND, WAVES = 0, 1, 2, 3, 4, 5, 6
FREE_END, PINNED, CLAMPED, GUIDED = 0, 1, 2, 3
THETA_M, W_V, M_THETA, V_W = 0, 1, 2, 3  # (state that jumps, state that makes it jump)

Flag = NDArray[np.bool_]


class System(NamedTuple):
    """A compiled chain, made by `chain.compile_chain`.

    kinds (n_op,), pars (n_op, 9) : the elements, their parameters in the schema's order.
    place (n_op, 2) : of a point element its pair and its row in `Factors.jump`, of WAVES -1
        and its row in `Factors.matrix`.
    ends (2,) : boundary condition of base and tip.
    source (n_source, 2) : port and actuator of each source; source_c (n_source, 5) the
        sensor its jump is dual to, and its K.
    feed (n_sensor, n_source) : what a sensor reads of the source's own jump.
    term (n_term, 4) : sensor, port, kind of factor, spring or hinge of each term of the
        sensors, in the sensors' order; term_c (n_term, 4) its coefficients on w, theta, M, V.
    """

    kinds: Int
    pars: Float
    place: Int
    ends: Int
    source: Int
    source_c: Float
    feed: Float
    term: Int
    term_c: Float


class Factors(NamedTuple):
    """What depends on s, at the n values of one call, made by `factors.bind`.

    jump (n_jump, n), matrix (n_matrix, 2, 34, n) : x of `laws`, and `timoshenko.matrix`.
    drive (n_source, n) : f of each source, its jump at K = 1.
    jump_d (n_jump, 7, n), drive_d (n_source, n_par, n) : their derivatives, for gradients.
    """

    jump: Complex
    matrix: Complex
    drive: Complex
    jump_d: Complex
    drive_d: Complex


class Work(NamedTuple):
    """What a block of LANES values of s leaves: W is the register file.

    Per element: beams (what `beam.prepare` leaves), regimes (behind the last, the number
    of beams), changes_p and changes_q (B of the sweeps from base and tip). Per port:
    columns_p and columns_q (X of the two sweeps, q mirrored), alphas and gammas (a
    solution's coefficients on them).
    """

    W: Float
    beams: Float
    regimes: Int
    columns_p: Float
    columns_q: Float
    changes_p: Float
    changes_q: Float
    alphas: Float
    gammas: Float


class Span(NamedTuple):
    """The n values of s of a block, s[start : start + n]; lanes beyond n repeat the last."""

    start: int
    n: int


class States(NamedTuple):
    """The states of a block at the elements (n_op,) with a derivative, as of
    `adjoint.element_states`: z (n_source, n_op, 16 LANES) of the sources' solutions, zh (n_sensor,
    n_op, 16 LANES) of the sensors' dual ones, at unit f and K."""

    elements: Flag
    z: Float
    zh: Float


SHORT, LONG, MIXED = 0, 1, 2  # all lanes of a beam below the threshold, above, or both


@part
def workspace(n_op: int) -> Work:
    """The arrays that one call of a loop over blocks works in."""
    return Work(
        np.zeros(ROWS * LANES),
        np.zeros((n_op, BEAM_ROWS * LANES)),
        np.zeros(n_op + 1, np.int64),
        np.zeros((n_op + 1, X_ROWS * LANES)),
        np.zeros((n_op + 1, X_ROWS * LANES)),
        np.zeros((n_op, B_ROWS * LANES)),
        np.zeros((n_op, B_ROWS * LANES)),
        np.zeros((n_op + 1, 4 * LANES)),
        np.zeros((n_op + 1, 4 * LANES)),
    )
