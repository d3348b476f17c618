"""A design as a rig file, as plain data and in words."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from samii_rig.control.design import Design
from samii_rig.control.plants import Judgement
from samii_rig.control.settle import Settling
from samii_rig.rig.schema import Feedback

PARTS = (5.0, 50.0, 95.0)  # per cent of the rigs drawn within the tolerances
SHOWN = ("damping", "gain_db", "phase_deg")


def rig_text(text: str, design: Design) -> str:
    """The rig file `text` with the loop of `design` added to it."""
    loop = design.feedback
    n, corner, gain = lowpass_numbers(loop)
    poles = ", ".join(repr(p) for p in loop.poles)
    return f"""{text.rstrip()}

# {gain:.4g} {loop.unit} at rest, low-pass of {n} equal poles at {corner:.4g} Hz.
[[feedback]]
name = "{loop.name}"
sensor = "{loop.sensor}"
actuator = "{loop.actuator}"
gain = {loop.gain!r}
unit = "{loop.unit}"
poles = [{poles}]
max = {loop.max!r}
"""


def lowpass_numbers(loop: Feedback) -> tuple[int, float, float]:
    """Number of poles, the slowest one's corner in Hz and the gain at rest of a filter."""
    zeros, poles, k = loop.zpk()
    rest = k * np.prod([-z for z in zeros]) / np.prod([-p for p in poles])
    corner = min((abs(p) for p in poles), default=math.inf) / (2 * math.pi)
    return len(poles), corner, float(np.real(rest))


def lines(design: Design) -> tuple[str, str, str]:
    """What was found, in three lines."""
    d, goals = design, design.goals
    n, corner, gain = lowpass_numbers(d.feedback)
    centring = d.rig.centring
    beside = f" beside kp = {centring.kp:g} on {centring.sensor}" if centring else ""
    first = (
        f"{d.feedback.name}: {d.feedback.sensor} to {d.feedback.actuator}, {gain:.3g} "
        f"{d.feedback.unit} at rest, {n} pole{'s'[: n > 1]} from {corner:.3g} Hz{beside}"
    )
    second = (
        f"nominal: damping of mode 1 {d.without.damping:.3f} -> {d.nominal.damping:.3f}, "
        f"gain margin {_number(d.nominal.gain_db)} dB, "
        f"phase margin {_number(d.nominal.phase_deg)} deg"
    )
    word = "reached" if d.reached else "NOT REACHED"
    third = (
        f"worst of {len(d.corners) + len(d.draws)} rigs, every stiffness within "
        f"+-{100 * goals.spread:g} %: {d.least('damping'):.3f}, "
        f"{_number(d.least('gain_db'))} dB, {_number(d.least('phase_deg'))} deg: {word} "
        f"({goals.damping:g}, {goals.gain_db:g} dB, {goals.phase_deg:g} deg)"
    )
    return first, second, third


def step_line(s: Settling) -> str:
    """What the steps of one recording show, in a line."""
    loops = "with " + ", ".join(s.feedback) if s.feedback else "without feedback"
    text = (
        f"{s.source}, {loops}: {s.sensor} within 5 % after {_number(s.measured_s)} s "
        f"(model {_number(s.predicted_s)} s)"
    )
    if s.decay is None:
        return text
    return (
        f"{text}, damping {s.decay.damping:.4f} +- {s.decay.sd:.1g} at {s.decay.hz:.3g} Hz "
        f"(model {s.expected[1]:.4f} at {s.expected[0]:.3g} Hz)"
    )


def plain(design: Design, steps: Sequence[Settling] = ()) -> dict[str, Any]:
    """Everything as plain data, for machines."""
    d = design
    n, corner, gain = lowpass_numbers(d.feedback)
    return {
        "feedback": d.feedback.model_dump(mode="json"),
        "poles": n,
        "corner_hz": corner,
        "gain_at_rest": gain,
        "goals": asdict(d.goals),
        "reached": d.reached,
        "trials": [
            {
                "poles": t.poles,
                "corner_hz": t.corner_hz,
                "gain_at_rest": t.gain,
                "reserve": t.reserve,
                "worst": judgement(t.worst),
            }
            for t in d.trials
        ],
        "without": judgement(d.without),
        "nominal": judgement(d.nominal),
        "worst": judgement(d.worst),
        "least": {what: d.least(what) for what in SHOWN},
        "rigs_in_the_range": len(d.corners) + len(d.draws),
        "uncertain": distribution(d.uncertain),
        "steps": [
            {
                "recording": s.source,
                "feedback": list(s.feedback),
                "sensor": s.sensor,
                "steps": s.steps,
                "settled_s": s.measured_s,
                "settled_by_the_model_s": s.predicted_s,
                "decay": None if s.decay is None else asdict(s.decay),
                "damping_of_the_model": s.expected[1],
            }
            for s in steps
        ],
    }


def judgement(j: Judgement) -> dict[str, Any]:
    """One judgement as plain data."""
    return {
        "rig": j.plant,
        "stable": j.outside == 0,
        "damping": j.damping,
        "frequency_hz": j.frequency_hz,
        "actuator": asdict(j.actuator),
        "feedback": asdict(j.feedback),
        "slow_poles": [
            [float(p.real), float(p.imag)] for p in j.poles if abs(p) < 2 * math.pi * 15
        ],
    }


def distribution(judgements: Sequence[Judgement]) -> dict[str, Any]:
    """Percentiles of damping and margins over the rigs drawn, and how many are stable."""
    return {
        "rigs": len(judgements),
        "stable": sum(j.outside == 0 for j in judgements),
        **{
            what: {
                f"{part:g} %": _percentile([getattr(j, what) for j in judgements], part)
                for part in PARTS
            }
            for what in SHOWN
        },
    }


def _percentile(values: Sequence[float], part: float) -> float:
    """Between its two neighbours linearly; a margin without end is one, not the lack of one."""
    low, high = (float(np.percentile(values, part, method=m)) for m in ("lower", "higher"))
    return low if low == high else float(np.percentile(values, part))


def _number(x: float) -> str:
    return f"{x:.3g}" if math.isfinite(x) else "no end of"
