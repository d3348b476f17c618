"""The columns of a device's outputs: references and commands."""

from __future__ import annotations

from samii_rig.errors import InputError
from samii_rig.rig.schema import ActuatorSpec, Rig
from samii_rig.types import Channel


def reference_names(rig: Rig, actuator: str) -> tuple[str, str]:
    """Columns of u and theta_ref of one actuator: these names where it is the rig's only one,
    else with its own name behind them, `u_v_2` and `theta_ref_v_2`."""
    if len(rig.actuator) == 1:
        return "u", "theta_ref"
    return f"u_{actuator}", f"theta_ref_{actuator}"


def centring_name(rig: Rig, actuator: str) -> str:
    """The sensor that theta_ref of an actuator means: that of its loop, else the rig's first."""
    loop = rig.centring_of(actuator)
    return loop.sensor if loop else rig.sensor[0].name


def reference_channels(rig: Rig) -> tuple[Channel, ...]:
    """u and theta_ref of each actuator, in the rig file's order; InputError where a channel of the
    rig file has such a name."""
    units = rig.units()
    made: list[Channel] = []
    for spec in rig.actuator:
        centring = centring_name(rig, spec.name)
        u, ref = reference_names(rig, spec.name)
        for name in (u, ref):
            if name in units:
                raise InputError(rig.name, "name", name, "another; the references have this name")
        drives = "the excitation" if len(rig.actuator) == 1 else f"the excitation of {spec.name}"
        made += [
            Channel(u, spec.unit, "reference", description=f"reference of {drives}"),
            Channel(ref, units[centring], "reference", description=f"reference of {centring}"),
        ]
    return tuple(made)


def command_channel(spec: ActuatorSpec, step: float, description: str) -> Channel:
    """The command of an actuator. step : in which it is known. description : how."""
    return Channel(spec.name, spec.unit, "command", spec.low, spec.high, step, description)
