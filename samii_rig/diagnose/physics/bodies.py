"""Effects in what the chain is made of: dampers of its joints, masses on its links, its beams."""

from __future__ import annotations

import math
from collections.abc import Iterator
from functools import partial

import numpy as np

from samii_rig.diagnose.physics import insert
from samii_rig.diagnose.physics.along import Along, stretches
from samii_rig.diagnose.physics.effect import Effect, Jump, Key, Unknown, Values
from samii_rig.diagnose.physics.fractional import Joint
from samii_rig.diagnose.physics.points import ON_LINK
from samii_rig.diagnose.physics.scales import PAIRS, RANGE, STARTS, Places, middle, spread
from samii_rig.rig.schema import (
    ANGLE_SOURCES,
    BEAMS,
    LINES,
    Rig,
    RigidLink,
    Rod,
    TorsionalSpring,
    TranslationalSpring,
)
from samii_rig.types import Float

# Of a fractional damper: nearer 0 it is the spring that the joint has, nearer 1 its damper.
POWER = (0.1, 0.9)
POWERS = (0.2, 0.35, 0.5, 0.7)  # at which a search starts
COMPLIANCES = (1e-4, 0.01, 1.0)  # of a line's oil over the chain's own, at which a search starts
# No material's loss is the same at all frequencies: relaxation makes it wander by some per cent.
LOSS_WANDERS = 0.05
# Of a beam's stiffness or density to the file's; farther off it is another beam.
BEAM_RATIO = (0.2, 5.0)
# At which a search starts: not 1 in the middle, where all ratios are one effect, none.
BEAM_RATIOS = (0.5, 0.75, 1.35, 1.0, 2.0)
DAMPED = (1e-7, 1e3)  # loss angle of a joint's spring with a damper, from invisible to gross


def effects(rig: Rig, where: Places) -> Iterator[Effect]:
    """All of them on this rig."""
    yield from _joint_dampers(rig, where)
    yield from _lines(rig, where)
    yield from _links(rig, where)
    yield from _beams(rig, where)


def _joint_dampers(rig: Rig, where: Places) -> Iterator[Effect]:
    """A damper beside a spring that the chain has: c of the rig file and more."""
    w = middle(where)
    for e in rig.element:
        if not isinstance(e, TorsionalSpring | TranslationalSpring):
            continue
        key = (e.name, "c")
        port = next(i for i, n in enumerate(where.names) if n[-1] == e.name)
        pair = PAIRS.index(("theta", "M") if isinstance(e, TorsionalSpring) else ("w", "V"))
        x = where.strength(pair, port)
        if not 0 < x < math.inf:
            continue
        scale = max(e.k.value, 1 / x * 1e-2) / w

        def values(x: Float, nominal: Values, key: Key = key) -> dict[Key, float]:
            return {key: nominal[key] + float(x[0])}

        bounds = DAMPED[0] * scale, DAMPED[1] * scale
        yield Effect(
            physics="viscous_damping",
            site=e.name,
            unknowns=(Unknown("c", e.c.unit, *bounds, spread(*bounds, 11)),),
            parameters=values,
            touches=(key,),
            jump=Jump(f"beside {e.name}", lambda s, x: np.asarray(s * x[:, :1])),
            variant="beside the spring",
        )
        yield _fractional(e, tuple(w * c for c in bounds), w)


def _fractional(
    spring: TorsionalSpring | TranslationalSpring, forces: tuple[float, ...], w: float
) -> Effect:
    """A damper c s^alpha beside a spring. Its unknowns are its force over motion at w rad/s, in
    the bounds of `forces`, and alpha: with c itself the two would hardly be distinguished."""
    low, high = forces
    joint = Joint(spring.name, math.sqrt(low * high) / w)
    unit = spring.k.unit.replace("/", " s^alpha/")

    def reported(x: Float) -> Float:
        return np.array([x[0] / w ** x[1], x[1]])

    def values(x: Float, _: Values) -> dict[Key, float]:
        return dict(zip(joint.keys, reported(x).tolist(), strict=True))

    def write(rig: Rig, x: Float) -> Rig:
        c, alpha = reported(x)
        remark = (
            f"Found beside this rig, which has no element for it: a fractional damper at "
            f"{spring.name}, {c:.4g} {unit} with alpha = {alpha:.3g}."
        )
        return rig.model_copy(update={"description": f"{rig.description} {remark}".strip()})

    return Effect(
        physics="fractional_damping",
        site=spring.name,
        unknowns=(
            Unknown("c", unit, low, high, spread(low, high, 11)),
            Unknown("alpha", "1", *POWER, POWERS),
        ),
        parameters=values,
        fractional=joint,
        jump=Jump(
            f"beside {spring.name}", lambda s, x: np.asarray(x[:, :1] * (s / w) ** x[:, 1:2])
        ),
        report=reported,
        write=write,
    )


