"""Arithmetic on lanes: LANES values of s side by side, so that the compiler can use SIMD.

The kernels work on one flat register file of rows, each LANES numbers long; a complex
quantity takes two rows, the real parts and the imaginary parts. All rows of a loop lie at
offsets known at compile time in one array: only then does LLVM see that they do not
overlap and vectorises the loop over the lanes. For the same reason a sign is written
1 - 2 * flag, not as a conditional expression.
"""

from __future__ import annotations

import hashlib
import logging
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar, cast

import numba
from numba.core import event
from numba.extending import register_jitable

from samii_rig.types import Float

F = TypeVar("F", bound=Callable[..., Any])

log = logging.getLogger(__name__)
log.setLevel(logging.INFO)

LANES = 64  # measured: 32 and 128 are 10 % slower, 256 is 40 %
TINY = 1e-300  # keeps 0/0 from being NaN where a numerator of 0 shall give 0


# Of fastmath only contraction to fused multiply-add and freedom of the zero's sign: neither
# costs digits, and NaN still means NaN.
_OPTIONS: dict[str, Any] = {"error_model": "numpy", "fastmath": {"contract", "nsz"}}
# How Python and C would call a part, which neither does: a sixth of the compilation, left out.
_UNCALLED: dict[str, Any] = {"no_cpython_wrapper": True, "no_cfunc_wrapper": True}


class _Compiling(event.Listener):
    """Reports a compilation: it takes a minute, where the cache on the disk has nothing yet."""

    def on_start(self, event: event.Event) -> None:
        # Whoever estimates the time that is left does not know of it before it begins.
        log.info(
            "compiling the model's kernels, once a machine: one minute or two that no time to the "
            "end counts"
        )

    def on_end(self, event: event.Event) -> None:
        pass


event.register("numba:compile", _Compiling())  # type: ignore[no-untyped-call]


def kernel(make: Callable[[int], F]) -> F:
    """Compile by numba, once a machine (cached on disk): what Python calls.

    make : gives the function, which closes over the number that it gets. numba compiles a cached
        function anew when its own file has changed, or what it closes over; kernels call each
        other, so that number stands for the files of all of them.
    """
    return cast(F, numba.njit(cache=True, **_OPTIONS)(make(_files())))


def _files() -> int:
    """A number for what stands in the files of this room."""
    found = hashlib.sha256()
    for file in sorted(Path(__file__).parent.glob("*.py")):
        found.update(file.read_bytes())
    return int.from_bytes(found.digest()[:7], "big")


def part(function: F) -> F:
    """Let kernels call the function; it is compiled with them, and stays Python here."""
    register_jitable(**_OPTIONS, **_UNCALLED)(function)
    return function


@part
def get(W: Float, row: int, i: int) -> complex:
    """The complex number in rows `row`, `row` + 1 of lane i."""
    return complex(W[row * LANES + i], W[(row + 1) * LANES + i])


@part
def put(W: Float, row: int, i: int, z: complex) -> None:
    """Store z in rows `row`, `row` + 1 of lane i."""
    W[row * LANES + i] = z.real
    W[(row + 1) * LANES + i] = z.imag


@part
def load(W: Float, row: int, source: Float, rows: int) -> None:
    """Copy the first `rows` rows of `source` to row `row` of W."""
    for i in range(rows * LANES):
        W[row * LANES + i] = source[i]


@part
def store(target: Float, W: Float, row: int, rows: int) -> None:
    """Copy `rows` rows of W from row `row` on to the start of `target`."""
    for i in range(rows * LANES):
        target[i] = W[row * LANES + i]


@part
def scaled(z: complex, x: float) -> complex:
    """z times a real number (numba would make x complex)."""
    return complex(z.real * x, z.imag * x)


@part
def conj(z: complex) -> complex:
    """The complex conjugate."""
    return complex(z.real, -z.imag)


@part
def norm2(z: complex) -> float:
    """|z|^2."""
    return z.real * z.real + z.imag * z.imag


@part
def pick(flag: bool, a: complex, b: complex) -> complex:
    """`a` where the flag is set, else `b`."""
    return complex(a.real if flag else b.real, a.imag if flag else b.imag)


@part
def inverse(z: complex) -> complex:
    """1/z for |z| within 1e-150 to 1e150, without a branch; 0 for 0."""
    return scaled(conj(z), 1.0 / (norm2(z) + TINY))


@part
def root(z: complex) -> complex:
    """The principal square root, without a branch."""
    u = math.sqrt(0.5 * (math.sqrt(norm2(z)) + abs(z.real)))
    v = 0.5 * z.imag / (u + TINY)
    sign = 1.0 - 2.0 * (z.imag < 0)
    return pick(z.real >= 0, complex(u, v), complex(v * sign, u * sign))
