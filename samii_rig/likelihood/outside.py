"""Up to where a command follows what moves it from outside, not the noise that its loop feeds back.

Where a loop runs that no model of the records closes, their input is the command. At a line that
nothing else excites it is -C z, and a change of the response that is free fits z wholly, the noise
with it: there the spectra show -1/C (Ljung 1999, System Identification, 13.5). What moves it from
outside is the command less what the loop makes of a sensor, by the rig file's law or one that the
recording shows, or the reference.
"""

from __future__ import annotations

from collections.abc import Collection

import numpy as np
from scipy import signal

from samii_rig.likelihood.bridged import Bridged
from samii_rig.model.feedback import sections
from samii_rig.rig.schema import Feedback, Rig
from samii_rig.signal import local
from samii_rig.signal.columns import asked, of_input
from samii_rig.signal.groups import Piece
from samii_rig.signal.spectra import spectrum
from samii_rig.types import Float, Recording

# Differences that noise has and an excitation hardly has: of a sine at a tenth of the rate 0.06, of
# white noise 30. Of a command's noise, by these, what is left without what a loop made of a
# sensor's: a law that did not run would add to it, and one that nobody stated may fit by chance. Of
# open loops at least 0.8 was left, of PD loops at most 0.08.
ROUGH, SHOWN = 6, 0.2
# Poles and zeros of a law that nobody stated: a PD controller with its filter has one of each.
# Rounds to its least absolute residual, and samples that show it to a thousandth.
LAW_ORDER, ROUNDS, LOOKED_AT = 2, 30, 1 << 15
# Of a command's energy at least, what the reference explains line by line: what moves the rig
# besides is recorded nowhere, and must not be taken for the loop's answer to noise. And the part
# that is not proportional to it, below which it is the command.
EXPLAINED, IS_COMMAND = 0.5, 1e-3
STRETCHES, FEWEST = 8, 64  # of a record, by which that is judged, and samples of each at least
DEGREE = 2  # of the local models' denominators: a mode within a window
# Of an input's power in a third of an octave, the loop's answer to noise up to which it follows
# what moves it: some 30 lines tell a response from its neighbours', and of less their noise sees
# a fraction.
ANSWERS, OCTAVE_PARTS = 0.02, 3
MOST_LINES = 2000  # at which that is judged, evenly in octaves: a second of a core


def outside(whole: Bridged, rig: Rig, command: str, read: Collection[str]) -> Float | None:
    """(n,) what moved a command from outside; None where the command itself is the best that is
    known: no loop ran, neither its law nor its reference is, or the noise of none of the sensors
    that are `read` goes round it."""
    if not any(c.name == command for c in whole.recording.channels):
        return None
    recording = of_input(whole.recording, command)
    if len(recording) < FEWEST:
        return None
    loops = (*_laws(rig, command), rig.centring_of(command))
    around = {loop.sensor for loop in loops if loop is not None}
    if around and not around & set(read):
        return None
    found = _without(recording, rig, command, around) if around else None
    if found is None:
        found = _asked(recording, rig, command)
    if found is None:
        found = _less_a_law(recording, command, read)
    return found


def _laws(rig: Rig, command: str) -> list[Feedback]:
    return [loop for loop in rig.feedback if loop.actuator == command]


def _without(recording: Recording, rig: Rig, command: str, around: Collection[str]) -> Float | None:
    """A command less what the rig file's loops made of the sensors that they are `around`; None
    where one of these was not recorded as the loop saw it, or the loops did not run."""
    at_rate = abs(recording.rate_hz / rig.rate_hz - 1) < 1e-6
    if not at_rate or not set(around) <= {c.name for c in recording.channels}:
        return None
    v, centring = recording.values_of(command), rig.centring_of(command)
    made = -centring.kp * recording.values_of(centring.sensor) if centring else np.zeros(v.size)
    for loop in _laws(rig, command):
        rows = sections(loop, rig.rate_hz)
        sos = np.insert(rows, 3, 1.0, axis=1)
        y = np.asarray(signal.sosfilt(sos, recording.values_of(loop.sensor)), np.float64)
        made += np.clip(y, -loop.max, loop.max)
    return v - made if _rough(v - made) < SHOWN * _rough(v) else None


