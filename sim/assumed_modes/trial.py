"""One trial: a rig with nominal parameters drawn within their tolerances and effects concealed.

make("one", 7, Path("trials"), rig_toml)      # trials/one_7/*.mcap, trials/truth/one_7.json
"""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from samii_rig.errors import InputError, SamiiRigError
from samii_rig.rig.load import parse
from samii_rig.rig.schema import Rig
from samii_rig.types import Float
from sim.assumed_modes import effects as table
from sim.assumed_modes import ground, record, rigfile, styles
from sim.assumed_modes.effects import Draft
from sim.assumed_modes.forces import FORCES, Swing
from sim.assumed_modes.noise import Noise, noise_model, unit_effect, whitener
from sim.assumed_modes.outside import OUTSIDE
from sim.assumed_modes.parts import (
    ANGLE_SOURCES,
    EXTENDED,
    JOINTS,
    Force,
    Nominal,
    Setup,
    nominal,
    setup_of,
)
from sim.assumed_modes.plant import Push, UnphysicalError, plant
from sim.assumed_modes.ritz import first_hz
from sim.assumed_modes.sampled import Loop, closed, discrete, impulse, timeline
from sim.assumed_modes.sigma import FURTHEST, STEP, Bench, Left, Records, Refit, Waveform, convolved
from sim.assumed_modes.simulate import Control, recorded
from sim.assumed_modes.size import LEAST, MOST, SIZE_CLOSE, records, records_by_run, solve
from sim.assumed_modes.styles import Style
from sim.assumed_modes.varying import BETWEEN, VARYING

KINDS = ("nothing", "one", "two", "outside", "force", "varying")
POOLS = {"outside": OUTSIDE, "varying": VARYING}  # what is drawn by itself
FARTHEST = 2.5  # tolerances that a nominal parameter is drawn from the file's value at most
SMALLEST = 0.2  # of the file's value: no damping is drawn to nothing
FORCED_TRIES = 40  # effects drawn until one has a size
# Of that lateness, for a difference: a filter that is much faster than the rest of the rig costs
# digits, so not smaller.
RIVAL_STEP = 1e-2
RIVAL = 30.0  # times the lateness of what it stands in for: a rival's strength, 1 sigma
LOSSY = 0.01  # s, damping over stiffness of a joint that had none, at most, in a refit
OTHER_SPAN = 10.0  # times its strength: that of the other effect in a refit, 1 sigma
OTHER_STEP = 1e-2  # of its strength, for a difference
OTHER = 3.0  # nepers by which a joint's stiffness and damping may move in a refit, 1 sigma

Rng = np.random.Generator


@dataclass(frozen=True, slots=True)
class Concealed:
    """An effect with its strength, the sigma asked for and what a refit leaves."""

    draft: Draft
    strength: float
    target: float
    alone: Left


@dataclass(frozen=True, slots=True)
class Scene:
    """A trial before its effects."""

    rig: Rig
    rig_toml: str
    style: Style
    setup: Setup
    nominal: Nominal
    drawn: Float
    control: Control
    level: float
    noise: Noise
    bench: Bench

    def built(self, offsets: Float) -> Setup:
        """The setup with nominal parameters moved from the truth by `offsets` tolerances, in the
        logarithm: none changes its sign."""
        moved = np.exp(np.array(self.nominal.tolerance) * offsets)
        return _built(self.rig, self.nominal, self.drawn, moved)


def make(kind: str, seed: int, out: Path, rig_toml: str, style: tuple[str, ...] = ()) -> Path:
    """Make the trial `kind`, `seed` of the rig `rig_toml` (text of a rig file).

    Recordings and the rig file go to `out`/KIND_SEED, the truth to `out`/truth/KIND_SEED.json.
    style : names of `styles.EXCITATIONS` and `styles.OPTIONS` that must hold, `clean` for none of
    the latter. Returns the folder of the recordings.

    Raises InputError for an unknown kind or style or a rig this plant cannot simulate.
    """
    if kind not in KINDS:
        raise InputError("make", "kind", kind, f"one of {', '.join(KINDS)}")
    rig = parse(Rig, rig_toml, "rig file")
    known: tuple[str, ...] = (*styles.EXCITATIONS, *styles.OPTIONS, "clean")
    if len(rig.actuator) > 1:
        known = (*(x for x in known if x not in styles.OF_ONE_INPUT), *styles.SEVERAL)
    for name in style:
        if name not in known:
            raise InputError("make", "style", name, f"one of {', '.join(known)}")
    folder = out / f"{kind}_{seed}"
    if folder.exists():
        raise InputError(str(folder), "", "there already", "a trial that was not made yet")
    made = conceal(kind, seed, rig, style)
    scene, rngs = made.scene, made.rngs
    folder.mkdir(parents=True)
    (folder / "rig.toml").write_text(scene.rig_toml, encoding="utf-8")
    faults = [
        file_of(folder, i, scene, made.found, rngs[3], rngs[4])
        for i in range(len(scene.style.files))
    ]
    truth = out / "truth"
    truth.mkdir(exist_ok=True)
    text = json.dumps(made.truth(faults, rivals=True), indent=1)
    (truth / f"{kind}_{seed}.json").write_text(text + "\n", encoding="utf-8")
    return folder


