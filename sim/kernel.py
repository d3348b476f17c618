"""The inner loop: plant, converters and the device's own control, sample by sample.

What an embedded controller does at sample n: read the sensors, form
v[n] = u[n] + kp (theta_ref[n] - theta[n]) + feedback[n], keep its limits and its deadman, put
v[n] out. The plant then moves on by one sample in `inner` exact steps.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar

import numpy as np
from numba import njit
from numba.extending import register_jitable

from samii_rig.types import Flags, Float, Int, Quality
from sim.plant import Tables

F = TypeVar("F", bound=Callable[..., Any])
CLIPPED, LIMITED, MISSING = int(Quality.CLIPPED), int(Quality.LIMITED), int(Quality.MISSING)
# Columns of a block: the two references, the command, then the sensors.
U, THETA_REF, V, SENSORS = 0, 1, 2, 3


class Converters(NamedTuple):
    """What stands between the analogue values and the numbers; (m,) each, one a sensor.

    step, low, high : resolution (0 for none) and ends of the range. noise, offset : in the
    sensor's unit. hum, hum_rate : amplitude after the sensor's filters and rad a sample.
    stuck, lost : sample from which the value stands still, or is NaN.
    v_step, v_low, v_high : the same of the output.
    """

    step: Float
    low: Float
    high: Float
    noise: Float
    offset: Float
    hum: Float
    hum_rate: Float
    stuck: Int
    lost: Int
    v_step: float
    v_low: float
    v_high: float


class Control(NamedTuple):
    """The device's loop and limits, in actuator units and samples.

    theta : index of the centring sensor. slew : largest change a sample. deadman : samples
    without reference after which the output drops to zero.
    """

    theta: int
    kp: float
    max_output: float
    slew: float
    max_angle: float
    deadman: int


class Filters(NamedTuple):
    """The device's feedback loops: cascades of sections, see `samii_rig.model.feedback`.

    sensor, most : (n,) index of the sensor that each loop reads, and its largest |output|.
    first : (n + 1,) its sections are first[i] to first[i + 1].
    rows : (n_section, 5) b0 b1 b2 a1 a2. memory : (n_section, 2), changed in place.
    """

    sensor: Int
    most: Float
    first: Int
    rows: Float
    memory: Float


class Drive(NamedTuple):
    """What acts on the drive beside the command.

    disturbance : rms of the equivalent input in one inner step. friction : dry friction as an
    equivalent input. memory : what is left of the drive's speed after one inner step.
    """

    disturbance: float
    friction: float
    memory: float


class Contact(NamedTuple):
    """A force of contact, held over one inner step: min(max(gain y, -most), most), see
    `sim.contact`.

    most : N or N m, 0 for none. look, own : (2, n) the motion y from the states of the output and
    of the force at the start of a step; of_old, of_new : from the inputs before and after the
    change. at_once, look_now, own_now, of_now : the same of the force at the instant itself, which
    a sensor reads; at_once is 0 of one that is known over a step alone. row, row_extra : as of
    `Tables`, of sensor values from the force. push : (2, n) what a force of 1 adds to its states in
    one step. x : (2, n) states of the force; held : (1,) the force of this step; both are changed
    in place.
    """

    most: float
    gain: float
    look: Float
    of_old: float
    of_new: float
    own: Float
    at_once: float
    look_now: Float
    own_now: Float
    of_now: float
    row: Float
    row_extra: Float
    push: Float
    x: Float
    held: Float


class State(NamedTuple):
    """All that the loop carries from one call to the next; arrays, changed in place.

    x : (2, n) modal states. held, held_flag : the last sensor values and their flags. waiting :
    (pipeline + 1,) outputs on their way. early : (slots, m) sensor values read ahead of their
    sample. number : [v, applied input, extra input, drive speed, last theta_ref].
    flag : [sample, live, dry samples, tripped, dead]
    """

    x: Float
    held: Float
    held_flag: Flags
    waiting: Float
    early: Float
    number: Float
    flag: Int


# Places in State.number and State.flag.
LAST_V, APPLIED, EXTRA, SPEED, LAST_REF = range(5)
SAMPLE, LIVE, DRY, TRIPPED, DEAD = range(5)


def rest(tables: Tables) -> State:
    """Everything still."""
    m, _, n = tables.row.shape
    slots = int(tables.ahead.max(initial=0)) // tables.inner + 2
    return State(
        np.zeros((2, n)),
        np.zeros(m),
        np.zeros(m, dtype=np.uint8),
        np.zeros(tables.pipeline + 1),
        np.zeros((slots, m)),
        np.zeros(5),
        np.zeros(5, dtype=np.int64),
    )


def free(tables: Tables) -> Contact:
    """No force of contact."""
    m, _, n = tables.row.shape
    none = np.zeros((2, n))
    x, held = np.zeros((2, n)), np.zeros(1)
    rows = np.zeros((m, 2, n))
    now = 0.0, none, none, 0.0
    return Contact(0.0, 0.0, none, 0.0, 0.0, none, *now, rows, np.zeros(m), none, x, held)


def part(function: F) -> F:
    """Let compiled functions call it. It is compiled with them, without how Python and C would
    call it, and stays Python here."""
    register_jitable(no_cpython_wrapper=True, no_cfunc_wrapper=True)(function)
    return function


@part
def _touch(g: Contact, s: State, before: float, both: float) -> None:
    """Set the force of contact of one step. before, both : the input on both sides of its
    change."""
    y = g.of_old * before + g.of_new * both + _motion(s.x, g.x, g.look, g.own)
    g.held[0] = min(max(g.gain * y, -g.most), g.most)


@part
def _motion(x: Float, of_force: Float, look: Float, own: Float) -> float:
    """The motion that a force of contact looks at, from the states of the output and its own."""
    y = 0.0
    for q in range(x.shape[1]):
        y += look[0, q] * x[0, q] + look[1, q] * x[1, q]
        y += own[0, q] * of_force[0, q] + own[1, q] * of_force[1, q]
    return y


@njit(cache=True)
def contact_now(g: Contact, s: State) -> float:
    """The force of contact at the state's instant."""
    if g.at_once == 0.0:
        return float(g.held[0])
    y = g.of_now * (s.number[APPLIED] + s.number[EXTRA])
    y += _motion(s.x, g.x, g.look_now, g.own_now)
    return float(min(max(g.at_once * y, -g.most), g.most))


