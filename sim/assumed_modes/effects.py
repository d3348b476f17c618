"""The effects that a trial conceals: where they may be, how they are put in, how they grow.

A draft stands for one physics at one place. Its strength grows from nothing (0) and the numbers of
the effect follow from it, so that a size can be solved for: a compliance's strength is 1/k, that of
a lag 1/p.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from samii_rig.rig.schema import Acceleration, RelativeAngle, SensorBase, Strain
from sim.assumed_modes.parts import (
    ANGLE_SOURCES,
    EXTENDED,
    JOINTS,
    MOTION_SOURCES,
    Attachment,
    Drive,
    Lag,
    Part,
    Setup,
)

Rng = np.random.Generator
Numbers = dict[str, float]
NEAR_END = 0.02  # of a link's length within which a place counts as its end
NEAR_SENSOR = 0.02  # of a beam's length, that a crack is away from its sensors at least
WITHIN = (0.15, 0.85)  # of a beam's length: where it may be cracked
SOFTEST = 3.0  # times as much as all of its beam gives, a crack at most
CRACKED = 0.5  # of the compliances of a rig with a beam are a crack in one


@dataclass(frozen=True, slots=True)
class Draft:
    """One physics at one place.

    values : the numbers at a strength; units of each, in the same order. apply : the setup with
    the effect of these numbers. start : a strength that surely shows little; most : the largest
    that makes sense. least : a strength below which noise-free records, in which no converter
    rounds, do not say how large it is. fixed : it has no size, and is in or not. run : in place of
    apply, for an effect that is another one in each run, by the run's number.
    also : other names that mean the same here, (physics, site). where : the variant, of physics
    that has some.
    """

    physics: str
    site: str
    position: float | None
    units: dict[str, str]
    values: Callable[[float], Numbers]
    apply: Callable[[Setup, Numbers], Setup]
    start: float = 1e-6
    most: float = np.inf
    least: float = 0.0
    fixed: bool = False
    run: Callable[[Setup, Numbers, int], Setup] | None = None
    also: tuple[tuple[str, str], ...] = ()
    where: str = ""

    def put(self, setup: Setup, strength: float) -> Setup:
        """`setup` with the effect at this strength."""
        return self.apply(setup, self.values(strength))

    def put_in(self, setup: Setup, strength: float, run: int) -> Setup:
        """The same for the run of this number."""
        if self.run is None:
            return self.put(setup, strength)
        return self.run(setup, self.values(strength), run)


GIVES = (*JOINTS, *MOTION_SOURCES, "cylinder")  # of an axial chain; the rest of it is rigid


def _port_names(setup: Setup, after: str | None, *, jump: bool = True) -> tuple[str, ...]:
    """Names by which the port behind `after` goes: the parts at both of its sides, and the parts
    without extent next to it.

    jump : whether it is a motion that jumps there. Along an axial chain what gives is the same
    anywhere between two bodies, and what hangs on or holds it anywhere between two that give.
    """
    order = list(setup.parts)
    at = -1 if after is None else [p.name for p in order].index(after)
    names = []
    for way in (range(at, -1, -1), range(at + 1, len(order))):
        for i in way:
            names.append(order[i].name)
            ends = setup.motion == "axial" and (order[i].kind in GIVES) != jump
            if order[i].kind in EXTENDED or ends:
                break
    return tuple(dict.fromkeys(names))


def _hosts(setup: Setup, names: set[str]) -> list[Part]:
    """Links, beams and masses among `names`."""
    hosts = [p for p in setup.parts if p.kind in (*EXTENDED, "lumped_mass") and p.name in names]
    if not hosts:
        raise LookupError("nothing of this chain moves so")
    return hosts


def _ports(setup: Setup, names: set[str]) -> list[tuple[str | None, str]]:
    """(behind which part, its site) where the chain may give: the base, links' and beams' ends and
    the joints that are there already, of the parts `names`."""
    out: list[tuple[str | None, str]] = []
    for i, part in enumerate(setup.parts):
        last = i == len(setup.parts) - 1
        if part.name not in names:
            continue
        if part.kind in (*JOINTS, "cylinder") or (part.kind in EXTENDED and not last):
            out.append((part.name, part.name))
    if setup.base == "clamped" and setup.parts[0].kind == "beam":
        out.append((None, setup.parts[0].name))
    if not out:
        raise LookupError("nothing of this chain can give so")
    return out


def _place(rng: Rng, setup: Setup, names: set[str]) -> tuple[str, float]:
    """A link, beam or mass of `names` at random, and a place on it (m) that moves."""
    hosts = _hosts(setup, names)
    host = hosts[int(rng.integers(len(hosts)))]
    first = host is setup.parts[0]
    return host.name, float(rng.uniform(0.3 if first else 0.0, 1.0)) * host.values.get("L", 0.0)


def at_end(setup: Setup, on: str, x: float) -> tuple[str, ...]:
    """Names of the neighbours that mean the same place, for a place at a link's end."""
    part = setup.part(on)
    if part.kind not in EXTENDED:
        return _port_names(setup, on, jump=False)
    before = [p.name for p in setup.parts][: [p.name for p in setup.parts].index(on)]
    if x >= (1 - NEAR_END) * part.values["L"]:
        return _port_names(setup, on)
    if x <= NEAR_END * part.values["L"]:
        return _port_names(setup, before[-1] if before else None)
    return (on,)


