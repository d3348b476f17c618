"""The table of physics: what may have been left out of a rig file, as data.

Parts at a point are rows of `points`, changes of what the chain is made of are in `bodies`, what a
rig has less of in `reduced`, factors in `channels`, what is no physics in `faults`. A lab adds
effects by the entry point `samii_rig.effects`.
"""

from __future__ import annotations

from collections.abc import Iterator

from samii_rig import installed
from samii_rig.devices.plugins import asked, named, wrong
from samii_rig.diagnose.physics import bodies, channels, elsewhere, faults, points, reduced
from samii_rig.diagnose.physics.effect import Effect
from samii_rig.diagnose.physics.scales import places
from samii_rig.rig.schema import Rig

GROUP = "samii_rig.effects"  # of entry points


def hypotheses(
    rig: Rig,
    low_hz: float,
    high_hz: float,
    *,
    signed: bool = False,
    recorded_hz: float | None = None,
) -> list[Effect]:
    """Every single effect that the table knows on this rig; ranges are those of the band.

    signed : with what is less than it was, in parameters that the refit moves too: what may change
    between two states. recorded_hz : rate of the recordings, where it is not the rig's.
    """
    where = places(rig, low_hz, high_hz)
    return [
        *points.effects(rig, where),
        *bodies.effects(rig, where),
        *reduced.effects(rig, between=signed),
        *channels.effects(rig, low_hz, high_hz),
        *elsewhere.effects(rig),
        *faults.effects(rig, recorded_hz or rig.rate_hz),
        *plugged(rig, low_hz, high_hz),
    ]


def plugged(rig: Rig, low_hz: float, high_hz: float) -> Iterator[Effect]:
    """The effects of other packages: each entry point of `samii_rig.effects` is a function
    (rig, low_hz, high_hz) -> iterable of Effect, seen by the command line, the service and workers.

    Raises InputError with the entry point's name for what it raises or gives in place of effects.
    """
    for point in installed.points(GROUP):
        who = named(point)
        with asked(who, "effects"):
            made = list(point.load()(rig, low_hz, high_hz))
        for effect in made:
            if not isinstance(effect, Effect):
                raise wrong(who, "effects", effect, "an Effect")
        yield from made
