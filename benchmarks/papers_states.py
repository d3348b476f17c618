"""The papers' puzzle: joint stiffnesses by a braced and by a free robot differ by a factor of two.

python benchmarks/papers_states.py [--seed 0]      # some minutes of one core

The second plant records SAMII with its base braced, where joints 1 and 2 are as method 2 of paper 1
has them, and then free, where they are as method 1 has them (Table II). The rig file is that of the
braced robot; that the braces are gone is stated as known. What is said of the joints is printed.
"""

from __future__ import annotations

import argparse
import time
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from samii_rig.diagnose.changed import State, changed
from samii_rig.papers.rigs import METHOD_1, METHOD_2
from samii_rig.record.reader import read_recording
from samii_rig.rig.load import load_rig
from samii_rig.signal.estimate import estimate
from sim.assumed_modes import styles
from sim.assumed_modes.parts import Setup
from sim.assumed_modes.states import record_with
from sim.assumed_modes.trial import scene_of

JOINTS = {name: k / METHOD_1[name] for name, k in METHOD_2.items()}
BRACES = ("brace", "brace_moment")
GONE = {f"{name}.{symbol}": 0.0 for name in BRACES for symbol in ("k", "c")}
SAMPLES = 30_000  # of a state's loop, a minute


def softer(setup: Setup, joint: str, ratio: float) -> Setup:
    """A joint softer by a ratio."""
    return setup.with_value(joint, "k", ratio * setup.part(joint).values["k"])


def free(setup: Setup) -> Setup:
    """The robot without its braces."""
    for name in BRACES:
        for symbol in ("k", "c"):
            setup = setup.with_value(name, symbol, 0.0)
    return setup


def state(folder: Path) -> State:
    """The recordings of a folder, and their responses."""
    runs = [read_recording(path) for path in sorted(folder.glob("*.mcap"))]
    return State(estimate(runs, gaps="exclude"), runs)


def main() -> None:
    """Record both configurations and print what changed."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--seed", type=int, default=0)
    seed = parser.parse_args().seed
    styles.BUDGET = SAMPLES
    rig = load_rig("samii_braced")[0]
    rngs = [np.random.default_rng([seed, k]) for k in range(4)]
    scene = scene_of(rngs[0], rngs[1], rig, ("clean", "cut"))
    joints = [partial(softer, joint=name, ratio=ratio) for name, ratio in JOINTS.items()]
    with TemporaryDirectory() as temporary:
        braced, unbraced = Path(temporary) / "braced", Path(temporary) / "free"
        record_with(scene, braced, joints, rngs[2])
        record_with(scene, unbraced, [free], rngs[3])
        start = time.process_time()
        found = changed(state(braced), state(unbraced), rig, known=GONE)
    for line in found.lines():
        print(line)
    for cause in found.causes:
        for symbol, v in cause.parameters.items():
            there = 1 / JOINTS.get(cause.site, np.nan)
            print(
                f"    {cause.physics} at {cause.site}: {symbol} {v.value:.4g} "
                f"({v.low:.4g} to {v.high:.4g}), concealed {there:.4g}"
            )
    print(f"{found.before}"[:300])
    print(f"chi-square per degree of freedom {found.chi2_per_dof:.3g}, {found.with_causes[0]:.3g}")
    print(f"{time.process_time() - start:.0f} s of a core")


if __name__ == "__main__":
    main()
