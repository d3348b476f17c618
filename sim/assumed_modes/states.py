"""Two states of one rig: recordings before and after something changed.

make_states(7, Path("states"), rig_toml)   # states/7/before/*.mcap, states/7/after/*.mcap

Both have the same nominal parameters, drawn within their tolerances, and the same style; the noise
is drawn anew. In both there may be an effect that the rig file does not know. The change's size is
what is left of it where the nominal parameters are held by the records of both states.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from samii_rig.errors import SamiiRigError
from samii_rig.rig.load import parse
from samii_rig.rig.schema import Rig
from sim.assumed_modes.effects import LINEAR, Draft, Numbers
from sim.assumed_modes.parts import Setup
from sim.assumed_modes.plant import UnphysicalError
from sim.assumed_modes.sigma import Left, Refit
from sim.assumed_modes.size import records
from sim.assumed_modes.trial import Concealed, Rng, Scene, file_of, nominal_refit, scene_of

SIZES = (3.0, 30.0)  # sigma of a change, drawn evenly in the logarithm between them
COMMON = 60.0  # sigma of what is in both states: plainly to be seen
STATE_CLOSE = 1.1  # ratio to the sigma drawn that is near enough
STATE_TRIES, DRAWS = 14, 40  # strengths tried for one effect; effects drawn until one has a size
STATE_JUMP = 30.0  # largest ratio of two strengths tried one after the other


def make_states(
    seed: int,
    out: Path,
    rig_toml: str,
    style: tuple[str, ...] = (),
    *,
    nothing: bool = False,
    common: bool = False,
) -> Path:
    """Make the two states of this seed; returns their folder.

    style : as of `trial.make`. nothing : without a change. common : with an effect in both states.
    """
    rngs = [np.random.default_rng([seed, 1000, k]) for k in range(6)]
    scene = scene_of(rngs[0], rngs[1], parse(Rig, rig_toml, "rig file"), style)
    refit = nominal_refit(scene)
    both = [_sized(rngs[5], scene, refit, scene.setup, COMMON)] if common else []
    setup = both[0].draft.put(scene.setup, both[0].strength) if both else scene.setup
    target = float(np.exp(rngs[2].uniform(*np.log(SIZES))))
    change = [] if nothing else [_sized(rngs[2], scene, refit, setup, target)]
    folder = out / str(seed)
    for name, effects in (("before", both), ("after", [*both, *change])):
        (folder / name).mkdir(parents=True)
        for i in range(len(scene.style.files)):
            file_of(folder / name, i, scene, effects, rngs[3], rngs[4])
    (folder / "rig.toml").write_text(scene.rig_toml, encoding="utf-8")
    truth = {
        "seed": seed,
        "style": scene.style.excitation,
        "common": [_plain(e) for e in both],
        "change": [_plain(e) for e in change],
    }
    (folder / "truth.json").write_text(json.dumps(truth, indent=1) + "\n", encoding="utf-8")
    return folder


def record_with(
    scene: Scene, folder: Path, changes: Sequence[Callable[[Setup], Setup]], rng: Rng
) -> None:
    """Record a state of a scene that is stated: its setup after `changes`."""

    def put(setup: Setup, _: Numbers) -> Setup:
        for change in changes:
            setup = change(setup)
        return setup

    draft = Draft("", "", None, {}, lambda _: {}, put)
    stated = Concealed(draft, 1.0, 0.0, Left(0.0, 0.0, np.zeros(0)))
    folder.mkdir(parents=True, exist_ok=True)
    for i in range(len(scene.style.files)):
        file_of(folder, i, scene, [stated], rng, rng)


def _sized(rng: Rng, scene: Scene, refit: Refit, setup: Setup, target: float) -> Concealed:
    """An effect on `setup` that is about `target` sigma between two states."""
    for _ in range(DRAWS):
        try:
            draft = LINEAR[str(rng.choice(list(LINEAR)))](rng, setup)
        except (LookupError, ValueError):
            continue  # this rig has no place for it
        found = None if draft.fixed else _solved(scene, refit, setup, draft, target)
        if found is not None:
            return found
    raise SamiiRigError(f"{DRAWS} effects drawn and none had a size")


def _solved(
    scene: Scene, refit: Refit, setup: Setup, draft: Draft, target: float
) -> Concealed | None:
    before = scene.bench.linear(setup)
    x = draft.start
    for _ in range(STATE_TRIES):
        try:
            rows = records(scene.bench, scene.control, draft.put(setup, x))
        except UnphysicalError:
            return None
        sigma = refit.between(rows, before)
        ratio = target / max(sigma, 1e-12)
        if 1 / STATE_CLOSE < ratio < STATE_CLOSE:
            alone = refit.left(rows) if setup is scene.setup else refit.tangent(rows)
            return Concealed(draft, x, sigma, alone)
        x = min(x * float(np.clip(ratio, 1 / STATE_JUMP, STATE_JUMP)), draft.most)
    return None


def _plain(effect: Concealed) -> dict[str, Any]:
    draft, numbers = effect.draft, effect.draft.values(effect.strength)
    return {
        "physics": draft.physics,
        "site": draft.site,
        "position": draft.position,
        "parameters": {
            name: {"value": numbers[name], "unit": unit} for name, unit in draft.units.items()
        },
        "also": [{"physics": p, "site": s} for p, s in draft.also],
        "sigma": effect.target,
        "sigma_after_alone": effect.alone.sigma,
    }