@part
def _push(t: Tables, g: Contact) -> None:
    """Move the states of the force of contact on by one step."""
    for q in range(g.x.shape[1]):
        re = t.decay[0, q] * g.x[0, q] - t.decay[1, q] * g.x[1, q]
        im = t.decay[1, q] * g.x[0, q] + t.decay[0, q] * g.x[1, q]
        g.x[0, q] = re + g.push[0, q] * g.held[0]
        g.x[1, q] = im + g.push[1, q] * g.held[0]


@njit(cache=True)
def touched(g: Contact, i: int, force: float) -> float:
    """What sensor i reads of the force of contact, which is `force` at its instant."""
    y = g.row_extra[i] * force
    for k in range(g.x.shape[1]):
        y += g.row[i, 0, k] * g.x[0, k] + g.row[i, 1, k] * g.x[1, k]
    return float(y)


@part
def _read(t: Tables, s: State, i: int, old: float, new: float, extra: float) -> float:
    y = t.row_old[i] * old + t.row_new[i] * new + t.row_extra[i] * extra
    x = s.x
    for k in range(x.shape[1]):
        y += t.row[i, 0, k] * x[0, k] + t.row[i, 1, k] * x[1, k]
    return float(y)


@part
def _convert(c: Converters, i: int, n: int, y: float, noise: float) -> tuple[float, int]:
    """One sample of sensor i: its value and its flags."""
    if n >= c.lost[i]:
        return np.nan, MISSING
    y += c.offset[i] + c.noise[i] * noise
    if c.hum[i] > 0.0:
        y += c.hum[i] * np.sin(c.hum_rate[i] * n)
    if c.step[i] > 0.0:
        y = np.rint(y / c.step[i]) * c.step[i]
    if y >= c.high[i]:
        return c.high[i], CLIPPED
    if y <= c.low[i]:
        return c.low[i], CLIPPED
    return y, 0


