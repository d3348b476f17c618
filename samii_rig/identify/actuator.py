"""The joint with its actuator: paper 2's fit on the Bode diagram, and where the encoder sits."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from samii_rig.errors import InputError
from samii_rig.identify.likelihood import FAR, Misfit, log_misfit, minimise
from samii_rig.identify.maximum_likelihood import STARTS, identify, problem
from samii_rig.identify.parameters import Free
from samii_rig.identify.result import Identification
from samii_rig.rig.schema import AngularVelocitySource, RelativeAngle, Rig, TorsionalSpring
from samii_rig.types import Float, FrequencyResponse


@dataclass(frozen=True, slots=True)
class BodeFit:
    """Fit on the Bode diagram. names, values : (n,) SI; gain_db, phase_deg : rms of what is
    left of gain and phase over all lines."""

    rig: Rig
    names: tuple[str, ...]
    values: Float
    gain_db: float
    phase_deg: float


def actuated_joint(rig: Rig, output: str) -> tuple[str, ...]:
    """Names of c, k and p of the joint whose angle is `output` (K is left as it is known).

    The source that the encoder spans and the spring it spans or that follows the source.
    Raises InputError if `output` is no relative angle over a source beside a spring.
    """
    sensor = next((s for s in rig.sensor if s.name == output), None)
    names = [e.name for e in rig.element]
    if isinstance(sensor, RelativeAngle):
        at = [names.index(name) for name in sensor.across]
        span = rig.element[at[0] : at[-1] + 2]
        source = next((e for e in span if isinstance(e, AngularVelocitySource)), None)
        spring = next((e for e in span if isinstance(e, TorsionalSpring)), None)
        if source and spring:
            return f"{spring.name}.c", f"{spring.name}.k", f"{source.name}.p"
    expected = "a relative angle across a source with a torsional spring in or after it"
    raise InputError("actuator fit", "output", output, expected)


def fit_actuator(
    responses: Sequence[FrequencyResponse],
    rig: Rig,
    output: str,
    free: Sequence[str | Free] | None = None,
    *,
    band: tuple[float, float] | None = None,
) -> BodeFit:
    """c, k and p from the Bode diagram theta/v by least squares, as paper 2 section 6.2 did.

    The error is that of gain and phase (the complex logarithm), every line alike but for those
    that noise hides. No intervals: `identify` gives them.

    free : other parameters than `actuated_joint`. Raises InputError as `identify` does.
    """
    chosen = actuated_joint(rig, output) if free is None else free
    return bode_fit(log_misfit, responses, rig, output, chosen, band)


def bode_fit(
    misfit: Misfit,
    responses: Sequence[FrequencyResponse],
    rig: Rig,
    output: str,
    free: Sequence[str | Free],
    band: tuple[float, float] | None,
) -> BodeFit:
    """Least squares on one output's Bode diagram by `misfit`. Raises as `identify` does."""
    posed = problem(responses, rig, free, band=band, outputs=[output])
    start = np.zeros(len(posed.space.names))
    posed.predictor.update_aliases(start)
    found = minimise(misfit, posed.data, posed.space, posed.predictor, start, damping=FAR)
    H = posed.predictor.response(found.x)
    left = np.concatenate(
        [np.log(h / d.H).ravel() for h, d in zip(H, posed.data.lines, strict=True)]
    )
    return BodeFit(
        posed.changed(found.x),
        posed.space.names,
        posed.space.values(found.x),
        float(np.sqrt(np.mean(left.real**2)) * 20 / np.log(10)),
        float(np.degrees(np.sqrt(np.mean(left.imag**2)))),
    )


def with_encoder(rig: Rig, sensor: str, across: Sequence[str]) -> Rig:
    """The rig with the relative angle `sensor` measured across other elements.

    Raises InputError if there is no such sensor or the elements are not neighbours.
    """
    place = next((s for s in rig.sensor if s.name == sensor), None)
    if not isinstance(place, RelativeAngle):
        have = [s.name for s in rig.sensor if isinstance(s, RelativeAngle)]
        raise InputError("encoder", "sensor", sensor, f"a relative angle: {have}")
    data = rig.model_dump()
    for s in data["sensor"]:
        if s["name"] == sensor:
            s["across"] = tuple(across)
    try:
        return Rig.model_validate(data)
    except ValueError as error:
        raise InputError("encoder", "across", tuple(across), "neighbours of the rig") from error


@dataclass(frozen=True, slots=True)
class Variant:
    """One of several rigs held against the same data."""

    name: str
    found: Identification

    @property
    def ratio(self) -> float:
        """Chi-square per degree of freedom."""
        return self.found.fit.ratio


def compare_variants(
    responses: Sequence[FrequencyResponse],
    variants: Mapping[str, Rig],
    free: Sequence[str | Free],
    *,
    prior: bool = False,
    band: tuple[float, float] | None = None,
    outputs: Sequence[str] | None = None,
    starts: int = STARTS,
) -> tuple[Variant, ...]:
    """Every rig fitted to the same data with the same parameters free, the best fit first.

    Raises InputError as `identify` does.
    """
    done = [
        Variant(
            name,
            identify(responses, rig, free, prior=prior, band=band, outputs=outputs, starts=starts),
        )
        for name, rig in variants.items()
    ]
    return tuple(sorted(done, key=lambda v: v.ratio))


def choice(variants: Sequence[Variant]) -> str:
    """Which variant the data choose, in words."""
    best, *others = variants
    if not others:
        return f"{best.name}: chi-square per degree of freedom {best.ratio:.3g}."
    rest = "; ".join(f"{v.name} {v.ratio:.3g}" for v in others)
    if all(v.found.fit.holds for v in variants):
        return (
            f"Noise hides which it is: chi-square per degree {best.name} {best.ratio:.3g}; {rest}."
        )
    verdict = "fits" if best.found.fit.holds else "fits best, but does not fit"
    return f"{best.name} {verdict}: chi-square per degree of freedom {best.ratio:.3g}; {rest}."
