"""Recordings of two states of the second plant, with changes that are stated."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from table_kit import table_of

from samii_rig.diagnose.changed import State
from samii_rig.diagnose.physics.effect import Effect
from samii_rig.record.reader import read_recording
from samii_rig.rig.load import load_rig
from samii_rig.signal.estimate import estimate
from sim.assumed_modes import styles
from sim.assumed_modes.parts import Attachment, Setup
from sim.assumed_modes.states import record_with
from sim.assumed_modes.trial import Scene, scene_of

RIG, TOML = load_rig("samii")
SAMPLES = 10_000  # of a state, one sweep of 20 s
SEED = 4
Change = Callable[[Setup], Setup]

LOOKED_FOR = ("added_mass", "joint_stiffness", "transport_delay")


def stiffness(joint: str, ratio: float) -> Change:
    """A joint softer or stiffer by a ratio."""
    return lambda s: s.with_value(joint, "k", s.part(joint).values["k"] * ratio)


def mass(on: str, m: float, at: float) -> Change:
    """A mass of m kg on a link, `at` m from its upstream end; less than 0 for one taken off."""
    return lambda s: s.attached(Attachment("mass", on, at, {"m": m}))


@cache
def scene() -> Scene:
    """SAMII, its nominal parameters drawn within their tolerances; noise and sweeps drawn."""
    whole, styles.BUDGET = styles.BUDGET, SAMPLES
    try:
        rngs = (np.random.default_rng([SEED, k]) for k in range(2))
        return scene_of(*rngs, RIG, ("clean", "cut"))
    finally:
        styles.BUDGET = whole


def recorded(noise: int, *changes: Change, folder: Path | None = None) -> State:
    """One state of the rig. noise : a seed; folder : where its recordings stay."""
    rng = np.random.default_rng([SEED, 7, noise])
    with TemporaryDirectory() as temporary:
        out = folder or Path(temporary)
        record_with(scene(), out, changes, rng)
        runs = [read_recording(path) for path in sorted(out.glob("*.mcap"))]
    return State(estimate(runs, gaps="exclude"), runs)


def late(tau: float) -> Change:
    """A dead time of the drive, s."""
    return lambda s: replace(s, delay=s.delay + tau)


def effects(*physics: str, site: str = "") -> Sequence[Effect]:
    """Part of the signed table: a search over all of it takes too long for a test."""
    known = table_of(RIG, 0.4, 30.0, *(physics or LOOKED_FOR), signed=True)
    return [e for e in known if site in ("", e.site)]