@dataclass(frozen=True, slots=True)
class Conceals:
    """A trial before it is recorded. rngs : of the scene, its disturbances, the effects, the
    records and the one who logs them, in this order."""

    kind: str
    seed: int
    scene: Scene
    refit: Refit | None
    found: list[Concealed]
    rngs: list[Rng]

    def truth(self, faults: list[record.Faults], *, rivals: bool = False) -> dict[str, Any]:
        """The truth as plain data. rivals : with what else may be late."""
        return _truth(self, faults, rivals=rivals)


def conceal(
    kind: str,
    seed: int,
    rig: Rig,
    style: tuple[str, ...] = (),
    *,
    seconds: float = np.inf,
    close: float = SIZE_CLOSE,
) -> Conceals:
    """Draw a trial of a rig. seconds : of records, at most; close : ratio of a size to the drawn
    one that is near enough.

    Raises SamiiRigError where no effect has a size.
    """
    rngs = [np.random.default_rng([seed, KINDS.index(kind), k]) for k in range(5)]
    beyond = str(rngs[2].choice(list(POOLS[kind]))) if kind in POOLS else ""
    runs = beyond == BETWEEN
    scene = scene_of(rngs[0], rngs[1], rig, style, runs=runs, seconds=seconds)
    refit = None if kind == "nothing" else nominal_refit(scene)
    found: list[Concealed] = []
    if refit is not None:
        found = _concealed(rngs[2], Wanted(kind, beyond, close), scene, refit)
    return Conceals(kind, seed, scene, refit, found, rngs)


def _built(rig: Rig, about: Nominal, drawn: Float, moved: Float) -> Setup:
    """The rig with its nominal parameters `drawn` tolerances off the file's, times `moved`."""
    values = {
        key: float(value * (1.0 + tolerance * x) * m)
        for key, value, tolerance, x, m in zip(
            about.keys, about.value, about.tolerance, drawn, moved, strict=True
        )
    }
    return setup_of(rig, values)