def compliance(rng: Rng, setup: Setup) -> Draft:
    """A clamp or joint that gives in rotation, or a beam between its ends."""
    beams = [p for p in setup.parts if p.kind == "beam" and p.name in setup.turning()]
    if beams and rng.random() < CRACKED:
        return crack(rng, setup, beams[int(rng.integers(len(beams)))])
    ports = _ports(setup, setup.turning())
    after, site = ports[int(rng.integers(len(ports)))]
    loss = float(np.exp(rng.uniform(np.log(3e-4), np.log(8e-3))))  # s, c over k

    def apply(s: Setup, v: Numbers) -> Setup:
        return s.inserted(after, Part(f"gives_{site}", "torsional_spring", v))

    names = _port_names(setup, after)
    return Draft(
        "torsional_compliance", site, None, {"k": "N m/rad", "c": "N m s/rad"},
        lambda x: {"k": 1 / x, "c": loss / x}, apply, 1e-9, 1.0,
        also=tuple(("torsional_compliance", n) for n in names if n != site),
    )  # fmt: skip


def crack(rng: Rng, setup: Setup, beam: Part) -> Draft:
    """A beam that gives in rotation at a place between its ends, clear of its sensors."""
    length = beam.values["L"]
    seen = [s for s in setup.sensors if isinstance(s, Acceleration | Strain) and s.on == beam.name]
    at = length * float(rng.uniform(*WITHIN))
    while any(abs(at - s.position) <= NEAR_SENSOR * length for s in seen):
        at = length * float(rng.uniform(*WITHIN))
    loss = float(np.exp(rng.uniform(np.log(3e-4), np.log(8e-3))))
    own = length / beam.values["EI"]  # rad/(N m), that the beam gives from end to end

    def apply(s: Setup, v: Numbers) -> Setup:
        return s.attached(Attachment("crack", beam.name, at, v))

    return Draft(
        "torsional_compliance", beam.name, at, {"k": "N m/rad", "c": "N m s/rad"},
        lambda x: {"k": 1 / x, "c": loss / x}, apply, 1e-5 * own, SOFTEST * own,
    )  # fmt: skip


def sideways(rng: Rng, setup: Setup) -> Draft:
    """A support that gives sideways, or what gives along an axial chain."""
    ports = _ports(setup, setup.shifting())
    after, site = ports[int(rng.integers(len(ports)))]
    loss = float(np.exp(rng.uniform(np.log(3e-4), np.log(8e-3))))

    def apply(s: Setup, v: Numbers) -> Setup:
        return s.inserted(after, Part(f"slides_{site}", "translational_spring", v))

    names = _port_names(setup, after)
    return Draft(
        "translational_compliance", site, None, {"k": "N/m", "c": "N s/m"},
        lambda x: {"k": 1 / x, "c": loss / x}, apply, 1e-10, 1.0,
        also=tuple(("translational_compliance", n) for n in names if n != site),
    )  # fmt: skip


