"""What a trial conceals, drawn by its seed: parameters, effects, their places and sizes."""

from __future__ import annotations

import copy
import hashlib
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from samii_rig.errors import InputError
from samii_rig.rig.load import parse
from samii_rig.rig.schema import Rig
from samii_rig.rig.schema.elements import parameters
from sim.concealed.effects import ROWS, TABLES, Row, clamp_of, places
from sim.concealed.measure import Errors, draw_errors, reach
from sim.concealed.modes import Poles, poles_of
from sim.concealed.nonlinear import is_body
from sim.concealed.parts import Description, described
from sim.concealed.runs import Design
from sim.concealed.scales import REACH, RIGID, RIGID_SOURCE, UNDAMPED_SOURCE, Concealed, Dose
from sim.concealed.size import Yardstick, response_change, yardstick
from sim.concealed.stated import Stated, as_stated, row_of

Kind = Literal["nothing", "one", "two", "outside", "joints", "stated", "varying"]
KINDS: tuple[Kind, ...] = ("nothing", "one", "two", "outside", "joints", "stated", "varying")
DRAWN = tuple(kind for kind in KINDS if kind != "stated")
SMALLEST_SIGMA, LARGEST = 1.0, 1000.0  # sigma aimed at
LEAST_OF_TWO = 5.0  # of each of two, and of what lies outside
INNOCENT = 0.3  # of the trials have a joint that is as rigid or undamped as the rig file says
WIDEST = 2.5  # standard deviations that a parameter may lie off
LEAST_MULTIPLE = 1e-8
SIZINGS, SIZED = 12, 0.1  # attempts, and the relative error in size that is good enough


@dataclass(frozen=True)
class Drawn:
    """A trial before it is run.

    plant, poles : the truth. nominal_toml : the rig file that the recordings will hold.
    effects : what is concealed, with the multiple and the predicted size of each. yard, believed :
    the measure of the first one, and the poles of the nominal plant at the drawn values; None
    where nothing is concealed. values : the truth's parameters, before any effect changed them.
    """

    kind: Kind
    seed: int
    plant: Description
    poles: Poles
    nominal: Rig
    nominal_toml: str
    design: Design
    errors: Errors
    effects: tuple[Concealed, ...]
    multiples: tuple[float, ...]
    sizes: tuple[float, ...]
    values: dict[str, float]
    yard: Yardstick | None
    believed: Poles | None


@dataclass(frozen=True, slots=True)
class Chosen:
    """An effect before it is put in: what, where, and how much of it if that is stated. reach : of
    `Dose`."""

    row: Row
    site: str
    stated: Stated | None = None
    reach: float = REACH

    def at(self, rig: Rig, plant: Description, design: Design) -> Chosen:
        """The same with how far its place moves in the runs of a design, where that counts."""
        if not self.row.gap:
            return self
        most = reach(rig, plant, design, self.site, ground=is_body(plant, self.site))
        return replace(self, reach=most)

    def put(self, plant: Description, x: float, seed: int) -> Concealed:
        """Change a plant. x, seed : of what is not stated."""
        rng = np.random.default_rng(seed)
        if self.stated is None:
            return self.row.put(plant, self.site, Dose(x, rng, reach=self.reach))
        said = self.stated
        dose = Dose(x, rng, said.parameters, said.where, self.reach, said.position)
        effect = self.row.put(plant, self.site, dose)
        as_stated(self.stated, effect)
        return effect


def trial_id(kind: str, seed: int, stated: Sequence[Stated] = ()) -> str:
    """Name of a trial's folders: says nothing of what is in it."""
    words = " ".join(["concealed", kind, str(seed), *map(repr, stated)])
    return hashlib.sha256(words.encode()).hexdigest()[:12]


