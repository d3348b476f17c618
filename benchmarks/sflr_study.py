"""SFLR: identified on the sweeps at 50 counts, judged on other levels and on the motor's steps.

python benchmarks/sflr_study.py --data FOLDER

The steps are of the motor without the beam, four weeks later: there are none of the whole robot.
They judge motor, spring and base of the model, with clamp, beam and accelerometer taken off.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from rich.console import Console
from scipy import signal

from samii_rig.identify.maximum_likelihood import identify
from samii_rig.identify.table import summary_table
from samii_rig.model.realise import realise
from samii_rig.model.sampled import sampled_response
from samii_rig.record.importer import import_file
from samii_rig.record.maps import load_map
from samii_rig.rig.load import load_rig
from samii_rig.rig.schema import Rig
from samii_rig.signal.estimate import estimate
from samii_rig.types import FrequencyResponse

BAND = (1.0, 24.0)  # Hz in which the recordings of SFLR hold more than noise
FREE = (
    "motor.K", "motor.p", "spring.k", "spring.c", "clamp.k", "clamp.c", "beam.EI", "beam.mu",
    "base_mass.I", "accelerometer_mass.m",
)  # fmt: skip
TAKEN_OFF = ("clamp", "beam", "accelerometer_mass")
LEVELS = (50, 100, 150)  # counts of the steps


def study(data: Path) -> None:
    """Normalised errors of four models at each level of the sweeps, then on the steps."""
    rig = load_rig("sflr")[0]
    layout, text = load_map("sflr")
    levels = {}
    for level in (25, 50, 75):
        files = sorted(data.glob(f"*full-robot_swept_sine_amp-{level}_*"))
        runs = [import_file(f, layout, text) for f in files]
        levels[level] = estimate(runs, gaps="exclude")[0]
    gain = identify([levels[50]], rig, ["motor.K"], band=BAND)
    held = identify([levels[50]], rig, FREE, band=BAND, prior=True)
    free = identify([levels[50]], rig, FREE, band=BAND)
    Console(width=150).print(summary_table(held))
    models = {
        "rig file": (rig, gain.start_fit),
        "gain alone": (gain.rig, gain.fit),
        "all, with priors": (held.rig, held.fit),
        "all, without": (free.rig, free.fit),
    }
    channels = [f"{o}, {n}" for n in levels for o in ("theta", "a")]
    print(f"\n| model | {' | '.join(channels)} | chi-square at 50 |")
    print("|---|" + "---|" * (len(channels) + 1))
    for name, (model, fit) in models.items():
        cells = [f"{100 * e:.1f} %" for r in levels.values() for e in normalised(model, r)]
        print(f"| {name} | {' | '.join(cells)} | {fit.ratio:.1f} |")
    kinds = {
        "open loop": ("sflr_motor_open", "ol_step"),
        "closed loop": ("sflr_motor", "only_step"),
    }
    print(f"\n| model | {' | '.join(f'{k}, {n}' for k in kinds for n in LEVELS)} |")
    print("|---|" + "---|" * (len(kinds) * len(LEVELS)))
    for name, (model, _) in models.items():
        cells = []
        for layout_name, files in kinds.values():
            for level in LEVELS:
                steps = sorted(data.glob(f"*{files}_response_amp-{level}_*"))
                mean = np.mean([step_error(model, f, layout_name) for f in steps])
                cells.append(f"{100 * mean:.1f} %")
        print(f"| {name} | {' | '.join(cells)} |")


def normalised(rig: Rig, response: FrequencyResponse) -> np.ndarray:
    """|H_model - H|/|H| in the band, each summed in squares, per output."""
    inside = (response.frequency >= BAND[0]) & (response.frequency <= BAND[1])
    H = response.H[inside]
    error = sampled_response(rig, response.frequency[inside]) - H
    return np.linalg.norm(error, axis=0)[:, 0] / np.linalg.norm(H, axis=0)[:, 0]


def motor_alone(rig: Rig) -> Rig:
    """The rig with the beam taken off: motor, spring and base."""
    return rig.model_copy(
        update={
            "element": tuple(e for e in rig.element if e.name not in TAKEN_OFF),
            "sensor": tuple(s for s in rig.sensor if s.name == "theta"),
            "limit": (),
        }
    )


def step_error(rig: Rig, file: Path, layout: str) -> float:
    """rms(model - theta)/rms(theta) over a whole step: driven by v where there was no loop, else
    by the reference through the model's own loop v = kp (theta_ref - theta)."""
    run = import_file(file, *load_map(layout))
    names = [c.name for c in run.channels]
    theta = run.values[:, names.index("theta")]
    looped = "theta_ref" in names
    u = run.values[:, names.index("theta_ref" if looped else "v")]
    known = np.isfinite(theta)
    # Samples that were lost: the reference and the pulse stay as they were.
    u = u[np.maximum.accumulate(np.where(np.isfinite(u), np.arange(u.size), 0))]
    assert rig.centring is not None
    kp = rig.centring.kp if looped else 0.0
    A, B, C, _, _ = signal.cont2discrete(realise(motor_alone(rig)).state_space(), 1 / rig.rate_hz)
    x, y = np.zeros(len(A)), np.empty(u.size)
    for n, given in enumerate(u):
        y[n] = C[0] @ x
        x = A @ x + B[:, 0] * (kp * (given - y[n]) if looped else given)
    theta = theta - theta[known][0]
    return float(np.linalg.norm((y - theta)[known]) / np.linalg.norm(theta[known]))


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--data", type=Path, default=Path("../shared/recordings/sflr"))
    study(parser.parse_args().data)


if __name__ == "__main__":
    main()