def _attached(
    physics: str, kind: str, rng: Rng, setup: Setup, units: dict[str, str],
    values: Callable[[float], Numbers], span: tuple[float, float], *, turns: bool = False,
) -> Draft:  # fmt: skip
    """A part somewhere on the chain. span : its strength at the start and at most."""
    on, x = _place(rng, setup, setup.turning() if turns else setup.shifting())
    if turns and setup.part(on).kind == "beam":
        x = setup.part(on).values["L"]  # the moment that it makes jumps there: see ritz.ORDER

    def apply(s: Setup, v: Numbers) -> Setup:
        return s.attached(Attachment(kind, on, x, v))  # type: ignore[arg-type]

    also = tuple((physics, n) for n in at_end(setup, on, x) if n != on)
    return Draft(physics, on, x, units, values, apply, *span, also=also)


def mass(rng: Rng, setup: Setup) -> Draft:
    """A mass somewhere, or too much of it in the rig file."""
    moving = [p.values["m"] for p in setup.parts if p.kind in ("rigid_link", "lumped_mass")]
    draft = _attached(
        "added_mass", "mass", rng, setup, {"m": "kg"}, lambda x: {"m": x}, (1e-7, 0.5 * max(moving))
    )
    host = setup.part(draft.site)
    if host.kind != "rigid_link" or rng.random() < 0.75:
        return draft
    # Taken off at most a third, so that the rest is still a body.
    return replace(draft, values=lambda x: {"m": -x}, most=host.values["m"] / 3)


def inertia(rng: Rng, setup: Setup) -> Draft:
    """Rotary inertia somewhere."""
    return _attached(
        "added_inertia",
        "mass",
        rng,
        setup,
        {"J": "kg m^2"},
        lambda x: {"m": 0.0, "J": x},
        (1e-9, 10.0),
        turns=True,
    )


def brace(rng: Rng, setup: Setup) -> Draft:
    """A spring to ground, against displacement or rotation."""
    loss = float(np.exp(rng.uniform(np.log(3e-4), np.log(1e-2))))
    turn = rng.random() < 0.3 or not setup.shifting()
    turn = turn and bool(setup.turning())
    units = {"k": "N m/rad", "c": "N m s/rad"} if turn else {"k": "N/m", "c": "N s/m"}
    kind = "ground_torsion" if turn else "ground"
    return _attached(
        "ground_spring", kind, rng, setup, units, lambda x: {"k": x, "c": loss * x}, (1e-5, 1e7),
        turns=turn,
    )  # fmt: skip


def gravity(rng: Rng, setup: Setup) -> Draft:
    """The pendulum term of what hangs on a joint, or stands on it."""
    joints = [p.name for p in setup.parts if p.kind == "torsional_spring"]
    on = str(rng.choice(joints))
    sign = 1.0 if rng.random() < 0.6 else -1.0

    def apply(s: Setup, v: Numbers) -> Setup:
        return s.inserted(on, Part(f"gravity_{on}", "gravity_stiffness", {"k": v["k"]}))

    names = _port_names(setup, on)
    return Draft(
        "gravity_stiffness", on, None, {"k": "N m/rad"}, lambda x: {"k": sign * x}, apply, 1e-5,
        0.3 * setup.part(on).values["k"] if sign < 0 else 1e5,
        also=(
            *(("gravity_stiffness", n) for n in names if n != on),
            *(("ground_spring", n) for n in names),
        ),
    )  # fmt: skip


def damping(rng: Rng, setup: Setup) -> Draft:
    """More viscous damping: of a joint, or against the ground."""
    joints = [p.name for p in setup.parts if p.kind in JOINTS]
    if rng.random() < 0.5 and setup.shifting():
        return _attached(
            "viscous_damping", "ground", rng, setup, {"c": "N s/m"},
            lambda x: {"k": 0.0, "c": x}, (1e-5, 1e5),
        )  # fmt: skip
    on = str(rng.choice(joints))

    def apply(s: Setup, v: Numbers) -> Setup:
        return s.with_value(on, "c", s.part(on).values["c"] + v["c"])

    turns = setup.part(on).kind == "torsional_spring"
    return Draft(
        "viscous_damping",
        on,
        None,
        {"c": "N m s/rad" if turns else "N s/m"},
        lambda x: {"c": x},
        apply,
        1e-6,
        10 * max(setup.part(on).values["c"], 1e-3 * setup.part(on).values["k"]),
    )