def draw(
    kind: Kind, seed: int, rig_toml: str, design: Design, stated: Sequence[Stated] = ()
) -> Drawn:
    """The trial of this seed. Rows of the table follow each other with the seeds, places with
    each round through the rows, so that any range of seeds is spread evenly. `joints` conceals
    that every joint of the rig file gives, each as the file says (the papers' own case). `stated`
    conceals the effects given and nothing else; values of the rig, and noise, are drawn."""
    if kind not in KINDS:
        raise InputError("--kind", "", kind, f"one of {', '.join(KINDS)}")
    if (kind == "stated") != bool(stated):
        raise InputError("effects", "", list(stated), "at least one if, and only if, stated")
    rig = parse(Rig, rig_toml, "rig file")
    rng = np.random.default_rng([KINDS.index(kind), seed])
    base, values = draw_values(rig, rng)
    chosen = [Chosen(row_of(base, s), s.site, s) for s in stated] or _chosen(kind, seed, base, rng)
    innocent = {} if stated else _innocent(rig, base, {c.site for c in chosen}, rng)
    rig_toml = edited(rig_toml, innocent)
    values.update({f"{name}.{symbol}": v for (name, symbol), (v, _) in innocent.items()})
    rig = parse(Rig, rig_toml, "rig file")
    seeds = [int(x) for x in rng.integers(0, 2**31, max(2, len(chosen)))]
    least = SMALLEST_SIGMA if kind == "one" else LEAST_OF_TWO
    span = math.log(least), math.log(LARGEST)
    targets = [math.exp(rng.uniform(*span)) for _ in seeds]
    clean = poles_of(base)
    chosen = [one.at(rig, base, design) for one in chosen]
    errors = draw_errors(rig, clean, design.noise, rng)
    multiples, sizes, sizings = [], [], []
    for one, s, target in zip(chosen, seeds, targets, strict=False):
        sizing = _Sizing(rig, base, one, s, design, errors, clean)
        as_given = kind in ("joints", "stated")
        x, sigma = (1.0, sizing.sigma(1.0)) if as_given else sizing.solve(target)
        multiples.append(x)
        sizes.append(sigma)
        sizings.append(sizing)
    plant, effects = put(base, chosen, seeds, multiples)
    edits = {k: v for e in effects for k, v in e.edits.items()}
    nominal_toml = edited(rig_toml, edits)
    return Drawn(
        kind,
        seed,
        plant,
        poles_of(plant),
        parse(Rig, nominal_toml, "rig file"),
        nominal_toml,
        design,
        errors,
        tuple(effects),
        tuple(multiples),
        tuple(sizes),
        values,
        sizings[0].yard if sizings else None,
        sizings[0].believed if sizings else None,
    )


def put(
    base: Description, chosen: list[Chosen], seeds: list[int], multiples: list[float]
) -> tuple[Description, list[Concealed]]:
    """A copy of a plant with effects in it."""
    plant = copy.deepcopy(base)
    drawn = zip(chosen, seeds, multiples, strict=False)
    return plant, [one.put(plant, x, s) for one, s, x in drawn]


def believed(base: Description, effects: list[Concealed]) -> Description:
    """The plant as the nominal rig file has it, at the drawn values."""
    plant = copy.deepcopy(base)
    for effect in effects:
        for (name, symbol), (value, _) in effect.edits.items():
            plant.part(name).values[symbol] = value
    return plant


def draw_values(rig: Rig, rng: np.random.Generator) -> tuple[Description, dict[str, float]]:
    """The nominal plant with each parameter off by its tolerance: log-normal with the rig
    file's value as median, cut off at 2.5 standard deviations."""
    plant = described(rig)
    values: dict[str, float] = {}
    for element in rig.element:
        for symbol, p in parameters(element).items():
            if p.tolerance <= 0:
                continue
            z = float(np.clip(rng.standard_normal(), -WIDEST, WIDEST))
            value = p.value * math.exp(z * math.sqrt(math.log1p(p.tolerance**2)))
            values[f"{element.name}.{symbol}"] = value
            plant.set_value(element.name, symbol, value)
    return plant, values


