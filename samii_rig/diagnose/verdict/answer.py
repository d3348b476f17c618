"""What is told of a verdict: causes with their values, places, and how well each model does."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import replace

import numpy as np

from samii_rig.diagnose.data.measured import Measured
from samii_rig.diagnose.fit.between_runs import VARIATION
from samii_rig.diagnose.fit.classes import Class
from samii_rig.diagnose.fit.gap import gap_of
from samii_rig.diagnose.fit.intervals import values_of
from samii_rig.diagnose.fit.refit import Fitted
from samii_rig.diagnose.fit.search import Search
from samii_rig.diagnose.forces.laws import FRICTION, HYSTERESIS
from samii_rig.diagnose.physics.along import POSITION
from samii_rig.diagnose.physics.confusions import nearest
from samii_rig.diagnose.physics.effect import Effect
from samii_rig.diagnose.physics.model import Model
from samii_rig.diagnose.result import Band, Cause, Gap, Moved, Value
from samii_rig.diagnose.verdict.judge import MOST_NAMES, Judgement
from samii_rig.signal.statistics import octaves
from samii_rig.types import Complex

LISTED = 0.01  # probability of an alternative from which it is listed
CALIBRATED = 0.03  # relative, of a fitted gain: what a sensor's calibration may be off by


def causes_of(chosen: Class, judged: Judgement, share: float | None = None) -> tuple[Cause, ...]:
    """The physics of a class's first member. Each has its own marginal probability, or that of
    the whole class where it is given."""
    first = chosen.first
    values = values_of(chosen, judged.overdispersion)
    out = []
    for effect, found in zip(first.effects, values, strict=True):
        if not effect.physical or unit_of(effect, found):
            continue
        same = {effect.name, *chosen.equivalents(effect)}
        p = share
        if p is None:
            p = sum(
                q
                for c, q in zip(judged.classes, judged.probabilities, strict=True)
                if any(n in same for e in c.first.effects for n in e.names)
            )
        equivalents = tuple(chosen.equivalents(effect))
        dry = FRICTION.physics, effect.site
        # What sticks on a spring of no upper limit, and then slips, is dry friction.
        if (
            effect.physics == HYSTERESIS.physics
            and found["k"].high is None
            and dry not in equivalents
        ):
            equivalents += (dry,)
        place = found[POSITION].value if POSITION in found else effect.position
        out.append(Cause(*effect.name, min(p, 1.0), equivalents, found, place))
    return tuple(out)


def varying(judged: Judgement) -> tuple[Cause, ...]:
    """The stiffness that is not constant, if one is."""
    if (found := judged.varies) is None:
        return ()
    site, p = found.sites[0]
    return (Cause(VARIATION, site, p * judged.right, (), found.parameters),)


def unit_of(effect: Effect, found: dict[str, Value]) -> str:
    """What unit a sensor's gain would be a confusion of, "" for none."""
    if effect.physics != "sensor_gain":
        return ""
    gain = found["gain"].value
    unit, factor = nearest(gain)
    return unit.name if abs(gain / factor - 1) < CALIBRATED else ""


def moved(fitted: Fitted, stated: Model) -> tuple[Moved, ...]:
    """Nominal parameters that are off by more than their tolerance in a model of the same, the
    farthest first."""
    n = fitted.model.n_nominal
    away = fitted.x[:n] / stated.prior[:n]
    out = [
        Moved(".".join(key), float(a))
        for key, a in zip(fitted.model.keys, away, strict=True)
        if abs(a) > 1
    ]
    return tuple(sorted(out, key=lambda m: -abs(m.sigmas)))


def not_physics_of(judged: Judgement) -> list[str]:
    """Findings of the chosen explanation that are not physics, in words."""
    out = []
    best = judged.best
    values = values_of(judged.classes[0], judged.overdispersion)
    for effect, found in zip(best.effects, values, strict=True):
        unit = unit_of(effect, found)
        match effect.physics:
            case "channel_swap":
                out.append(f"{effect.site} and {effect.aliases[0][1]} are swapped")
            case "sign_error" | "unit_error" | "kind_error" | "column_shifted" | "columns_shifted":
                out.append(f"{effect.site} {effect.variant}")
            case "time_offset":
                ms = found["tau"].times(1e3)
                out.append(
                    f"{effect.site} is {ms.value:.4g} ms ({ms.within()}) ahead of the other "
                    "channels: stamped or read too early"
                )
            case "input_not_held":
                out.append(
                    f"{effect.site} was not held between samples but recorded as a meter sees it, "
                    "half a sample from what the rig file states"
                )
            case "input_held":
                out.append(
                    f"{effect.site} was held between samples: the rig file states that it was "
                    "measured (held = false), which is half a sample from what was recorded"
                )
            case "common_gain":
                g = found["gain"]
                out.append(
                    f"all channels share a gain of {g.value:.4g} ({g.within()}): "
                    "a scale of the input, not a shape that physics would have"
                )
            case _ if unit:
                g = found["gain"]
                out.append(f"{effect.site} is {g.value:.4g} times what it should be: {unit}")
    many = judged.classes[0].names()
    if many > MOST_NAMES:
        alike = [" and ".join(" at ".join(e.name) for e in m.effects)
                 for m in judged.classes[0].members[:MOST_NAMES]]  # fmt: skip
        out.append(f"{many} names fit these data alike, among them {'; '.join(alike)}")
    return out


def sites(judged: Judgement) -> list[tuple[str, float]]:
    """Probability of each site over all explanations and what they are not distinguished from, the
    most probable first. Sites of what was chosen are there however improbable."""
    if judged.varies is not None:
        return [(s, p) for s, p in judged.varies.sites if p >= LISTED]
    total: dict[str, float] = defaultdict(float)
    for c, share in zip(judged.classes, judged.placed, strict=True):
        for member, part in c.parts():
            for site in dict.fromkeys(e.site for e in member.effects if e.physical):
                total[site] += share * part
    chosen = {e.site for e in judged.best.effects}
    ranked = sorted(total.items(), key=lambda item: -item[1])
    return [(s, min(p, 1.0)) for s, p in ranked if p >= LISTED or s in chosen]


def bands(search: Search, fitted: Fitted) -> tuple[Band, ...]:
    """Chi-square per degree of freedom of each channel in each octave."""
    data = search.problem.data
    e = np.abs(fitted.model.response(fitted.x, search.problem.at) - data.H) ** 2
    variance = np.diagonal(np.linalg.pinv(data.W), axis1=1, axis2=2).real
    q = data.H.shape[1]
    mean = (data.expected / q)[:, None]
    unit = np.divide(e, variance, out=np.zeros_like(e), where=variance > 0) / mean
    out = []
    for low, high in octaves(data.frequency):
        inside = (data.frequency >= low) & (data.frequency < high)
        if inside.any():
            top = min(high, float(data.frequency[-1]))
            out += [
                Band(name, low, top, float(np.mean(unit[inside, k])))
                for k, name in enumerate(data.outputs)
            ]
    return tuple(out)


def gap(show: Measured, before: Complex, after: Complex) -> Gap:
    """How far the way from the refitted nominal model to the noise was gone, on `show`. before,
    after : (n, q) what the models without and with the causes predict there."""
    return gap_of(show.chi_square(before), show.chi_square(after), show.expected)


def due_there(show: Measured, before: Complex, after: Complex) -> float:
    """Chi-square that the causes, if true, should explain of `show`: its lines may lie where the
    two predictions are alike."""
    return float(np.sum(replace(show, H=after).chi_square(before)))