def _less_a_law(recording: Recording, command: str, read: Collection[str]) -> Float | None:
    """A command less what a loop around one of the sensors made, whose law nobody stated; None
    where the recording shows none.

    What went out follows from what was read exactly, but for what moves it from outside, which is
    smooth or seldom changes: the law is that of the least sum of absolute sixth differences.
    """
    v = recording.values_of(command)
    if not _rough(v):
        return None
    every = [_left_of(v, recording.values_of(name)) for name in read]
    best = min(every, key=_rough, default=v)
    return best if _rough(best) < SHOWN * _rough(v) else None


def _left_of(v: Float, z: Float) -> Float:
    """v (n,) less what the likeliest law of `LAW_ORDER` makes of z (n,); v where none is stable."""
    dv, dz = np.diff(v[:LOOKED_AT], ROUGH), np.diff(z[:LOOKED_AT], ROUGH)
    n = dv.size
    before = [dv[LAW_ORDER - i : n - i] for i in range(1, LAW_ORDER + 1)]
    read = [dz[LAW_ORDER - i : n - i] for i in range(LAW_ORDER + 1)]
    X, goal = np.stack([*before, *read], axis=1), dv[LAW_ORDER:]
    size = np.sqrt(np.mean(X**2, axis=0))
    if not np.all(size > 0):
        return v
    X, weight = X / size, np.ones(goal.size)
    least = np.mean(np.abs(goal)) / goal.size
    for _ in range(ROUNDS):
        law = np.linalg.lstsq(X * weight[:, None], goal * weight, rcond=None)[0]
        weight = 1 / np.sqrt(np.maximum(np.abs(goal - X @ law), least))
    law = law / size
    poles = np.append(1.0, -law[:LAW_ORDER])
    if np.max(np.abs(np.roots(poles))) >= 1:
        return v
    return np.asarray(v - signal.lfilter(law[LAW_ORDER:], poles, z), np.float64)


def _asked(recording: Recording, rig: Rig, command: str) -> Float | None:
    """The reference of a command that is not the command; None without one, or where it does not
    explain most of the command."""
    v = recording.values_of(command)
    if not recording.names("reference"):
        return None
    centring = rig.centring_of(command)
    r = asked(recording, command, centring.kp if centring else 0.0)
    size = float(np.sum((v - np.mean(v)) ** 2))
    if not np.all(np.isfinite(r)) or not np.ptp(r) or size == 0:
        return None
    if _misfit(v, r) < IS_COMMAND:
        return None
    n = max(v.size // STRETCHES, FEWEST)
    power = signal.welch(v, nperseg=n)[1]
    each = np.nan_to_num(signal.coherence(v, r, nperseg=n)[1])
    return r if float(power @ each) > EXPLAINED * float(np.sum(power)) else None


def _misfit(v: Float, r: Float) -> float:
    """Part of v's energy, its mean aside, that is not proportional to r."""
    v, r = v - np.mean(v), r - np.mean(r)
    return 1 - float(v @ r) ** 2 / float((v @ v) * (r @ r))


def _rough(x: Float) -> float:
    """Median size of these differences, which noise has and an excitation hardly has."""
    return float(np.median(np.abs(np.diff(x, ROUGH))))


def followed(v: Float, from_outside: Float, rate_hz: float) -> float:
    """Hz up to which an input follows what moves it from outside: the highest third of an octave in
    which the loop's answer to noise is a small part of its power. inf where it does everywhere, or
    nowhere: then nothing tells what it follows. v, from_outside : (n,)."""
    if not np.ptp(from_outside):
        return np.inf
    piece = Piece("input", from_outside, np.stack([from_outside, v], axis=1))
    lines = spectrum(piece, rate_hz)
    at = np.unique(np.geomspace(1, lines.frequency.size, MOST_LINES).astype(np.int64)) - 1
    f = lines.frequency[at]
    width, transients = local.plan([[]], 1, v.size / rate_hz, at_rest=False)
    found = local.fit(local.windows([lines], f, width, transients), DEGREE)
    answer, whole = np.abs(found.noise[:, 0, 0]), np.abs(lines.Z[at, 1]) ** 2
    part = np.floor(OCTAVE_PARTS * np.log2(f / f[0])).astype(np.int64)
    follows = np.bincount(part, answer) < ANSWERS * np.bincount(part, whole)
    if not follows.any() or follows[-1]:
        return np.inf
    return float(f[0] * 2 ** ((np.flatnonzero(follows)[-1] + 1) / OCTAVE_PARTS))