def _chosen(kind: Kind, seed: int, plant: Description, rng: np.random.Generator) -> list[Chosen]:
    table = [row for row in TABLES.get(kind, ROWS) if places(plant, row)]

    def at(number: int) -> Chosen:
        row = table[number % len(table)]
        sites = places(plant, row)
        return Chosen(row, sites[(number // len(table)) % len(sites)])

    if kind == "nothing":
        return []
    if kind == "joints":
        row = next(r for r in ROWS if r.physics == "torsional_compliance")
        return [Chosen(row, p.name) for p in plant.parts if p.kind == "torsional_spring"]
    first = at(seed)
    if kind != "two":
        return [first]
    while True:
        other = at(int(rng.integers(0, 60 * len(table))))
        # Two of one physics at one place are one; a joint can be edited only once.
        if other.row.physics != first.row.physics and other.site != first.site:
            return [first, other]


def _innocent(
    rig: Rig, plant: Description, sites: set[str], rng: np.random.Generator
) -> dict[tuple[str, str], tuple[float, str]]:
    """In some trials a joint that the rig file has as rigid or undamped, and that is so: what a
    rig file says must not tell where something is concealed. None that a loop is closed across,
    which its damper keeps stable."""
    order = [p.name for p in plant.parts]
    loops = [
        (drive.element, sensor.across[-1])
        for drive, actuator in zip(plant.drives, rig.actuator, strict=True)
        for sensor in plant.sensors
        if (loop := rig.centring_of(actuator.name)) and loop.sensor == sensor.name
    ]
    closed = [n for a, b in loops for n in order[order.index(a) : order.index(b) + 1]]
    taken = {*sites, clamp_of(plant), *closed}
    joints = [p for p in plant.parts if p.kind == "torsional_spring" and p.name not in taken]
    if not joints or rng.random() >= INNOCENT:
        return {}
    part = joints[int(rng.integers(len(joints)))]
    rigid = rng.random() < 0.5
    edits = {(part.name, "c"): (0.0, RIGID_SOURCE if rigid else UNDAMPED_SOURCE)}
    if rigid:
        edits[part.name, "k"] = (RIGID, RIGID_SOURCE)
    for (_, symbol), (value, _) in edits.items():
        part.values[symbol] = value
    return edits


class _Sizing:
    """Finds the multiple of one effect that makes it so many sigma."""

    def __init__(
        self,
        rig: Rig,
        base: Description,
        chosen: Chosen,
        seed: int,
        design: Design,
        errors: Errors,
        clean: Poles,
    ) -> None:
        self.base, self.chosen, self.seed, self.row = base, [chosen], seed, chosen.row
        _, effects = put(base, self.chosen, [seed], [1.0])
        nominal = believed(base, effects)
        self.believed = poles = poles_of(nominal) if effects[0].edits else clean
        fixed = {key for e in effects for key in e.edits}
        self.yard: Yardstick = yardstick(_exact(rig, fixed), design, nominal, poles, errors)
        self.nominal = poles.response(self.yard.f)

    def sigma(self, x: float) -> float:
        """Size at a multiple."""
        plant, _ = put(self.base, self.chosen, [self.seed], [x])
        change = response_change(self.yard, poles_of(plant), self.nominal, plant)
        return self.yard(change)

    def solve(self, target: float) -> tuple[float, float]:
        """(multiple, sigma), as near to the target as the row can come."""
        if self.row.fixed:
            return 1.0, self.sigma(1.0)
        low, high = LEAST_MULTIPLE, self.row.most
        x = 0.1 * high
        sigma = self.sigma(x)
        for _ in range(SIZINGS):
            if abs(math.log(max(sigma, 1e-12) / target)) < SIZED:
                break
            low, high = (x, high) if sigma < target else (low, x)
            if high / low < 1.001:
                break
            # Most sizes grow with the multiple; where one does not, halve what is left.
            x_next = x * target / max(sigma, 1e-12)
            x = x_next if low < x_next < high else math.sqrt(low * high)
            if sigma < target and high == self.row.most and x_next >= high:
                x = high
            sigma = self.sigma(x)
            if x == self.row.most and sigma < target:
                break
        return x, sigma


def _exact(rig: Rig, keys: set[tuple[str, str]]) -> Rig:
    """The rig with these parameters taken for exact."""
    elements = []
    for e in rig.element:
        changed = {
            symbol: p.model_copy(update={"tolerance": 0.0})
            for symbol, p in parameters(e).items()
            if (e.name, symbol) in keys
        }
        elements.append(e.model_copy(update=changed))
    return rig.model_copy(update={"element": tuple(elements)})


def edited(rig_toml: str, edits: dict[tuple[str, str], tuple[float, str]]) -> str:
    """A rig file's text with some parameters replaced by exact values."""
    text = rig_toml
    for (name, symbol), (value, source) in edits.items():
        head = re.search(rf'\[\[element\]\]\s+name = "{name}"\n', text)
        line = re.compile(rf"^{symbol} = \{{.*unit = (\"[^\"]*\").*\}}$", re.MULTILINE)
        found = line.search(text, head.end()) if head else None
        if found is None:
            raise InputError("rig file", f"element.{name}.{symbol}", "", "a line of its own")
        new = f'{symbol} = {{ value = {value!r}, unit = {found[1]}, source = "{source}" }}'
        text = text[: found.start()] + new + text[found.end() :]
    return text


def scaled(design: Design, by: float) -> Design:
    """The design with all levels turned down."""
    return replace(design, levels=tuple(level * by for level in design.levels))