def loss_factor(rng: Rng, setup: Setup) -> Draft:
    """A beam's loss factor, causal."""
    on = str(rng.choice([p.name for p in setup.parts if p.kind == "beam"]))

    def apply(s: Setup, v: Numbers) -> Setup:
        return s.with_value(on, "eta", s.part(on).values["eta"] + v["eta"])

    return Draft(
        "structural_damping", on, None, {"eta": "1"}, lambda x: {"eta": x}, apply, 1e-7, 0.3
    )


def beam_property(rng: Rng, setup: Setup) -> Draft:
    """The beam's stiffness or density is not as given."""
    on = str(rng.choice([p.name for p in setup.parts if p.kind == "beam"]))
    symbol = str(rng.choice(["EI", "mu"]))
    sign = 1.0 if rng.random() < 0.5 else -1.0

    def apply(s: Setup, v: Numbers) -> Setup:
        ratio = v[f"{symbol}_ratio"]
        return s.with_value(on, symbol, s.part(on).values[symbol] * ratio)

    return Draft(
        "beam_property", on, None, {f"{symbol}_ratio": "1"},
        lambda x: {f"{symbol}_ratio": float(np.exp(sign * x))}, apply, 1e-6, 0.7,
    )  # fmt: skip


def oscillator(rng: Rng, setup: Setup) -> Draft:
    """Something that hangs on and resonates within the band."""
    omega = 2 * np.pi * float(np.exp(rng.uniform(np.log(1.0), np.log(30.0))))
    zeta = float(rng.uniform(0.005, 0.05))
    return _attached(
        "attached_oscillator", "oscillator", rng, setup, {"m": "kg", "k": "N/m", "c": "N s/m"},
        lambda x: {"m": x, "k": x * omega**2, "c": 2 * zeta * omega * x}, (1e-7, 2.0),
    )  # fmt: skip


def drawn_drive(rng: Rng, drives: Sequence[Drive]) -> Drive:
    """One of them; nothing is drawn where there is but one."""
    return drives[0 if len(drives) == 1 else int(rng.integers(len(drives)))]


def turning_drives(setup: Setup) -> list[Drive]:
    """Drives that turn an angle; LookupError where all are forces or torques."""
    turn = {p.name for p in setup.parts if p.kind in ANGLE_SOURCES}
    found = [d for d in setup.drives if turn.intersection(d.sources)]
    if not found:
        raise LookupError("no angular velocity source")
    return found


def _angle_source(rng: Rng, setup: Setup) -> str:
    drive = drawn_drive(rng, turning_drives(setup))
    return next(p.name for p in setup.parts if p.name in drive.sources and p.kind in ANGLE_SOURCES)


def _filtering(physics: str, drive: Drive, units: Mapping[str, str], values: Callable[
    [float], Numbers], most: float) -> Draft:  # fmt: skip
    """A filter in a drive's path."""

    def apply(s: Setup, v: Numbers) -> Setup:
        own = next(d for d in s.drives if d.name == drive.name)
        return s.driven(replace(own, path=(*own.path, Lag(**v))))

    return Draft(
        physics, drive.sources[0], None, dict(units), values, apply, 1e-7, most,
        also=((physics, drive.name),),
    )  # fmt: skip


def _lag(drive: Drive) -> Draft:
    return _filtering("actuator_lag", drive, {"p": "rad/s"}, lambda x: {"p": 1 / x}, 0.1)


def lag(rng: Rng, setup: Setup) -> Draft:
    """A first-order lag of a drive."""
    return _lag(drawn_drive(rng, setup.drives))


