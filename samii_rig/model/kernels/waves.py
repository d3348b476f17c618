"""exp, sin and cos without branches or calls, so that loops over lanes vectorise.

Each is within 2 units in the last place of the C library's on the range the beams need.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, cast

from numba import types
from numba.extending import intrinsic

from samii_rig.model.kernels.lanes import part, pick

# x + ROUND - ROUND rounds x to an integer, which stands in the low bits of x + ROUND.
ROUND = 1.5 * 2.0**52
_BITS_OF_ONE = 1023 << 52
_LOG2_E = 1.4426950408889634
# ln 2 and pi/2 in parts whose first ones have so few digits that n times them is exact
# (fdlibm, e_exp.c and e_rem_pio2.c).
_LN2 = (6.93147180369123816490e-01, 1.90821492927058770002e-10)
_HALF_PI = (1.57079632673412561417e00, 6.07710050630396597660e-11, 2.02226624879595063154e-21)
_2_BY_PI = 0.6366197723675814
# Best approximations on |r| <= pi/4 (fdlibm, k_sin.c and k_cos.c).
_SIN = (
    -1.66666666666666324348e-01,
    8.33333333332248946124e-03,
    -1.98412698298579493134e-04,
    2.75573137070700676789e-06,
    -2.50507602534068634195e-08,
    1.58969099521155010221e-10,
)
_COS = (
    4.16666666666666019037e-02,
    -1.38888888888741095749e-03,
    2.48015872894767294178e-05,
    -2.75573143513906633035e-07,
    2.08757232129817482790e-09,
    -1.13596475577881948265e-11,
)


def _cast(source: Any, target: Any) -> Callable[..., Any]:
    """The same 64 bits as another type."""

    def typer(context: Any, x: Any) -> Any:
        def build(context: Any, builder: Any, signature: Any, args: Any) -> Any:
            return builder.bitcast(args[0], context.get_value_type(target))

        return target(source), build

    return cast(Callable[..., Any], intrinsic(typer))


_bits = _cast(types.float64, types.int64)
_float = _cast(types.int64, types.float64)


@part
def decay(x: float) -> float:
    """exp(-x) for 0 <= x <= 700."""
    t = x * _LOG2_E + ROUND
    n = t - ROUND
    r = n * _LN2[0] - x + n * _LN2[1]
    # Taylor: |r| <= ln 2 / 2, the next term is below 1e-17.
    p = r * (1.0 / 6227020800.0) + 1.0 / 479001600.0
    p = p * r + 1.0 / 39916800.0
    p = p * r + 1.0 / 3628800.0
    p = p * r + 1.0 / 362880.0
    p = p * r + 1.0 / 40320.0
    p = p * r + 1.0 / 5040.0
    p = p * r + 1.0 / 720.0
    p = p * r + 1.0 / 120.0
    p = p * r + 1.0 / 24.0
    p = p * r + 1.0 / 6.0
    p = p * r + 0.5
    p = p * r + 1.0
    p = p * r + 1.0
    power: float = _float(_BITS_OF_ONE - (_bits(t) << 52))
    return p * power


@part
def circle(x: float) -> complex:
    """cos x + j sin x for |x| < 1e5."""
    n = (x * _2_BY_PI + ROUND) - ROUND
    r = ((x - n * _HALF_PI[0]) - n * _HALF_PI[1]) - n * _HALF_PI[2]
    z = r * r
    p = z * _SIN[5] + _SIN[4]
    p = z * p + _SIN[3]
    p = z * p + _SIN[2]
    p = z * p + _SIN[1]
    p = z * p + _SIN[0]
    sin = r + r * z * p
    p = z * _COS[5] + _COS[4]
    p = z * p + _COS[3]
    p = z * p + _COS[2]
    p = z * p + _COS[1]
    p = z * p + _COS[0]
    cos = 1.0 - (0.5 * z - z * z * p)
    quadrant = n - 4.0 * ((n * 0.25 + ROUND) - ROUND)  # -2 and 2 are the same
    both = pick(abs(quadrant) == 1.0, complex(sin, cos), complex(cos, sin))
    flip_cos = 1.0 - 2.0 * ((quadrant > 0.5) | (quadrant < -1.5))
    flip_sin = 1.0 - 2.0 * ((quadrant < -0.5) | (quadrant > 1.5))
    return complex(both.real * flip_cos, both.imag * flip_sin)
