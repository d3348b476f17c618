"""The dry run and the gate's limits for every kind of source: predicted as the simulated rig then
does, or refused in one line."""

from __future__ import annotations

import numpy as np
import pytest
from elements_kit import branch, part
from elements_kit import rig as chain
from loop_kit import Memory

from samii_rig.errors import InputError, LimitError
from samii_rig.rig.load import load_rig, parse
from samii_rig.rig.schema import Feedback, Limit, Rig
from samii_rig.run.dryrun import predict
from samii_rig.run.loop import run
from samii_rig.run.plan import Plan, PlannedSegment
from samii_rig.safety.limits import gate_limits
from samii_rig.signal.excitation import swept_sine
from sim.rig import open_rig

RATE = 500.0
SPRING = part("torsional_spring", "spring", k=40.0, c=0.4)
LINK = part("rigid_link", "link", L=0.5, r=0.25, m=1.0, I=0.02)
OUTER = part("rigid_link", "outer", L=0.3, r=0.1, m=0.5, I=0.01)
ANGLE = {
    "name": "theta", "kind": "absolute_angle", "after": "spring", "unit": "rad",
    "noise_rms": 1e-5, "resolution": 1e-5,
}  # fmt: skip
PUSH = {
    "name": "a", "kind": "acceleration", "on": "link", "position": 0.5, "unit": "m/s^2",
    "antialias": {"order": 4, "corner_hz": 100.0}, "noise_rms": 0.01,
}  # fmt: skip
DRIVES = {
    "angular_velocity_source": (
        part("angular_velocity_source", "drive", K=0.5, p=100.0), SPRING, LINK,
    ),
    "angular_velocity_source_2": (
        part("angular_velocity_source_2", "drive", K=0.5, omega=120.0, zeta=0.7), SPRING, LINK,
    ),
    "torque_source": (SPRING, part("torque_source", "drive", K=2.0, p=200.0), LINK),
    "force_source": (SPRING, LINK, part("force_source", "drive", K=3.0, p=200.0), OUTER),
}  # fmt: skip


def rig_of(*parts, **changes) -> Rig:
    r = chain(*parts, base="clamped", tip="free", sensor=[ANGLE, PUSH])
    actuator = r.actuator[0].model_copy(update={"deadman": 0.05, "low": -10.0, "high": 10.0})
    return r.model_copy(update={"actuator": (actuator,), **changes})


def sweep(kp=0.0, level=0.5) -> Plan:
    u, f = swept_sine(RATE, 0.5, 30.0, 6.0, ramp=0.5, lead_in=0.3, ring_down=1.0)
    segment = PlannedSegment(
        "s", "burst", level, "V", 0, level * u, np.zeros_like(u), (0.5, 30.0), f
    )
    return Plan("test", RATE, "v", kp, "theta", (segment,), 0)


@pytest.mark.parametrize("kind", DRIVES)
def test_the_simulated_rig_reaches_the_predicted_peaks(kind):
    rig = rig_of(*DRIVES[kind])
    plan = sweep()
    predicted = predict(plan, rig)
    predicted.refuse()
    assert predicted.channels == ("v", "theta", "a", "M_drive")
    assert predicted.peaks[0, 3] > 0.0
    sink = Memory()
    stop = run(plan, rig, open_rig(rig, {"noise": False}), sink)
    assert stop.status == "completed", stop
    for name in ("theta", "a"):
        peak = np.abs(sink.column(name)).max()
        assert predicted.peaks[0, predicted.channels.index(name)] == pytest.approx(peak, rel=0.01)


def test_the_moment_at_a_torque_or_force_is_what_the_chain_towards_the_base_carries():
    """Slowly driven, the joint's spring holds both torques, what is behind the first the second
    alone, and a force its arm."""
    u = np.r_[0.5 - 0.5 * np.cos(np.pi * np.arange(2000) / 2000), np.ones(1000)]
    rest, silent = np.zeros(3000), np.full(3000, np.nan)
    slow = PlannedSegment("s", "burst", 1.0, "V", 0, u, rest, (0.5, 30.0), silent)

    def peaks(*parts):
        found = predict(Plan("t", RATE, "v", 0.0, "theta", (slow,), 0), rig_of(*parts))
        return dict(zip(found.channels, found.peaks[0], strict=True))

    near, far = (part("torque_source", name, K=2.0) for name in ("near", "far"))
    found = peaks(SPRING, near, LINK, far)
    assert found["theta"] == pytest.approx(4.0 / 40.0, rel=0.01)
    assert found["M_near"] == pytest.approx(4.0, rel=0.01)
    assert found["M_far"] == pytest.approx(2.0, rel=0.05)
    shaker = part("force_source", "shaker", K=3.0)
    found = peaks(SPRING, LINK, shaker, OUTER)
    assert found["theta"] == pytest.approx(3.0 * 0.5 / 40.0, rel=0.01)
    assert found["M_shaker"] < 0.02, "nothing but the outer link is behind it"


