"""Rig files as text: what the trial changed about the rig that a lab would know of.

The rate, which sensors there are and how coarse their converters are stand in the file that goes
with the recordings; nominal parameters and effects do not.
"""

from __future__ import annotations

import json
from typing import Any

import numpy as np

from samii_rig.rig.load import parse
from samii_rig.rig.schema import Acceleration, AntiAlias, Beam, LumpedMass, Rig, RigidLink

MOST_SENSORS = 6
LEAST_SENSORS = 2
COARSER = (8, 16, 32)  # times the file's resolution: three to five bits fewer


def varied(rng: np.random.Generator, rig: Rig, rate_hz: float, options: tuple[str, ...]) -> Rig:
    """`rig` at another rate, and by `options` with other sensors or coarser converters."""
    sensors: list[Any] = list(rig.sensor)
    if "other_channels" in options:
        sensors = _chosen(rng, rig)
    if "coarse" in options:
        hit = rng.random(len(sensors)) < 0.6
        hit[int(rng.integers(len(sensors)))] = True
        factor = float(rng.choice(COARSER))
        sensors = [
            s.model_copy(update={"resolution": s.resolution * factor}) if h else s
            for s, h in zip(sensors, hit, strict=True)
        ]
    names = {s.name for s in sensors} | {a.name for a in rig.actuator}
    names |= {m.name for m in rig.monitor}
    made = rig.model_copy(
        update={
            "rate_hz": rate_hz,
            "sensor": tuple(sensors),
            "limit": tuple(x for x in rig.limit if x.channel in names),
        }
    )
    return parse(Rig, text(made), rig.name)


def _chosen(rng: np.random.Generator, rig: Rig) -> list[Any]:
    """Two to six sensors, those of the centring among them; new ones are accelerometers."""
    n = int(rng.integers(LEAST_SENSORS, MOST_SENSORS + 1))
    loops = [rig.centring_of(a.name) for a in rig.actuator]
    centring = {loop.sensor for loop in loops if loop} or {rig.sensor[0].name}
    order = [s for s in rig.sensor if s.name in centring]
    others = [s for s in rig.sensor if s.name not in centring]
    keep = order + [others[i] for i in rng.permutation(len(others))][: max(n - len(order), 0)]
    keep.sort(key=[*rig.sensor].index)
    hosts = [
        e for e in rig.element
        if isinstance(e, RigidLink | Beam) or (isinstance(e, LumpedMass) and e.m.value > 0)
    ]  # fmt: skip
    while hosts and len(keep) < n:
        host = hosts[int(rng.integers(len(hosts)))]
        length = host.L.value if isinstance(host, RigidLink | Beam) else 0.0
        at = round(float(rng.uniform(0.2, 1.0)) * length, 4)
        like = next((s for s in rig.sensor if isinstance(s, Acceleration)), _accelerometer())
        keep.append(
            like.model_copy(update={"name": f"a_x{len(keep)}", "on": host.name, "position": at})
        )
    return keep


def _accelerometer() -> Acceleration:
    """A piezoelectric accelerometer as SAMII has them."""
    return Acceleration(
        name="a", kind="acceleration", on="link", position=0.0, unit="m/s^2", noise_rms=0.004,
        resolution=0.0015, low=-50.0, high=50.0, highpass_hz=0.05,
        antialias=AntiAlias(order=4, corner_hz=150.0),
    )  # fmt: skip


def text(rig: Rig) -> str:
    """The rig file of `rig`."""
    data = rig.model_dump(exclude_unset=True)
    # A copy with another value counts as set; what a sensor is must always be said.
    lines, tables = [], []
    for key, value in data.items():
        if isinstance(value, (list, tuple)) and value and isinstance(value[0], dict):
            tables += [f"\n[[{key}]]\n" + _table(row) for row in value]
        elif isinstance(value, dict):
            tables.append(f"\n[{key}]\n" + _table(value))
        elif value not in ((), []):
            lines.append(f"{key} = {_value(value)}\n")
    return "".join(lines) + "".join(tables)


def _table(row: dict[str, Any]) -> str:
    return "".join(f"{k} = {_value(v)}\n" for k, v in row.items() if v is not None)


def _value(x: Any) -> str:
    if isinstance(x, bool):
        return "true" if x else "false"
    if isinstance(x, str):
        return json.dumps(x)  # TOML's basic string has JSON's escapes
    if isinstance(x, dict):
        return "{ " + ", ".join(f"{k} = {_value(v)}" for k, v in x.items() if v is not None) + " }"
    if isinstance(x, (list, tuple)):
        return "[" + ", ".join(_value(v) for v in x) + "]"
    return repr(x)