def _valve(zeta: float, drive: Drive) -> Draft:
    return _filtering(
        "valve_dynamics", drive, {"omega": "rad/s", "zeta": "1"},
        lambda x: {"omega": 1 / x, "zeta": zeta}, 0.05,
    )  # fmt: skip


def valve(rng: Rng, setup: Setup) -> Draft:
    """A valve of second order."""
    return _valve(float(rng.uniform(0.3, 1.0)), drawn_drive(rng, setup.drives))


def _dead_time(drive: Drive) -> Draft:
    def apply(s: Setup, v: Numbers) -> Setup:
        own = next(d for d in s.drives if d.name == drive.name)
        return s.driven(replace(own, delay=own.delay + v["tau"]))

    return Draft(
        "transport_delay", drive.sources[0], None, {"tau": "s"}, lambda x: {"tau": x}, apply,
        1e-7, 0.02, also=(("transport_delay", drive.name),),
    )  # fmt: skip


def dead_time(rng: Rng, setup: Setup) -> Draft:
    """Dead time in an input's path."""
    return _dead_time(drawn_drive(rng, setup.drives))


def velocity_feedback(rng: Rng, setup: Setup) -> Draft:
    """The drive gives way to the torque: M = g_v (g_a v - theta')."""
    site = _angle_source(rng, setup)

    def apply(s: Setup, v: Numbers) -> Setup:
        return s.inserted(
            site, Part(f"gives_way_{site}", "torsional_spring", {"k": 0.0, "c": v["g_v"]})
        )

    return Draft(
        "velocity_feedback", site, None, {"g_v": "N m s/rad"}, lambda x: {"g_v": 1 / x}, apply,
        1e-9, 0.1, also=tuple(("velocity_feedback", n) for n in _port_names(setup, site)),
    )  # fmt: skip


def oil(rng: Rng, setup: Setup) -> Draft:
    """Compressible oil between valve and vane."""
    D = 1.475e-5  # m^3/rad, the motor of paper 2, section 2
    site = _angle_source(rng, setup)

    def apply(s: Setup, v: Numbers) -> Setup:
        return s.inserted(site, Part(f"oil_{site}", "oil_column", {"D": D, "C_h": v["C_h"]}))

    names = _port_names(setup, site)
    return Draft(
        "hydraulic_compressibility", site, None, {"C_h": "m^3/Pa"},
        lambda x: {"C_h": x * D**2}, apply, 1e-9, 1.0,
        also=(
            *(("hydraulic_compressibility", n) for n in names if n != site),
            *(("torsional_compliance", n) for n in names),
        ),
    )  # fmt: skip


def _sensor(rng: Rng, setup: Setup) -> SensorBase:
    return setup.sensors[int(rng.integers(len(setup.sensors)))]


def changed(setup: Setup, name: str, **update: object) -> Setup:
    """The setup with fields of one sensor changed."""
    return replace(
        setup,
        sensors=tuple(s.model_copy(update=update) if s.name == name else s for s in setup.sensors),
    )


def _sensor_delay(s: SensorBase) -> Draft:
    return Draft(
        "sensor_delay", s.name, None, {"tau": "s"}, lambda x: {"tau": x},
        lambda o, v: changed(o, s.name, delay=s.delay + v["tau"]), 1e-7, 0.02,
    )  # fmt: skip


def _sensor_lag(s: SensorBase) -> Draft:
    return Draft(
        "sensor_lag", s.name, None, {"p": "rad/s"}, lambda x: {"p": 1 / x},
        lambda o, v: changed(o, s.name, lag=1 / v["p"]), 1e-7, 0.05,
    )  # fmt: skip


def sensor_delay(rng: Rng, setup: Setup) -> Draft:
    """A sensor that is late."""
    return _sensor_delay(_sensor(rng, setup))


def sensor_lag(rng: Rng, setup: Setup) -> Draft:
    """A sensor behind a first-order low-pass."""
    s = _sensor(rng, setup)
    if s.lag > 0:
        raise LookupError(f"{s.name} has a lag already")
    return _sensor_lag(s)