def _lines(rig: Rig, where: Places) -> Iterator[Effect]:
    """Oil between valve and vane that has to be moved too: a resonance of its compliance, in the
    flow that arrives and in what gives way to the load."""
    low_w, high_w = (2 * math.pi * float(where.frequency[i]) for i in (0, -1))
    have = {e.source for e in rig.element if isinstance(e, LINES)}
    for e in rig.element:
        if not isinstance(e, ANGLE_SOURCES) or e.name in have:
            continue
        port = next(i for i, n in enumerate(where.names) if n[-1] == e.name)
        x = where.strength(PAIRS.index(("theta", "M")), port)
        if not 0 < x < math.inf:
            continue
        name = f"{insert.PREFIX}line_{port}"
        scale = insert.DISPLACEMENT**2 * x  # C_h/D^2 is the compliance
        bounds = scale / RANGE[1], scale / RANGE[0]

        def values(x: Float, _: Values, name: str = name) -> dict[Key, float]:
            C_h, omega, zeta = (float(v) for v in x)
            found = {"D": insert.DISPLACEMENT, "C_h": C_h, "omega": omega, "zeta": zeta}
            return {(name, symbol): value for symbol, value in found.items()}

        yield Effect(
            physics="hydraulic_compressibility",
            site=e.name,
            unknowns=(
                Unknown("C_h", insert.VOLUME, *bounds, tuple(scale * part for part in COMPLIANCES)),
                Unknown("omega", "rad/s", low_w, 100 * high_w, spread(low_w, 30 * high_w, 6)),
                Unknown("zeta", "1", 0.01, 3.0, (0.15,)),
            ),
            build=partial(insert.line, source=e.name, name=name),
            parameters=values,
            variant="line",
        )


def _links(rig: Rig, where: Places) -> Iterator[Effect]:
    """A mass somewhere on a rigid link: the link's own m, r and I change."""
    w = middle(where)
    for port, e in enumerate(rig.element):
        if not isinstance(e, RigidLink) or e.L.value == 0 or e.m.value == 0:
            continue
        x = where.strength(PAIRS.index(("V", "w")), port + 1)
        if not 0 < x < math.inf:
            continue
        (stretch,) = stretches(rig, e)
        keys = tuple((e.name, s) for s in ("m", "r", "I"))

        def values(
            x: Float, nominal: Values, keys: tuple[Key, ...] = keys, stretch: Along = stretch
        ) -> dict[Key, float]:
            m, r, inertia = (nominal[k] for k in keys)
            more, at = float(x[0]), stretch.position(float(x[1]))
            total = m + more
            centre = (m * r + more * at) / total
            own = inertia + m * (r - centre) ** 2 + more * (at - centre) ** 2
            return dict(zip(keys, (total, centre, own), strict=True))

        def report(x: Float, stretch: Along = stretch) -> Float:
            return np.array([x[0], stretch.position(float(x[1]))])

        scale = x / w**2
        bounds = scale / RANGE[1], scale / RANGE[0]
        yield Effect(
            physics="added_mass",
            site=e.name,
            unknowns=(
                Unknown("m", "kg", *bounds, spread(*bounds, STARTS)),
                stretch.unknown(ON_LINK),
            ),
            parameters=values,
            touches=keys,
            jump=Jump(
                f"V by w {stretch.place()}",
                lambda s, x: np.asarray(s**2 * x[:, :1]),
                ("V", "w"),
                fixed=1,
            ),
            report=report,
            variant="along the link",
        )


def _beams(rig: Rig, where: Places) -> Iterator[Effect]:
    for e in rig.element:
        if isinstance(e, Rod):
            yield from _properties(e.name, ("EA", "mu"))
        if not isinstance(e, BEAMS):
            continue
        eta = (e.name, "eta")

        def lossy(x: Float, nominal: Values, key: Key = eta) -> dict[Key, float]:
            return {key: nominal[key] + float(x[0])}

        yield Effect(
            physics="structural_damping",
            site=e.name,
            unknowns=(Unknown("eta", "1", 1e-5, 1.0, (1e-3, 1e-2, 0.1)),),
            parameters=lossy,
            touches=(eta,),
            causal=(e.name, middle(where) / (2 * math.pi)),
            rough=LOSS_WANDERS,
        )
        yield from _properties(e.name, ("EI", "mu"))


def _properties(name: str, symbols: tuple[str, ...]) -> Iterator[Effect]:
    """A beam or rod that is not of the stated stiffness or mass."""
    for symbol in symbols:
        key = (name, symbol)

        def scaled(x: Float, nominal: Values, key: Key = key) -> dict[Key, float]:
            return {key: nominal[key] * float(x[0])}

        yield Effect(
            physics="beam_property",
            site=name,
            unknowns=(Unknown(f"{symbol} ratio", "1", *BEAM_RATIO, BEAM_RATIOS, ratio=True),),
            parameters=scaled,
            touches=(key,),
            variant=symbol,
        )
