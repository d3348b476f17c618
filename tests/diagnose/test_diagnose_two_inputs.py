"""A rig with two actuators, each excited by itself: what is missing shows in the responses to both,
what is wrong with one input in those to it alone.
"""

import numpy as np
import pytest
from identify_kit import samii
from table_kit import Effects, table_of

from samii_rig.diagnose.diagnose import diagnose
from samii_rig.diagnose.physics.grid import grid
from samii_rig.diagnose.physics.model import Model
from samii_rig.identify.bootstrap import redraw
from samii_rig.model.sampled import sampled_response
from samii_rig.rig.schema import Parameter, Rig, TorqueSource
from samii_rig.types import Channel, FrequencyResponse

BAND = (0.5, 40.0)
LINES = np.geomspace(*BAND, 40)
PHYSICS = ("torsional_compliance", "transport_delay")


def shaken() -> Rig:
    """SAMII with a torque on link 1 beside its joint 2."""
    rig = samii()
    gain = Parameter(value=20.0, unit="N m/V", tolerance=0.05, source="chosen")
    shaker = TorqueSource(kind="torque_source", name="shaker", input="v_t", K=gain)
    at = [e.name for e in rig.element].index("link_1") + 1
    first = rig.actuator[0]
    return rig.model_copy(
        update={
            "element": (*rig.element[:at], shaker, *rig.element[at:]),
            "actuator": (first, first.model_copy(update={"name": "v_t"})),
        }
    )


RIG = shaken()
ALL = Effects(lambda: table_of(RIG, *BAND))
FEW = Effects(lambda: table_of(RIG, *BAND, *PHYSICS))


def measured_twice(*effects, seed=1):
    """A response to each input of the rig with (effect, values) in it."""
    model = Model(RIG, [e for e, _ in effects])
    x = np.concatenate([np.zeros(model.n_nominal), *(np.log(values) for _, values in effects)])
    q = len(RIG.sensor)
    exact = sampled_response(RIG, LINES)
    out = []
    for i, actuator in enumerate(RIG.actuator):
        at = grid(RIG, LINES, np.arange(q), np.full(q, i))
        size = np.abs(exact[:, :, i])
        sd = 0.01 * (size + np.median(size, axis=0)) / 2
        like = FrequencyResponse(
            frequency=LINES,
            H=exact[:, :, i : i + 1],
            covariance=sd[:, :, None] * (0.3 + 0.7 * np.eye(q)) * sd[:, None, :] + 0j,
            dof=np.full(LINES.size, 40.0),
            coherence=np.ones((LINES.size, q)),
            inputs=(Channel(actuator.name, actuator.unit, "command"),),
            outputs=tuple(Channel(s.name, RIG.units()[s.name]) for s in RIG.sensor),
            level=1.0,
            level_unit=actuator.unit,
            input_rms=np.ones((LINES.size, 1)),
            rate_hz=RIG.rate_hz,
            n_averages=41,
            method="burst (drawn)",
            why="drawn",
        )
        H = model.response(x, at)[:, :, None]
        out.append(redraw(like, H, np.random.default_rng([seed, i])))
    return out


def effect(physics, site):
    return next(e for e in ALL if (physics, site) in e.names)


@pytest.mark.parametrize(
    ("physics", "site", "values"),
    [
        ("torsional_compliance", "clamp", [2e5, 0.05]),
        ("transport_delay", "shaker", [2e-3]),
    ],
)
def test_what_is_missing_is_named_where_it_is(physics, site, values):
    found = diagnose(measured_twice((effect(physics, site), values)), RIG, effects=FEW)
    assert found.verdict == "named"
    (cause,) = found.causes
    assert (physics, site) in {(cause.physics, cause.site), *cause.equivalents}
