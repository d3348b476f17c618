"""A sensor that alone disagrees with the model that explains all others: where it sits, which way
it points, or what it reads is not as the rig file has it. Or it alone is fine enough to show what
is missing.
"""

from __future__ import annotations

import numpy as np

from samii_rig.diagnose.data.measured import measured
from samii_rig.diagnose.data.wiring import outputs_of
from samii_rig.diagnose.fit.explanations import threshold
from samii_rig.diagnose.fit.search import Search
from samii_rig.diagnose.physics.grid import grid
from samii_rig.diagnose.verdict.stages import Case
from samii_rig.errors import SamiiRigError

FEWEST = 3  # sensors: of two, each may be the one


def odd_sensor(case: Case) -> str:
    """The one sensor without which the nominal model, refitted within its tolerances, explains the
    lines to their noise, "" where there is none or more than one. Not one that a loop is closed
    around: that would have moved all."""
    search = case.search
    names = {c.name for r in case.responses for c in r.outputs}
    explained = search.ratio(search.nominal.fitted) <= threshold(search.spread)
    # Where a sensor sits depends on no level.
    if len(names) < FEWEST or explained or search.lines.depends_on_level():
        return ""
    odd = [name for name in sorted(names - search.rig.centred) if _explained(case, name)]
    return odd[0] if len(odd) == 1 else ""


def _explained(case: Case, without: str) -> bool:
    """Whether the nominal model explains the lines of the other sensors."""
    rig, f = case.search.rig, case.lines.frequency
    kept = [(r, [i for i, c in enumerate(r.outputs) if c.name != without]) for r in case.responses]
    try:
        lines = measured(
            [outputs_of(r, keep) for r, keep in kept if keep], rig, (float(f[0]), float(f[-1]))
        )
        at = grid(rig, lines.frequency, lines.sensor, lines.actuator)
        search = Search(rig, lines, at, ())
    except (SamiiRigError, np.linalg.LinAlgError):
        return False
    return search.ratio(search.nominal.fitted) <= threshold(search.spread)


def describe(sensor: str) -> tuple[str, str]:
    """Why no part is named, and what to do."""
    return (
        f"without {sensor} the model of the rig file explains all other sensors to their noise: it "
        "is not as the rig file says, or shows alone what is missing",
        f"check where {sensor} sits, its axis, its unit and its filter, and what the rig file says "
        "of them",
    )
