"""What a job's files ask for, as a plan."""

from __future__ import annotations

from samii_rig.rig.load import parse
from samii_rig.rig.schema import Rig
from samii_rig.run.order import Order, PlannedRun
from samii_rig.run.plan import Plan
from samii_rig.serve.job import EXPERIMENT, RIG, Job


def averages(plan: Plan, segment: int) -> tuple[int, int]:
    """How many segments like the one that goes on are whole, and how many the plan has.

    segment : the number of the one that goes on, from 1. Alike are those that are averaged
    together: of one kind and level, that drive the same actuators.
    """
    alike = [(s.kind, s.level, s.unit, s.excited) for s in plan.segments]
    now = alike[segment - 1]
    return alike[: segment - 1].count(now), alike.count(now)


def planned(job: Job) -> PlannedRun:
    """The run that a job's files ask for; InputError if they are wrong, RecordingError if they
    cannot be read."""
    rig_toml = (job.folder / RIG).read_text(encoding="utf-8")
    rig = parse(Rig, rig_toml, RIG)
    return Order.named(str(job.folder / EXPERIMENT), rig, rig_toml).run(job.order().setup)