@part
def _feedback(f: Filters, y: Float) -> float:
    """Sum of the loops' outputs for the sensors' values y, (m,), each clipped."""
    total = 0.0
    for i in range(f.sensor.shape[0]):
        value = y[f.sensor[i]]
        for j in range(f.first[i], f.first[i + 1]):
            w, row = f.memory[j], f.rows[j]
            out = row[0] * value + w[0]
            w[0] = row[1] * value - row[3] * out + w[1]
            w[1] = row[2] * value - row[4] * out
            value = out
        total += min(max(value, -f.most[i]), f.most[i])
    return total


@part
def _lost(k: Control, f: Filters, y: Float) -> bool:
    """Whether theta is beyond its limit, or a sensor that a loop reads gives no number."""
    lost = not abs(y[k.theta]) <= k.max_angle
    for i in f.sensor:
        lost = lost or not np.isfinite(y[i])
    return lost


@part
def _command(
    c: Converters, k: Control, f: Filters, s: State, u: float, ref: float, given: bool, y: Float
) -> tuple[float, int]:
    """v of this sample from the sensors' values y, and whether a limit or the deadman changed
    it. The filters stand at zero whenever the output is not live."""
    flag = s.flag
    if given:
        flag[LIVE], flag[DRY], flag[DEAD] = 1, 0, 0
    elif flag[LIVE]:
        flag[DRY] += 1
        if k.deadman >= 0 and flag[DRY] > k.deadman:
            flag[LIVE], flag[DEAD] = 0, 1
    if flag[LIVE] and not flag[TRIPPED] and _lost(k, f, y):
        flag[TRIPPED] = 1
    if flag[TRIPPED] or flag[DEAD] or not flag[LIVE]:
        f.memory[:] = 0.0
        return 0.0, LIMITED if flag[TRIPPED] or flag[DEAD] else 0
    wanted = u + k.kp * (ref - y[k.theta]) + _feedback(f, y)
    low = max(-k.max_output, c.v_low, s.number[LAST_V] - k.slew)
    high = min(k.max_output, c.v_high, s.number[LAST_V] + k.slew)
    v = min(max(wanted, low), high)
    limited = LIMITED if v != wanted else 0
    if c.v_step > 0.0:
        v = np.rint(v / c.v_step) * c.v_step
        if v > high:
            v -= c.v_step
        elif v < low:
            v += c.v_step
    return v, limited


@part
def _friction(d: Drive, speed: float, u: float) -> tuple[float, float]:
    """Dry friction of the drive over one step, as an input, and the speed after the step.

    The drive's speed in units of its input obeys speed' = p (u - friction sign(speed) -
    speed); it sticks where it passes zero while |u| <= friction.
    """
    gain = 1.0 - d.memory
    side = speed if speed != 0.0 else u
    if speed == 0.0 and abs(u) <= d.friction:
        return -u, 0.0
    pull = -d.friction if side > 0.0 else d.friction
    after = d.memory * speed + gain * (u + pull)
    if after * side <= 0.0 and abs(u) <= d.friction:
        return -d.memory * speed / gain - u, 0.0
    return pull, after