def scene_of(
    rng: Rng,
    disturb: Rng,
    rig: Rig,
    forced: tuple[str, ...],
    *,
    runs: bool = False,
    seconds: float = np.inf,
) -> Scene:
    """A rig with its nominal parameters, style and noise drawn."""
    # The torque tests are of the band below their resonance; a bench that slides is driven to it.
    first = first_hz(setup_of(rig, {})) if rig.motion == "axial" else 0.0
    about_rig = styles.About(rig.rate_hz, first, seconds, len(rig.actuator))
    style = styles.draw(rng, forced, about_rig, runs=runs)
    measured = "measured" in style.options
    shown = style.rate_hz / style.every if measured else style.rate_hz
    rig = rigfile.varied(rng, rig, shown, style.options)
    about = nominal(rig)
    drawn = np.array([_offset(rng, tolerance) for tolerance in about.tolerance])
    setup = _built(rig, about, drawn, np.ones(len(drawn)))
    closed_loops = "open_loop" not in style.options
    control = Control(feedback_of(rig) * float(closed_loops), style.rate_hz)
    level = _level(rng, rig, setup, style, control)
    noise = _noise(disturb, setup, style, control)
    loop = _loop(setup, control, noise.pushes)
    longest = max(len(p.r) for f in style.files for p in f)
    response = whitener(noise_model(loop, noise, style.rate_hz), style.every).response(
        -(-longest // style.every)
    )
    hum = noise.hum_hz if np.any(noise.hum) else 0.0
    waveforms = _waveforms(style, level, runs=runs)
    bench = Bench(style.rate_hz, style.every, control.feedback, waveforms, response, hum)
    return Scene(rig, rigfile.text(rig), style, setup, about, drawn, control, level, noise, bench)


def feedback_of(rig: Rig) -> Float:
    """(n_in, n_y) gains of the rig file's loops: v = r - feedback y."""
    names = [s.name for s in rig.sensor]
    gains = np.zeros((len(rig.actuator), len(names)))
    for row, actuator in zip(gains, rig.actuator, strict=True):
        loop = rig.centring_of(actuator.name)
        if loop is not None:
            row[names.index(loop.sensor)] = loop.kp
    return gains


def _offset(rng: Rng, tolerance: float) -> float:
    while True:
        x = float(rng.standard_normal())
        if abs(x) <= FARTHEST and 1.0 + tolerance * x >= SMALLEST:
            return x


def _loop(setup: Setup, control: Control, pushes: tuple[Push, ...] = ()) -> Loop:
    made = plant(setup, pushes)
    line = timeline(setup, made, control.rate_hz)
    return closed(discrete(made, line), control.feedback)


def _waveforms(style: Style, level: float, *, runs: bool = False) -> tuple[Waveform, ...]:
    """The different references of a style, each with its levels; repeats only count, unless each
    of the `runs` is one for itself."""
    pieces = [p for f in style.files for p in f]
    if runs:
        return tuple(Waveform(p.r, (level * p.level,), 1) for p in pieces)
    out = []
    for r in {id(p.r): p.r for p in pieces}.values():
        own = [level * p.level for p in pieces if p.r is r]
        levels = tuple(dict.fromkeys(own))
        out.append(Waveform(r, levels, len(own) // len(levels)))
    return tuple(out)


def _level(rng: Rng, rig: Rig, setup: Setup, style: Style, control: Control) -> float:
    """Amplitude at which the limit that is met first is used by 10 to 90 %."""
    waveforms = _waveforms(style, 1.0)
    bench = Bench(style.rate_hz, 1, control.feedback, waveforms, np.zeros((1, 1, 1)))
    most = np.inf
    limits = {x.channel: x.max for x in rig.limit}
    for w, y in zip(waveforms, bench.linear(setup), strict=True):
        v = w.r - y @ control.feedback.T
        for name, column in [
            *((a.name, v[:, i]) for i, a in enumerate(rig.actuator)),
            *((s.name, y[:, i]) for i, s in enumerate(rig.sensor)),
        ]:
            s = next(s for s in (*rig.sensor, *rig.actuator) if s.name == name)
            limit = min(limits.get(name, np.inf), -s.low, s.high)
            most = min(most, limit / max(float(np.abs(column).max()), 1e-12))
    return float(most * np.exp(rng.uniform(np.log(0.1), np.log(0.9))))


def _noise(rng: Rng, setup: Setup, style: Style, control: Control) -> Noise:
    sensors = setup.sensors
    n_y = len(sensors)
    white = np.array([s.noise_rms for s in sensors]) * rng.uniform(0.8, 1.5, n_y)
    rounding = np.array([s.resolution for s in sensors]) / np.sqrt(12.0)
    floor = np.hypot(white, rounding)
    pushes = _pushes(rng, setup)
    corner = np.exp(rng.uniform(np.log(1.0), np.log(40.0), len(pushes)))
    effect = unit_effect(_loop(setup, control, pushes), corner, style.rate_hz)
    # What nothing of this rig answers to disturbs nothing, as a floor under what only turns.
    felt = np.flatnonzero((effect > 0).any(axis=0))
    pushes, corner, effect = tuple(pushes[i] for i in felt), corner[felt], effect[:, felt]
    share = np.exp(rng.uniform(np.log(0.3), np.log(3.0), len(pushes)))
    rms = share / np.sqrt(max(1, len(pushes))) / (effect / floor[:, None]).max(axis=0)
    has = {name: float(name in style.options) for name in ("wander", "hum", "spikes")}
    draws = rng.uniform(2.0, 10.0, n_y), rng.uniform(0.0, 5.0, n_y), rng.uniform(10.0, 60.0, n_y)
    return Noise(
        pushes, rms, corner, white, rounding,
        wander=has["wander"] * draws[0] * floor,
        wander_hz=float(np.exp(rng.uniform(np.log(0.01), np.log(0.1)))),
        offset=rng.standard_normal(n_y) * 10.0 * floor + np.array([s.offset for s in sensors]),
        hum=has["hum"] * draws[1] * floor,
        hum_hz=float(rng.choice([50.0, 60.0])),
        hum_phase=rng.uniform(0.0, 2 * np.pi, n_y),
        spikes=has["spikes"] * float(rng.uniform(0.05, 0.5)),
        spike=draws[2] * floor,
    )  # fmt: skip


def _pushes(rng: Rng, setup: Setup) -> tuple[Push, ...]:
    """One to three disturbances at places where they make sense."""
    joints = [p.name for p in setup.parts if p.kind in JOINTS]
    hosts = [p for p in setup.parts if p.kind in (*EXTENDED, "lumped_mass")]
    hosts = [p for p in hosts if p.name in setup.shifting()] or hosts
    host = hosts[int(rng.integers(len(hosts)))]
    valve = Push("valve", table.drawn_drive(rng, setup.drives).name)
    choice = [
        Push("joint", str(rng.choice(joints))) if joints else valve,
        Push("w", host.name, host.values.get("L", 0.0) * float(rng.uniform(0.5, 1.0))),
        Push("floor"),
        valve,
    ]
    order = rng.permutation(len(choice))[: int(rng.integers(1, 4))]
    return tuple(choice[i] for i in sorted(order))


def _swing(scene: Scene) -> Swing:
    """What the nominal rig's joints, sources and bodies do at the largest level."""
    joints = [p.name for p in scene.setup.parts if p.kind in JOINTS]
    angles = {p.name for p in scene.setup.parts if p.kind in ANGLE_SOURCES}
    drives = [d.name for d in scene.setup.drives]
    turned = [d.name for d in scene.setup.drives if angles.intersection(d.sources)]
    bodies = ground.bodies(scene.setup)
    probes = [Force("probe", name, {}) for name in (*joints, *turned)]
    probes += [Force("probe", name, {}, ground=True) for name in bodies]
    made = plant(replace(scene.setup, forces=tuple(probes)))
    c = scene.control
    loop = closed(discrete(made, timeline(scene.setup, made, c.rate_hz)), c.feedback)
    rows = np.zeros((len(probes), len(loop.A)))
    rows[:, : made.Z.shape[1]] = made.Z[::2]
    # Beside the laws' places the commands, v = r - feedback y.
    rows = np.vstack([rows, -c.feedback @ loop.C])
    commands = slice(len(probes), None)
    peak = np.zeros(len(rows))
    for w in scene.bench.waveforms:
        moved = convolved(impulse(loop.A, loop.b, rows, len(w.r)), w.r)
        # Rows act on the state after r.
        moved[1:, commands] = moved[:-1, commands] + w.r[1:]
        peak = np.maximum(peak, max(w.levels) * np.abs(moved).max(axis=0))
    each, n, m = peak.tolist(), len(joints), len(joints) + len(turned)
    return Swing(
        dict(zip(joints, each[:n], strict=True)),
        dict(zip(turned, each[n:m], strict=True)),
        dict(zip(drives, each[commands], strict=True)),
        dict(zip(bodies, each[m : len(probes)], strict=True)),
    )


def nominal_refit(scene: Scene) -> Refit:
    """The refit of the rig file's nominal parameters."""
    own = np.array(scene.nominal.tolerance)
    return Refit(scene.bench, scene.built, STEP / own, FURTHEST / own)


@dataclass(frozen=True, slots=True)
class Wanted:
    """The kind of a trial, its physics outside the table ("" for none), and how close to a drawn
    size it has to come, as a ratio."""

    kind: str
    beyond: str
    close: float


def _concealed(rng: Rng, wish: Wanted, scene: Scene, refit: Refit) -> list[Concealed]:
    wanted = 2 if wish.kind == "two" else 1
    names = (*(table.LINEAR if wish.kind != "force" else ()), *FORCES)
    swing = _swing(scene)
    found: list[Concealed] = []
    for _ in range(FORCED_TRIES):
        target = float(np.exp(rng.uniform(np.log(LEAST), np.log(MOST))))
        draft = _draft(rng, names, wish.beyond, scene, swing)
        if draft is None or any(_clash(f.draft, draft) for f in found):
            continue
        one = _solved(scene, refit, draft, target, wish.close)
        if one is not None:
            found.append(one)
        if len(found) == wanted:
            return found
    raise SamiiRigError(f"{FORCED_TRIES} effects drawn and none of {wanted} had a size")


def _clash(one: Draft, other: Draft) -> bool:
    """Whether two effects cannot be told apart by their names, or are two forces: the sigma of one
    beside the other is found from linear records."""
    forces = (one.physics in FORCES) + (other.physics in FORCES)
    if one.site == other.site:
        return one.physics == other.physics or forces > 0
    return forces == 2


def _draft(
    rng: Rng, names: tuple[str, ...], beyond: str, scene: Scene, swing: Swing
) -> Draft | None:
    if beyond:
        return {**OUTSIDE, **VARYING}[beyond](rng, scene.setup, swing)
    name = str(rng.choice(names))
    try:
        if name in FORCES:
            return FORCES[name](rng, scene.setup, swing)
        return table.LINEAR[name](rng, scene.setup)
    except (LookupError, ValueError):
        return None  # this rig has no place for it


def _solved(
    scene: Scene, refit: Refit, draft: Draft, target: float, close: float
) -> Concealed | None:
    def of(strength: float) -> Records:
        return _records_of(scene, draft, strength)

    try:
        got = solve(refit, draft, of, target, close)
    except UnphysicalError:
        return None
    if got is None or got[0] < draft.least:
        return None
    return Concealed(draft, got[0], target, got[1])


def _records_of(scene: Scene, draft: Draft, strength: float) -> Records:
    """Records without noise, with an effect of this strength."""
    if draft.run is not None:
        runs = range(len(scene.bench.waveforms))
        return records_by_run(scene.bench, [draft.put_in(scene.setup, strength, i) for i in runs])
    return records(scene.bench, scene.control, draft.put(scene.setup, strength))


def _beside(scene: Scene, refit: Refit, effect: Concealed, others: list[Concealed]) -> Left:
    """What a refit leaves of `effect` where the others' strengths are free as well.

    A force is no part of the linear records that are refitted, so it does not stand beside; what
    has no strength is there.
    """
    others = [o for o in others if o.draft.physics not in FORCES]
    if not others:
        return effect.alone
    n = refit.n
    free = [o for o in others if not o.draft.fixed]

    def build(offsets: Float) -> Setup:
        setup = scene.built(offsets[:n])
        for other in others:
            if other.draft.fixed:
                setup = other.draft.put(setup, other.strength)
        for x, other in zip(offsets[n:], free, strict=True):
            setup = other.draft.put(setup, OTHER_SPAN * x * other.strength) if x > 0 else setup
        return setup

    more = np.ones(len(free))
    step = np.concatenate([refit.step, OTHER_STEP / OTHER_SPAN * more])
    reach = np.concatenate([refit.reach, 2.0 * more])
    known = refit if len(free) == len(others) else None
    both = scene.setup
    for one in (*others, effect):
        both = one.draft.put(both, one.strength)
    start = np.concatenate([effect.alone.moved, more / OTHER_SPAN])
    rows = records(scene.bench, scene.control, both)
    return Refit(scene.bench, build, step, reach, known).left(rows, start)


def _rivals(scene: Scene, refit: Refit | None, effect: Concealed) -> list[dict[str, Any]]:
    """The other late physics of the same site, each with the sigma that it leaves of this one, its
    strength and the nominal parameters refitted: below a few sigma no data tell them apart."""
    if refit is None:
        return []
    draft, n, out = effect.draft, refit.n, []
    late = table.lateness(draft, effect.strength)
    for rival in table.late_rivals(draft, scene.setup):
        unit = late / table.lateness(rival, 1.0)

        def build(offsets: Float, rival: Draft = rival, unit: float = unit) -> Setup:
            setup = scene.built(offsets[:n])
            return rival.put(setup, RIVAL * unit * offsets[n]) if offsets[n] > 0 else setup

        more = Refit(
            scene.bench,
            build,
            np.append(refit.step, RIVAL_STEP / RIVAL),
            np.append(refit.reach, 1.0),
            refit,
        )
        rows = records(scene.bench, scene.control, draft.put(scene.setup, effect.strength))
        start = np.append(np.zeros(n), 1.0 / RIVAL)
        left = min((more.left(rows, x) for x in (start, 0.0 * start)), key=lambda x: x.sigma)
        out.append({"physics": rival.physics, "site": rival.site, "sigma": left.sigma})
    return out


def logged(i: int, scene: Scene, found: list[Concealed], rng: Rng, logger: Rng) -> record.Log:
    """Record i of a style, with the effects `found`."""
    style, setup = scene.style, scene.setup
    for effect in found:
        setup = effect.draft.put_in(setup, effect.strength, i)
    pieces = style.files[i]
    drives = [d.name for d in setup.drives]
    u, segments = record.reference(pieces, scene.level, style, drives)
    y, v = recorded(setup, scene.control, scene.noise, u, rng)
    values = record.columns(scene.rig, style, u, v, y, logger)
    return record.Log(values, segments, record.draw_faults(logger, style, len(values)))


def save(folder: Path, i: int, scene: Scene, log: record.Log) -> None:
    """Write record i of a scene."""
    path = folder / f"run_{i + 1:02d}.mcap"
    record.write(path, scene.rig, scene.rig_toml, scene.style, _loops(scene), log)


def _loops(scene: Scene) -> list[tuple[str, float]]:
    """Sensor and kp of each loop of the rig file; 0 where it is left open."""
    names = [s.name for s in scene.rig.sensor]
    found = []
    for row, actuator in zip(scene.control.feedback, scene.rig.actuator, strict=True):
        loop = scene.rig.centring_of(actuator.name)
        if loop is not None:
            found.append((loop.sensor, float(row[names.index(loop.sensor)])))
    return found


def file_of(
    folder: Path, i: int, scene: Scene, found: list[Concealed], rng: Rng, logger: Rng
) -> record.Faults:
    """Record file i of a style, with the effects `found`."""
    one = logged(i, scene, found, rng, logger)
    save(folder, i, scene, one)
    return one.faults


def _mimicked(scene: Scene, refit: Refit, effect: Concealed) -> Left:
    """What a refit leaves of physics outside the table where stiffness and damping of its joint are
    free as well: the nearest that is within the table."""
    on, n = effect.draft.site, refit.n

    def build(offsets: Float) -> Setup:
        setup = scene.built(offsets[:n])
        own = setup.part(on).values
        for symbol, x in zip(("k", "c"), offsets[n:], strict=True):
            # A joint without damping may have that of a hundredth of its stiffness at 1 rad/s.
            most = max(own[symbol], LOSSY * own["k"]) if symbol == "c" else own[symbol]
            moved = own[symbol] * float(np.exp(OTHER * x)) if own[symbol] else most * abs(x)
            setup = setup.with_value(on, symbol, moved)
        return setup

    step = np.concatenate([refit.step, [STEP / OTHER] * 2])
    reach = np.concatenate([refit.reach, [2.0, 2.0]])
    more = Refit(scene.bench, build, step, reach, refit)
    rows = _records_of(scene, effect.draft, effect.strength)
    return more.left(rows, np.append(effect.alone.moved, [0.0, 0.0]))


def _truth(made: Conceals, faults: list[record.Faults], *, rivals: bool) -> dict[str, Any]:
    kind, seed, scene, refit, found = made.kind, made.seed, made.scene, made.refit, made.found
    style, about = scene.style, scene.nominal
    names = [f"{e}.{s}" for e, s in about.keys]
    effects = []
    for effect in found:
        others = [o for o in found if o is not effect]
        left = effect.alone if refit is None else _beside(scene, refit, effect, others)
        if kind in POOLS and refit is not None:
            left = min(left, _mimicked(scene, refit, effect), key=lambda x: x.data)
        draft, numbers = effect.draft, effect.draft.values(effect.strength)
        effects.append(
            {
                "physics": draft.physics,
                "site": draft.site,
                "position": draft.position,
                "where": draft.where,
                "parameters": {
                    name: {"value": numbers[name], "unit": unit}
                    for name, unit in draft.units.items()
                },
                "also": [{"physics": p, "site": s} for p, s in draft.also],
                "sigma": left.sigma,
                "sigma_data": left.data,
                "sigma_alone": effect.alone.sigma,
                "sigma_drawn": effect.target,
                "rivals": _rivals(scene, refit, effect) if rivals else [],
                "moved": dict(zip(names, left.moved.tolist(), strict=False)),
            }
        )
    noise = asdict(scene.noise)
    return {
        "kind": kind,
        "seed": seed,
        "rig": scene.rig.name,
        "effects": effects,
        "nominal": [
            {
                "parameter": name, "file": value, "tolerance": tolerance, "unit": unit,
                "offset_in_tolerances": float(x), "drawn": value * (1 + tolerance * float(x)),
            }
            for name, value, tolerance, unit, x in zip(
                names, about.value, about.tolerance, about.units, scene.drawn, strict=True
            )
        ],
        "style": {
            **{k: v for k, v in asdict(replace(style, files=())).items() if k != "files"},
            "samples": [sum(len(p.r) for p in f) // style.every for f in style.files],
            "level": scene.level,
            "loops": _loops(scene),
            "faults": [asdict(f) for f in faults],
        },
        "noise": {k: v.tolist() if isinstance(v, np.ndarray) else v for k, v in noise.items()},
    }  # fmt: skip
