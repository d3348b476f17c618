"""Results as plain data, as the service's answers hold them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

import numpy as np

from samii_rig.types import FrequencyResponse

if TYPE_CHECKING:
    from samii_rig.run.dryrun import DryRun  # loads the model and its compiler

# Expected largest |difference|^2 over its variance is about log(lines); this many times the
# variance is beyond noise for any number of lines that we have.
BEYOND_NOISE = 16.0


def prediction(predicted: DryRun) -> dict[str, Any]:
    """A dry run: durations, margins worst first, expected errors by band."""
    return {
        "duration_s": predicted.duration,
        "shortest_s": predicted.shortest,
        "margins": [{**asdict(m), "margin": m.margin} for m in predicted.margins],
        "bands": [asdict(b) for b in predicted.bands],
    }


def response(r: FrequencyResponse) -> dict[str, Any]:
    """A frequency response, by output and input: real, imaginary part, standard deviation.

    sd : sqrt(E|dH|^2), so that half of its square belongs to each part.
    """
    sd = np.sqrt(r.variance())
    return {
        "level": r.level,
        "level_unit": r.level_unit,
        "method": r.method,
        "why": r.why,
        "frequency": r.frequency.tolist(),
        "curves": [
            {
                "output": y.name,
                "input": u.name,
                "unit": f"{y.unit}/{u.unit}",
                "re": r.H[:, i, j].real.tolist(),
                "im": r.H[:, i, j].imag.tolist(),
                "sd": sd[:, i, j].tolist(),
                "coherence": r.coherence[:, i].tolist(),
            }
            for i, y in enumerate(r.outputs)
            for j, u in enumerate(r.inputs)
        ],
        "findings": [asdict(f) for f in r.findings],
    }


def compared(
    a: Sequence[FrequencyResponse], b: Sequence[FrequencyResponse]
) -> list[dict[str, Any]]:
    """Each response of `a` against that of `b` with the nearest level, on the lines of both.

    For each output: how far they are apart in units of their joint standard deviation (mean
    square, largest and where), and relative to their size. Lines differ by noise alone where the
    mean square is about 1.
    """
    pairs = []
    for r in a:
        if not b:
            break
        other = min(b, key=lambda x: abs(x.level - r.level) if np.isfinite(x.level) else np.inf)
        common, at, there = np.intersect1d(r.frequency, other.frequency, return_indices=True)
        names = {
            (y.name, u.name): (i, j)
            for i, y in enumerate(other.outputs)
            for j, u in enumerate(other.inputs)
        }
        rows = []
        for i, y in enumerate(r.outputs):
            for j, u in enumerate(r.inputs):
                place = names.get((y.name, u.name))
                if place is None or not len(common):
                    continue
                H, G = r.H[at, i, j], other.H[there][:, place[0], place[1]]
                variance = r.variance()[at, i, j] + other.variance()[there][:, place[0], place[1]]
                with np.errstate(divide="ignore", invalid="ignore"):
                    z = np.abs(H - G) ** 2 / variance
                    relative = np.abs(H - G) / np.abs(H)
                worst = int(np.nanargmax(z)) if np.isfinite(z).any() else 0
                rows.append(
                    {
                        "output": y.name,
                        "input": u.name,
                        "lines": len(common),
                        "mean_square": float(np.nanmean(z)),
                        "beyond_noise": int((z > BEYOND_NOISE).sum()),
                        "largest": float(np.sqrt(z[worst])),
                        "largest_hz": float(common[worst]),
                        "median_relative": float(np.nanmedian(relative)),
                    }
                )
        pairs.append(
            {"level": r.level, "other_level": other.level, "unit": r.level_unit, "outputs": rows}
        )
    return pairs