@njit(cache=True)
def sense(
    t: Tables, c: Converters, g: Contact, s: State, noise: Float, values: Float, quality: Flags
) -> None:
    """Read all sensors at the state's sample into values and quality, (m,). noise : (m,)."""
    sample = s.flag[SAMPLE]
    slot = sample % s.early.shape[0]
    force = contact_now(g, s) if g.most > 0.0 else 0.0
    for i in range(t.ahead.shape[0]):
        if t.ahead[i] == 0:
            y = _read(t, s, i, s.number[APPLIED], 0.0, s.number[EXTRA])
            if g.most > 0.0:
                y += touched(g, i, force)
        else:
            y = s.early[slot, i]
        y, q = _convert(c, i, sample, y, noise[i])
        if sample >= c.stuck[i]:
            y, q = s.held[i], s.held_flag[i]
        s.held[i], s.held_flag[i] = y, q
        values[i], quality[i] = y, q


@njit(cache=True)
def move(t: Tables, d: Drive, g: Contact, s: State, v: float, disturbance: Float) -> None:
    """Put v out at the state's sample and go on to the next. disturbance : (inner,)."""
    m = t.ahead.shape[0]
    slots = s.early.shape[0]
    number, sample = s.number, s.flag[SAMPLE]
    number[LAST_V] = v
    s.waiting[sample % s.waiting.shape[0]] = v
    for j in range(t.inner):
        old = number[APPLIED]
        new = old
        share = 0.0
        if j == t.change:
            new = s.waiting[(sample - t.pipeline) % s.waiting.shape[0]]
            share = t.mean
        extra = d.disturbance * disturbance[j] if d.disturbance > 0.0 else 0.0
        if d.friction > 0.0:
            push = share * old + (1.0 - share) * new + extra
            pull, number[SPEED] = _friction(d, number[SPEED], push)
            extra += pull
        if g.most > 0.0:
            _touch(g, s, old + extra, new + extra)
        for i in range(m):
            if t.ahead[i] > 0 and (j + t.ahead[i]) % t.inner == 0:
                at = (sample + (j + t.ahead[i]) // t.inner) % slots
                s.early[at, i] = _read(t, s, i, old, new, extra)
                if g.most > 0.0:
                    s.early[at, i] += touched(g, i, g.held[0])
        both = new + extra
        before = old + extra
        for q in range(s.x.shape[1]):
            re = t.decay[0, q] * s.x[0, q] - t.decay[1, q] * s.x[1, q]
            im = t.decay[1, q] * s.x[0, q] + t.decay[0, q] * s.x[1, q]
            s.x[0, q] = re + t.old[0, q] * before + t.new[0, q] * both
            s.x[1, q] = im + t.old[1, q] * before + t.new[1, q] * both
        if g.most > 0.0:
            _push(t, g)
        number[APPLIED], number[EXTRA] = new, extra
    s.flag[SAMPLE] = sample + 1


@njit(cache=True)
def advance(
    t: Tables,
    c: Converters,
    k: Control,
    f: Filters,
    d: Drive,
    g: Contact,
    s: State,
    u: Float,
    theta_ref: Float,
    given: Flags,
    noise: Float,
    disturbance: Float,
    values: Float,
    quality: Flags,
) -> None:
    """Take len(u) samples: fills values and quality, (n, 3 + m), and moves the state on.

    given : (n,) 1 where the queue held a reference. noise : (n, m), disturbance : (n, inner),
    standard normal; empty if there is none.
    """
    none = np.zeros(max(t.ahead.shape[0], t.inner))
    for n in range(u.shape[0]):
        y = values[n, SENSORS:]
        sense(t, c, g, s, noise[n] if noise.shape[0] > 0 else none, y, quality[n, SENSORS:])
        if given[n]:
            s.number[LAST_REF] = theta_ref[n]
        reference = u[n] if given[n] else 0.0
        ref = s.number[LAST_REF]
        v, limited = _command(c, k, f, s, reference, ref, given[n] != 0, y)
        values[n, U], values[n, THETA_REF], values[n, V] = reference, ref, v
        quality[n, U], quality[n, THETA_REF], quality[n, V] = 0, 0, limited
        move(t, d, g, s, v, disturbance[n] if disturbance.shape[0] > 0 else none)
