"""The papers' own story, concealed: what each says when the other model is the truth.

python benchmarks/papers_story.py [joints spring feedback encoder encoder_only]

Sweeps of the simulated rig (same transfer matrix model in the time domain, converters, loop, noise
and a disturbance at the input) are diagnosed with another rig file: perfect joints and a perfect
source, the joint's spring left out, the actuator's velocity feedback left out, the encoder on the
other side of the spring, and all of it with theta_2 alone.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable

import numpy as np

from experiments.swept_sine import SweptSine
from samii_rig.diagnose.diagnose import diagnose
from samii_rig.diagnose.result import Diagnosis
from samii_rig.identify.actuator import with_encoder
from samii_rig.identify.velocity_feedback import in_series
from samii_rig.rig.load import load_rig
from samii_rig.rig.schema import Rig, TorsionalSpring
from samii_rig.run.protocols import CommandBlock, DeviceLoop
from samii_rig.signal.estimate import estimate
from samii_rig.types import FrequencyResponse, Recording, Segment
from sim.rig import open_rig

SOURCE, JOINT = "joint_2_source", "joint_2"
GIVES = 700.0  # N m s/rad, the velocity feedback of an actuator that gives
AMPLITUDES = (0.3, 0.6)  # V
DISTURBANCE = 0.05  # V rms, at the input


def perfect(rig: Rig, *names: str) -> Rig:
    """The rig without the joints named, or without all: they do not give."""
    gone = {
        e.name
        for e in rig.element
        if isinstance(e, TorsionalSpring) and (not names or e.name in names)
    }
    data = rig.model_dump()
    data["element"] = [e for e in data["element"] if e["name"] not in gone]
    for sensor in data["sensor"]:
        if "across" in sensor:
            sensor["across"] = tuple(n for n in sensor["across"] if n not in gone)
    return Rig.model_validate(data)


def recorded(rig: Rig, level: float, seed: int) -> Recording:
    """Three sweeps of 60 s, from rest to rest."""
    plan = SweptSine(
        experiment="swept_sine", name="story", actuator="v_2", unit="V", sweep="logarithmic",
        start_hz=0.5, stop_hz=40.0, duration=30.0, ramp=1.0, lead_in=1.0, ring_down=29.0,
        amplitudes=(level,), repeats=3,
    ).plan(rig)  # fmt: skip
    device = open_rig(rig, {"seed": seed, "disturbance_rms": DISTURBANCE})
    device.actuator.configure(DeviceLoop(plan.centring_sensor, plan.kp, 10.0, 1e9, 1e9))
    u = np.concatenate([s.u for s in plan.segments])
    device.actuator.write(CommandBlock(0, u, np.zeros_like(u)))
    device.clock.sleep(len(u) / rig.rate_hz)
    b = device.sensor.read()
    ends = np.cumsum([len(s.u) for s in plan.segments])
    segments = tuple(
        Segment(s.name, s.kind, int(end) - len(s.u), int(end), s.level, s.unit, s.repeat)
        for s, end in zip(plan.segments, ends, strict=True)
    )
    return Recording(b.channels, rig.rate_hz, b.time, b.sequence, b.values, b.quality, segments)


def responses(rig: Rig, outputs: tuple[str, ...] | None = None) -> tuple[FrequencyResponse, ...]:
    """What is measured on a rig."""
    runs = [recorded(rig, level, 1 + i) for i, level in enumerate(AMPLITUDES)]
    return estimate(runs, outputs=outputs)


def joints() -> Diagnosis:
    """Perfect joints and a perfect source against the rig of the papers."""
    rig = load_rig("samii")[0]
    return diagnose(responses(rig), perfect(rig))


def spring() -> Diagnosis:
    """The spring and damper of joint 2, with the encoder across them, left out."""
    rig = load_rig("samii")[0]
    return diagnose(responses(rig), perfect(rig, JOINT))


def feedback() -> Diagnosis:
    """An actuator that gives way to torque, in the place of the spring."""
    rig = perfect(load_rig("samii")[0], JOINT)
    return diagnose(responses(in_series(rig, SOURCE, GIVES)), rig)


def encoder() -> Diagnosis:
    """The encoder at the actuator, where the rig file has it across the spring."""
    rig = load_rig("samii")[0]
    return diagnose(responses(with_encoder(rig, "theta_2", (SOURCE,))), rig)


def encoder_only() -> Diagnosis:
    """As `spring`, with theta_2 over v_2 alone to look at."""
    rig = load_rig("samii")[0]
    return diagnose(responses(rig, ("theta_2",)), perfect(rig, JOINT))


def all_from_encoder() -> Diagnosis:
    """As `joints`, with theta_2 over v_2 alone to look at."""
    rig = load_rig("samii")[0]
    return diagnose(responses(rig, ("theta_2",)), perfect(rig))


STORY: dict[str, Callable[[], Diagnosis]] = {
    f.__name__: f for f in (joints, spring, feedback, encoder, encoder_only, all_from_encoder)
}


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("which", nargs="*", default=[])
    for name in parser.parse_args().which or STORY:
        start = time.process_time()
        found = STORY[name]()
        print(f"{name}: {STORY[name].__doc__}")
        print(f"    {found.verdict}: {found.lines()[0]}")
        for cause in found.causes:
            same = ", ".join(f"{p} at {s}" for p, s in cause.equivalents)
            print(f"    {cause.physics} at {cause.site} {cause.probability:.2f} (= {same})")
        for causes, p in found.alternatives[:3]:
            words = " and ".join(f"{c.physics} at {c.site}" for c in causes)
            print(f"    or {words}: {p:.3f}")
        print(f"    {found.lines()[2]}")
        print(f"    why: {found.why}; {time.process_time() - start:.0f} s", flush=True)


if __name__ == "__main__":
    main()
