"""The whole table in one screen: each place of the chain is evaluated once for all parts there."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from itertools import product

import numpy as np

from samii_rig.diagnose.fit.moebius import Place, place_of
from samii_rig.diagnose.fit.screen import Found, Screen, Start
from samii_rig.diagnose.physics.effect import Effect
from samii_rig.diagnose.physics.model import Model
from samii_rig.errors import SamiiRigError
from samii_rig.types import Float

ModelOf = Callable[[tuple[Effect, ...]], Model | None]


def ranking(
    screen: Screen, table: Iterable[Effect], base: tuple[Effect, ...], model_of: ModelOf
) -> list[tuple[float, Effect, list[Start]]]:
    """How far chi-square should fall with each effect of `table` beside those of `base`, and one
    or two starts for its refit; the largest first.

    model_of : the model with some effects, None if the rig does not allow them together.
    """
    names = {e.key for e in base}
    linear = all(e.force is None for e in base)
    # A dead time turns an alias by more than it turns the line itself, and that may be all of it
    # that no nominal parameter does too.
    folding = screen.problem.at.own_aliases is not None
    places: dict[tuple[str, Start], Place | None] = {}
    out = []
    for effect in table:
        if effect.key in names:
            continue
        found: Found | None = None
        if linear and effect.jump is not None:
            found = _at_place(screen, base, effect, model_of, places)
        elif linear and effect.factor is not None and not (folding and effect.unknowns):
            found = screen.channel(effect)
        else:
            model = model_of((*base, effect))
            if model is not None:
                found = screen.tried(model, moved(screen.base.model, screen.base.x, model), effect)
        if found is not None:
            out.append((found[0], effect, found[1]))
    out.sort(key=lambda item: -item[0])
    return out


def _at_place(
    screen: Screen,
    base: tuple[Effect, ...],
    effect: Effect,
    model_of: ModelOf,
    places: dict[tuple[str, Start], Place | None],
) -> Found | None:
    """The screen of a part, the best of the places that it may be at."""
    assert effect.jump is not None
    own = effect.unknowns[len(effect.unknowns) - effect.jump.fixed :]
    best: Found | None = None
    for fixed in product(*(u.starts for u in own)):
        key = (effect.jump.place, fixed)
        if key not in places:
            places[key] = place_at(screen, base, effect, model_of, fixed)
        place = places[key]
        found = screen.through(place, effect, fixed) if place else None
        if found is not None and (best is None or found[0] > best[0]):
            best = found
    return best


def place_at(
    screen: Screen, base: tuple[Effect, ...], effect: Effect, model_of: ModelOf, fixed: Start
) -> Place | None:
    """The place of a part beside those of `base`, with the unknowns that belong to it."""
    model = model_of((*base, effect))
    if model is None:
        return None
    known = moved(screen.base.model, screen.base.x, model)
    try:
        return place_of(model, known, effect, screen.problem.at, screen.response, fixed)
    except SamiiRigError:
        return None


def moved(old: Model, x: Float, model: Model) -> Float:
    """x of `old`, copied, for a model of more effects: some nominal parameters may be gone or
    back."""
    if model.keys == old.keys:
        return x.copy()
    held = dict(zip(old.keys, x[: old.n_nominal].tolist(), strict=True))
    return np.array([held.get(k, 0.0) for k in model.keys] + x[old.n_nominal :].tolist())
