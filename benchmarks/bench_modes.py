"""The counted root search beside a scan of the plain matrix product.

    python benchmarks/bench_modes.py [--rig samii] [--high 200] [--repeats 15] [--picture FILE]

Peer: the determinant of the product of the elements' matrices, scanned on even steps and
polished by brentq, as the papers' method is usually programmed. It proves nothing; its step is
chosen here as the widest of 0.5, 0.2, 0.1, ... Hz that finds as many roots as were counted.
Prints medians of processor time (one thread, so that a shared machine does not spoil it), their
ratio, and the same of mode shapes, damped poles and finite elements.
With --picture it draws the first three mode shapes instead, beside those with rigid joints.
"""

import argparse
import statistics
import time

import numpy as np
from scipy.optimize import brentq

from samii_rig.fem.model import Fem
from samii_rig.model import elements
from samii_rig.model.modes import natural_frequencies, poles, undamped
from samii_rig.model.shapes import mode_shape
from samii_rig.model.tmm import Chain
from samii_rig.rig.load import load_rig
from samii_rig.rig.schema import TorsionalSpring

LOW_HZ = 0.1
SHOWN = 3  # modes in the picture
STEPS_HZ = (0.5, 0.2, 0.1, 0.05, 0.02, 0.01)


def median_ms(repeats, call):
    times = []
    for _ in range(repeats):
        start = time.process_time()
        call()
        times.append(time.process_time() - start)
    return 1e3 * statistics.median(times)


def scan(rig, high_hz, step_hz):
    """Sign changes of the plain product's determinant, each polished."""
    rows = {"free": (2, 3), "pinned": (0, 2), "clamped": (0, 1)}[rig.tip]
    columns = {"free": (0, 1), "pinned": (1, 3), "clamped": (2, 3)}[rig.base]

    def value(f):
        s = 2j * np.pi * np.atleast_1d(f)
        U = np.eye(5)
        for e in rig.element:
            U = elements.matrix(e, s) @ U
        return np.linalg.det(U[:, rows, :][:, :, columns]).real

    f = np.arange(LOW_HZ, high_hz, step_hz)
    D = value(f)
    at = np.flatnonzero(np.sign(D[1:]) != np.sign(D[:-1]))
    return [brentq(lambda x: float(value(x)[0]), f[i], f[i + 1], xtol=1e-12) for i in at]


def draw(rig, path):
    """Displacement of the first modes along the chain, and where its joints are."""
    import matplotlib.pyplot as plt

    springs = [e for e in rig.element if isinstance(e, TorsionalSpring)]
    rigid = Chain(rig).with_values({(e.name, "k"): 1e6 * e.k.value for e in springs})
    fig, axes = plt.subplots(1, SHOWN, figsize=(9, 4.2), sharey=True, layout="constrained")
    stiff = natural_frequencies(rigid, LOW_HZ, 400.0).hz
    for axis, hz, other in zip(
        axes, natural_frequencies(rig, LOW_HZ, 200.0).hz, stiff, strict=False
    ):
        mode, plain = mode_shape(rig, hz), mode_shape(rigid, other)
        axis.plot(mode.w.real, -mode.x, color="#1f5fa8", lw=2, label=f"{hz:.2f} Hz")
        axis.plot(
            plain.w.real, -plain.x, color="#999999", ls="--", label=f"rigid joints, {other:.2f} Hz"
        )
        at = {name: x for (name, _), x in zip(mode.place, -mode.x, strict=True)}
        for e in springs:
            axis.axhline(at[e.name], color="#dddddd", lw=0.8, zorder=0)
        axis.axvline(0, color="black", lw=0.5, zorder=0)
        axis.set_xlabel("displacement, largest is 1")
        axis.legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), frameon=False, fontsize=9)
    for e in springs:
        axes[0].text(
            -1.15,
            at[e.name],
            e.name.replace("_", " "),
            fontsize=8,
            va="bottom" if e.name in ("clamp", "joint_1") else "top",
        )
    axes[0].set_xlim(-1.2, 1.2)
    for axis in axes[1:]:
        axis.set_xlim(-1.2, 1.2)
    axes[0].set_ylabel("place along the chain, m below the clamp")
    axes[0].set_yticks(range(-6, 1), [str(-y) for y in range(-6, 1)])
    fig.savefig(path, dpi=120)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rig", default="samii")
    parser.add_argument("--high", type=float, default=200.0)
    parser.add_argument("--repeats", type=int, default=15)
    parser.add_argument("--picture")
    given = parser.parse_args()
    rig = load_rig(given.rig)[0]
    if given.picture:
        draw(rig, given.picture)
        return
    found = natural_frequencies(rig, LOW_HZ, given.high)
    print(f"natural frequencies, Hz: {np.round(found.hz, 5)}\n{found.proof}")
    chain, lossless = Chain(rig), undamped(rig)
    search = median_ms(given.repeats, lambda: natural_frequencies(lossless, LOW_HZ, given.high))
    whole = median_ms(given.repeats, lambda: natural_frequencies(rig, LOW_HZ, given.high))
    for step in STEPS_HZ:
        peer = scan(lossless.rig, given.high, step)
        if len(peer) == found.count:
            break
    scanned = median_ms(given.repeats, lambda: scan(lossless.rig, given.high, step))
    off = np.max(np.abs(np.array(peer) / found.hz - 1))
    print(f"counted search {search:.2f} ms, from the rig file's model {whole:.2f} ms")
    print(f"scan at {step:g} Hz and brentq {scanned:.1f} ms, differs by {off:.0e}")
    print(f"ratio {scanned / search:.1f}")
    shape = median_ms(given.repeats, lambda: mode_shape(lossless, found.hz[0]))
    damped = median_ms(given.repeats, lambda: poles(chain, given.high))
    fem = median_ms(given.repeats, lambda: Fem(rig).modes(found.count))
    print(
        f"one mode shape {shape:.1f} ms, damped poles {damped:.0f} ms, finite elements {fem:.1f} ms"
    )


if __name__ == "__main__":
    main()