@pytest.mark.parametrize("kind", ["torque_source", "force_source"])
def test_centring_through_a_torque_or_a_force_is_refused_in_one_line(kind):
    """How far it turned a joint is not known from v, so a dead angle would show too late."""
    rig = rig_of(*DRIVES[kind])
    for refused in (
        lambda: gate_limits(rig, "v", 4.0, "theta"),
        lambda: predict(sweep(4.0), rig),
        lambda: run(sweep(4.0), rig, open_rig(rig, {}), Memory()),
    ):
        with pytest.raises(InputError, match=r"sensor\[theta\].* or kp = 0") as said:
            refused()
        assert "\n" not in str(said.value)


@pytest.mark.parametrize("kind", ["angular_velocity_source", "angular_velocity_source_2"])
def test_an_angle_behind_either_velocity_source_must_follow_it(kind):
    rig = rig_of(*DRIVES[kind])
    (theta,) = gate_limits(rig, "v", 4.0, "theta").sensors
    assert theta.stuck.gain == 0.5
    limit = Limit(channel="theta", unit="rad", max=1.0, reason="the frame")
    rig = rig.model_copy(update={"limit": (limit,)})
    stop = run(sweep(4.0), rig, open_rig(rig, {"stuck": {"theta": 2.0}, "seed": 1}), Memory())
    assert stop.status == "tripped"
    assert "theta is stuck" in stop.reason


def damping(sensor: str) -> Feedback:
    unit = {"theta": "rad", "a": "m/s^2"}[sensor]
    return Feedback(
        name="f", sensor=sensor, actuator="v", gain=0.1, unit=f"V/({unit})", poles=(-5.0,), max=0.5
    )


def test_a_feedback_from_a_sensor_without_noise_is_refused_in_one_line():
    rig = rig_of(*DRIVES["angular_velocity_source"], feedback=(damping("a"),))
    assert gate_limits(rig, "v", 0.0, "theta").feedback
    coarse = rig.sensor[1].model_copy(update={"resolution": 0.05})
    rig = rig.model_copy(update={"sensor": (rig.sensor[0], coarse)})
    with pytest.raises(InputError, match=r"sensor\[a\].noise_rms is 0.01; expected above 0.25"):
        gate_limits(rig, "v", 0.0, "theta")
    # An angle that the output turns needs none: its travel says that it lives.
    still = rig.sensor[0].model_copy(update={"noise_rms": 0.0})
    rig = rig.model_copy(update={"sensor": (still, coarse), "feedback": (damping("theta"),)})
    assert gate_limits(rig, "v", 0.0, "theta").sensors[0].stuck.gain == 0.5


STANDING = part("gravity_stiffness", "gravity", k=-5.0)


@pytest.mark.parametrize(
    ("k", "where", "falls"),
    [(6.0, "chain", False), (4.0, "chain", True), (6.0, "branch", False), (4.0, "branch", True)],
)
def test_a_chain_that_falls_over_by_itself_is_refused(k, where, falls):
    """Link and joint as an inverted pendulum: the spring holds 5 N m/rad of gravity or does not."""
    soft = part("torsional_spring", "soft", k=k, c=0.05)
    upright = (soft, STANDING, part("rigid_link", "pole", L=0.5, r=0.25, m=1.0, I=0.02))
    source = part("angular_velocity_source", "drive", K=0.5, p=100.0)
    side = (branch(*upright),) if where == "branch" else upright
    rig = rig_of(source, SPRING, *side, LINK)
    if not falls:
        predict(sweep(level=0.01), rig).refuse()
        return
    with pytest.raises(LimitError, match=r"falls over by itself, by e in 0\.") as refusal:
        predict(sweep(level=0.01), rig)
    assert "\n" not in str(refusal.value)


def test_a_sensor_of_which_the_model_knows_no_number_is_refused(monkeypatch):
    from samii_rig.run import dryrun

    rig = rig_of(*DRIVES["angular_velocity_source"])
    known = dryrun._sampled

    def lost(*args):
        H = known(*args)
        H[3, 1] = np.nan
        return H

    monkeypatch.setattr(dryrun, "_sampled", lost)
    with pytest.raises(LimitError, match="no number for a of test"):
        predict(sweep(), rig)


def test_the_shipped_rigs_stand():
    for name in ("samii_torque_vertical", "samii_torque_horizontal"):
        rig, text = load_rig(name)
        assert parse(Rig, text, name) == rig
        gate_limits(rig, rig.actuator[0].name, rig.centring.kp, rig.centring.sensor)
