"""The loops of all outputs of a plan closed together, line by line.

With v (k,) the outputs, y = H v the sensors and u, theta_ref the references,

    v_j = u_j + kp_j (theta_ref_j - y_theta_j) + sum over its loops F_i y_i,

in short (I + L) v = u + kp theta_ref with L_jl = kp_j H_theta_j,l - sum F_i H_i,l: a loop feels
what the other outputs do to its sensor.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from samii_rig.errors import LimitError
from samii_rig.model.loops import Loops, loops_of
from samii_rig.rig.schema import Rig
from samii_rig.run.plan import Plan
from samii_rig.types import Complex

# A closed loop without poles outside the circle does not wind around 0 at all.
MOST_WINDING = 0.5


@dataclass(frozen=True, slots=True)
class ClosedLoops:
    """The loops of k outputs on a row of n points.

    loops : of each output. filters : (n, n_feedback) values of each one's filters.
    difference : (n, k, k) I + L.
    """

    loops: tuple[Loops, ...]
    filters: tuple[Complex, ...]
    difference: Complex

    @classmethod
    def of(cls, plan: Plan, rig: Rig, H: Complex, z: Complex) -> ClosedLoops:
        """Of a completed plan; H (n, n_sensor, k) at z (n,)."""
        names = [s.name for s in rig.sensor]
        loops = tuple(
            replace(
                loops_of(rig, o.actuator), actuator=j, theta=names.index(o.centring_sensor), kp=o.kp
            )
            for j, o in enumerate(plan.outputs)
        )
        filters = tuple(one.filters(z, rig.rate_hz) for one in loops)
        k = len(loops)
        L = np.empty((len(z), k, k), dtype=np.complex128)
        for j, (one, own) in enumerate(zip(loops, filters, strict=True)):
            for other in range(k):
                L[:, j, other] = replace(one, actuator=other).gain(H, own)
        return cls(loops, filters, np.eye(k) + L)

    def outputs(self, drive: Complex) -> Complex:
        """v (n, k) for the references u + kp theta_ref (n, k)."""
        if len(self.loops) == 1:
            return np.asarray(drive / self.difference[:, :, 0])
        return np.asarray(np.linalg.solve(self.difference, drive[:, :, None])[:, :, 0])

    def refuse_unstable(self, plan: Plan) -> None:
        """LimitError by Nyquist's count: det(I + L) has no pole outside the circle and is 1 far
        out, so the times it winds around 0 along the circle are the closed loops' poles outside."""
        closed = [o for o in plan.outputs if o.kp != 0.0]
        filters = [f for one in self.loops for _, f in one.feedback]
        if not closed and not filters:
            return
        D = np.linalg.det(self.difference) if len(self.loops) > 1 else self.difference[:, 0, 0]
        turns = float(np.abs(np.diff(np.unwrap(np.angle(D))).sum()) / np.pi)
        if turns <= MOST_WINDING:
            return
        shown = closed or plan.outputs[:1]
        s = "s" if len(shown) > 1 else ""
        gains = " and ".join(f"kp = {o.kp:g} on {o.centring_sensor}" for o in shown)
        what = f"the centring loop{s} with {gains}"
        if filters:
            what += f" and the feedback {', '.join(f'{f.name} on {f.sensor}' for f in filters)}"
        smaller = "a smaller kp or gain" if filters else "a smaller kp"
        raise LimitError(f"{what} would be unstable by the model; expected {smaller}")
