"""The papers' open puzzle: the robot free and braced has joints that differ by a factor of two.

python benchmarks/papers_states.py numbers          # which single change gives method 2's numbers
python benchmarks/papers_states.py told [CASE ...]  # two states with such a change concealed, told

Method 1 of paper 1 (free) has 13600 and 10800 N m/rad for joints 1 and 2, method 2 (braced) has
6510 and 7130. `numbers` gives each single change of the braced rig the strength that comes nearest
to the first frequency and the mode shape ratio that method 2's numbers stand for. `told` records
both configurations of the second plant with one set of nominal parameters; that the brace is gone
before is stated.
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from samii_rig.diagnose.changed import State, changed
from samii_rig.diagnose.physics.insert import inserted, parameter
from samii_rig.errors import SamiiRigError
from samii_rig.identify.conservative import Conservative
from samii_rig.identify.parameters import Free
from samii_rig.identify.targets import method_2
from samii_rig.record.reader import read_recording
from samii_rig.rig.load import load_rig
from samii_rig.rig.schema import LumpedMass, Rig
from samii_rig.signal.estimate import estimate
from sim.assumed_modes import styles
from sim.assumed_modes.parts import Attachment, Setup
from sim.assumed_modes.states import record_with
from sim.assumed_modes.trial import scene_of

Change = Callable[[Setup], Setup]

RIG = load_rig("samii_braced")[0]
OUTPUTS = ("a_1", "a_2")
METHOD_1 = {"joint_1": 13600.0, "joint_2": 10800.0}  # N m/rad, paper 1, Table II
METHOD_2 = {"joint_1": 6510.0, "joint_2": 7130.0}
HELD = ("clamp", "joint_3")  # method 2's model keeps them rigid: only so does Table III come out
RIGID = 1e10  # N m/rad
SAMPLES = 10_000  # of a state: a sweep of 20 s
NO_BRACE = {f"{e}.{s}": 0.0 for e in ("brace", "brace_moment") for s in ("k", "c")}
SEED = 5
BAND = (0.5, 15.0)  # Hz, that holds the first frequency of every change
TRIES = 41  # strengths of a change


def with_values(rig: Rig, values: dict[tuple[str, str], float]) -> Rig:
    """The rig with other parameters."""
    data = rig.model_dump()
    for e in data["element"]:
        for (name, symbol), value in values.items():
            if e["name"] == name:
                e[symbol]["value"] = value
    return Rig.model_validate(data)


def numbers(rig: Rig) -> tuple[float, float]:
    """First frequency, Hz, and mode shape ratio of a rig."""
    chain = Conservative(rig, BAND)
    f = float(chain.frequencies()[0])
    return f, float(chain.shape_ratio(f, *OUTPUTS))


def heavier(*links: str) -> Callable[[float], Rig]:
    """Links of more mass and inertia."""
    return scaled(*((link, s) for link in links for s in ("m", "I")))


def scaled(*keys: tuple[str, str]) -> Callable[[float], Rig]:
    """Parameters times one factor."""
    own = {(e.name, s): getattr(e, s).value for e in RIG.element for n, s in keys if e.name == n}
    return lambda x: with_values(RIG, {key: own[key] * x for key in keys})


def mass(after: str) -> Callable[[float], Rig]:
    """A mass of x kg behind a link."""

    def put(x: float) -> Rig:
        made = LumpedMass(kind="lumped_mass", name="more", m=parameter(x, "kg"))
        return inserted(RIG, after, made)

    return put


# Single changes of the braced rig, with the least and the largest strength that is tried.
SINGLE: dict[str, tuple[Callable[[float], Rig], float, float]] = {
    "joint 1 softer": (scaled(("joint_1", "k")), 0.1, 1.0),
    "joint 2 softer": (scaled(("joint_2", "k")), 0.1, 1.0),
    "joint 3 softer": (scaled(("joint_3", "k")), 0.1, 1.0),
    "all joints softer alike": (scaled(*((f"joint_{i}", "k") for i in (1, 2, 3))), 0.1, 1.0),
    "the brace gives sideways": (scaled(("brace", "k")), 1e-3, 1.0),
    "the brace turns": (scaled(("brace_moment", "k")), 1e-3, 1.0),
    "both braces give alike": (scaled(("brace", "k"), ("brace_moment", "k")), 1e-3, 1.0),
    "link 2 heavier": (heavier("link_2"), 1.0, 20.0),
    "links 3 to 6 heavier": (heavier("link_3_6"), 1.0, 20.0),
    "all links heavier alike": (heavier("link_1", "link_2", "link_3_6"), 1.0, 20.0),
    "kg behind link 2": (mass("link_2"), 0.1, 60.0),
    "kg at the tip": (mass("link_3_6"), 0.1, 60.0),
}


def told_by_numbers() -> None:
    """What each single change would make method 2 find."""
    held = {(name, "k"): RIGID for name in HELD}
    method = {(joint, "k"): k for joint, k in METHOD_2.items()}
    f, ratio = numbers(with_values(RIG, held | method))
    print(f"method 2's numbers stand for {f:.3f} Hz and a ratio of {ratio:.4f}")

    def found(rig: Rig) -> str:
        free = [Free(joint, "k", start=k) for joint, k in METHOD_1.items()]
        by = method_2(with_values(RIG, held), *numbers(rig), OUTPUTS, free)
        ks = [by.values[by.names.index(f"{joint}.k")] for joint in METHOD_2]
        return ", ".join(f"{k:.0f}" for k in ks)

    print(f"| change | strength | Hz | ratio | method 2 would find |\n{'|---' * 5}|")
    print("| none | | {:.2f} | {:.4f} | {} |".format(*numbers(RIG), found(RIG)))
    for name, (change, low, high) in SINGLE.items():
        every = []
        for x in np.geomspace(low, high, TRIES).tolist():
            try:
                at = numbers(change(x))
            except (SamiiRigError, IndexError):
                continue
            every.append((math.hypot(math.log(at[0] / f), math.log(abs(at[1]) / ratio)), x, at))
        _, x, at = min(every)
        print(f"| {name} | {x:.3g} | {at[0]:.2f} | {at[1]:.4f} | {found(change(x))} |", flush=True)


def softer(joint: str, ratio: float) -> Change:
    """A joint of the plant that is softer by a ratio."""
    return lambda s: s.with_value(joint, "k", s.part(joint).values["k"] * ratio)


def set_to(values: dict[str, float]) -> Change:
    """Parameters of the plant, by "element.parameter"."""

    def put(setup: Setup) -> Setup:
        for name, value in values.items():
            setup = setup.with_value(*name.split("."), value)
        return setup

    return put


BOTH = {joint: METHOD_2[joint] / METHOD_1[joint] for joint in METHOD_1}
CASES: dict[str, tuple[Change, ...]] = {
    "nothing": (),
    "joint 1 softer": (softer("joint_1", BOTH["joint_1"]),),
    "both joints softer": tuple(softer(joint, ratio) for joint, ratio in BOTH.items()),
    "the brace turns": (set_to({"brace_moment.k": 1.25e4}),),
    "10 kg behind link 2": (lambda s: s.attached(Attachment("mass", "link_2", 0.4, {"m": 10.0})),),
}


def tell(case: str) -> None:
    """Both configurations recorded, the change in the braced one, and what is said."""
    styles.BUDGET = SAMPLES
    rngs = [np.random.default_rng([SEED, k]) for k in range(4)]
    scene = scene_of(rngs[0], rngs[1], RIG, ("clean", "cut"))
    states = []
    with TemporaryDirectory() as folder:
        free = (set_to(NO_BRACE),)
        for name, changes, rng in (("free", free, rngs[2]), ("braced", CASES[case], rngs[3])):
            record_with(scene, Path(folder) / name, changes, rng)
            runs = [read_recording(p) for p in sorted((Path(folder) / name).glob("*.mcap"))]
            states.append(State(estimate(runs, gaps="exclude"), runs))
    start = time.process_time()
    found = changed(states[0], states[1], RIG, known_before=NO_BRACE)
    seconds = time.process_time() - start
    print(f"\n{case}: {found.verdict}, {found.sigma:.0f} noise units, {seconds:.0f} s")
    for c in found.causes:
        own = ", ".join(
            f"{s} {v.value:.4g} {v.unit} ({v.within()})" for s, v in c.parameters.items()
        )
        print(f"    {c.physics} at {c.site}, {c.probability:.2f}: {own} {c.equivalents or ''}")
    moved = [f"{m.parameter} by {m.sigmas:.1f}" for m in found.moved]
    print(f"    before: {found.before and found.before.verdict}; moved: {', '.join(moved) or '-'}")
    for line in (*found.lines()[:1], *found.not_physics):
        print(f"    {line}", flush=True)


def main() -> None:
    """Numbers, or answers."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("what", choices=("numbers", "told"))
    parser.add_argument("case", nargs="*", choices=[*CASES, []])
    given = parser.parse_args()
    if given.what == "numbers":
        told_by_numbers()
        return
    for case in given.case or CASES:
        tell(case)


if __name__ == "__main__":
    main()
