"""What a weak force adds to the records' lines, to first order and computed in time."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from samii_rig.diagnose.fit.ranking import moved
from samii_rig.diagnose.fit.screen import Screen
from samii_rig.diagnose.forces.laws import FRICTION, HYSTERESIS, PLAY, Law
from samii_rig.diagnose.forces.model import ForceModel
from samii_rig.diagnose.forces.screen import Looks, scaled, weakly
from samii_rig.diagnose.forces.search import ForceSearch
from samii_rig.types import Float


def weak_ones(search: ForceSearch) -> Iterator[tuple[Law, str, float, float]]:
    """Of each force its law and site, and the power of what it adds, to first order and in time."""
    nominal = search.nominal.fitted
    looks = Looks(search.problem, (Screen.of(search.problem, nominal),))
    hopes = weakly(search.forces, search.reach, looks)
    assert {h.effect.key for h in hopes} == {e.key for e in search.forces}
    for hope in hopes:
        law = hope.effect.quasi.law
        if law in (
            PLAY,
            HYSTERESIS,
            FRICTION,
        ):  # whose shape depends on the strength, or that stick
            continue
        share = 0.02 if law.told is None else 1.0
        largest = search.reach.largest(hope.effect.quasi.place)
        strengths = scaled(law, hope.strengths, share, largest)
        model = search.model((hope.effect,))
        assert isinstance(model, ForceModel)
        x = np.append(moved(nominal.model, nominal.x, model), np.log(strengths))
        in_time = _power(*looks.gains(search.problem.change(model, x))) / share**2
        yield law, hope.effect.site, _power(hope.own, hope.may, hope.times), in_time


def _power(own: Float, _may: Float, times: Float | float) -> float:
    """Squared length of a change, from what it gains and how many times it should be."""
    return float(np.ravel(own / (2 * np.asarray(times) - 1))[0])
