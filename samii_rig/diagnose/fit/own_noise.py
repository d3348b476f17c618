"""The noise of the records, and that which the rig file states for its sensors.

Noise is estimated from what no change of a linear response explains. A force that depends on the
amplitude passes for it.
"""

from __future__ import annotations

import numpy as np

from samii_rig.diagnose.fit.record_search import RecordSearch
from samii_rig.diagnose.fit.records import Whole
from samii_rig.diagnose.fit.search import Search
from samii_rig.types import Float, Int

# Times the noise of a sensor, root mean square, from which it is more: a data sheet's and a bench's
# differ by two or three, with a floor that shakes.
MORE_NOISE = 5.0
# Steps of its converter by which a sensor moves, root mean square, below which a loop around it
# drives the rig by its rounding: noise that no rig file states.
FEW_STEPS = 4.0


def estimated(search: RecordSearch, whole: Whole) -> Float:
    """(q,) root mean square of each sensor in the middle of the lines, but for those where one is
    covered, if others are left: a disturbance at a resonance, or a few lines, is not its noise."""
    noise, lines = search.reduced.noise, _lines(whole)
    power, read = np.sum(np.abs(noise.root(*lines)) ** 2, axis=2), ~noise.covered(*lines)
    return np.asarray(np.sqrt(np.median(power[read] if read.any() else power, axis=0)))


def not_read(search: Search) -> dict[str, float]:
    """Sensors of which nothing is read at some lines, as they move by few steps, and at which part
    of all lines."""
    if not isinstance(search, RecordSearch) or not isinstance(search.whole, Whole):
        return {}
    known, (f, piece) = search.reduced.noise.known, _lines(search.whole)
    part = np.mean(known.cover(f, known.group[piece]) > 0, axis=0)
    return {n: float(x) for n, x in zip(search.whole.wired.sensors, part, strict=True) if x > 0}


def _lines(whole: Whole) -> tuple[Float, Int]:
    """Hz of all lines (n,), and the piece (n,) of each."""
    each = [whole.records.lines(piece).frequency for piece in whole.records.pieces]
    return np.concatenate(each), np.repeat(np.arange(len(each)), [f.size for f in each])


def stated(whole: Whole) -> Float:
    """(q,) root mean square of noise and rounding by the rig file, nan where it states none; of all
    where a loop feeds back a sensor that hardly moves by its steps."""
    sensors = {s.name: s for s in whole.rig.sensor}
    known = not _steps_drive(whole)
    return np.array(
        [
            sensors[name].own_noise if known and sensors[name].noise_rms > 0 else np.nan
            for name in whole.wired.sensors
        ]
    )


def own_power(search: RecordSearch, whole: Whole) -> Float:
    """(q,) power a sample of each sensor's noise, without its rounding: by the rig file, or as
    estimated where that states none."""
    sensors = {s.name: s for s in whole.rig.sensor}
    by_file = np.array([sensors[name].noise_rms for name in whole.wired.sensors])
    return np.where(by_file > 0, by_file, estimated(search, whole)) ** 2


def _steps_drive(whole: Whole) -> bool:
    closed = whole.rig.centred | {f.sensor for f in whole.rig.feedback}
    steps = {s.name: s.resolution for s in whole.rig.sensor}
    for j, name in enumerate(whole.wired.sensors):
        moved = max(float(np.std(piece.z[:, j])) for piece in whole.records.pieces)
        if name in closed and moved < FEW_STEPS * steps[name]:
            return True
    return False
