"""How fast the transfer matrix core is, beside plain products of the same matrices.

    python benchmarks/bench_tmm.py [--rig samii] [--frequencies 20000] [--repeats 21]

Medians of interleaved runs in one process on one core; each row gives all sensors of the rig:
the stable form (`Chain.response`), the batched product (one numpy matmul of 5x5 matrices
over all frequencies an element), the loop (the same in Python, frequency by frequency), and
the gradients by the adjoint. The best of the runs is given too: on a shared machine it is
nearer to what the code costs.
"""

import argparse
import time
from collections.abc import Callable

import numpy as np

from samii_rig.model import elements
from samii_rig.model.tmm import Chain
from samii_rig.rig.load import load_rig
from samii_rig.rig.schema import Rig
from samii_rig.types import Complex, Float

CONDITIONS = {"clamped": (0, 1), "pinned": (0, 2), "free": (2, 3)}
LOOP_FREQUENCIES = 200  # the loop takes milliseconds each; its time a frequency is constant


def plain_states(rig: Rig, s: Complex) -> list[Complex]:
    """The state at every port by the plain product: what a sensor would read from."""
    products = [np.broadcast_to(np.eye(5, dtype=complex), (*s.shape, 5, 5))]
    for element in rig.element:
        products.append(elements.matrix(element, s) @ products[-1])
    free = [i for i in range(4) if i not in CONDITIONS[rig.base]]
    tip = list(CONDITIONS[rig.tip])
    z = np.zeros((*s.shape, 5, 1), complex)
    A = products[-1][..., tip, :][..., free]
    z[..., free, :] = np.linalg.solve(A, -products[-1][..., tip, 4:])
    z[..., 4, 0] = 1
    return [U @ z for U in products]


def median_and_best(runs: dict[str, tuple[Callable[[], object], int]], repeats: int) -> Float:
    """(n_run, 2) seconds a frequency; the runs take turns, so that all see the same machine."""
    for run, _ in runs.values():
        run()
    times = np.zeros((repeats, len(runs)))
    for i in range(repeats):
        for j, (run, n) in enumerate(runs.values()):
            start = time.perf_counter()
            run()
            times[i, j] = (time.perf_counter() - start) / n
    return np.stack([np.median(times, axis=0), times.min(axis=0)], axis=1)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--rig", default="samii")
    parser.add_argument("--frequencies", type=int, default=20000)
    parser.add_argument("--repeats", type=int, default=21)
    arguments = parser.parse_args()
    rig, _ = load_rig(arguments.rig)
    chain = Chain(rig)
    n = arguments.frequencies
    f = np.geomspace(0.1, 1000.0, n)
    s = 2j * np.pi * f
    few = s[:: max(1, n // LOOP_FREQUENCIES)]
    joints = [key for key in chain.parameters if key[1] in ("k", "c", "K", "p")][:10]

    start = time.perf_counter()
    chain.gradient(f[:1])
    chain.response(f[:1])
    print(f"first call (compiled or loaded from cache): {time.perf_counter() - start:.2f} s")
    runs: dict[str, tuple[Callable[[], object], int]] = {
        "response": (lambda: chain.response(f), n),
        "batched product": (lambda: plain_states(rig, s), n),
        "loop over frequencies": (lambda: [plain_states(rig, x[None]) for x in few], few.size),
        f"gradient, {len(joints)} of the joints": (lambda: chain.gradient(f, joints), n),
        f"gradient, all {len(chain.parameters)}": (lambda: chain.gradient(f), n),
    }
    table = median_and_best(runs, arguments.repeats)
    sensors, actuators = len(rig.sensor), len(rig.actuator)
    print(f"{rig.name}: {sensors} sensors, {actuators} actuator, {n} frequencies, one core")
    print(f"{'':28}{'us/frequency':>14}{'best':>10}{'x response':>12}")
    for name, (median, best) in zip(runs, table, strict=True):
        print(f"{name:28}{median * 1e6:14.3f}{best * 1e6:10.3f}{median / table[0, 0]:12.2f}")


if __name__ == "__main__":
    main()
