"""What a weak force adds to the records' lines, to first order and computed in time."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from samii_rig.diagnose.fit.ranking import moved
from samii_rig.diagnose.forces.laws import FRICTION, HYSTERESIS, PLAY, SLACK, Law
from samii_rig.diagnose.forces.model import ForceModel
from samii_rig.diagnose.forces.screen import ForceScreen, first_order, scaled
from samii_rig.diagnose.forces.search import ForceSearch
from samii_rig.types import Float


def weak_ones(search: ForceSearch) -> Iterator[tuple[Law, str, float, float]]:
    """Of each force its law and site, and the power of what it adds, to first order and in time."""
    nominal = search.nominal.fitted
    screen = ForceScreen.of(search.problem, [nominal])
    scores = first_order(search.forces, search.paths, screen)
    assert {h.effect.key for h in scores} == {e.key for e in search.forces}
    for score in scores:
        law = score.effect.force.law
        if law in (
            PLAY,
            SLACK,
            HYSTERESIS,
            FRICTION,
        ):  # whose shape depends on the strength, or that stick
            continue
        # So little that what it adds is of first order also beside the nominal parameters, which do
        # nearly all that a stop near the clamp does.
        share = 5e-4 if law.of_command is None else 1.0
        largest = search.paths.largest(score.effect.force.place)
        strengths = scaled(law, score.strengths, share, largest)
        model = search.model((score.effect,))
        assert isinstance(model, ForceModel)
        x = np.append(moved(nominal.model, nominal.x, model), np.log(strengths))
        (gains,) = screen.gains([search.problem.added(model, x)])
        in_time = _power(*gains) / share**2
        yield law, score.effect.site, _power(score.own, score.may, score.times), in_time


def _power(own: Float, _may: Float, times: Float | float) -> float:
    """Squared length of a change, from what it gains and how many times it should be."""
    return float(np.ravel(own / (2 * np.asarray(times) - 1))[0])
