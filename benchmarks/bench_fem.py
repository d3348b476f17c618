"""Finite elements beside transfer matrices: time against error, and what velocity feedback does.

    python benchmarks/bench_fem.py [--rig samii] [--repeats 9] [--feedback]

Prints, for meshes from 2 to 120 elements a beam, the medians of building the model, of all its
undamped modes, of 400 frequencies, and its errors against the transfer matrices (natural
frequencies of the undamped rig; responses to 50 Hz, the largest error of any sensor relative to
its response there, and relative to its peak); the same of the transfer matrices; the time and
the errors of the component-mode reduction. With --feedback: damping, frequencies, and the phase
at a collocated encoder, over g_v of the rig's first source.
"""

import argparse
import statistics
import time

import numpy as np
from scipy.optimize import brentq

from samii_rig.fem.model import Fem
from samii_rig.fem.reduce import reduce
from samii_rig.model.tmm import Chain
from samii_rig.rig.load import load_rig
from samii_rig.rig.schema import AngularVelocitySource

MESHES = (2, 4, 8, 15, 30, 60, 120)
N_MODES = 4
TOP_HZ = 50.0


def median_ms(repeats, call):
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        call()
        times.append(time.perf_counter() - start)
    return 1e3 * statistics.median(times)


def exact_hz(rig, near):
    """Natural frequencies of the transfer matrices without damping, near these."""
    chain = Chain(rig)
    lossless = chain.with_values({k: 0.0 for k in chain.parameters if k[1] in ("c", "tau", "eta")})

    def value(f):
        return lossless.characteristic([2j * np.pi * f])[0][0].real

    return np.array([brentq(value, 0.995 * f, 1.005 * f, xtol=1e-13) for f in near])


def errors(H, truth):
    """Largest error relative to the response itself, and to each sensor's peak."""
    off = abs(H - truth)
    return np.max(off / abs(truth)), np.max(off / abs(truth).max(axis=0))


def meshes(rig, f, truth, repeats):
    hz = exact_hz(rig, Fem(rig, elements=60).modes(N_MODES).frequency_hz)
    print(f"natural frequencies of the transfer matrices, Hz: {np.round(hz, 5)}")
    print("elements  build ms  modes ms  400 f ms   response  of peak   frequencies 1 to 4, over")
    for n in MESHES:
        fem = Fem(rig, elements=n)
        build = median_ms(repeats, lambda n=n: Fem(rig, elements=n))
        modes = median_ms(repeats, fem.modes)
        solve = median_ms(repeats, lambda fem=fem: fem.response(f))
        own, peak = errors(fem.response(f), truth)
        over = fem.modes(N_MODES).frequency_hz / hz - 1
        shown = "  ".join(f"{x:9.1e}" for x in over)
        print(f"{n:8d}  {build:8.1f}  {modes:8.1f}  {solve:8.1f}   {own:.1e}   {peak:.1e}  {shown}")
    build = median_ms(repeats, lambda: Chain(rig))
    chain = Chain(rig)
    solve = median_ms(repeats, lambda: chain.response(f))
    print(f"transfer matrices: build {build:.1f} ms, 400 frequencies {solve:.1f} ms, exact")


def reduction(rig, f, repeats):
    total = median_ms(repeats, lambda: reduce(Fem(rig)))
    fem = Fem(rig)
    alone = median_ms(repeats, lambda: reduce(fem))
    print(f"\nreduction to 4 flexible modes: {alone:.1f} ms, with the model built {total:.1f} ms")
    size = fem.basis().modes.omega.size
    for band in (10.0, TOP_HZ):
        inside = f[f <= band]
        H = fem.response(inside)
        for n in (2, 4, 6, 8, 16, size):
            own, peak = errors(reduce(fem, n).response(inside), H)
            print(f"  to {band:g} Hz, {n:2d} flexible modes: {own:.1e} of H, {peak:.1e} of peak")


def feedback(rig):
    source = next(e for e in rig.element if isinstance(e, AngularVelocitySource))
    encoder = {"kind": "relative_angle", "name": "at_source", "unit": "rad"}
    raw = rig.model_dump()
    raw["sensor"] = [{**encoder, "across": [source.name]}]
    raw["limit"], raw["centring"] = [], None
    collocated = type(rig).model_validate(raw)
    held = Fem(collocated).poles()
    held = held[held.imag > 1][:3]
    print("\nvelocity feedback, encoder at the source; phase of theta/v over that of 1/s, degrees")
    print("      g_v   f1 Hz  zeta1   f2 Hz  zeta2   dip at f, rise at f around mode 2")
    for g_v in (10, 30, 100, 200, 300, 500, 1000, 3000, 1e4, 1e5):
        fem = Fem(collocated, feedback={source.name: (float(g_v), source.K.value)})
        poles = fem.poles()
        hz = abs(held[1]) / (2 * np.pi)
        f = np.linspace(0.6 * hz, 1.8 * hz, 600)
        phase = np.degrees(np.unwrap(np.angle(fem.response(f)[:, 0, 0]))) + 90
        text = "".join(
            f"  {abs(p) / (2 * np.pi):6.3f} {-p.real / abs(p):6.4f}"
            for p in poles[poles.imag > 1][:2]
        )
        i, j = phase.argmin(), phase.argmax()
        print(f"{g_v:9g}{text}   {phase[i]:6.1f} at {f[i]:.2f}, {phase[j]:6.1f} at {f[j]:.2f}")


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rig", default="samii")
    parser.add_argument("--repeats", type=int, default=9)
    parser.add_argument("--feedback", action="store_true")
    given = parser.parse_args()
    rig = load_rig(given.rig)[0]
    f = np.geomspace(0.1, TOP_HZ, 400)
    truth = Chain(rig).response(f)
    meshes(rig, f, truth, given.repeats)
    reduction(rig, f, given.repeats)
    if given.feedback:
        feedback(rig)


if __name__ == "__main__":
    main()