def sensor_gain(rng: Rng, setup: Setup) -> Draft:
    """A sensor whose calibration is off."""
    s, sign = _sensor(rng, setup), 1.0 if rng.random() < 0.5 else -1.0
    return Draft(
        "sensor_gain", s.name, None, {"gain": "1"}, lambda x: {"gain": float(np.exp(sign * x))},
        lambda o, v: changed(o, s.name, gain=s.gain * v["gain"]), 1e-6, 0.7,
    )  # fmt: skip


def sensor_highpass(rng: Rng, setup: Setup) -> Draft:
    """A sensor that loses what is slow; the corner is beside the one that the rig file states."""
    free = [s for s in setup.sensors if s.highpass_hz == 0]
    if not free:
        raise LookupError("every sensor has a high-pass already")
    s = free[int(rng.integers(len(free)))]
    return Draft(
        "sensor_highpass", s.name, None, {"corner": "Hz"}, lambda x: {"corner": x},
        lambda o, v: changed(o, s.name, highpass_hz=v["corner"]), 1e-7, 1.0,
    )  # fmt: skip


def tilt(rng: Rng, setup: Setup) -> Draft:
    """An accelerometer that reads gravity as it turns."""
    free = [s.name for s in setup.sensors if isinstance(s, Acceleration) and s.tilt == 0]
    if not free:
        raise LookupError("no accelerometer without tilt")
    name = str(rng.choice(free))
    return Draft(
        "gravity_cross_sensitivity", name, None, {}, lambda x: {},
        lambda o, v: changed(o, name, tilt=1.0), fixed=True,
    )  # fmt: skip


def other_side(rng: Rng, setup: Setup) -> Draft:
    """The encoder sits on the other side of the joint's spring."""
    free = [s for s in setup.sensors if isinstance(s, RelativeAngle) and len(s.across) > 1]
    if not free:
        raise LookupError("no encoder across a source and a spring")
    s = free[int(rng.integers(len(free)))]
    return Draft(
        "noncollocated_encoder", s.name, None, {}, lambda x: {},
        lambda o, v: changed(o, s.name, across=s.across[:1]), fixed=True,
        also=tuple(("noncollocated_encoder", n) for n in s.across),
    )  # fmt: skip


Maker = Callable[[Rng, Setup], Draft]
LINEAR: dict[str, Maker] = {
    "torsional_compliance": compliance,
    "translational_compliance": sideways,
    "added_mass": mass,
    "added_inertia": inertia,
    "ground_spring": brace,
    "gravity_stiffness": gravity,
    "viscous_damping": damping,
    "structural_damping": loss_factor,
    "beam_property": beam_property,
    "attached_oscillator": oscillator,
    "actuator_lag": lag,
    "valve_dynamics": valve,
    "transport_delay": dead_time,
    "velocity_feedback": velocity_feedback,
    "hydraulic_compressibility": oil,
    "sensor_delay": sensor_delay,
    "sensor_lag": sensor_lag,
    "sensor_gain": sensor_gain,
    "sensor_highpass": sensor_highpass,
    "gravity_cross_sensitivity": tilt,
    "noncollocated_encoder": other_side,
}


def lateness(draft: Draft, strength: float) -> float:
    """s by which a lag, a second-order valve or a delay is late at low frequency."""
    v = draft.values(strength)
    if "p" in v:
        return 1 / v["p"]
    return 2 * v["zeta"] / v["omega"] if "omega" in v else v.get("tau", 0.0)


RIVAL_ZETA = 0.7  # of a valve that stands in for something else


def late_rivals(draft: Draft, setup: Setup) -> list[Draft]:
    """Other physics that make the same drive or sensor late."""
    if draft.physics in ("actuator_lag", "valve_dynamics", "transport_delay"):
        drive = next(d for d in setup.drives if draft.site in d.sources)
        late = (_lag(drive), _valve(RIVAL_ZETA, drive), _dead_time(drive))
        return [x for x in late if x.physics != draft.physics]
    if draft.physics in ("sensor_delay", "sensor_lag"):
        s = next(s for s in setup.sensors if s.name == draft.site)
        return [_sensor_lag(s) if draft.physics == "sensor_delay" else _sensor_delay(s)]
    return []
