"""Bode diagrams of paper 1: v_2 to theta_2 (Fig. 5), theta_2 to a_0 (Fig. 6), v_3 to theta_3.

Truth, estimate from a simulated recording with noise, and the model refitted to that recording
from a start away from the truth.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np

from samii_rig.identify.conservative import Conservative
from samii_rig.identify.maximum_likelihood import identify
from samii_rig.identify.modal import estimate_modes
from samii_rig.identify.parameters import Free
from samii_rig.identify.result import Identification
from samii_rig.model.tmm import Chain
from samii_rig.papers.measure import continuous, recorded, thinned
from samii_rig.papers.result import (
    Bode,
    Mark,
    Number,
    Picture,
    Result,
    between,
    bode_panels,
    shown,
)
from samii_rig.papers.rigs import JOINTS
from samii_rig.papers.tables import BAND as TABLE_BAND
from samii_rig.rig.load import load_rig
from samii_rig.rig.schema import Rig, parameters
from samii_rig.signal.ratio import ratio
from samii_rig.types import Complex, Float, FrequencyResponse

BAND = (0.5, 38.0)  # Hz, that of the sweep without its ends
LINES = 400  # of the response that the model is fitted to
AWAY = 0.25  # relative, how far from the truth each parameter starts
GRID = np.geomspace(*BAND, 1500)
MODES = 3  # in the band
LIGHT = 0.3  # damping ratio below which a zero shows
MODE_2 = 7.394  # Hz, Table III
SAME = 0.02  # largest difference of the refitted model from the truth, of the truth


@dataclass(frozen=True, slots=True)
class Refit:
    """A recording and what was made of it."""

    rig: Rig
    response: FrequencyResponse
    found: Identification


@cache
def refit(rig_name: str) -> Refit:
    """The ten parameters of docs/evidence/identify.md from the loudest level of the shipped sweep,
    all channels, started `AWAY` from the truth, up and down by turns."""
    rig = load_rig(rig_name)[0]
    loud = recorded(rig_name, "swept_sine")
    few = thinned(loud, len(loud.frequency) // LINES)
    free = []
    for i, (element, symbol) in enumerate(free_parameters(rig)):
        value = next(parameters(e)[symbol].value for e in rig.element if e.name == element)
        free.append(Free(element, symbol, start=value * (1 + AWAY * (-1) ** i)))
    return Refit(rig, loud, identify([few], rig, free, band=BAND, starts=1))


def free_parameters(rig: Rig) -> tuple[tuple[str, str], ...]:
    """(element, symbol): k and c of the joints, K and p of the source."""
    source = next(e.name for e in rig.element if e.kind == "angular_velocity_source")
    return (*((j, s) for j in JOINTS for s in "kc"), (source, "K"), (source, "p"))


def figure_5() -> Result:
    """v_2 to theta_2."""
    return _angle("samii", "theta_2", "p1-fig-5", "Paper 1, Fig. 5: v_2 to theta_2")


def joint_3() -> Result:
    """v_3 to theta_3, joint 3 actuated: told of in section IV-C, step 2, not drawn."""
    title = "Paper 1, section IV-C: v_3 to theta_3, joint 3 actuated"
    return _angle("samii_joint_3", "theta_3", "p1-joint-3", title)


def figure_6() -> Result:
    """theta_2 to a_0 and its first zero z_1."""
    held = refit("samii")
    zero = Conservative(held.rig, TABLE_BAND).zeros("a_0")[0]
    modes = estimate_modes(
        thinned(held.response, len(held.response.frequency) // LINES),
        held.rig,
        band=BAND,
        outputs=["theta_2", "a_0"],
        n_pairs=MODES + 1,
    )
    light = [z for z in modes.zeros_of("a_0") if abs(z.damping.value) < LIGHT]
    found = min(light, key=lambda z: abs(z.frequency_hz.value - zero))
    damped = Conservative(held.rig, TABLE_BAND).damped(np.array([zero]), "a_0")[0]
    low, high = found.frequency_hz.interval()
    quotient = ratio(held.response, "theta_2", ["a_0"])
    names = [s.name for s in held.rig.sensor]
    seen = continuous(held.response, held.rig)[:, :, 0]
    at = [[y.name for y in held.response.outputs].index(n) for n in ("theta_2", "a_0")]
    Q = seen[:, at[1]] / seen[:, at[0]]
    sd = np.sqrt(quotient.variance()[:, 0, 0]) / np.abs(quotient.H[:, 0, 0])
    columns = [names.index(n) for n in ("theta_2", "a_0")]
    true = _ratio_of(held.rig, columns)
    fitted = _ratio_of(held.found.rig, columns)
    off = float(np.max(np.abs(fitted / true - 1)))
    numbers: list[Number] = [
        shown("first zero z_1 without damping", zero, "Hz", "used, not printed", 5),
        shown("first zero z_1 with the rig's damping", damped, "Hz", "", 5),
        between(
            "first zero z_1 from the recording, over the rig's",
            found.frequency_hz.value / damped,
            "",
            1 - SAME,
            1 + SAME,
            digits=5,
        ),
        shown("its 90 % interval, half width", 50 * (high - low) / damped, "%", "", 2),
        between("refitted model against truth, most", 100 * off, "%", 0.0, 100 * SAME, digits=2),
    ]
    panels = bode_panels(
        _three(held.response.frequency, Q, sd, true, fitted),
        "(m/s²)/rad",
        (Mark(f"z_1 = {damped:.1f} Hz", damped, foot=True),),
        near=180.0,
        legend="lower center",
    )
    return Result(
        tuple(numbers),
        (
            "z_1 is a zero of the way from v_2 to a_0, and is the same wherever the encoder sits. "
            "What stands below it is not: at the source the ratio's poles are the natural "
            "frequencies, across source and spring they are those with the link's angle held.",
        ),
        (Picture("p1-fig-6", "Paper 1, Fig. 6: theta_2 to a_0", panels),),
    )


def _ratio_of(rig: Rig, columns: list[int]) -> Complex:
    H = Chain(rig).response(GRID)[:, columns, 0]
    return np.asarray(H[:, 1] / H[:, 0])


def _angle(rig_name: str, output: str, name: str, title: str) -> Result:
    held = refit(rig_name)
    column = [s.name for s in held.rig.sensor].index(output)
    at = [y.name for y in held.response.outputs].index(output)
    f = held.response.frequency
    H = continuous(held.response, held.rig)[:, at, 0]
    true = Chain(held.rig).response(GRID)[:, column, 0]
    fitted = Chain(held.found.rig).response(GRID)[:, column, 0]
    near = (f >= BAND[0]) & (f <= BAND[1])
    again = np.interp(f[near], GRID, np.abs(true))
    numbers = (
        between(
            "estimate against truth, gain, median",
            100 * float(np.median(np.abs(np.abs(H[near]) / again - 1))),
            "%",
            0.0,
            1.0,
            digits=2,
        ),
        between(
            "refitted model against truth, most",
            100 * float(np.max(np.abs(fitted / true - 1))),
            "%",
            0.0,
            100 * SAME,
            digits=2,
        ),
        between(
            "chi-square per degree of freedom of the refit",
            held.found.fit.ratio,
            "",
            0.8,
            1.25,
            digits=3,
        ),
    )
    picture = overlay(held.rig, held.found.rig, held.response, output, name, title)
    return Result(numbers, tuple(held.found.sentences()), (picture,))


def overlay(
    truth: Rig, fitted: Rig, response: FrequencyResponse, output: str, name: str, title: str
) -> Picture:
    """Truth, estimate and refitted model of one angle over the first input."""
    column = [s.name for s in truth.sensor].index(output)
    at = [y.name for y in response.outputs].index(output)
    H = continuous(response, truth)[:, at, 0]
    sd = np.sqrt(response.variance()[:, at, 0]) / np.abs(response.H[:, at, 0])
    bodes = _three(
        response.frequency,
        H,
        sd,
        Chain(truth).response(GRID)[:, column, 0],
        Chain(fitted).response(GRID)[:, column, 0],
    )
    gain = np.abs(Chain(truth).response(np.array([BAND[0], MODE_2, BAND[1]]))[:, column, 0])
    high = bool(gain[1] ** 2 > gain[0] * gain[2])  # in the upper half of the picture
    mark = Mark("mode 2: 7.4 Hz", MODE_2, foot=high)
    return Picture(name, title, bode_panels(bodes, "rad/V", (mark,)))


def _three(f: Float, H: Complex, sd: Float, true: Complex, fitted: Complex) -> tuple[Bode, ...]:
    keep = (f >= BAND[0]) & (f <= BAND[1])
    return (
        Bode("truth: the rig that was simulated", GRID, true, "broad", 0),
        Bode("estimate from the recording", f[keep], H[keep], "points", 2, sd[keep]),
        Bode("model refitted to it", GRID, fitted, "dashed", 1),
    )
