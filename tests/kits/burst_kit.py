"""A short burst on the fake device, predicted: the least that is a whole run."""

from __future__ import annotations

import numpy as np
from fake_device import RATE, fake_rig

from samii_rig.run.dryrun import predict
from samii_rig.run.plan import Plan, PlannedSegment
from samii_rig.signal.excitation import swept_sine

RIG = fake_rig()
U, F = swept_sine(RATE, 2.0, 20.0, 0.6, ramp=0.1, lead_in=0.1, ring_down=0.3)
SEGMENT = PlannedSegment("burst", "burst", 1.0, "V", 0, U, np.zeros_like(U), (2.0, 20.0), F)
PLAN = Plan("sweep", RATE, "v", 4.0, "theta", (SEGMENT,), 0)
PREDICTED = predict(PLAN, RIG)
